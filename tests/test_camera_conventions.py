"""Camera parameters of other programs: one ray, projected by hand, by each program's own formula and by ours.

The formulas stand here a second time, from each program's documentation or source (docs/cameras.md), and take the
numbers of the files that are read or written. p1 and p2 differ in sign and size: exchanged, they move the point by 2
px.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_export_colmap import make_truth

from aeromatch_cli.blocks.calibration import calibrated_camera
from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import BROWN, FISHEYE, pixels_of_rays
from aeromatch_cli.strategies.exporters import EXPORTERS, ExportContents, PairContents
from aeromatch_cli.strategies.exporters.contents import ExportSummary

WIDTH, HEIGHT = 1000, 750
RAY = (0.4, 0.2)
K1, K2, K3, P1, P2, B1, B2 = -0.1, 0.05, -0.02, 0.002, -0.005, 2.0, 0.5
F, CX, CY = 900.0, 509.5, 369.5
# By hand: r2 = 0.2, radial = 1 - 0.02 + 0.002 - 0.00016 = 0.98184;
# xd = 0.4 * 0.98184 + 2 * 0.002 * 0.08 - 0.005 * (0.2 + 2 * 0.16) = 0.390456,
# yd = 0.2 * 0.98184 + 0.002 * (0.2 + 2 * 0.04) - 2 * 0.005 * 0.08 = 0.196128.
XD, YD = 0.390456, 0.196128
# x = 509.5 + 902 * 0.390456 + 0.5 * 0.196128, y = 369.5 + 900 * 0.196128; without b2; without b1 and b2.
WHOLE, WITHOUT_B2, PLAIN = (861.789376, 546.0152), (861.691312, 546.0152), (860.9104, 546.0152)
# The fisheye by hand: tan(angle) = sqrt(0.2); with f = 600, 606 and the terms below.
TERMS = (-0.02, 0.006, -0.003, 0.0005)
ANGLE = math.atan(math.sqrt(0.2))  # 0.420534
FISH_XD = 0.4 * ANGLE * (1 - 0.02 * ANGLE**2 + 0.006 * ANGLE**4 - 0.003 * ANGLE**6 + 0.0005 * ANGLE**8) / math.sqrt(0.2)
FISH = (CX + 600.0 * FISH_XD, CY + 606.0 * FISH_XD / 2.0)
FISH_SQUARE = (FISH[0], CY + 600.0 * FISH_XD / 2.0)


def block_camera(b1: float = B1, b2: float = B2, **others: float) -> Camera:
    values = {"f": F, "cx": CX, "cy": CY, "k1": K1, "k2": K2, "k3": K3, "p1": P1, "p2": P2, "b1": b1, "b2": b2}
    return Camera(BROWN, WIDTH, HEIGHT, tuple((values | others).values()))


def fisheye_camera(fy: float = 606.0) -> Camera:
    return Camera(FISHEYE, WIDTH, HEIGHT, (600.0, fy, CX, CY, *TERMS))


def check(camera: Camera, expected: tuple[float, float], atol: float = 1e-6) -> None:
    assert (camera.width_px, camera.height_px) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(pixels_of_rays(camera, np.array([RAY]))[0], expected, rtol=0, atol=atol)


def test_our_own_models_by_hand() -> None:
    check(block_camera(), WHOLE)
    check(block_camera(b2=0.0), WITHOUT_B2)
    check(block_camera(b1=0.0, b2=0.0), PLAIN)
    check(fisheye_camera(), FISH)
    exchanged = block_camera(p1=P2, p2=P1)
    assert np.linalg.norm(pixels_of_rays(exchanged, np.array([RAY]))[0] - WHOLE) > 2.0


# --- readers: files as the programs write them, the numbers named by their own words ---------------------------------


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def of_poses(path: Path) -> Camera:
    found = read_pose_file(path)
    assert not found.warnings
    return found.cameras[found.rows[0].camera]


IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
METASHAPE = (
    "<document version='2.0.0'><chunk><sensors><sensor id='0'><calibration class='adjusted' type='{kind}'><resolution "
    f"width='{WIDTH}' height='{HEIGHT}'/>{{values}}</calibration></sensor></sensors><cameras><camera id='0' "
    f"sensor_id='0' label='A'><transform>{IDENTITY}</transform></camera></cameras></chunk></document>"
)


def tags(**values: float) -> str:
    return "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items())


# Metashape counts cx, cy from the middle of the picture, 509.5 + 0.5 - 500, and its P1 goes with r2 + 2 x2.
METASHAPE_VALUES = tags(f=F, cx=10.0, cy=-5.0, b1=B1, b2=B2, k1=K1, k2=K2, k3=K3, p1=P2, p2=P1)


def test_metashape_is_read(tmp_path: Path) -> None:
    """Manual, appendix C: x' = x (1 + K1 r2 + ...) + P1 (r2 + 2 x2) + 2 P2 x y; u = w / 2 + cx + x' f + x' B1 + y' B2.

    Its fisheye does the same with x and y of length atan(r).
    """
    check(of_poses(write(tmp_path / "c.xml", METASHAPE.format(kind="frame", values=METASHAPE_VALUES))), WHOLE)
    values = tags(f=606.0, cx=10.0, cy=-5.0, b1=-6.0, **dict(zip(("k1", "k2", "k3", "k4"), TERMS, strict=True)))
    check(of_poses(write(tmp_path / "f.xml", METASHAPE.format(kind="fisheye", values=values))), FISH)


def test_metashapes_calibration_is_a_camera_file(tmp_path: Path) -> None:
    size = f"<projection>frame</projection><width>{WIDTH}</width><height>{HEIGHT}</height>"
    text = f"<?xml version='1.0'?><calibration>{size}{METASHAPE_VALUES}<date>2026-01-01</date></calibration>"
    found = read_camera_file(write(tmp_path / "lens.xml", text))
    check(found.cameras["lens"], WHOLE)
    for wrong, said in (("<other/>", "its root is other"), (f"<calibration>{size}</calibration>", "f is missing")):
        with pytest.raises(ConfigError, match=said):
            read_camera_file(write(tmp_path / "wrong.xml", wrong))


BLOCKS = (
    "<BlocksExchange version='3.2'><Block><Photogroups><Photogroup>{lens}<Photo><Id>0</Id><ImagePath>A.jpg</ImagePath>"
    "<Pose><Center><x>1</x><y>2</y><z>3</z></Center></Pose></Photo></Photogroup></Photogroups></Block></BlocksExchange>"
)


def test_blocks_exchange_is_read(tmp_path: Path) -> None:
    """Bentley: P1 goes with r2 + 2 u2 and P2 with 2 u v; the principal point from the middle of the first pixel."""
    lens = (
        f"<ImageDimensions>{tags(Width=WIDTH, Height=HEIGHT)}</ImageDimensions><CameraModelType>Perspective"
        f"</CameraModelType>{tags(FocalLengthPixels=F + B1, AspectRatio=F / (F + B1), Skew=B2)}"
        f"<PrincipalPoint>{tags(x=CX, y=CY)}</PrincipalPoint>"
        f"<Distortion>{tags(K1=K1, K2=K2, K3=K3, P1=P2, P2=P1)}</Distortion>"
    )
    check(of_poses(write(tmp_path / "blocks.xml", BLOCKS.format(lens=lens))), WHOLE)


def test_pix4d_is_read(tmp_path: Path) -> None:
    """T1 goes with 2 x y, T2 with r2 + 2 x2; the principal point from the corner."""
    head = "fileName imageWidth imageHeight\n" + "x\n" * 3 + "camera position t [3x1]\n" + "x\n" * 2 + "\n"
    lens = f"{F + B1} 0 {CX + 0.5}\n0 {F} {CY + 0.5}\n0 0 1\n{K1} {K2} {K3}\n{P1} {P2}\n"
    text = f"{head}a.jpg {WIDTH} {HEIGHT}\n{lens}1 2 3\n1 0 0\n0 -1 0\n0 0 -1\n"
    write(tmp_path / "p_offset.xyz", "0 0 0\n")
    check(of_poses(write(tmp_path / "p_calibrated_camera_parameters.txt", text)), WITHOUT_B2)


OPENSFM = {
    "width": WIDTH, "height": HEIGHT, "projection_type": "brown", "focal_x": (F + B1) / WIDTH, "focal_y": F / WIDTH,
    "c_x": 10.0 / WIDTH, "c_y": -5.0 / WIDTH, "k1": K1, "k2": K2, "k3": K3, "p1": P1, "p2": P2,
}  # fmt: skip
OPENSFM_FISHEYE = {
    "width": WIDTH, "height": HEIGHT, "projection_type": "fisheye_opencv", "focal_x": 600.0 / WIDTH,
    "focal_y": 606.0 / WIDTH, "c_x": 10.0 / WIDTH, "c_y": -5.0 / WIDTH,
    **dict(zip(("k1", "k2", "k3", "k4"), TERMS, strict=True)),
}  # fmt: skip


@pytest.mark.parametrize(
    ("entry", "expected"), [(OPENSFM, WITHOUT_B2), (OPENSFM_FISHEYE, FISH)], ids=["brown", "fisheye"]
)
def test_opensfm_and_odm_are_read(tmp_path: Path, entry: dict[str, Any], expected: tuple[float, float]) -> None:
    """camera_distortions_functions.h: p1 goes with 2 x y; lengths are shares of the longer side."""
    shot = {"rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0], "camera": "c"}
    text = json.dumps([{"cameras": {"c": entry}, "shots": {"A.jpg": shot}, "points": {}}])
    check(of_poses(write(tmp_path / "reconstruction.json", text)), expected)
    check(read_camera_file(write(tmp_path / "cameras.json", json.dumps({"v2 c": entry}))).cameras["v2 c"], expected)


def test_opensfms_one_sided_models_are_read(tmp_path: Path) -> None:
    """perspective: two radial terms; fisheye: the angle times 1 + k1 angle2 + k2 angle4; both about the middle."""
    size = {"width": WIDTH, "height": HEIGHT, "focal": 0.6, "k1": -0.02, "k2": 0.006}
    text = json.dumps({"f": {"projection_type": "fisheye", **size}, "p": {"projection_type": "perspective", **size}})
    found = read_camera_file(write(tmp_path / "cameras.json", text)).cameras
    scale = 600.0 * ANGLE * (1 - 0.02 * ANGLE**2 + 0.006 * ANGLE**4) / math.sqrt(0.2)
    check(found["f"], (499.5 + 0.4 * scale, 374.5 + 0.2 * scale))
    scale = 600.0 * (1 - 0.02 * 0.2 + 0.006 * 0.04)
    check(found["p"], (499.5 + 0.4 * scale, 374.5 + 0.2 * scale))


def colmap_line(model: str, *values: float) -> str:
    return f"1 {model} {WIDTH} {HEIGHT} {' '.join(map(repr, values))}\n"


FULL_VALUES = (F + B1, F, CX + 0.5, CY + 0.5, K1, K2, P1, P2, K3, 0.0, 0.0, 0.0)
FISH_VALUES = (600.0, 606.0, CX + 0.5, CY + 0.5, *TERMS)


@pytest.mark.parametrize(
    ("model", "number", "values", "expected"),
    [("FULL_OPENCV", 6, FULL_VALUES, WITHOUT_B2), ("OPENCV_FISHEYE", 5, FISH_VALUES, FISH)],
)
def test_colmap_is_read(
    tmp_path: Path, model: str, number: int, values: tuple[float, ...], expected: tuple[float, float]
) -> None:
    """models.h: k1, k2, p1, p2, k3 ... as in OpenCV, the corner of the first pixel is 0; as text and binary."""
    check(read_camera_file(write(tmp_path / "cameras.txt", colmap_line(model, *values))).cameras["1"], expected)
    write(tmp_path / "text" / "images.txt", "1 1 0 0 0 0 0 0 1 A.jpg\n\n")
    write(tmp_path / "text" / "cameras.txt", colmap_line(model, *values))
    check(of_poses(tmp_path / "text"), expected)
    folder = tmp_path / "binary"
    folder.mkdir()
    row = struct.pack("<iiQQ", 1, number, WIDTH, HEIGHT) + struct.pack(f"<{len(values)}d", *values)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + row)
    pose = struct.pack("<i7di", 1, 1.0, 0, 0, 0, 0, 0, 0, 1) + b"A.jpg\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 1) + pose)
    check(of_poses(folder), expected)


def test_our_own_camera_files_hold_everything(tmp_path: Path) -> None:
    params = [F, CX + 0.5, CY + 0.5, K1, K2, K3, P1, P2, B1, B2]
    text = json.dumps({"own": {"model": BROWN, "width": WIDTH, "height": HEIGHT, "params": params}})
    check(read_camera_file(write(tmp_path / "own.json", text)).cameras["own"], WHOLE)


MICMAC = """<ExportAPERO><OrientationConique><Interne><CalibrationInternConique>
<KnownConv>eConvApero_DistM2C</KnownConv><PP>{cx} {cy}</PP><F>{f}</F><SzIm>{width} {height}</SzIm>
<CalibDistortion><ModPhgrStd><RadialePart><CDist>{cx} {cy}
</CDist><CoeffDist>{k1}</CoeffDist><CoeffDist>{k2}</CoeffDist><CoeffDist>{k3}</CoeffDist></RadialePart><P1>{p1}</P1>
<P2>{p2}</P2><b1>{b1}</b1><b2>{b2}</b2></ModPhgrStd></CalibDistortion></CalibrationInternConique></Interne><Externe>
<Centre>1 2 3</Centre><ParamRotation><CodageMatr><L1>1 0 0</L1><L2>0 -1 0</L2><L3>0 0 -1</L3></CodageMatr>
</ParamRotation></Externe><ConvOri><KnownConv>eConvApero_DistM2C</KnownConv></ConvOri></OrientationConique>
</ExportAPERO>"""


def micmac(values: dict[str, Any]) -> tuple[float, float]:
    """phgr_ebner_brown_dist.cpp, DistElemDRad: all in pixels from the principal point, b1 and b2 of the ideal place."""
    f, cx, cy, *radial = (values[name] for name in ("f", "cx", "cy", "k1", "k2", "k3"))
    x, y = f * RAY[0], f * RAY[1]
    rho2 = x * x + y * y
    factor = sum(term * rho2**n for n, term in enumerate(radial, 1))
    p1, p2, b1, b2 = (values[name] for name in ("p1", "p2", "b1", "b2"))
    return (
        cx + x + x * factor + (2 * x * x + rho2) * p1 + 2 * x * y * p2 + b1 * x + b2 * y,
        cy + y + y * factor + (2 * y * y + rho2) * p2 + 2 * x * y * p1,
    )


@pytest.mark.parametrize("affine", [False, True])
def test_micmac_is_read(tmp_path: Path, affine: bool) -> None:
    """P1 is OpenCV's p2; with b1 and b2, which MicMac applies before distortion, the nearest camera."""
    values = {
        "width": WIDTH, "height": HEIGHT, "f": F, "cx": CX, "cy": CY, "k1": K1 / F**2, "k2": K2 / F**4, "k3": K3 / F**6,
        "p1": P2 / F, "p2": P1 / F, "b1": B1 / F if affine else 0.0, "b2": B2 / F if affine else 0.0,
    }  # fmt: skip
    path = write(tmp_path / "Orientation-A.jpg.xml", MICMAC.format(**values))
    expected = micmac(values)
    if not affine:
        np.testing.assert_allclose(expected, PLAIN, atol=1e-9)
    found = read_pose_file(path)
    check(found.cameras[found.rows[0].camera], expected, 0.05 if affine else 1e-6)


