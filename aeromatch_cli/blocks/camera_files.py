"""Cameras from files: COLMAP's cameras.txt, YAML or JSON, the block.json of a shared block, OpenSfM's and ODM's
cameras.json, and the calibration that Metashape writes as XML.

Parameters follow COLMAP: its order and its corner origin (cx = W / 2 is the centre); here they become this project's.
BROWN, which COLMAP does not have, stands there in the same way.

YAML and JSON: NAME: {model, width, height, params}, for every camera, or the same below a key `cameras`, beside which
`crs` (a code) and `ground_z` (a height, or percentiles with p50) may stand. One camera may stand without its NAME.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.blocks.lenses import of_metashape, of_opensfm, remark
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes
from aeromatch_cli.geometry.cameras import FULL_OPENCV, MODELS, corner_params, focal_px
from aeromatch_cli.geometry.lenses import Nearest, of_colmap

# Shorter focal lengths, as a share of the longer side, are no pixels: a fisheye's is about 0.3.
_SHORTEST_FOCAL = 0.05
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
