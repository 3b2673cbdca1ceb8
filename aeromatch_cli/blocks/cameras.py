"""Which camera took which image: from EXIF, by folder, by a column of the pose list, or from a camera file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.scan import identifier
from aeromatch_cli.blocks.sensors import sensor_size_mm
from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import resized

FULL_FRAME_DIAGONAL_MM = 43.267
# Between a wide and a normal lens: what to start from where nothing is known (COLMAP's default_focal_length_factor).
GUESSED_FOCAL_FACTOR = 1.2


@dataclass(frozen=True)
class CameraAssignment:
    """cameras: camera id -> Camera. camera_ids: image name -> camera id. reasons: image name -> why it has none.

    guessed: camera ids whose focal length is a guess.
    """

    cameras: Mapping[str, Camera]
    camera_ids: Mapping[str, str]
    reasons: Mapping[str, str]
    warnings: tuple[str, ...]
    guessed: frozenset[str] = frozenset()


def focal_from_exif_px(facts: ExifFacts) -> tuple[float, str]:
    """Focal length in px of the stored raster, and where it came from, in words.

    In this order: sensor size of a known model, focal-plane resolution whose raster EXIF names, 35-mm equivalent (by
    the diagonal), any focal-plane resolution, a guess of 1.2 x the longer side. The picture lies inside the sensor, so
    its pixels are no larger than either side allows.
    """
    long_px, short_px = max(facts.width_px, facts.height_px), min(facts.width_px, facts.height_px)
    sensor_mm = sensor_size_mm(facts.make, facts.model)
    if facts.focal_mm and sensor_mm:
        return facts.focal_mm * max(long_px / sensor_mm[0], short_px / sensor_mm[1]), "sensor size"
    plane_px = (facts.focal_mm or 0.0) * (facts.focal_plane_px_per_mm or 0.0)
    plausible = 0.2 * long_px < plane_px < 50.0 * long_px
    if plausible and facts.focal_plane_confirmed:
        return plane_px, "focal-plane resolution"
    if facts.focal_35mm_mm:
        return facts.focal_35mm_mm / FULL_FRAME_DIAGONAL_MM * math.hypot(long_px, short_px), "35-mm equivalent"
    if plausible:
        return plane_px, "focal-plane resolution"
    return GUESSED_FOCAL_FACTOR * long_px, "guess"


def cameras_from_exif(facts: Mapping[str, ExifFacts], groups: Mapping[str, str]) -> CameraAssignment:
    """One camera per make, model, focal length, size and group; facts and groups by image name.

    groups: what else keeps cameras apart (folder or column of the pose list), "" for nothing. A camera depends on
    the image's own header alone, so it does not change when images are added. Model SIMPLE_RADIAL without distortion.
    """
    cameras: dict[str, Camera] = {}
    camera_ids: dict[str, str] = {}
    guessed: list[str] = []
    for name, fact in facts.items():
        focal_px, source = focal_from_exif_px(fact)
        focal_px = round(focal_px, 2)
        if source == "guess":
            guessed.append(name)
        lens = re.sub(r"[^a-z0-9._]+", "-", _full_model(fact).lower()).strip("-")
        parts = [identifier(groups.get(name, "")), lens or "unknown"]
        parts += [f"{fact.focal_mm:.4g}mm"] if fact.focal_mm else []
        parts += [f"f{focal_px:g}", f"{fact.width_px}x{fact.height_px}"]
        camera_id = "_".join(part for part in parts if part)
        principal = ((fact.width_px - 1) / 2.0, (fact.height_px - 1) / 2.0)
        cameras[camera_id] = Camera("SIMPLE_RADIAL", fact.width_px, fact.height_px, (focal_px, *principal, 0.0))
        camera_ids[name] = camera_id
    warnings = (
        (
            f"the focal length of {len(guessed)} of {len(facts)} images is a guess ({GUESSED_FOCAL_FACTOR} x the "
            f"longer side), since EXIF says too little ({listed(guessed)}): better give --cameras FILE",
        )
        if guessed
        else ()
    )
    return CameraAssignment(cameras, camera_ids, {}, warnings, frozenset(camera_ids[name] for name in guessed))


def _full_model(facts: ExifFacts) -> str:
    """Make and model, the make once (Canon repeats it in the model)."""
    return facts.model if facts.model.lower().startswith(facts.make.lower()) else f"{facts.make} {facts.model}"


def cameras_from_file(
    stated: Mapping[str, Camera], sizes_px: Mapping[str, tuple[int, int]], columns: Mapping[str, str]
) -> CameraAssignment:
    """Cameras of a file, one for every image: by column, else the only one, else by folder, else by size.

    stated: camera name -> Camera. sizes_px: image name -> (width, height). columns: image name -> camera named by the
    pose list, "" for none. An image that is a resized picture of its camera gets the resized camera.
    """
    cameras: dict[str, Camera] = {}
    camera_ids: dict[str, str] = {}
    reasons: dict[str, str] = {}
    for name, (width_px, height_px) in sizes_px.items():
        chosen = _chosen(stated, name, (width_px, height_px), columns.get(name, ""))
        if isinstance(chosen, _Refusal):
            reasons[name] = chosen.reason
            continue
        camera = fitted(stated[chosen.camera], width_px, height_px)
        if camera is None:
            reasons[name] = _mismatch(chosen.camera, stated[chosen.camera], width_px, height_px)
            continue
        size = "" if camera is stated[chosen.camera] else f"_{width_px}x{height_px}"
        camera_ids[name] = identifier(chosen.camera) + size
        cameras[camera_ids[name]] = camera
    return CameraAssignment(cameras, camera_ids, reasons, ())


def fitted(camera: Camera, width_px: int, height_px: int) -> Camera | None:
    """The camera for a picture of the given size: itself, resized by a pure scale, or None where neither fits."""
    if (camera.width_px, camera.height_px) == (width_px, height_px):
        return camera
    scale = (width_px / camera.width_px + height_px / camera.height_px) / 2.0
    # A resizing tool rounds each side to whole pixels.
    if abs(camera.width_px * scale - width_px) > 1.0 or abs(camera.height_px * scale - height_px) > 1.0:
        return None
    return resized(camera, scale, width_px, height_px)


@dataclass(frozen=True)
class _Choice:
    camera: str


@dataclass(frozen=True)
class _Refusal:
    reason: str


def _chosen(stated: Mapping[str, Camera], name: str, size_px: tuple[int, int], column: str) -> _Choice | _Refusal:
    if column:
        if column in stated:
            return _Choice(column)
        return _Refusal(f"camera {column!r} of the pose list is not in the camera file, which has {listed(stated)}")
    if len(stated) == 1:
        return _Choice(next(iter(stated)))
    for folder in reversed(PurePosixPath(name).parts[:-1]):
        if folder in stated:
            return _Choice(folder)
    for fits in (
        [key for key, camera in stated.items() if (camera.width_px, camera.height_px) == size_px],
        [key for key, camera in stated.items() if fitted(camera, *size_px) is not None],
    ):
        if len(fits) == 1:
            return _Choice(fits[0])
        if fits:
            return _Refusal(
                f"cameras {listed(fits)} all fit {size_px[0]} x {size_px[1]} px: say which by a column camera in the "
                "pose list, or name folders like cameras"
            )
    return _Refusal(f"no camera of the camera file ({listed(stated)}) has the shape {size_px[0]} x {size_px[1]} px")


def _mismatch(name: str, camera: Camera, width_px: int, height_px: int) -> str:
    words = f"image is {width_px} x {height_px} px, camera {name!r} {camera.width_px} x {camera.height_px} px"
    if fitted(camera, height_px, width_px) is not None:
        return f"{words}: the picture was turned by 90 degrees after capture; use the unturned file or another camera"
    return f"{words}, not the same shape: the picture was cropped, or this is the wrong camera"


def listed(names: Mapping[str, object] | list[str], limit: int = 5) -> str:
    """The first few names for a message."""
    shown = [str(name) for name in list(names)[:limit]]
    return ", ".join(shown) + (", ..." if len(names) > limit else "")
