"""Calibration and accuracy that aircraft write into XMP: numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from make_images import DJI_XMP, gps_tags, write_image

from aeromatch_cli.blocks.calibration import calibrated_camera, position_sigmas_m
from aeromatch_cli.blocks.cameras import FOCAL_SIGMAS, cameras_from_exif, focal_from_exif_px
from aeromatch_cli.blocks.exif import ExifFacts, read_exif
from aeromatch_cli.blocks.observations import observation_of_exif
from aeromatch_cli.geometry.cameras import distort, focal_px, parameters, pixels_of_rays

DEWARP = "2021-03-04;3678.87,3671.84,10.10,27.29,-0.26,0.11,0.0001,-0.0002,-0.03"


def test_dewarp_data_of_the_full_picture() -> None:
    camera = calibrated_camera({"drone-dji:DewarpData": DEWARP}, 5472, 3648)
    assert camera is not None
    found = parameters(camera)
    assert (found["fx"], found["fy"]) == (3678.87, 3671.84)
    assert (found["cx"], found["cy"]) == (pytest.approx(2735.5 + 10.10), pytest.approx(1823.5 + 27.29))
    assert (found["p1"], found["p2"]) == (0.0001, -0.0002)
    assert (found["k1"], found["k2"], found["k3"]) == (-0.26, 0.11, -0.03)
    # u = 0.5, v = 0: r2 = 0.25; the radial factor is 1 - 0.065 + 0.006875 - 0.00046875 = 0.94140625.
    x = 2735.5 + 10.10 + 3678.87 * (0.5 * 0.94140625 + 3 * -0.0002 * 0.25)
    y = 1823.5 + 27.29 + 3671.84 * 0.0001 * 0.25
    np.testing.assert_allclose(pixels_of_rays(camera, np.array([[0.5, 0.0]])), [[x, y]], atol=1e-9)


def test_reduced_picture_gets_the_reduced_calibration() -> None:
    xmp = {"drone-dji:DewarpData": DEWARP, "drone-dji:CalibratedOpticalCenterX": "2736.0"}
    half, full = calibrated_camera(xmp, 2736, 1824), calibrated_camera(xmp, 5472, 3648)
    assert half is not None
    assert full is not None
    assert focal_px(half) == pytest.approx(focal_px(full) / 2.0)
    place = np.array([[100.0, 50.0]])
    # Pixel centres: (x + 0.5) / 2 - 0.5.
    assert distort(half, (place + 0.5) / 2.0 - 0.5) == pytest.approx((distort(full, place) + 0.5) / 2.0 - 0.5, abs=1e-6)


def test_dewarped_picture_has_no_distortion() -> None:
    camera = calibrated_camera({"drone-dji:DewarpData": DEWARP, "drone-dji:DewarpFlag": "1"}, 5472, 3648)
    assert camera is not None
    assert camera.model == "PINHOLE"


@pytest.mark.parametrize("text", ["", "2021;1,2,3", "x;" + ",".join(["nan"] * 9), "2021;1,1,0,0,0,0,0,0,0", "a;b,c"])
def test_unusable_dewarp_data_is_passed_over(text: str) -> None:
    assert calibrated_camera({"drone-dji:DewarpData": text}, 5472, 3648) is None


def test_calibrated_focal_length_alone() -> None:
    xmp = {"drone-dji:CalibratedFocalLength": "3666.67", "drone-dji:CalibratedOpticalCenterX": "2736"}
    camera = calibrated_camera(xmp, 2736, 1824)
    assert camera is not None
    assert focal_px(camera) == pytest.approx(1833.335)


def test_rtk_accuracy_is_the_position_s_sigma() -> None:
    xmp = {"drone-dji:RtkStdLon": "0.0112", "drone-dji:RtkStdLat": "0.0131", "drone-dji:RtkStdHgt": "0.0291"}
    assert position_sigmas_m(xmp) == ((0.02, 0.02, 0.0291), "")
    assert position_sigmas_m(dict.fromkeys(xmp, "0.004")) == ((0.02, 0.02, 0.02), "")
    assert position_sigmas_m(dict.fromkeys(xmp, "0")) == (None, "")
    assert position_sigmas_m({}) == (None, "")


@pytest.mark.parametrize(
    ("flag", "sigmas_m", "said"),
    [
        ("50", (0.02, 0.03, 0.7), ""),
        ("34", (0.5, 0.5, 0.7), "no fixed RTK solution"),
        ("16", None, "no RTK solution"),
        ("0", None, "no RTK solution"),
    ],
)
def test_what_a_receiver_without_a_fix_states_is_not_believed(flag: str, sigmas_m: tuple | None, said: str) -> None:
    xmp = {"RtkStdLon": "0.01", "RtkStdLat": "0.03", "RtkStdHgt": "0.7", "RtkFlag": flag}
    found, remark = position_sigmas_m({f"drone-dji:{name}": value for name, value in xmp.items()})
    assert found == sigmas_m
    assert remark.startswith(said)
    assert bool(remark) == bool(said)


def test_an_image_file_is_read_with_both(tmp_path: Path) -> None:
    more = 'drone-dji:DewarpData="2021;60,60,1,1,0,0,0,0,0" drone-dji:RtkStdLon="0.05" drone-dji:RtkStdLat="0.05" '
    xmp = DJI_XMP.format(yaw="1", pitch="-90", roll="0", relative="40").replace(
        "drone-dji:GimbalYaw", more + 'drone-dji:RtkStdHgt="0.1" drone-dji:GimbalYaw'
    )
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp, gps=gps_tags(46.0, 7.0, 500.0)))
    assert focal_from_exif_px(facts) == (60.0, "XMP calibration")
    observation = observation_of_exif(facts, "auto")
    assert observation is not None
    assert observation.sigmas_m == (0.05, 0.05, 0.1)
    found = cameras_from_exif({"a.jpg": facts}, {})
    assert set(found.focal_sigmas.values()) == {FOCAL_SIGMAS["XMP calibration"]}


def test_focal_plane_resolution_of_the_original_gives_way_to_the_35_mm_equivalent() -> None:
    facts = ExifFacts(
        2000, 1500, focal_mm=4.0, focal_35mm_mm=24.0, focal_plane_px_per_mm=700.0, focal_plane_confirmed=True
    )
    focal, source = focal_from_exif_px(facts)
    assert source == "35-mm equivalent"
    assert focal == pytest.approx(24.0 / 43.267 * 2500)
    (warning,) = cameras_from_exif({"a.jpg": facts, "b.jpg": facts}, {}).warnings
    assert "2 of 2 images states two focal lengths (a.jpg: 2800 px by focal-plane resolution, 1387 px" in warning
