"""From what the user has (a folder, a pose list, a camera file) to images, cameras and poses in one world frame.

One bad image never stops the rest: it is left out and recorded. A bad list or setting is a ConfigError.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple, get_args

import numpy as np

from aeromatch_cli.blocks import pose_files
from aeromatch_cli.blocks.agreement import agreed, refuse_degrees
from aeromatch_cli.blocks.camera_files import CameraFile, read_camera_file
from aeromatch_cli.blocks.cameras import (
    CameraAssignment,
    cameras_from_exif,
    cameras_from_file,
    contradicting_exif,
)
from aeromatch_cli.blocks.crs import (
    AUTO,
    LOCAL,
    WorldFrame,
    checked_crs,
    checked_heights,
    heights_of,
)
from aeromatch_cli.blocks.doubles import in_two_formats, remarks_on, thumbnails
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.exif_and_xmp import settled, with_conventions
from aeromatch_cli.blocks.image_names import matched_rows
from aeromatch_cli.blocks.left_out import excluded, ground_shots, remarks_on_ground_shots
from aeromatch_cli.blocks.observations import (
    AngleConvention,
    Located,
    Observation,
    angles_of_exif,
    foreign_crs,
    in_world_heights,
    observation_of_exif,
    observation_of_row,
    oriented,
)
from aeromatch_cli.blocks.other_files import KINDS
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.blocks.scan import ScanFailure, image_ids
from aeromatch_cli.blocks.sorties import captures_of, flights, velocities
from aeromatch_cli.data import Camera, FloatArray, Image, Pose
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.words import counted, form, listed, of_images

EXIF = "exif"
FOLDER = "folder"


class ReadFailure(NamedTuple):
    """An image that is left out: its relative path and why."""

    name: str
    reason: str


@dataclass(frozen=True, eq=False)
class BlockInputs:
    """A block before its ground is known.

    images: sorted by image_id. cameras: camera_id -> Camera. poses: image_id -> Pose in the world (crs - origin_m);
    images without position are absent. angles: image_id -> attitude as it was given. ground_hint_z_m: world height of
    the ground as the input states it, or None; ground_hint_source: where it came from, in words, "" for None;
    ground_is_stated: the user's camera file says so, rather than a barometer. focal_sigmas: camera id -> standard
    deviation of its focal length, as a share of it. warnings: for a person, in order of reading. unread: pictures of
    kinds that are not read, panoramas, and copies of others.
    recognised: what the pose file was read as, and how many images it has, "" without one. flights, velocities: as in
    `sorties`. heights: what those of the world count from, as of `crs.heights_of`, "" where nothing states it.
    """

    images: tuple[Image, ...]
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    angles: Mapping[str, Angles]
    crs: str
    origin_m: tuple[float, float, float]
    ground_hint_z_m: float | None
    ground_hint_source: str
    ground_is_stated: bool
    focal_sigmas: Mapping[str, float]
    likely_focals: Mapping[str, float]
    warnings: tuple[str, ...]
    failures: tuple[ReadFailure, ...]
    unread: tuple[ReadFailure, ...] = ()
    recognised: str = ""
    flights: Mapping[str, str] = field(default_factory=dict)
    velocities: Mapping[str, FloatArray] = field(default_factory=dict)
    heights: str = ""


class GivenHeights(NamedTuple):
    """What is said of heights of positions. zero: "auto", or as of `crs.checked_heights`; shift_m: is added to them."""

    zero: str = AUTO
    shift_m: float = 0.0


_AS_STATED = GivenHeights()


@dataclass(frozen=True, eq=False)
class GivenLists:
    """The files that describe a block.

    poses, cameras: as the user wrote them: a path, "exif", "folder" (a camera for every folder), "" for none. angles:
    what yaw, pitch, roll mean; "auto": by the tags' origin in EXIF (DJI gimbal, Camera:* nadir), gimbal in a pose list.
    pose_list, camera_file: None where no file was given.
    """

    poses: str
    cameras: str
    angles: AngleConvention
    pose_list: PoseList | None
    camera_file: CameraFile | None


def read_lists(
    poses: str | None,
    cameras: str = EXIF,
    angles: AngleConvention = "auto",
    pose_format: str = pose_files.AUTO,
    crs: str = AUTO,
) -> GivenLists:
    """Read the pose list and the camera file. To be called first: they are quick, and a mistake in them should not
    cost a walk over 10,000 files.

    poses: path of a pose list, "exif", or "" / None for none. cameras: path of a camera file, "exif" or "folder".
    pose_format, crs: as in `pose_files.read_pose_file`. Raises ConfigError for a bad argument, pose list or camera
    file.
    """
    if angles not in get_args(AngleConvention):
        raise ConfigError(f"angles {angles!r} is unknown: use one of {', '.join(get_args(AngleConvention))}")
    pose_list = pose_files.read_pose_file(Path(poses), pose_format, crs) if poses and poses != EXIF else None
    camera_file = read_camera_file(Path(cameras)) if cameras not in (EXIF, FOLDER) else None
    return GivenLists(poses or "", cameras, angles, pose_list, camera_file)


def block_inputs(
    images_dir: str,
    lists: GivenLists,
    headers: Mapping[str, ExifFacts | str],
    passed_over: Sequence[ScanFailure] = (),
    *,
    crs: str = "auto",
    sigma_position_m: float,
    sigma_angle_deg: float,
    known_frame: WorldFrame | None = None,
    exclude: str = "",
    drop_ground_shots: bool = False,
    given_heights: GivenHeights = _AS_STATED,
    copies: Mapping[str, str] | None = None,
) -> BlockInputs:
    """Everything that is known of a block, except its ground.

    images_dir: named in messages. headers: by relative name, sorted: the facts of each picture's header, or the reason
    why it is unusable (`exif.exif_or_reason`). passed_over: what the search of the folder left out. crs: a code of one
    in metres (`crs.world_crs`), "local" or "auto". sigmas: of a pose that states none. known_frame: of an earlier run
    in the same workspace, kept so that a growing block does not move. exclude: as of `left_out.excluded`.
    drop_ground_shots: leave out pictures that were taken on the ground. given_heights: of positions.
    copies: images that are left out, since their files have the same contents as those of others: name -> the other.

    Raises ConfigError for lists that do not fit the images, InputError where no image is left.
    """
    chosen = _chosen_images(headers, passed_over, exclude, copies or {}, drop_ground_shots=drop_ground_shots)
    facts, warnings, failures = chosen.facts, [*chosen.warnings], [*chosen.failures]
    rows, remarks = _rows_of_images(lists, list(headers), facts)
    warnings += remarks
    assignment = _assign_cameras(lists, facts, {name: row.camera for name, row in rows.items()})
    warnings += assignment.warnings
    failures += [ReadFailure(name, reason) for name, reason in assignment.reasons.items()]
    facts = {name: fact for name, fact in facts.items() if name in assignment.camera_ids}
    if not facts:
        raise InputError(_nothing_left(images_dir, failures, warnings))

    facts, remarks = _consistent_headers(lists, facts)
    warnings += remarks
    observations, remarks = _observations(lists, rows, facts)
    warnings += remarks
    with_file = lists.camera_file is not None
    likely_focals, remarks = contradicting_exif(assignment, facts) if with_file else ({}, [])
    warnings += remarks
    sigmas = sigma_position_m, sigma_angle_deg
    located, heights, remarks = _located(lists, observations, facts, crs, known_frame, sigmas, given_heights)
    warnings += remarks
    ground = _ground_hint(lists, located, facts)
    angles = located.angles | _angles_alone(lists, facts, located.angles)
    ids = image_ids(facts)
    images = _images(ids, facts, assignment.camera_ids)
    captures = captures_of(images, facts, located.poses, located.frame)
    flight_of = flights(captures)
    return BlockInputs(
        images=images,
        cameras=assignment.cameras,
        poses={ids[name]: pose for name, pose in located.poses.items()},
        angles={ids[name]: one for name, one in angles.items()},
        crs=located.frame.crs,
        origin_m=located.frame.origin_m,
        ground_hint_z_m=ground.z_m,
        ground_hint_source=ground.source,
        ground_is_stated=ground.is_stated,
        focal_sigmas=assignment.focal_sigmas,
        likely_focals=likely_focals,
        warnings=tuple(warnings),
        failures=tuple(sorted(failures)),
        unread=chosen.unread,
        recognised=_recognised(lists, rows, headers, assignment.by_pose_file),
        flights=flight_of,
        velocities=velocities(captures, flight_of),
        heights=heights,
    )


class _ChosenImages(NamedTuple):
    """The images that a block has. facts: their headers, by name. unread, failures: what is left out, and why."""

    facts: dict[str, ExifFacts]
    unread: tuple[ReadFailure, ...]
    failures: list[ReadFailure]
    warnings: list[str]


def _chosen_images(
    headers: Mapping[str, ExifFacts | str],
    passed_over: Sequence[ScanFailure],
    exclude: str,
    copies: Mapping[str, str],
    *,
    drop_ground_shots: bool,
) -> _ChosenImages:
    """Return the images that the user does not leave out and whose headers are usable, without panoramas, copies of
    others and, where asked for, without pictures that were taken on the ground."""
    out, remarks = excluded(exclude, [*headers, *(one.name for one in passed_over if one.unread)])
    passed_over = [one for one in passed_over if one.name not in out]
    unread = tuple(ReadFailure(one.name, one.reason) for one in passed_over if one.unread)
    warnings, failures = _report_scan(passed_over)
    warnings += remarks
    facts: dict[str, ExifFacts] = {}
    for name, header in headers.items():
        if name in out:
            continue
        if isinstance(header, str):
            failures.append(ReadFailure(name, header))
        else:
            facts[name] = header
    panoramas, said = _panoramas(facts)
    warnings += said
    facts = {name: fact for name, fact in facts.items() if not fact.panorama}
    shots = ground_shots(facts)
    warnings += remarks_on_ground_shots(shots, facts, dropped=drop_ground_shots)
    if drop_ground_shots:
        facts = {name: fact for name, fact in facts.items() if name not in shots}
    warnings += remarks_on(copies, facts)
    facts = {name: fact for name, fact in facts.items() if name not in copies}
    doubled = tuple(ReadFailure(name, f"a copy of {first}") for name, first in copies.items())
    return _ChosenImages(facts, unread + panoramas + doubled, failures, warnings)


def _rows_of_images(
    lists: GivenLists, names: Sequence[str], facts: Mapping[str, ExifFacts]
) -> tuple[dict[str, PoseRow], list[str]]:
    """Return image name -> its line of the pose list, and remarks of the list; nothing without a list."""
    if lists.pose_list is None:
        return {}, []
    times = {name: fact.time for name, fact in facts.items()}
    rows, remarks = matched_rows(lists.pose_list, names, f"pose list {lists.poses}", times)
    return rows, [*lists.pose_list.warnings, *remarks]


def _consistent_headers(lists: GivenLists, facts: dict[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Return headers without the contradictions that a block as a whole shows, and remarks.

    Of positions and angles they are said only where these come from the headers.
    """
    warnings = _rasters(facts)
    facts, remarks = settled(facts)
    warnings += remarks if lists.poses == EXIF else []
    sizes_px = {name: (fact.width_px, fact.height_px) for name, fact in facts.items()}
    warnings += [*in_two_formats(sizes_px), *thumbnails(sizes_px)]
    facts, remarks = with_conventions(facts)
    warnings += remarks if lists.poses == EXIF and lists.angles == "auto" else []
    return facts, warnings


