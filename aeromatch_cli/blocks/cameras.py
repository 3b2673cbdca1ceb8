"""Which camera took which image: from EXIF, by folder, by a column of the pose list, or from a camera file."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from zlib import crc32

import numpy as np

from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.scan import identifier
from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import focal_px, resized
from aeromatch_cli.words import listed, of_images

FULL_FRAME_DIAGONAL_MM = 43.267
# Between a wide and a normal lens: what to start from where nothing is known (COLMAP's default_focal_length_factor).
GUESSED_FOCAL_FACTOR = 1.2
# Standard deviation of a focal length, as a share of it, by where it comes from.
FOCAL_SIGMAS: Mapping[str, float] = {
    "XMP calibration": 0.01,
    "camera file": 0.03,
    "sensor size": 0.03,
    "focal-plane resolution": 0.05,
    "35-mm equivalent": 0.05,
    "35-mm equivalent of a zoomed picture": 0.4,
    "guess": 0.4,
}
# Focal lengths that differ by no more than this share are one, where cameras have fewer images each on average.
_ROUNDING, _FEW_IMAGES = 0.01, 3
# Two statements of the focal length that differ by more than this factor cannot both be meant.
_CONTRADICTION = 1.25
# What is shorter or longer than so many times the longer side is no focal length of a camera that takes pictures.
_SHORTEST, _LONGEST = 0.2, 50.0
# Cameras are calibrated with pictures of another size: where EXIF confirms one of these factors to this share, it is
# that.
_OTHER_SIZES, _SIZE_SHARE = (0.25, 0.5, 2.0, 4.0), 0.1

# What is computed from the focal length of the lens, and contradicts a 35-mm equivalent where the lens is another one.
_BY_LENS = ("XMP calibration", "sensor size", "focal-plane resolution")
# Shorter focal lengths, as a share of the longer side, are those of fisheye lenses (16 mm on 35-mm film).
_FISHEYE_FOCAL = 0.45
# Sensor sizes of common drone and compact cameras, width and height in mm, from their makers' data sheets. They go
# before the 35-mm equivalent (a rounded integer) and the focal-plane resolution (wrong after resizing by most tools,
# and with some makers from the start).
_TYPE_1_2_3 = (6.17, 4.55)
_TYPE_1_2 = (6.4, 4.8)
_TYPE_1_1_7 = (7.44, 5.58)
_TYPE_1_1_3 = (9.6, 7.2)
_TYPE_1 = (13.2, 8.8)
_FOUR_THIRDS = (17.3, 13.0)
_APS_C = (23.5, 15.6)
_FULL_FRAME = (35.9, 24.0)

# Size -> EXIF models in lower case, without the make in front.
_MODELS: dict[tuple[float, float], tuple[str, ...]] = {
    _TYPE_1_2_3: (
        *("fc200", "fc220", "fc300s", "fc300x", "fc300c", "fc300xw", "fc330", "fc350", "fc1102", "fc2103", "fc2204"),
        *("fc7203", "fc7303", "powershot a2200", "powershot a3300 is", "powershot elph 110 hs"),
        *("powershot elph 300 hs", "powershot sx230 hs", "powershot sx260 hs", "dsc-wx220"),
    ),
    _TYPE_1_2: ("fc3170",),
    _TYPE_1_1_7: ("powershot s100", "powershot s110", "powershot s120"),
    _TYPE_1_1_3: ("fc3582",),
    _TYPE_1: ("fc3411", "fc6310", "fc6310s", "fc6310r", "l1d-20c", "powershot g9 x", "dsc-rx100"),
    _FOUR_THIRDS: ("fc550", "fc6520", "l2d-20c", "m3e"),
    _APS_C: ("ilce-5100", "ilce-6000", "nex-5", "nex-7"),
    (23.7, 15.7): ("gr", "gr ii"),
    _FULL_FRAME: ("zenmusep1", "ilce-7r", "ilce-7rm2", "dsc-rx1rm2"),
    (4.87, 3.96): ("fc6360",),
    (12.75, 8.5): ("s.o.d.a.",),
}
_SIZES_MM = {model: size for size, models in _MODELS.items() for model in models}


@dataclass(frozen=True)
class CameraAssignment:
    """cameras: camera id -> Camera. camera_ids: image name -> camera id. reasons: image name -> why it has none.

    focal_sigmas: camera id -> standard deviation of its focal length, as a share of it. by_pose_file: images that have
    the camera of the pose file.
    """

    cameras: Mapping[str, Camera]
    camera_ids: Mapping[str, str]
    reasons: Mapping[str, str]
    warnings: tuple[str, ...]
    focal_sigmas: Mapping[str, float] = field(default_factory=dict)
    by_pose_file: int = 0


def focal_from_exif_px(facts: ExifFacts) -> tuple[float, str]:
    """Focal length in px of the stored raster, and where it came from: a key of FOCAL_SIGMAS.

    In this order: the calibration in XMP, sensor size of a known model, focal-plane resolution whose raster EXIF names
    and that the 35-mm equivalent does not contradict, 35-mm equivalent (by the diagonal), any focal-plane resolution, a
    guess of 1.2 x the longer side. The picture lies inside the sensor, so its pixels are no larger than either side
    allows. Programs that reduce pictures often keep the focal-plane resolution of the original. Digital zoom multiplies
    the focal length of the lens; whether a 35-mm equivalent holds it depends on the maker.
    """
    if facts.calibrated is not None:
        return focal_px(facts.calibrated), "XMP calibration"
    long_px = max(facts.width_px, facts.height_px)
    sensor_px, plane_px, equivalent_px = _stated_px(facts)
    if sensor_px:
        return sensor_px, "sensor size"
    if plane_px and facts.focal_plane_confirmed and not _contradicts(plane_px, equivalent_px, facts.digital_zoom):
        return plane_px, "focal-plane resolution"
    if equivalent_px:
        zoomed = " of a zoomed picture" if facts.digital_zoom > 1.0 else ""
        return equivalent_px, f"35-mm equivalent{zoomed}"
    if plane_px:
        return plane_px, "focal-plane resolution"
    return GUESSED_FOCAL_FACTOR * long_px, "guess"


def _stated_px(facts: ExifFacts) -> tuple[float, float, float]:
    """Focal length by sensor size, focal-plane resolution and 35-mm equivalent, 0 where it is not stated or absurd."""
    long_px, short_px = max(facts.width_px, facts.height_px), min(facts.width_px, facts.height_px)
    lens_mm = (facts.focal_mm or 0.0) * facts.digital_zoom
    sensor_mm = sensor_size_mm(facts.make, facts.model)
    sensor_px = lens_mm * max(long_px / sensor_mm[0], short_px / sensor_mm[1]) if sensor_mm else 0.0
    plane_px = lens_mm * (facts.focal_plane_px_per_mm or 0.0)
    equivalent_px = (facts.focal_35mm_mm or 0.0) / FULL_FRAME_DIAGONAL_MM * math.hypot(long_px, short_px)
    sensor_px, plane_px, equivalent_px = (
        px if _SHORTEST * long_px < px < _LONGEST * long_px else 0.0 for px in (sensor_px, plane_px, equivalent_px)
    )
    return sensor_px, plane_px, equivalent_px


def _contradicts(first_px: float, second_px: float, zoom: float = 1.0) -> bool:
    """Whether two focal lengths cannot both be meant; one that is not stated, 0, contradicts none. zoom: what the
    second one may lack."""
    return second_px > 0.0 and not any(
        1.0 / _CONTRADICTION < first_px / (factor * second_px) < _CONTRADICTION for factor in (1.0, zoom)
    )


def cameras_from_exif(facts: Mapping[str, ExifFacts], groups: Mapping[str, str]) -> CameraAssignment:
    """One camera per make, model, serial number, lens, band, focal length, size and group; facts and groups by image
    name.

    groups: what else keeps cameras apart (folder or column of the pose list), "" for nothing. A camera depends on
    the image's own header alone, so it does not change when images are added; but an image whose header has lost serial
    number or lens is taken for one of the only camera that it may be of. Model SIMPLE_RADIAL without distortion,
    but for cameras whose calibration is in XMP.
    """
    cameras: dict[str, Camera] = {}
    camera_ids: dict[str, str] = {}
    sources: dict[str, str] = {}
    facts, lost = _with_lost_numbers(facts, groups)
    facts, rounded = _with_one_focal_length(facts, groups)
    for name, fact in facts.items():
        focal, sources[name] = focal_from_exif_px(fact)
        focal = round(focal, 2)
        lens = re.sub(r"[^a-z0-9._]+", "-", _full_model(fact).lower()).strip("-")
        parts = [identifier(groups.get(name, "")), lens or "unknown"]
        parts += [identifier(part) for part in (fact.camera_serial, fact.lens, fact.band) if part]
        parts += [f"{fact.focal_mm:.4g}mm"] if fact.focal_mm else []
        parts += [f"f{focal:g}", f"{fact.width_px}x{fact.height_px}"]
        parts += [f"{crc32(repr(fact.calibrated).encode()):08x}"] if fact.calibrated else []
        camera_id = "_".join(part for part in parts if part)
        principal = ((fact.width_px - 1) / 2.0, (fact.height_px - 1) / 2.0)
        own = Camera("SIMPLE_RADIAL", fact.width_px, fact.height_px, (focal, *principal, 0.0))
        cameras[camera_id] = fact.calibrated or own
        camera_ids[name] = camera_id
    guessed = [name for name, source in sources.items() if source == "guess"]
    warnings = (
        (
            f"the focal length of {of_images(guessed, facts)} is a guess ({GUESSED_FOCAL_FACTOR} x the longer side), "
            "since EXIF says too little: better give --cameras FILE",
        )
        if guessed
        else ()
    )
    sigmas = {camera_ids[name]: FOCAL_SIGMAS[source] for name, source in sources.items()}
    said = (*warnings, *lost, *rounded, *_contradictions(facts), *_fisheyes(facts))
    return CameraAssignment(cameras, camera_ids, {}, said, sigmas)


def _with_lost_numbers(
    facts: Mapping[str, ExifFacts], groups: Mapping[str, str]
) -> tuple[dict[str, ExifFacts], tuple[str, ...]]:
    """Headers in which the serial number of the camera, and the lens, that some have lost are put in where all others
    of the same kind have the same one; and a word on those of which that is not known."""
    found = dict(facts)
    unclear: list[str] = []
    for field_name in ("camera_serial", "lens"):
        kinds: dict[tuple[object, ...], list[str]] = defaultdict(list)
        for name, fact in found.items():
            size = fact.width_px, fact.height_px
            kinds[groups.get(name, ""), fact.make, fact.model, fact.focal_mm, size, fact.band].append(name)
        for names in kinds.values():
            stated = {value for name in names if (value := getattr(found[name], field_name))}
            lacking = [name for name in names if not getattr(found[name], field_name)]
            if len(stated) == 1:
                found |= {name: replace(found[name], **{field_name: next(iter(stated))}) for name in lacking}
            elif stated and field_name == "camera_serial":
                unclear += lacking
    if not unclear:
        return found, ()
    return found, (
        f"{of_images(unclear, facts, 'has', 'have')} no serial number, and others of the same model have "
        "several: they count as a camera of their own; better keep cameras apart by folders (--cameras folder)",
    )


def _with_one_focal_length(
    facts: Mapping[str, ExifFacts], groups: Mapping[str, str]
) -> tuple[dict[str, ExifFacts], tuple[str, ...]]:
    """Headers with the most frequent focal length in place of others that differ by rounding alone, where they would
    make cameras of a few images each, which nothing could calibrate; and what is said of it."""
    kinds: dict[tuple[object, ...], list[str]] = defaultdict(list)
    for name, fact in facts.items():
        if fact.focal_mm and fact.calibrated is None:
            lens = fact.make, fact.model, fact.camera_serial, fact.lens, fact.band, fact.focal_35mm_mm
            kinds[groups.get(name, ""), *lens, fact.digital_zoom, fact.width_px, fact.height_px].append(name)
    found, said = dict(facts), list[str]()
    for names in kinds.values():
        lengths = Counter(mm for name in names if (mm := facts[name].focal_mm))
        least, most = min(lengths), max(lengths)
        if len(lengths) == 1 or most > (1.0 + _ROUNDING) * least or len(names) >= _FEW_IMAGES * len(lengths):
            continue
        usual_mm = lengths.most_common(1)[0][0]
        found |= {name: replace(facts[name], focal_mm=usual_mm) for name in names}
        said.append(
            f"the focal lengths of {of_images(names, facts)} differ by rounding "
            f"({least:g} to {most:g} mm): they count as one camera with {usual_mm:g} mm"
        )
    return found, tuple(said)


def _contradictions(facts: Mapping[str, ExifFacts]) -> tuple[str, ...]:
    """A sentence where EXIF states two focal lengths of which one must be wrong, and one about digital zoom."""
    reduced, odd, zoomed = [], [], []
    doubtful = [f"{name}: {fact.focal_doubt}" for name, fact in facts.items() if fact.focal_doubt]
    for name, fact in facts.items():
        used_px, source = focal_from_exif_px(fact)
        _, plane_px, equivalent_px = _stated_px(fact)
        if fact.digital_zoom > 1.0:
            zoomed.append(f"{name}: {fact.digital_zoom:g} x")
        if plane_px and source not in ("guess", "focal-plane resolution") and _contradicts(plane_px, used_px):
            reduced.append(f"{name}: {plane_px:.0f} px by focal-plane resolution, {used_px:.0f} px by {source}")
        if source in _BY_LENS and _contradicts(used_px, equivalent_px, fact.digital_zoom):
            odd.append(f"{name}: {equivalent_px:.0f} px by 35-mm equivalent, {used_px:.0f} px by {source}")
    said = []
    if doubtful:
        said.append(
            f"EXIF and XMP of {len(doubtful)} of {len(facts)} images state different focal lengths ({doubtful[0]}): "
            "the latter is used; where the first is right give --cameras FILE"
        )
    if reduced:
        said.append(
            f"EXIF of {len(reduced)} of {len(facts)} images states two focal lengths ({reduced[0]}): the latter is "
            "used; the pictures were probably reduced by a program that kept the resolution of the original"
        )
    if odd:
        said.append(
            f"EXIF of {len(odd)} of {len(facts)} images states two focal lengths ({odd[0]}): the latter is used; was "
            "there a zoom, a crop or another lens? Where the first is right give --cameras FILE"
        )
    if zoomed:
        said.append(
            f"{of_images(zoomed, facts, 'was', 'were')} taken with digital zoom: the focal length is "
            "multiplied with it, a calibration in XMP does not count, and a 35-mm equivalent is taken as zoomed"
        )
    return tuple(said)


def _fisheyes(facts: Mapping[str, ExifFacts]) -> tuple[str, ...]:
    """One sentence where a field of view is wider than those of other lenses."""
    wide = []
    for name, fact in facts.items():
        longer_px = max(fact.width_px, fact.height_px)
        if fact.calibrated is None and focal_from_exif_px(fact)[0] < _FISHEYE_FOCAL * longer_px:
            wide.append(name)
    if not wide:
        return ()
    degrees = 2.0 * math.degrees(math.atan(0.5 / _FISHEYE_FOCAL))
    return (
        f"the field of view of {of_images(wide, facts)} is wider than {degrees:.0f} degrees "
        "by EXIF: probably a fisheye lens, of which EXIF does not tell enough; give its camera as OPENCV_FISHEYE, by "
        "--cameras or a pose file that has it, or undistorted images with theirs",
    )


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
    return CameraAssignment(cameras, camera_ids, reasons, (), dict.fromkeys(cameras, FOCAL_SIGMAS["camera file"]))


def contradicting_exif(
    assignment: CameraAssignment, facts: Mapping[str, ExifFacts]
) -> tuple[dict[str, float], list[str]]:
    """camera id -> likely focal length in px, of cameras of a file that cannot be the one EXIF tells of; and remarks.

    The likely one is that of EXIF, or that of the file for pictures of half or double the size. facts: by image name.
    """
    stated: dict[str, list[float]] = defaultdict(list)
    for name, camera_id in assignment.camera_ids.items():
        px, source = focal_from_exif_px(facts[name])
        if source != "guess":
            stated[camera_id].append(px)
    found = {camera_id: float(np.median(values)) for camera_id, values in sorted(stated.items())}
    odd = {k: px for k, px in found.items() if _contradicts(focal_px(assignment.cameras[k]), px)}
    remarks = [
        f"camera {camera_id}: focal length {focal_px(assignment.cameras[camera_id]):.0f} px in the camera file, "
        f"{px:.0f} px by EXIF of its images: the matches decide between them"
        for camera_id, px in odd.items()
    ]
    return {k: _of_other_size(focal_px(assignment.cameras[k]), px) for k, px in odd.items()}, remarks


def _of_other_size(calibrated_px: float, exif_px: float) -> float:
    factor = min(_OTHER_SIZES, key=lambda one: abs(one * calibrated_px - exif_px))
    return factor * calibrated_px if abs(factor * calibrated_px / exif_px - 1.0) < _SIZE_SHARE else exif_px


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


def sensor_size_mm(make: str, model: str) -> tuple[float, float] | None:
    """Return width and height in mm of a known camera's sensor, None for any other."""
    name = model.strip().lower()
    return _SIZES_MM.get(name.removeprefix(make.strip().lower()).strip()) or _SIZES_MM.get(name)