def test_transforms_are_read(tmp_path: Path) -> None:
    """nerfstudio and instant-ngp: OpenCV's terms, the principal point from the corner."""
    frame = {"file_path": "images/A.jpg", "transform_matrix": np.eye(4).tolist()}
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": F + B1, "fl_y": F, "cx": CX + 0.5, "cy": CY + 0.5}
    brown = lens | {"k1": K1, "k2": K2, "k3": K3, "p1": P1, "p2": P2, "frames": [frame]}
    check(of_poses(write(tmp_path / "transforms.json", json.dumps(brown))), WITHOUT_B2)
    terms = dict(zip(("k1", "k2", "k3", "k4"), TERMS, strict=True))
    fish = lens | {"fl_x": 600.0, "fl_y": 606.0, "camera_model": "OPENCV_FISHEYE", **terms, "frames": [frame]}
    check(of_poses(write(tmp_path / "fish" / "transforms.json", json.dumps(fish))), FISH)


def test_dewarp_data_is_read() -> None:
    """DJI: fx, fy, cx, cy from the middle, k1, k2, p1, p2, k3 as OpenCV's."""
    text = f"2021-03-04;{F + B1},{F},10,-5,{K1},{K2},{P1},{P2},{K3}"
    camera = calibrated_camera({"drone-dji:DewarpData": text}, WIDTH, HEIGHT)
    assert camera is not None
    assert camera.model == BROWN
    check(camera, WITHOUT_B2)