def _located(
    lists: GivenLists,
    observations: dict[str, Observation],
    facts: Mapping[str, ExifFacts],
    crs: str,
    known_frame: WorldFrame | None,
    sigmas: tuple[float, float],
    given_heights: GivenHeights,
) -> tuple[Located, str, list[str]]:
    """Return the observations in the world frame, what its heights count from, and remarks.

    crs, known_frame, given_heights: as of `block_inputs`. sigmas: of a position in metres and of an attitude in degrees
    that states none.
    """
    stated_crs = _stated_crs(lists, crs)
    observations, warnings = _agreeing(lists, observations, facts, stated_crs if crs == AUTO and stated_crs else crs)
    located = oriented(observations, crs, stated_crs, known_frame, *sigmas)
    wanted = heights_of(crs) if crs.strip().lower() not in ("", AUTO, LOCAL) else ""
    stated = _stated_heights(lists, wanted, given_heights)
    located, heights, remarks = in_world_heights(located, stated, wanted, crs, given_heights.shift_m)
    warnings += remarks
    warnings += [f"{of_images(items, facts)} {what}: treated as unposed" for what, items in located.unusable.items()]
    warnings += _level_flight(located, facts)
    warnings += foreign_crs(located)
    return located, heights, warnings


class _GroundHint(NamedTuple):
    """World height of the ground as the input states it, None for unknown; source: where it comes from, in words."""

    z_m: float | None
    source: str
    is_stated: bool


