"""From positions and angles in any convention to poses in the world frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from aeromatch_cli.blocks.accuracies import Sigmas, overall_sigma_m
from aeromatch_cli.blocks.crs import (
    LOCAL,
    WorldFrame,
    choose_crs,
    convergence_deg,
    converted_heights,
    geographic_from_grid,
    grid_from_geographic,
    heights_words,
    outside_area,
    rounded_origin_m,
)
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.pose_columns import AttitudeKind, PositionKind
from aeromatch_cli.blocks.poses import PoseRow
from aeromatch_cli.data import FloatArray, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.words import form

AngleConvention = Literal["auto", "gimbal", "nadir"]

_FAR_M = 1_000_000.0  # no block reaches from its frame's zero this far
# Standard deviation of a flight's height above or below its level, in metres, where heights are not given.
_LEVEL_SIGMA_M = 10.0


@dataclass(frozen=True)
class Observation:
    """Where and how one image was taken, as stated. Units and kinds as in `poses.PoseRow`; a height may be NaN.

    sigmas_m: standard deviations to the east, to the north and of the height.
    forward: for yaw, pitch, roll: True where the optical axis is body x (gimbal), False where it is down (nadir).
    true_north: as in `poses.PoseRow`.
    """

    position: tuple[float, float, float]
    position_kind: PositionKind
    attitude: tuple[float, ...] | None
    attitude_kind: AttitudeKind
    forward: bool
    sigmas_m: Sigmas | None = None
    sigma_angle_deg: float | None = None
    true_north: bool = False


def observation_of_row(row: PoseRow, angles: AngleConvention) -> Observation | None:
    """What a line of a pose list states; None without position. "auto" means what the format says, else gimbal."""
    if row.position is None:
        return None
    stated = row.forward if row.forward is not None else True
    return Observation(
        position=row.position,
        position_kind=row.position_kind,
        attitude=row.attitude,
        attitude_kind=row.attitude_kind,
        forward=stated if angles == "auto" else angles != "nadir",
        sigmas_m=row.sigmas_m,
        sigma_angle_deg=row.sigma_angle_deg,
        true_north=row.true_north,
    )


def observation_of_exif(facts: ExifFacts, angles: AngleConvention) -> Observation | None:
    """What an image's header states; None without position. "auto" goes by the tags' origin."""
    if facts.latitude_deg is None or facts.longitude_deg is None:
        return None
    altitude_m = np.nan if facts.altitude_m is None else facts.altitude_m
    position = (facts.latitude_deg, facts.longitude_deg, altitude_m)
    found = facts.angles
    if found is None:
        return Observation(position, "geographic", None, "none", forward=True, sigmas_m=facts.sigmas_m)
    convention = found.convention if angles == "auto" else angles
    attitude = (found.yaw_deg, found.pitch_deg, found.roll_deg)
    forward = convention == "gimbal"
    sigmas = facts.sigmas_m, facts.sigma_angle_deg
    return Observation(position, "geographic", attitude, "yaw_pitch_roll", forward, *sigmas)


class Located(NamedTuple):
    """Observations in the world frame.

    poses, angles: by image name; angles are the attitudes as they were given. unusable: what is wrong with other
    positions, in words -> names. level: images without a height. level_m: the height that they were given, in the CRS.
    """

    frame: WorldFrame
    poses: dict[str, Pose]
    angles: dict[str, Angles]
    unusable: Mapping[str, Sequence[str]]
    level: Sequence[str]
    level_m: float

    @property
    def heights_from_flight(self) -> bool:
        """Whether heights count from the flight: a ground that counts from elsewhere says nothing there."""
        return bool(self.level) and len(self.level) == len(self.poses)


def angles_of_exif(facts: ExifFacts, angles: AngleConvention) -> Angles | None:
    """Attitude that an image's header states, whether or not it states a position; yaw as it counts there."""
    found = facts.angles
    if found is None:
        return None
    convention = found.convention if angles == "auto" else angles
    return Angles("yaw_pitch_roll", (found.yaw_deg, found.pitch_deg, found.roll_deg), convention == "gimbal")


