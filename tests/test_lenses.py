"""Lenses of other programs: exact where our models have them, else the nearest camera and how far it is off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.lenses import remark
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import (
    BROWN,
    FISHEYE,
    MODELS,
    as_brown,
    colmap_camera,
    from_colmap,
    normalise,
    pixels_of_rays,
)
from aeromatch_cli.geometry.lenses import Nearest, brown, fisheye, in_colmap, in_colmaps_mappers, nearest_of, of_colmap

SIZE = (4000, 3000)
FOCAL = (3000.0, 3010.0)
MIDDLE = (2010.0, 1490.0)


def pixels(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Corner-origin pixels (N, 2) of normalised coordinates (N, 2)."""
    return pixels_of_rays(camera, rays) + 0.5


def rays_of_picture() -> np.ndarray:
    grid = np.meshgrid(np.linspace(-0.6, 0.6, 13), np.linspace(-0.45, 0.45, 11))
    return np.column_stack([axis.ravel() for axis in grid])


def test_what_our_models_have_is_taken_as_it_is() -> None:
    lens = brown(SIZE, FOCAL, MIDDLE, (-0.05, 0.01), (1e-4, 2e-4))
    assert lens == Nearest(from_colmap("OPENCV", *SIZE, (*FOCAL, *MIDDLE, -0.05, 0.01, 1e-4, 2e-4)))
    assert remark(lens, "camera") == ""
    lens = brown(SIZE, FOCAL, MIDDLE, (-0.05, 0.01, 0.002, 0.0), (1e-4, 2e-4), 0.8)
    params = (3010.0, *MIDDLE, -0.05, 0.01, 0.002, 1e-4, 2e-4, -10.0, 0.8)  # f = fy, b1 = fx - fy
    assert lens == Nearest(from_colmap(BROWN, *SIZE, params))
    lens = fisheye(SIZE, FOCAL, MIDDLE, (-0.01, 0.002))
    assert lens == Nearest(from_colmap(FISHEYE, *SIZE, (*FOCAL, *MIDDLE, -0.01, 0.002, 0.0, 0.0)))


def test_a_fourth_radial_term_is_approached_and_said() -> None:
    """By the formula of Metashape's manual, worked here by hand."""
    radial, (p1, p2), skew = (-0.09, -0.05, 0.06, -0.03), (1e-4, -2e-4), 0.8
    lens = brown(SIZE, FOCAL, MIDDLE, radial, (p1, p2), skew)
    assert lens.camera is not None
    rays = rays_of_picture()
    u, v = rays.T
    r2 = u**2 + v**2
    factor = 1 + sum(k * r2**n for n, k in enumerate(radial, 1))
    x = u * factor + 2 * p1 * u * v + p2 * (r2 + 2 * u**2)
    y = v * factor + 2 * p2 * u * v + p1 * (r2 + 2 * v**2)
    true = np.column_stack([FOCAL[0] * x + skew * y + MIDDLE[0], FOCAL[1] * y + MIDDLE[1]])
    off = np.linalg.norm(pixels(lens.camera, rays) - true, axis=1)
    assert 0.1 < lens.worst_px < 1.0
    assert off.max() < 1.1 * lens.worst_px
    assert lens.misfit_px < 0.2
    assert f"{lens.worst_px:.2f} px at most" in remark(lens, "camera")
    # Cutting the term off is what this is for: far worse.
    cut = brown(SIZE, FOCAL, MIDDLE, radial[:3], (p1, p2), skew).camera
    assert cut is not None
    assert np.linalg.norm(pixels(cut, rays) - true, axis=1).max() > 4.0 * off.max()


def test_a_decentred_fisheye_is_approached() -> None:
    lens = fisheye(SIZE, (1500.0, 1500.0), (2000.0, 1500.0), (-0.01, 0.002), (2e-4, -1e-4))
    assert lens.camera is not None
    assert lens.camera.model == FISHEYE
    assert 0.1 < lens.worst_px < 5.0
    # tan(angle) = 1 to the right: the angle is pi / 4, and decentring adds 3 p2 angle^2.
    angle = np.pi / 4
    true = 2000.0 + 1500.0 * (angle * (1 - 0.01 * angle**2 + 0.002 * angle**4) - 3e-4 * angle**2)
    np.testing.assert_allclose(pixels(lens.camera, np.array([[1.0, 0.0]]))[0, 0], true, atol=lens.worst_px)