def _ground_hint(lists: GivenLists, located: Located, facts: Mapping[str, ExifFacts]) -> _GroundHint:
    """Return the ground that the camera file states, else that below the relative altitudes; none where heights count
    from the flight."""
    if located.heights_from_flight:
        return _GroundHint(None, "", is_stated=False)
    stated = _stated_ground(lists.camera_file, located.frame, Path(lists.cameras).name)
    if stated is not None:
        return _GroundHint(*stated, is_stated=True)
    return _GroundHint(*_relative_ground(located.poses, facts), is_stated=False)


def _recognised(lists: GivenLists, rows: Mapping[str, PoseRow], headers: Mapping[str, object], with_camera: int) -> str:
    if lists.pose_list is None:
        return ""
    cameras = f", {with_camera} with its camera" if with_camera else ""
    return f"{lists.pose_list.format}: {len(rows)} of {len(headers)} images{cameras}"


def _images(ids: Mapping[str, str], facts: Mapping[str, ExifFacts], camera_ids: Mapping[str, str]) -> tuple[Image, ...]:
    """Sorted by image_id."""
    images = [
        Image(
            image_id=ids[name],
            name=name,
            width_px=fact.width_px,
            height_px=fact.height_px,
            camera_id=camera_ids[name],
            exif_orientation=fact.orientation,
            time=fact.time,
        )
        for name, fact in facts.items()
    ]
    return tuple(sorted(images, key=lambda image: image.image_id))