def oriented(
    observations: Mapping[str, Observation],
    crs: str,
    stated_crs: str | None,
    known_frame: WorldFrame | None,
    sigma_position_m: float,
    sigma_angle_deg: float,
) -> Located:
    """Everything in one world frame. Images without heights get the median of the others', or 0 where none has one.

    crs: what the user gave ("auto", "local" or a code); stated_crs: what an input file states, or None. known_frame:
    the frame of an earlier run on a block that has grown since; used again where its CRS is the same, so that old
    poses keep their numbers. sigmas: where an observation states none. Raises ConfigError.
    """
    geographic = {name: o for name, o in observations.items() if o.position_kind == "geographic"}
    degrees = np.array([o.position[:2] for o in geographic.values()]).reshape(-1, 2)
    code = _code(crs, stated_crs, known_frame, degrees)
    grid = {name: np.array(o.position) for name, o in observations.items() if o.position_kind == "grid"}
    turns = _grid_turns(code, observations, grid)
    outside: list[str] = []
    if geographic:
        projected, convergences, outside = _projected(code, geographic, degrees)
        grid |= projected
        turns |= convergences
    zeros = _grid_zeros(code, grid)
    grid = {name: center_m for name, center_m in grid.items() if name not in zeros}
    grid, level_m, level = _with_heights(grid)
    frame = WorldFrame(code, _origin_m(code, list(grid.values()), known_frame))
    angles, poses = dict[str, Angles](), dict[str, Pose]()
    for name, center_m in grid.items():
        observation = observations[name]
        stated = _angles(observation, turns[name])
        if stated is not None:
            angles[name] = stated
        sigmas_m = _sigmas_m(observation, sigma_position_m)
        poses[name] = Pose(
            center_m=center_m - np.array(frame.origin_m),
            world_rotation=None if stated is None else stated.rotation,
            sigma_position_m=overall_sigma_m(sigmas_m),
            sigma_angle_deg=observation.sigma_angle_deg or sigma_angle_deg,
            sigmas_m=sigmas_m if len(set(sigmas_m)) > 1 else None,
        )
    area = f"outside the area of {code}"
    faults = {}
    if outside:
        faults[form(len(outside), f"lies {area}", f"lie {area}")] = outside
    if zeros:
        faults[form(len(zeros), "has the position (0, 0)", "have the position (0, 0)")] = zeros
    return Located(frame, poses, angles, faults, level, level_m)


def in_world_heights(
    located: Located, stated: str, wanted: str, crs: str, shift_m: float
) -> tuple[Located, str, list[str]]:
    """Return positions whose heights count from where the CRS says, what that is, "" for unknown, and remarks.

    stated, wanted: what heights count from, as of `crs.heights_of`: as something states it, and by the CRS that the
    user gave (crs); "" for unknown. shift_m: is added to the heights.
    """
    if located.heights_from_flight or not located.poses or located.frame.crs == LOCAL:
        return located, "", []
    origin_m = np.array(located.frame.origin_m)
    places_m = np.array([pose.center_m for pose in located.poses.values()]) + origin_m
    heights_m, own, remarks = _transformed(places_m, stated, wanted, located.frame.crs, crs)
    if shift_m:
        heights_m = heights_m + shift_m
        remarks.append(f"heights of positions are shifted by {shift_m:+g} m, as block.height_shift_m asks")
        own = wanted
    poses = {
        name: replace(pose, center_m=np.array([*pose.center_m[:2], height_m - origin_m[2]]))
        for (name, pose), height_m in zip(located.poses.items(), heights_m, strict=True)
    }
    return located._replace(poses=poses), own, remarks


def _transformed(
    places_m: FloatArray, stated: str, wanted: str, code: str, crs: str
) -> tuple[FloatArray, str, list[str]]:
    """Return the heights (N,) of places (N, 3) in a CRS (code), what they count from, and remarks; transformed where
    that is known and not what is wanted. crs: as the user gave it."""
    if wanted and not stated:
        remark = (
            f"--crs {crs} names {heights_words(wanted)}, and nothing states what heights of positions count from: they "
            "stay as they are; --set block.heights=ellipsoid has them transformed"
        )
        return places_m[:, 2], stated, [remark]
    if not wanted or stated == wanted:
        return places_m[:, 2], stated, []
    heights_m, why_not = converted_heights(code, stated, wanted, places_m)
    if why_not:
        remark = f"positions: {why_not}; --set block.height_shift_m=METRES shifts them by a known height"
        return heights_m, stated, [remark]
    by_m = float(np.median(heights_m - places_m[:, 2]))
    words = f"from {heights_words(stated)} to {heights_words(wanted)}"
    return heights_m, wanted, [f"heights of positions are transformed {words}: {by_m:+.2f} m (median)"]


def foreign_crs(located: Located) -> list[str]:
    """Return what is said of a CRS that is used elsewhere."""
    origin_m = np.array(located.frame.origin_m[:2])
    places_m = np.array([pose.center_m[:2] for pose in located.poses.values()]).reshape(-1, 2) + origin_m
    remark = outside_area(located.frame.crs, places_m)
    return [remark] if remark else []


