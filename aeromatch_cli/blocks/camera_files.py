"""Cameras from files: COLMAP's cameras.txt, YAML or JSON, the block.json of a shared block, OpenSfM's and ODM's
cameras.json, the calibration that Metashape writes as XML, and Pix4D's
*_pix4d_calibrated_internal_camera_parameters.cam.

Parameters follow COLMAP: its order and its corner origin (cx = W / 2 is the centre); here they become this project's.
BROWN, which COLMAP does not have, stands there in the same way.

YAML and JSON: NAME: {model, width, height, params}, for every camera, or the same below a key `cameras`, beside which
`crs` (a code) and `ground_z` (a height, or percentiles with p50) may stand. One camera may stand without its NAME.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.blocks.lenses import of_metashape, of_opensfm, remark
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes
from aeromatch_cli.geometry.cameras import FULL_OPENCV, MODELS, corner_params, focal_px
from aeromatch_cli.geometry.lenses import Nearest, brown, of_colmap

# Shorter focal lengths, as a share of the longer side, are no pixels: a fisheye's is about 0.3.
_SHORTEST_FOCAL = 0.05
_PIX4D = re.compile(r"^Pix4D camera calibration file.*$", re.MULTILINE)
_PIX4D_VALUE = re.compile(r"^(F|Px|Py|K[123]|T[12])\s+([-+]?\d{1,9}(?:\.\d*)?(?:[eE][-+]?\d{1,2})?)\s*$", re.MULTILINE)
_SENSOR = re.compile(r"sensor width of (\d{1,6}(?:\.\d{1,40})?)x(\d{1,6}(?:\.\d{1,40})?)mm")
# Pixels of the width of a sensor whose pixels are not stated: usual shapes have a whole number of rows, too.
_SENSOR_PX = 14_400
_USUAL_SHAPES = (4 / 3, 3 / 2, 16 / 9, 5 / 4, 1.0)
_ENTRY_KEYS = ("model", "width", "height", "params")


@dataclass(frozen=True)
class CameraFile:
    """What a camera file states. cameras: name -> Camera; crs, ground_z_m: in that CRS, None where not given; remarks:
    on lens models that others stand for."""

    cameras: Mapping[str, Camera]
    crs: str | None = None
    ground_z_m: float | None = None
    remarks: tuple[str, ...] = ()


def read_camera_file(path: Path) -> CameraFile:
    """Reads a camera file of any accepted form. Raises ConfigError with file and line or key."""
    try:
        text = given_bytes(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ConfigError(
            f"camera file {path} cannot be read ({reason}): give a COLMAP cameras.txt, YAML or JSON, or exif or folder"
        ) from error
    if text.lstrip().startswith("<"):
        content = _calibration(path, text)
    elif _PIX4D.search(text) or path.suffix.lower() == ".cam":
        content = _pix4d(path, text)
    else:
        content = _colmap(path, text) if path.suffix.lower() == ".txt" else _tree(path, text)
    if not content.cameras:
        raise ConfigError(f"camera file {path} names no camera: add one, or use --cameras exif")
    return content


def _colmap(path: Path, text: str) -> CameraFile:
    cameras: dict[str, Nearest] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        if len(fields) < 5:
            raise ConfigError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {line.strip()!r}")
        if fields[0] in cameras:
            raise ConfigError(f"{where}: camera {fields[0]} is defined twice: keep one")
        cameras[fields[0]] = _camera(where, fields[1], fields[2], fields[3], fields[4:])
    return _file(path, cameras)


def _calibration(path: Path, text: str) -> CameraFile:
    """Metashape's calibration (Agisoft Camera Calibration)."""
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        root = fromstring(text.encode())
        if root.tag != "calibration":
            raise ValueError(f"its root is {root.tag}")
        size = int(root.findtext("width", "")), int(root.findtext("height", ""))
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise ConfigError(
            f"camera file {path} is no calibration of Metashape ({error}): export one by Tools > Camera Calibration > "
            "Save, or give the cameras.xml with --poses"
        ) from error
    lens = of_metashape(root, root.findtext("projection", "frame"), *size)
    if lens is None:
        raise ConfigError(f"camera file {path}: the focal length f is missing, or something is no number")
    return _file(path, {path.stem: _plausible(str(path), lens)})


def _pix4d(path: Path, text: str) -> CameraFile:
    """Pix4D's, in millimetres of a sensor whose size is stated, and that of the pictures is not: cameras of as many
    pixels as keep its shape, which are resized to the pictures."""
    cameras: dict[str, Nearest] = {}
    for number, part in enumerate(_PIX4D.split(text)[1:]):
        where = f"{path}, camera {number}"
        sensor = _SENSOR.search(part)
        found = {name: float(value) for name, value in _PIX4D_VALUE.findall(part)}
        missing = [name for name in ("F", "Px", "Py") if name not in found]
        if sensor is None or missing or not float(sensor[1]) > 0.0 or not float(sensor[2]) > 0.0:
            what = missing[0] if missing else "the line with the width and height of the sensor"
            raise ConfigError(f"{where}: {what} is missing")
        width_mm = float(sensor[1])
        px = _SENSOR_PX / width_mm
        size = _SENSOR_PX, max(1, round(_SENSOR_PX / _shape(sensor[1], sensor[2])))
        radial = [found.get(name, 0.0) for name in ("K1", "K2", "K3")]
        tangential = found.get("T1", 0.0), found.get("T2", 0.0)
        focal, middle = (found["F"] * px, found["F"] * px), (found["Px"] * px, found["Py"] * px)
        cameras[f"{path.stem}_{number}" if number else path.stem] = _plausible(
            where, brown(size, focal, middle, radial, tangential)
        )
    if not cameras:
        raise ConfigError(
            f"camera file {path} is no calibration of Pix4D that is read: give "
            "*_pix4d_calibrated_internal_camera_parameters.cam, or *_calibrated_camera_parameters.txt with --poses"
        )
    return _file(path, cameras)