def _report_scan(scan_failures: Sequence[ScanFailure]) -> tuple[list[str], list[ReadFailure]]:
    """Warnings of by-products, one per kind, and failures of pictures that are missing."""
    failures = [ReadFailure(item.name, item.reason) for item in scan_failures if item.image_lost]
    passed: dict[str, list[str]] = defaultdict(list)
    for item in scan_failures:
        if not item.image_lost:
            passed[item.reason].append(item.name)
    return [f"passed over {len(items)}: {listed(items)}: {reason}" for reason, items in passed.items()], failures


def _nothing_left(images_dir: str, failures: list[ReadFailure], passed_over: list[str]) -> str:
    if not failures:
        return "; ".join([f"no image ({KINDS}) in {images_dir}: check --images", *passed_over])
    many = f"none of the {len(failures)} images in {images_dir} can be used"
    words = form(len(failures), f"the only image in {images_dir} cannot be used", many)
    return f"{words}; {failures[0].name}: {failures[0].reason}"


def _assign_cameras(lists: GivenLists, facts: Mapping[str, ExifFacts], columns: Mapping[str, str]) -> CameraAssignment:
    """Return the cameras of a camera file, else of the pose file, else of EXIF. columns: image -> camera as the pose
    list names it."""
    stated = lists.pose_list.cameras if lists.pose_list is not None else {}
    if lists.camera_file is not None:
        return _cameras_of_file(lists.camera_file, stated, facts, columns)
    if lists.cameras == EXIF and stated:
        return _cameras_of_poses(stated, facts, columns)
    groups = dict(columns)
    if lists.cameras == FOLDER:
        groups = {}
        for name in facts:
            group = columns.get(name) or str(PurePosixPath(name).parent)
            groups[name] = "" if group == "." else group
    return cameras_from_exif(facts, groups)