def _code(crs: str, stated_crs: str | None, known_frame: WorldFrame | None, degrees: FloatArray) -> str:
    """Return the CRS of the world: that of an earlier run where nothing names one and it suits, else as `choose_crs`.

    degrees: latitudes and longitudes (N, 2) of the positions that have such.
    """
    automatic = crs.strip().lower() in ("", "auto") and stated_crs is None
    if known_frame is not None and automatic and (known_frame.crs == LOCAL) == (not len(degrees)):
        return known_frame.crs
    return choose_crs(crs, stated_crs, degrees[:, 0].tolist(), degrees[:, 1].tolist())


def _projected(
    code: str, geographic: Mapping[str, Observation], degrees: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, float], list[str]]:
    """Return centres (3,) in the grid of a CRS, meridian convergences in degrees, and names of positions outside.

    degrees: (N, 2) latitudes and longitudes of the observations. Raises ConfigError where all lie outside.
    """
    latitudes, longitudes = degrees[:, 0], degrees[:, 1]
    xy_m = grid_from_geographic(code, latitudes, longitudes)
    convergences = convergence_deg(code, latitudes, longitudes)
    grid, turns, outside = dict[str, FloatArray](), dict[str, float](), list[str]()
    for row, (name, observation) in enumerate(geographic.items()):
        if np.isfinite(xy_m[row]).all() and np.isfinite(convergences[row]):
            grid[name] = np.array([*xy_m[row], observation.position[2]])
            turns[name] = float(convergences[row])
        else:
            outside.append(name)
    if len(outside) == len(geographic):
        raise ConfigError(f"no position lies in the area of {code}: check --crs, and latitude against longitude")
    return grid, turns, outside


def _sigmas_m(observation: Observation, usual_m: float) -> Sigmas:
    """Standard deviations of a position along x, y, z: east and north by the list are taken for those of the grid."""
    x_m, y_m, z_m = observation.sigmas_m or (usual_m, usual_m, usual_m)
    return x_m, y_m, max(z_m, _LEVEL_SIGMA_M) if np.isnan(observation.position[2]) else z_m


def _grid_turns(code: str, observations: Mapping[str, Observation], grid: Mapping[str, FloatArray]) -> dict[str, float]:
    """Meridian convergence, degrees, of grid positions whose angles count from true north; 0 of the others."""
    turns = dict.fromkeys(grid, 0.0)
    names = [name for name in grid if observations[name].true_north and np.isfinite(grid[name][:2]).all()]
    if code != LOCAL and names:
        places = geographic_from_grid(code, np.array([grid[name][:2] for name in names]))
        found = convergence_deg(code, places[:, 0], places[:, 1])
        turns |= {name: float(turn) for name, turn in zip(names, found, strict=True) if np.isfinite(turn)}
    return turns


def _with_heights(grid: Mapping[str, FloatArray]) -> tuple[dict[str, FloatArray], float, list[str]]:
    """Centres that all have a height, the one that was put in, and for which images: flights are about level."""
    level = [name for name, center_m in grid.items() if np.isnan(center_m[2])]
    heights_m = [center_m[2] for center_m in grid.values() if not np.isnan(center_m[2])]
    level_m = float(np.median(heights_m)) if heights_m else 0.0
    filled: dict[str, FloatArray] = {name: np.array([*grid[name][:2], level_m]) for name in level}
    return {**grid, **filled}, level_m, level


def _grid_zeros(crs: str, grid: Mapping[str, FloatArray]) -> list[str]:
    """Names whose x and y are exactly zero, which stands for "unknown"; a local frame may begin there."""
    zeros = [name for name, center_m in grid.items() if not center_m[:2].any()]
    others = [float(np.hypot(*center_m[:2])) for name, center_m in grid.items() if center_m[:2].any()]
    if crs == LOCAL and (not others or min(others) < _FAR_M):
        return []
    return zeros


def _origin_m(crs: str, centers_m: list[FloatArray], known: WorldFrame | None) -> tuple[float, float, float]:
    if known is not None and known.crs == crs:
        return known.origin_m
    if crs == LOCAL and (not centers_m or np.abs(np.array(centers_m)).max() < 1e5):
        return 0.0, 0.0, 0.0  # small coordinates stay as the user knows them
    return rounded_origin_m(np.array(centers_m)) if centers_m else (0.0, 0.0, 0.0)


def _angles(observation: Observation, convergence_deg: float) -> Angles | None:
    """convergence_deg: 0 where the position was given in the grid."""
    if observation.attitude is None or observation.attitude_kind == "none":
        return None
    facts = observation.attitude_kind, observation.attitude, observation.forward
    return Angles(*facts, convergence_deg, observation.true_north)