# --- exporters: the numbers of what they wrote, by the program's formula ---------------------------------------------


def contents_with(camera: Camera, pixel: tuple[float, float]) -> ExportContents:
    """Two images of one camera and one match, at `pixel` in both."""
    truth = make_truth()
    images = tuple(
        dataclasses.replace(image, camera_id="a", width_px=WIDTH, height_px=HEIGHT) for image in truth.block.images[:2]
    )
    poses = {image.image_id: truth.block.poses[image.image_id] for image in images}
    block = dataclasses.replace(truth.block, images=images, cameras={"a": camera}, poses=poses)
    places = {image.image_id: np.array([pixel], np.float64) for image in images}
    one = np.zeros((1, 2), np.int32)
    item = PairContents(truth.pairs[0].pair, one, one, "E", truth.pairs[0].model)
    return ExportContents(block, places.__getitem__, iter([item]))


def export(name: str, camera: Camera, folder: Path, pixel: tuple[float, float] = (1.0, 2.0)) -> ExportSummary:
    return EXPORTERS[name]()(contents_with(camera, pixel), folder)  # type: ignore[operator, no-any-return]


def opencv(k: tuple[float, ...], p1: float, p2: float) -> tuple[float, float]:
    """calib3d: k1, k2, p1, p2, k3; the names of OpenSfM (brown), openMVG (BrownT2) and AliceVision (brown) too."""
    u, v = RAY
    r2 = u * u + v * v
    radial = 1.0 + sum(term * r2**n for n, term in enumerate(k, 1))
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
        v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
    )


