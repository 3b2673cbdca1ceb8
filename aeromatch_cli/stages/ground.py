"""The ground of a block as it is stated (a height, a DEM, the camera file, altitudes) and as the pictures show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.ground import ConstantGround, DemGround, SeveralGrounds, open_dem, stated_height_m
from aeromatch_cli.blocks.read import BlockInputs
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, FloatArray, Ground, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.fingerprints import image_fingerprint
from aeromatch_cli.results.stages import OrientResult
from aeromatch_cli.sfm.dem import Terrain
from aeromatch_cli.sfm.epipolar_agreement import heights_above_m, position_errors_m
from aeromatch_cli.sfm.georeferencing import SIMILARITY_UNKNOWNS
from aeromatch_cli.sfm.heights import height_remedy, zeros_words
from aeromatch_cli.stages.context import Context

# A stated ground that differs from the terrain of the pictures by this share of the flying height is said; so is one
# that differs by more than so many standard deviations of a position, whichever is more.
_SAID_SHARE, _SAID_SIGMAS = 0.1, 3.0
# Median length of a vector whose three coordinates have a standard deviation of 1.
_MEDIAN_DISTANCE = 1.54
# A DEM is more exact than a height that somebody states. It has the shape of the terrain, and its heights count from
# another zero, where it differs by nearly the same everywhere: second share, median deviation from the median.
_DEM_SHARE, _ALIKE_SHARE = 0.05, 0.03
# No trees or houses are higher: a DEM of bare ground below them lies no farther below what the pictures show.
_TALLEST_M = 40.0
# No ground lies farther above or below the zero of its heights.
_FARTHEST_M = 100_000.0
# A stated ground that differs by this share is wrong: views and footprints of it would miss each other.
_WRONG_SHARE = 0.3
# Heights above the take-off point differ from those above ground by more than this only where something is wrong.
_ALTITUDE_SHARE = 0.25


def ground_fingerprint(settings: Settings) -> str:
    """Return the fingerprint of the ground setting; of a DEM also that of its content, since it may be replaced in
    place."""
    text = settings.block.ground
    return f"{text} {image_fingerprint(Path(text))}" if Path(text).is_file() else text


def check_ground(text: str) -> None:
    """Raise ConfigError for a ground that is no height, no file and not `auto`."""
    z_m = stated_height_m(text)
    if z_m is not None and not abs(z_m) <= _FARTHEST_M:
        raise ConfigError(f"--ground {text}: no height of any ground, in metres; give one, a DEM or auto")
    if z_m is None and text != "auto" and not Path(text).exists():
        raise ConfigError(f"--ground {text}: no such file, and no number: give metres, a DEM or auto")


def given_ground(settings: Settings, inputs: BlockInputs) -> tuple[Ground | None, str, tuple[str, ...]]:
    """Return the ground that settings or the camera file state, where it comes from in words, and remarks; else
    None."""
    text = settings.block.ground
    if (z_m := stated_height_m(text)) is not None:
        return ConstantGround(z_m - inputs.origin_m[2]), f"given: {z_m:g} m", ()
    if text != "auto":
        positions = np.array([pose.center_m for pose in inputs.poses.values()]).reshape(-1, 3)
        dem, remarks = open_dem(Path(text), inputs.crs, inputs.origin_m, positions, inputs.heights)
        return dem, f"DEM {text}", remarks
    if inputs.ground_hint_z_m is not None and inputs.ground_is_stated:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    return None, "", ()


def judged_ground(
    context: Context, terrains: Sequence[Terrain], found: OrientResult, oriented: Mapping[str, Pose]
) -> tuple[Ground | None, str, list[str]]:
    """Return the ground that later stages use, where it comes from in words, and what contradicts it.

    terrains: of the pictures, one for each flight. found: by the orientation. oriented: the poses that it has given
    images. A stated ground wins, unless it cannot be right.
    """
    ground, source = context.block.ground, context.block.ground_source
    own_frame = found.frame == "own"
    if not terrains:
        return (None, "", []) if own_frame else (ground, source, [])
    parts = tuple(
        DemGround(one.heights_m, one.west_m, one.north_m, (one.cell_m, one.cell_m), float(np.median(one.heights_m)))
        for one in terrains
    )
    shown: Ground = parts[0] if len(parts) == 1 else SeveralGrounds(parts)
    words = f"terrain from {found.points} points of the first pass"
    if ground is None or own_frame:
        return shown, words, []
    centers_m = _centers_m(context.block)
    off_m, spread_m, flying_m = heights_above_m(ground, shown, centers_m)
    share, sigma_m = _SAID_SHARE, context.settings.block.sigma_position_m
    if isinstance(ground, DemGround):
        share, sigma_m = _DEM_SHARE, float(np.median([p.axis_sigmas_m[2] for p in context.block.poses.values()]))
    terrain_m = _terrain_sigma_m(context.block.poses, oriented, sigma_m, flying_m)
    # However inexact positions are: views and footprints are made by the poses as they are.
    excused_m = min(_SAID_SIGMAS * terrain_m, max(_SAID_SIGMAS * sigma_m, _WRONG_SHARE * flying_m))
    if abs(off_m) <= max(share * flying_m, excused_m):
        return ground, source, []
    remark = (
        f"the ground ({source}) lies {abs(off_m):.1f} m {'above' if off_m > 0 else 'below'} the terrain that the "
        f"pictures show, at a flying height of {flying_m:.1f} m"
    )
    if isinstance(ground, DemGround) and spread_m <= _ALIKE_SHARE * flying_m:
        shift = f"{'lowered' if off_m > 0 else 'raised'} by {abs(off_m):.1f} m"
        covered = ", unless trees or roofs cover the ground all over" if -_TALLEST_M < off_m < 0.0 else ""
        words = (
            f"{remark}, and everywhere about as much (to {spread_m:.1f} m): {zeros_words(off_m)}{covered}. The DEM is "
            f"used, {shift}; {height_remedy(off_m, 'the DEM')}"
        )
        return ground.shifted(-off_m), f"{source}, {shift}", [words]
    remark += ": do heights and ground count from the same zero (ellipsoid, sea level, take-off point)?"
    keeps = context.settings.keeps_poses or abs(off_m) <= _WRONG_SHARE * flying_m
    return (ground, source, [remark]) if keeps else (shown, words, [f"{remark} The terrain of the pictures is used"])


def _terrain_sigma_m(
    given: Mapping[str, Pose], oriented: Mapping[str, Pose], stated_m: float, flying_m: float
) -> float:
    """Return how exactly positions tell the height of the terrain of the pictures: as they are stated, or as they fit
    these where that is worse. What they are off by changes the scale, and that the flying height."""
    off_m = position_errors_m(given, oriented)
    if not off_m:
        return stated_m
    known = 3 * len(off_m)
    # The pictures were moved onto the positions, which takes that many numbers.
    taken = np.sqrt(known / max(known - SIMILARITY_UNKNOWNS, 1))
    sigma_m = max(stated_m, taken * float(np.median([*off_m.values()])) / _MEDIAN_DISTANCE)
    centers_m = np.array([oriented[i].center_m for i in off_m])
    extent_m = float(np.linalg.norm(centers_m - centers_m.mean(axis=0)))
    return sigma_m * max(1.0, flying_m / max(extent_m, 1e-9))


def judged_altitudes(
    ground: Ground | None, block: Block, found: OrientResult, altitudes: tuple[Ground, str] | None
) -> list[str]:
    """Say where heights above the take-off point disagree with the ground. found: result of the orientation."""
    if altitudes is None or ground is None or not block.poses or found.frame == "own":
        return []
    off_m, _, flying_m = heights_above_m(altitudes[0], ground, _centers_m(block))
    if abs(off_m) <= _ALTITUDE_SHARE * flying_m:
        return []
    return [
        f"{altitudes[1]}: flying height {flying_m - off_m:.1f} m, but {flying_m:.1f} m by the pictures: the take-off "
        "point lies at another height than the ground, or the focal length is wrong (give --cameras)"
    ]


def _centers_m(block: Block) -> FloatArray:
    return np.array([pose.center_m for pose in block.poses.values()]).reshape(-1, 3)