def _cameras_of_file(
    camera_file: CameraFile,
    stated: Mapping[str, Camera],
    facts: Mapping[str, ExifFacts],
    columns: Mapping[str, str],
) -> CameraAssignment:
    """Return the cameras of a camera file. stated: those of the pose file, which give way, and so do their names."""
    sizes_px = {name: (fact.width_px, fact.height_px) for name, fact in facts.items()}
    own, remarks = camera_file.cameras, camera_file.remarks
    known = {name: camera for name, camera in columns.items() if camera in own or camera not in stated}
    named = sorted({camera for camera in known.values() if camera})
    if named and not own.keys() & set(named):
        # Of an earlier result, say: names that the program has given.
        remarks = (*remarks, f"the camera file has none of the cameras that the pose list names ({listed(named)}): "
                   "the names are not used")  # fmt: skip
        known = {}
    found = cameras_from_file(own, sizes_px, known)
    return replace(found, warnings=(*remarks, *found.warnings))


def _cameras_of_poses(
    stated: Mapping[str, Camera], facts: Mapping[str, ExifFacts], columns: Mapping[str, str]
) -> CameraAssignment:
    """Cameras of the pose file for the images that it gives one that fits, those of EXIF for the others."""
    named = {name: (facts[name].width_px, facts[name].height_px) for name in facts if columns.get(name)}
    found = cameras_from_file(stated, named, columns)
    others = cameras_from_exif({name: fact for name, fact in facts.items() if name not in found.camera_ids}, {})
    unfit = [
        f"{of_images(found.reasons, facts, 'does', 'do')} not take the camera of the pose file but that of EXIF: "
        f"{reason}"
        for reason in list(found.reasons.values())[:1]
    ]
    return CameraAssignment(
        {**others.cameras, **found.cameras},
        {**others.camera_ids, **found.camera_ids},
        others.reasons,
        (*others.warnings, *unfit),
        {**others.focal_sigmas, **found.focal_sigmas},
        len(found.camera_ids),
    )


def _panoramas(facts: Mapping[str, ExifFacts]) -> tuple[tuple[ReadFailure, ...], list[str]]:
    """Panoramas, which are left out, and what is said of them."""
    names = [name for name, fact in facts.items() if fact.panorama]
    kinds = ", ".join(sorted({fact.panorama[:30] for fact in facts.values() if fact.panorama}))
    what = f"panoramas by their XMP ({kinds}), no pictures of one lens: give the pictures that they were made of"
    said = [f"passed over {len(names)}: {listed(names)}: {what}"] if names else []
    return tuple(ReadFailure(name, what) for name in names), said


def _rasters(facts: Mapping[str, ExifFacts]) -> list[str]:
    """A warning of files that are probably results of an earlier project: a folder above the images was given."""
    names = [name for name, fact in facts.items() if fact.georeferenced]
    what = "georeferenced (GeoTIFF), as orthophotos and height models are"
    said = f"{of_images(names, facts, 'is', 'are')} {what}: move out of the folder what is no aerial image"
    return [said] if names else []


def _observations(
    lists: GivenLists, rows: Mapping[str, PoseRow], facts: Mapping[str, ExifFacts]
) -> tuple[dict[str, Observation], list[str]]:
    """Observations by image name, and remarks on what the headers lack where poses come from EXIF."""
    observations: dict[str, Observation] = {}
    if lists.poses != EXIF:
        for name in facts:
            stated = observation_of_row(rows[name], lists.angles) if name in rows else None
            if stated is not None:
                observations[name] = stated
        return _with_exif_heights(observations, facts)
    without: dict[str, list[str]] = defaultdict(list)
    for name, fact in facts.items():
        observation = observation_of_exif(fact, lists.angles)
        if observation is not None:
            observations[name] = observation
            if observation.attitude is None:
                without["no angles in XMP: position only"].append(name)
        else:
            without["no GPS position: treated as unposed"].append(name)
    remarks = [f"{of_images(items, facts, 'has', 'have')} {what}" for what, items in without.items()]
    notes = Counter(note for fact in facts.values() for note in fact.notes)
    for note, count in notes.items():
        remarks.append(f"{count} of {len(facts)} images: {note}")
    return observations, remarks