def kannala(k: tuple[float, ...]) -> tuple[float, float]:
    """calib3d, fisheye."""
    radius = math.hypot(*RAY)
    angle = math.atan(radius)
    scale = angle * (1.0 + sum(term * angle ** (2 * n) for n, term in enumerate(k, 1))) / radius
    return RAY[0] * scale, RAY[1] * scale


def written_colmap(folder: Path) -> tuple[float, float]:
    _, model, _, _, *cells = (folder / "sparse" / "cameras.txt").read_text().splitlines()[1].split()
    fx, fy, cx, cy, *values = map(float, cells)
    if model == "OPENCV_FISHEYE":
        x, y = kannala(tuple(values))
    else:
        k1, k2, p1, p2, *more = [*values, 0.0][:5] if model == "OPENCV" else values[:5]
        assert not any(values[5:])
        x, y = opencv((k1, k2, *more), p1, p2)
    return fx * x + cx - 0.5, fy * y + cy - 0.5  # its pixels count from the corner


def written_opensfm(folder: Path) -> tuple[float, float]:
    (model,) = json.loads((folder / "camera_models.json").read_text()).values()
    terms = [model[name] for name in ("k1", "k2", "k3")]
    if model["projection_type"] == "fisheye_opencv":
        x, y = kannala((*terms, model["k4"]))
    else:
        assert model["projection_type"] == "brown"
        x, y = opencv(tuple(terms), model["p1"], model["p2"])
    longer = max(model["width"], model["height"])
    u, v = model["focal_x"] * x + model["c_x"], model["focal_y"] * y + model["c_y"]
    return u * longer + (model["width"] - 1) / 2, v * longer + (model["height"] - 1) / 2