def _shape(width: str, height: str) -> float:
    """Width by height of a sensor: a usual one where the digits of both leave that open (12.82x8.55 is 3:2)."""
    shape = float(width) / float(height)
    rounding = sum(0.5 * 10.0 ** -len(text.partition(".")[2]) / float(text) for text in (width, height))
    return next((usual for usual in _USUAL_SHAPES if abs(usual / shape - 1.0) <= rounding), shape)


def _tree(path: Path, text: str) -> CameraFile:
    import yaml

    try:
        tree = yaml.safe_load(text.replace("\t", " "))  # JSON may be indented by tabs, which YAML forbids
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(
            f"camera file {path}{line} is neither YAML nor JSON: {getattr(error, 'problem', '')}"
        ) from error
    except RecursionError:
        raise ConfigError(f"camera file {path} is nested too deeply to be a list of cameras") from None
    except ValueError:
        raise ConfigError(f"camera file {path} holds a number of too many digits") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"camera file {path} must hold NAME: {{model, width, height, params}}")
    entries = tree.get("cameras", tree)
    if isinstance(entries, dict) and isinstance(entries.get("model"), str):
        single = {key: value for key, value in entries.items() if entries is not tree or key not in ("crs", "ground_z")}
        entries = {path.stem: single}
    if not isinstance(entries, dict):
        raise ConfigError(f"{path}, key cameras: must hold NAME: {{model, width, height, params}}")
    cameras = {str(name): _entry(f"{path}, camera {name!r}", entry) for name, entry in entries.items()}
    if entries is tree:
        return _file(path, cameras)
    crs = tree.get("crs")
    if crs is not None and not isinstance(crs, str):
        raise ConfigError(f"{path}, key crs: must be a code such as EPSG:32633, got {crs!r}")
    return _file(path, cameras, crs, _ground_z(path, tree.get("ground_z")))


def _file(
    path: Path, lenses: Mapping[str, Nearest], crs: str | None = None, ground_z_m: float | None = None
) -> CameraFile:
    cameras = {name: lens.camera for name, lens in lenses.items() if lens.camera is not None}
    remarks = [remark(lens, f"{path.name}, camera {name}") for name, lens in lenses.items()]
    return CameraFile(cameras, crs, ground_z_m, tuple(filter(None, remarks)))


def _entry(where: str, entry: Any) -> Nearest:
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: must be {{model, width, height, params}}, got {entry!r}")
    if "projection_type" in entry:
        lens = of_opensfm(entry)
        if lens is None:
            raise ConfigError(f"{where}: a value of this OpenSfM camera is missing or no number")
        return _plausible(where, lens)
    for key in _ENTRY_KEYS:
        if key not in entry:
            raise ConfigError(f"{where}: key {key!r} is missing: a camera needs {', '.join(_ENTRY_KEYS)}")
    unknown = sorted(set(map(str, entry)) - set(_ENTRY_KEYS))
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}: a camera has {', '.join(_ENTRY_KEYS)}")
    if not isinstance(entry["params"], list):
        raise ConfigError(f"{where}, key params: must be a list of numbers, got {entry['params']!r}")
    return _camera(where, str(entry["model"]), entry["width"], entry["height"], entry["params"])


def _camera(where: str, model: str, width: Any, height: Any, params: list[Any]) -> Nearest:
    try:
        size = int(width), int(height)
        values = tuple(float(value) for value in params)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: width, height and params must be numbers ({error})") from error
    if min(size) < 1 or not all(math.isfinite(value) for value in values):
        raise ConfigError(f"{where}: width and height must be positive and all params finite")
    try:
        lens = of_colmap(model, *size, values)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error
    return _plausible(where, lens)


def _plausible(where: str, lens: Nearest) -> Nearest:
    """The lens. Raises ConfigError where none is, or where it does not fit its picture."""
    camera = lens.camera
    if camera is None:
        raise ConfigError(f"{remark(lens, where)}: give one of {', '.join((*MODELS, FULL_OPENCV))}")
    names, size = MODELS[camera.model], (camera.width_px, camera.height_px)
    if focal_px(camera) > 0.0 and focal_px(camera) / _SHORTEST_FOCAL < max(size):
        raise ConfigError(
            f"{where}: a focal length of {focal_px(camera):g} px is none of an image of {size[0]} x {size[1]} px: is "
            "it in millimetres, or in widths of the image? Pixels are needed: millimetres by the size of a pixel"
        )
    named = dict(zip(names, corner_params(camera), strict=True))
    if focal_px(camera) <= 0 or not (0 <= named["cx"] <= size[0] and 0 <= named["cy"] <= size[1]):
        raise ConfigError(
            f"{where}: focal length {focal_px(camera):g} px and principal point ({named['cx']:g}, {named['cy']:g}) px "
            f"do not fit an image of {size[0]} x {size[1]} px: check the order of params ({', '.join(names)})"
        )
    return lens


def _ground_z(path: Path, value: Any) -> float | None:
    if isinstance(value, dict):
        value = value.get("p50")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{path}, key ground_z: must be a height or hold p50, got {value!r}")
    return float(value)