def _agreeing(
    lists: GivenLists, observations: dict[str, Observation], facts: Mapping[str, ExifFacts], crs: str
) -> tuple[dict[str, Observation], list[str]]:
    """Those of a pose list, put right by the GPS of the images, and remarks."""
    if lists.pose_list is None:
        return observations, []
    source = f"pose list {lists.poses}"
    refuse_degrees(observations, crs, source)
    return agreed(observations, facts, crs, source)


def _stated_crs(lists: GivenLists, crs: str) -> str | None:
    """What the pose file, else the camera file, says of the coordinates. Raises ConfigError where the user says other.

    crs: what the user gave.
    """
    stated = lists.pose_list.crs if lists.pose_list is not None else None
    if stated is None:
        return lists.camera_file.crs if lists.camera_file is not None else None
    if crs.strip().lower() not in ("", AUTO) and checked_crs(crs) != checked_crs(stated):
        raise ConfigError(
            f"{lists.poses} says that its coordinates are {stated[:60]}, --crs says {crs}: leave out --crs"
        )
    return stated


def _angles_alone(lists: GivenLists, facts: Mapping[str, ExifFacts], known: Mapping[str, Angles]) -> dict[str, Angles]:
    """Angles of images without a position, whose tilts count."""
    if lists.poses != EXIF:
        return {}
    alone = {name: angles_of_exif(fact, lists.angles) for name, fact in facts.items() if name not in known}
    return {name: one for name, one in alone.items() if one is not None}


def _with_exif_heights(
    observations: dict[str, Observation], facts: Mapping[str, ExifFacts]
) -> tuple[dict[str, Observation], list[str]]:
    """A list without any height takes those of the headers: one that has some may count from another zero."""
    if not observations or any(math.isfinite(one.position[2]) for one in observations.values()):
        return observations, []
    heights_m = {name: height_m for name in observations if (height_m := facts[name].altitude_m) is not None}
    for name, height_m in heights_m.items():
        observations[name] = replace(observations[name], position=(*observations[name].position[:2], height_m))
    remark = f"{of_images(heights_m, observations, 'has', 'have')} no height in the list: that of EXIF is used"
    return observations, [remark] if heights_m else []


def _stated_heights(lists: GivenLists, wanted: str, given: GivenHeights) -> str:
    """Return what heights of positions count from, as of `crs.heights_of`, "" for unknown: as the user says, else the
    pose list; of a list in a grid that states nothing else, as the CRS says that the user gave (wanted)."""
    if given.zero.strip().lower() != AUTO:
        return checked_heights(given.zero)
    if lists.pose_list is None:
        return ""
    if lists.pose_list.position_kind == "grid":
        return lists.pose_list.heights or wanted
    return lists.pose_list.heights


def _level_flight(located: Located, facts: Mapping[str, ExifFacts]) -> list[str]:
    """Return what is said of images without a height."""
    if not located.level:
        return []
    zero = f"{located.level_m:.1f} m, that of the others"
    if located.heights_from_flight:
        zero = "0 m, so that heights count from the flight"
    return [
        f"{of_images(located.level, facts, 'has', 'have')} a position without height: a level flight at {zero}, "
        "is assumed"
    ]


def _stated_ground(camera_file: CameraFile | None, frame: WorldFrame, source: str) -> tuple[float, str] | None:
    """World height that the camera file states, and where, None in another frame than the block's: datums differ."""
    if camera_file is None or camera_file.ground_z_m is None:
        return None
    if camera_file.crs is not None and checked_crs(camera_file.crs) != frame.crs:
        return None
    return camera_file.ground_z_m - frame.origin_m[2], f"ground height of {source}"


def _relative_ground(poses: Mapping[str, Pose], facts: Mapping[str, ExifFacts]) -> tuple[float | None, str]:
    """World height below the take-off relative altitudes, and its source."""
    heights_m = [
        float(poses[name].center_m[2]) - relative_m
        for name, fact in facts.items()
        if name in poses and (relative_m := fact.relative_altitude_m) is not None
    ]
    if heights_m:
        return float(np.median(heights_m)), f"XMP relative altitude of {counted(len(heights_m), 'image')}"
    return None, ""