def written_openmvg(folder: Path) -> tuple[float, float]:
    ((_, value),) = [one.items() for one in json.loads((folder / "sfm_data.json").read_text())["intrinsics"]]
    data, kind = value[1]["ptr_wrapper"]["data"], value[1]["polymorphic_name"]
    if kind == "fisheye":
        x, y = kannala(tuple(data["fisheye"]))
    elif kind == "pinhole_radial_k3":
        x, y = opencv(tuple(data["disto_k3"]), 0.0, 0.0)
    else:
        k1, k2, k3, t1, t2 = data["disto_t2"]
        x, y = opencv((k1, k2, k3), t1, t2)
    return data["focal_length"] * x + data["principal_point"][0], data["focal_length"] * y + data["principal_point"][1]


def written_alicevision(folder: Path) -> tuple[float, float]:
    (data,) = json.loads((folder / "cameras.sfm").read_text())["intrinsics"]
    terms = [float(value) for value in data["distortionParams"]]
    x, y = kannala(tuple(terms)) if data["type"] == "fisheye4" else opencv(tuple(terms[:3]), terms[3], terms[4])
    fx, fy = (float(value) for value in data["pxFocalLength"])
    dx, dy = (float(value) for value in data["principalPoint"])
    return fx * x + int(data["width"]) / 2 + dx, fy * y + int(data["height"]) / 2 + dy