def test_colmaps_larger_models_in_a_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("7 FULL_OPENCV 4000 3000 3000 3000 2000 1500 -0.1 0.02 1e-4 2e-4 0.05 0 0 0\n")
    found = read_camera_file(path)
    params = (3000.0, 1999.5, 1499.5, -0.1, 0.02, 0.05, 1e-4, 2e-4, 0.0, 0.0)
    assert found.cameras["7"] == Camera(BROWN, *SIZE, params)
    assert not found.remarks
    path.write_text("7 FULL_OPENCV 4000 3000 3000 3000 2000 1500 -0.1 0.02 0 0 0.05 0.1 0.02 0.01\n")
    found = read_camera_file(path)
    assert found.remarks[0].startswith("cameras.txt, camera 7: its lens model is read as the nearest BROWN camera, ")
    # u = 0.5: r2 = 0.25, (1 - 0.025 + 0.00125 + 0.00078125) / (1 + 0.025 + 0.00125 + 0.00015625) = 0.951895.
    true = 1999.5 + 3000.0 * 0.5 * 0.97703125 / 1.02640625
    np.testing.assert_allclose(pixels_of_rays(found.cameras["7"], np.array([[0.5, 0.0]])), [[true, 1499.5]], atol=0.2)
    path.write_text("8 OPENCV_FISHEYE 4000 3000 1300 1310 2000 1500 -0.01 0.002 0.001 -0.0005\n")
    found = read_camera_file(path)
    assert found.cameras["8"] == Camera(FISHEYE, *SIZE, (1300, 1310, 1999.5, 1499.5, -0.01, 0.002, 0.001, -0.0005))
    assert not found.remarks
    same = of_colmap("OPENCV", 4000, 3000, (3000.0, 3000.0, 2000.0, 1500.0, -0.1, 0.02, 0.0, 0.0))
    assert same == Nearest(from_colmap("OPENCV", 4000, 3000, (3000, 3000, 2000, 1500, -0.1, 0.02, 0, 0)))
    with pytest.raises(ValueError, match="not supported"):
        of_colmap("FOV", 4000, 3000, (1.0,))


FULL = Camera(BROWN, *SIZE, (3000.0, 2009.5, 1489.5, -0.09, 0.05, -0.02, 1e-3, -7e-4, 6.0, 1.5))


def test_the_nearest_camera_without_some_parameters() -> None:
    assert nearest_of(FULL, MODELS[BROWN]) == Nearest(FULL)
    found = in_colmap(FULL)
    assert found.camera is not None
    # b2 alone moves the upper and the lower border by 1.5 * 0.5 px.
    assert 0.1 < found.misfit_px < found.worst_px < 0.8
    assert found.camera.params[-1] == 0.0
    corners = np.array([[-0.5, -0.5], [3999.5, 2999.5]])
    off = np.linalg.norm(pixels_of_rays(found.camera, normalise(FULL, corners)) - corners, axis=1)
    assert off.max() <= found.worst_px + 1e-9
    # A camera that needs no other parameters is that one.
    simple = from_colmap("RADIAL", *SIZE, (3000.0, 2000.0, 1500.0, -0.1, 0.02))
    assert nearest_of(simple, ("f", "k1", "k2")) == Nearest(as_brown(simple))
    assert in_colmap(simple) == Nearest(simple)


def test_mappers_of_colmap_get_no_terms_that_divide() -> None:
    found = in_colmaps_mappers(FULL)
    assert found.camera is not None
    assert colmap_camera(found.camera)[0] == "OPENCV"
    # At the corner k3 moves by 3000 * 0.02 * r^7 = 13 px, most of which k1 and k2 take over.
    assert 0.1 < found.misfit_px < found.worst_px < 2.0
    simple = from_colmap("OPENCV", *SIZE, (3000.0, 3010.0, 2000.0, 1500.0, -0.1, 0.02, 1e-3, 0.0))
    fisheye_lens = Camera(FISHEYE, *SIZE, (1300.0, 1300.0, 1999.5, 1499.5, 0.01, 0.0, 0.001, 0.0))
    assert in_colmaps_mappers(simple) == Nearest(simple)
    assert in_colmaps_mappers(fisheye_lens) == Nearest(fisheye_lens)


def test_a_strong_fisheye_is_far_from_other_models_and_says_so() -> None:
    strong = Camera(FISHEYE, *SIZE, (1300.0, 1300.0, 1999.5, 1499.5, 0.0, 0.0, 0.0, 0.0))
    found = nearest_of(strong, MODELS[BROWN])
    assert found.camera is not None
    assert found.differs
    assert found.worst_px > 5.0
    mild = Camera(FISHEYE, *SIZE, (4000.0, 4000.0, 1999.5, 1499.5, 0.0, 0.0, 0.0, 0.0))
    assert nearest_of(mild, MODELS[BROWN]).worst_px < 0.1