def written_blocks(folder: Path) -> tuple[float, float]:
    from defusedxml.ElementTree import parse

    group = next(parse(folder / "blocks.xml").getroot().iter("Photogroup"))

    def value(path: str) -> float:
        return float(group.findtext(path))

    u, v = RAY
    r2 = u * u + v * v
    radial = 1 + value("Distortion/K1") * r2 + value("Distortion/K2") * r2**2 + value("Distortion/K3") * r2**3
    p1, p2 = value("Distortion/P1"), value("Distortion/P2")
    x = u * radial + 2 * p2 * u * v + p1 * (r2 + 2 * u * u)
    y = v * radial + 2 * p1 * u * v + p2 * (r2 + 2 * v * v)
    f = value("FocalLengthPixels")
    return (
        f * x + value("Skew") * y + value("PrincipalPoint/x"), f * value("AspectRatio") * y + value("PrincipalPoint/y")
    )  # fmt: skip


def written_micmac(folder: Path) -> tuple[float, float]:
    from defusedxml.ElementTree import parse

    root = parse(folder / "Ori-aeromatch" / "AutoCal_a.xml").getroot()
    terms = [float(one.text) for one in root.iter("CoeffDist")]
    cx, cy = map(float, root.findtext(".//PP").split())
    assert root.findtext(".//CDist") == root.findtext(".//PP")
    values = {"f": float(root.findtext(".//F")), "cx": cx, "cy": cy}
    values |= dict(zip(("k1", "k2", "k3"), [*terms, 0.0, 0.0], strict=False))
    values |= {name.lower(): float(root.findtext(f".//{name}") or 0.0) for name in ("P1", "P2", "b1", "b2")}
    return micmac(values)


def written_bundler(folder: Path) -> tuple[float, float]:
    """p = -P / P.z, f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the picture and y upwards."""
    f, k1, k2 = map(float, (folder / "bundle.out").read_text().splitlines()[2].split())
    x, y = opencv((k1, k2), 0.0, 0.0)
    return f * x + WIDTH / 2 - 0.5, f * y + HEIGHT / 2 - 0.5


WRITTEN: dict[str, Callable[[Path], tuple[float, float]]] = {
    "colmap": written_colmap, "opensfm": written_opensfm, "openmvg": written_openmvg,
    "alicevision": written_alicevision, "blocks-exchange": written_blocks, "micmac": written_micmac,
    "bundler": written_bundler,
}  # fmt: skip
BARE = block_camera(cx=499.5, cy=374.5, k3=0.0, p1=0.0, p2=0.0, b1=0.0, b2=0.0)
# u = 0.4, v = 0.2: the radial factor is 1 - 0.02 + 0.002 = 0.982.
BARE_PX = (499.5 + 900.0 * 0.4 * 0.982, 374.5 + 900.0 * 0.2 * 0.982)


@pytest.mark.parametrize(
    ("name", "camera", "expected"),
    [
        ("colmap", block_camera(b2=0.0), WITHOUT_B2),
        ("colmap", block_camera(b2=0.0, k3=0.0), (861.691312 + 902 * 0.4 * 0.00016, 546.0152 + 900 * 0.2 * 0.00016)),
        ("colmap", fisheye_camera(), FISH),
        ("opensfm", block_camera(b2=0.0), WITHOUT_B2),
        ("opensfm", fisheye_camera(), FISH),
        ("openmvg", block_camera(b1=0.0, b2=0.0), PLAIN),
        ("openmvg", BARE, BARE_PX),
        ("openmvg", fisheye_camera(fy=600.0), FISH_SQUARE),
        ("alicevision", block_camera(b2=0.0), WITHOUT_B2),
        ("alicevision", fisheye_camera(), FISH),
        ("blocks-exchange", block_camera(), WHOLE),
        ("micmac", block_camera(b1=0.0, b2=0.0), PLAIN),
        ("micmac", BARE, BARE_PX),
        ("bundler", BARE, BARE_PX),
    ],
)
def test_what_a_format_holds_is_written_exactly(
    name: str, camera: Camera, expected: tuple[float, float], tmp_path: Path
) -> None:
    check(camera, expected)
    summary = export(name, camera, tmp_path / name)
    np.testing.assert_allclose(WRITTEN[name](tmp_path / name), expected, rtol=0, atol=2e-6)
    assert summary.remarks == ()


@pytest.mark.parametrize(
    ("name", "off_px", "said"),
    [
        ("colmap", 0.3, True),
        ("opensfm", 0.3, True),
        ("openmvg", 0.6, True),
        ("alicevision", 0.3, True),
        ("blocks-exchange", 1e-6, False),
        ("micmac", 0.02, False),  # which of distortion and affinity comes first makes less
        ("bundler", 12.0, True),
    ],
)
def test_what_a_format_does_not_hold_is_approached_and_said(
    name: str, off_px: float, said: bool, tmp_path: Path
) -> None:
    summary = export(name, block_camera(), tmp_path / name)
    assert np.linalg.norm(np.subtract(WRITTEN[name](tmp_path / name), WHOLE)) < off_px
    assert len(summary.remarks) == said
    if said:
        assert summary.remarks[0].startswith("camera a: ")
        assert "has no such lens model; the nearest one is written, " in summary.remarks[0]


@pytest.mark.parametrize("name", ["blocks-exchange", "micmac", "bundler"])
def test_a_fisheye_is_approached_where_a_format_has_none(name: str, tmp_path: Path) -> None:
    summary = export(name, fisheye_camera(), tmp_path / name)
    assert np.linalg.norm(np.subtract(WRITTEN[name](tmp_path / name), FISH)) < 12.0
    (remark,) = summary.remarks
    worst = float(remark.split(" px at most")[0].rsplit(" ", 1)[1])
    assert 0.02 < worst < 40.0


@pytest.mark.parametrize(("camera", "pixel"), [(block_camera(), WHOLE), (fisheye_camera(), FISH)])
def test_bingo_has_rays_in_millimetres(camera: Camera, pixel: tuple[float, float], tmp_path: Path) -> None:
    """Distortion and affinity are taken out: x = c u, y = -c v (y upwards)."""
    export("bingo", camera, tmp_path / "b", pixel)
    first, point = (tmp_path / "b" / "image.txt").read_text().splitlines()[:2]
    focal = float(first.split()[1])
    _, x, y = map(float, point.split())
    np.testing.assert_allclose((x, y), (focal * RAY[0], -focal * RAY[1]), atol=2e-5)


def test_every_program_of_the_tests_is_on_the_page() -> None:
    page = (Path(__file__).parent.parent / "docs" / "cameras.md").read_text()
    programs = ("COLMAP", "OpenCV", "Metashape", "BlocksExchange", "Pix4D", "OpenSfM", "ODM", "MicMac", "openMVG",
                "AliceVision", "Bundler", "BINGO", "DJI", "transforms.json")  # fmt: skip
    assert [name for name in programs if name not in page] == []


def test_remarks_reach_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The stage says what an exporter could not write exactly, and keeps it in its result."""
    from aeromatch_cli.stages import export as stage

    monkeypatch.setattr(stage, "contents_of", lambda *_: contents_with(block_camera(), (1.0, 2.0)))
    task: Any = stage.ExportTask(EXPORTERS["bundler"](), None, tmp_path / "bundler", None)  # type: ignore[arg-type]
    (remark,) = stage._run_task(task).remarks
    assert f"warning: export bundler: {remark}" in caplog.text