METASHAPE = """<document version='2.0.0'><chunk><sensors><sensor id='0'><calibration class='adjusted' type='{kind}'>
<resolution width='4000' height='3000'/><f>3000</f><cx>10</cx><cy>-5</cy><b1>3</b1><b2>0.5</b2><k1>-0.09</k1>
<k2>-0.05</k2><k3>0.09</k3><k4>-0.06</k4><p1>1e-4</p1><p2>2e-4</p2></calibration></sensor></sensors><cameras>
<camera id='0' sensor_id='0' label='A'><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk>
</document>"""


def test_metashapes_further_terms_count_and_other_types_are_named(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text(METASHAPE.format(kind="frame"))
    found = read_pose_file(path)
    camera = found.cameras[found.rows[0].camera]
    expected = brown(SIZE, (3003.0, 3000.0), (2010.0, 1495.0), (-0.09, -0.05, 0.09, -0.06), (2e-4, 1e-4), 0.5)
    assert expected.worst_px > 0.1
    assert camera == expected.camera
    assert found.warnings == (remark(expected, "cameras.xml, camera sensor0"),)
    path.write_text(METASHAPE.format(kind="fisheye"))
    found = read_pose_file(path)
    assert found.cameras[found.rows[0].camera].model == FISHEYE
    path.write_text(METASHAPE.format(kind="spherical"))
    found = read_pose_file(path)
    assert not found.cameras
    assert "it is not used" in found.warnings[0]


MICMAC = """<ExportAPERO><OrientationConique>{internal}<Externe><Centre>1 2 3</Centre><ParamRotation><CodageMatr>
<L1>1 0 0</L1><L2>0 -1 0</L2><L3>0 0 -1</L3></CodageMatr></ParamRotation></Externe><ConvOri><KnownConv>
eConvApero_DistM2C</KnownConv></ConvOri></OrientationConique></ExportAPERO>"""
CALIBRATION = """<CalibrationInternConique><KnownConv>{sense}</KnownConv><PP>2009.5 1489.5</PP><F>3000</F>
<SzIm>4000 3000</SzIm><CalibDistortion><ModRad><CDist>{center}</CDist><CoeffDist>-1e-8</CoeffDist>
<CoeffDist>1e-16</CoeffDist></ModRad></CalibDistortion></CalibrationInternConique>"""


@pytest.mark.parametrize("center", ["2009.5 1489.5", "2030 1470"])
def test_micmacs_calibration_is_found_beside(tmp_path: Path, center: str) -> None:
    """r (1 - 1e-8 r^2 + 1e-16 r^4) about CDist, in pixels: 900 px from it, 7.23 px less."""
    ori = tmp_path / "Ori-x"
    ori.mkdir()
    internal = "<FileInterne>Ori-x/AutoCal_1.xml</FileInterne>"
    (ori / "Orientation-a.jpg.xml").write_text(MICMAC.format(internal=internal))
    calibration = CALIBRATION.format(center=center, sense="eConvApero_DistM2C")
    (ori / "AutoCal_1.xml").write_text(f"<ExportAPERO>{calibration}</ExportAPERO>")
    found = read_pose_file(ori)
    camera = found.cameras[found.rows[0].camera]
    middle = np.array(center.split(), float)
    right = np.array([[1.0, 0.0]])
    measured = middle + (900.0 - 1e-8 * 900.0**3 + 1e-16 * 900.0**5) * right
    ideal = (middle + 900.0 * right - [2009.5, 1489.5]) / 3000.0
    np.testing.assert_allclose(normalise(camera, measured), ideal, atol=1e-5)
    (ori / "AutoCal_1.xml").write_text(CALIBRATION.format(center=center, sense="eConvApero_DistC2M"))
    assert not read_pose_file(ori).cameras
    (ori / "AutoCal_1.xml").unlink()
    assert not read_pose_file(ori).warnings


def test_pix4ds_cameras_come_along(tmp_path: Path) -> None:
    head = "fileName imageWidth imageHeight\n" + "x\n" * 3 + "camera position t [3x1]\n" + "x\n" * 2 + "\n"
    one = "3000 0 2010\n0 3010 1490\n0 0 1\n-0.05 0.01 0\n1e-4 2e-4\n1 2 3\n1 0 0\n0 -1 0\n0 0 -1\n"
    path = tmp_path / "p_calibrated_camera_parameters.txt"
    path.write_text(head + f"a.jpg 4000 3000\n{one}b.jpg 4000 3000\n{one}")
    found = read_pose_file(path)
    assert [row.camera for row in found.rows] == ["camera0", "camera0"]
    assert found.cameras["camera0"] == from_colmap("OPENCV", *SIZE, (*FOCAL, *MIDDLE, -0.05, 0.01, 1e-4, 2e-4))
