"""This module finds which other reading of the given angles agrees with the attitudes that the images show.

Angles that are wrong as a whole are seldom random: columns are exchanged, a sign or a zero is another, degrees are
gon. Each such reading is tried on all images at once; the first that fits nearly as well as the best is what happened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.rotations import angle_between_deg, rotation_z

Reading = Callable[[Angles], FloatArray]

# Attitudes agree where the median angle between them is no larger; the frame of a short block is no more exact.
_AGREE_DEG = 5.0
# How far from level the frame of the pictures may be: positions with errors level a small block no better.
_FRAME_DEG = 5.0
# A turn of all headings by fewer standard deviations of the frame's north is none.
_FREE_SIGMAS = 3.0
# Another reading must be better by this factor than the angles as they were read.
_BETTER = 0.4
# Among readings that fit, the first whose median is at most this factor and these degrees above the best.
_NEARLY, _NEARLY_DEG = 1.3, 0.2
# A turn of all yaws that is smaller is no fault.
_LEAST_TURN_DEG = 1.0
# A turn this near to the meridian convergence is that of grid against true north.
_CONVERGENCE_DEG = 0.5
_SMALL_TURN_DEG = 10.0
# A turn this near to one of 90 or 180 degrees is that: the frame of the pictures is no more exact.
_NEAR_QUARTER_DEG = 3.0
# Where more images than this share are right as they were read, the others have faults of their own.
_MOST_RIGHT = 0.2
_MIN_IMAGES = 5
# More images say no more of a convention.
_MOST_IMAGES = 500
_GON_DEG = 0.9
# Kind of angles -> what may be wrong with them, the most usual first: the order in which the values are to be read, and
# what each of these is to be multiplied by.
_FAULTS: Mapping[str, tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]] = {
    "yaw_pitch_roll": (
        ("yaw counts counter-clockwise: change its sign", (0, 1, 2), (-1, 1, 1)),
        ("pitch has the other sign", (0, 1, 2), (1, -1, 1)),
        ("roll has the other sign", (0, 1, 2), (1, 1, -1)),
        ("pitch and roll are exchanged", (0, 2, 1), (1, 1, 1)),
        ("the angles are gon, not degrees", (0, 1, 2), (_GON_DEG,) * 3),
        ("the angles are radians, not degrees", (0, 1, 2), (180.0 / np.pi,) * 3),
    ),
    "omega_phi_kappa": (
        ("omega and phi are exchanged", (1, 0, 2), (1, 1, 1)),
        ("kappa counts clockwise: change its sign", (0, 1, 2), (1, 1, -1)),
        ("omega and phi have the other sign", (0, 1, 2), (-1, -1, 1)),
        ("omega has the other sign", (0, 1, 2), (-1, 1, 1)),
        ("phi has the other sign", (0, 1, 2), (1, -1, 1)),
        ("the angles are gon, not degrees", (0, 1, 2), (_GON_DEG,) * 3),
        ("the angles are radians, not degrees", (0, 1, 2), (180.0 / np.pi,) * 3),
    ),
    "quaternion": (("the quaternions are x, y, z, w, not w, x, y, z", (3, 0, 1, 2), (1, 1, 1, 1)),),
}


@dataclass(frozen=True, eq=False)
class Recognised:
    """words: what is wrong and what to do. rotation: the attitude that given angles stand for. error_deg: median."""

    words: str
    rotation: Reading
    error_deg: float


def recognised(
    given: Mapping[str, Angles], found: Mapping[str, FloatArray], north_sigma_deg: float = 0.0
) -> Recognised | None:
    """Return the reading of the given angles that explains the attitudes found; None where they agree as they are, or
    none does.

    found: image_id -> (3, 3) cam_from_world, in the world frame by positions. north_sigma_deg: how exactly these say
    where north is.
    """
    ids = sorted(given.keys() & found.keys())
    if len(ids) < _MIN_IMAGES:
        return None
    ids = ids[:: 1 + len(ids) // _MOST_IMAGES]
    angles = [given[i] for i in ids]
    true = np.array([found[i] for i in ids])
    free_deg = _FREE_SIGMAS * north_sigma_deg
    as_read = _median_deg(np.array([one.rotation for one in angles]), true, free_deg)
    limit_deg = min(_AGREE_DEG, _BETTER * as_read)
    fits = [fit for fit in _fits(angles, true, free_deg) if fit.error_deg <= limit_deg]
    if not fits:
        return None
    near_deg = _NEARLY * min(fit.error_deg for fit in fits) + _NEARLY_DEG
    fit = next(fit for fit in fits if fit.error_deg <= near_deg)
    read, meant = (np.array([reading(one) for one in angles]) for reading in (_as_read, fit.rotation))
    frame = _of_the_frame(_turns(meant, true), free_deg)
    right = np.rad2deg((frame.inv() * _turns(read, true)).magnitude()) <= limit_deg
    changed = np.array([angle_between_deg(*pair) for pair in zip(read, meant, strict=True)]) > 2.0 * limit_deg
    return None if (right & changed).mean() > _MOST_RIGHT else fit


def _fits(angles: list[Angles], true: FloatArray, free_deg: float) -> Iterator[Recognised]:
    """Every reading and how well it fits, single faults before two at once."""
    readings = [("", _as_read), *_readings(angles)]
    for words, reading in readings[1:]:
        yield Recognised(words, reading, _median_deg(np.array([reading(one) for one in angles]), true, free_deg))
    for words, reading in readings:
        rotations = np.array([reading(one) for one in angles])
        turn_deg = _heading_deg(true.transpose(0, 2, 1) @ rotations)
        error_deg = _median_deg(rotations @ rotation_z(turn_deg).T, true, free_deg)
        turned = abs(turn_deg) > max(_LEAST_TURN_DEG, free_deg)
        if turned and error_deg < _BETTER * _median_deg(rotations, true, free_deg):
            said = _turn_words("yaws" if angles[0].kind == "yaw_pitch_roll" else "headings", turn_deg, angles)
            yield Recognised(" and ".join(filter(None, (words, said))), _turned(reading, turn_deg), error_deg)
        if not words:
            turn_deg = _heading_deg(true @ rotations.transpose(0, 2, 1))
            error_deg = _median_deg(rotation_z(turn_deg) @ rotations, true, free_deg)
            said = _turn_words("kappas", turn_deg, angles) if angles[0].kind == "omega_phi_kappa" else (
                f"the images are turned by {_rounded(turn_deg)} degrees in the camera")  # fmt: skip
            if abs(turn_deg) > max(_LEAST_TURN_DEG, free_deg):
                yield Recognised(said, partial(_turned_in_camera, turn_deg), error_deg)


def _as_read(angles: Angles) -> FloatArray:
    return angles.rotation


def _readings(angles: list[Angles]) -> Iterator[tuple[str, Reading]]:
    """Yield what may be wrong, in words, and the right reading; the most usual faults come first."""
    kind = angles[0].kind
    if kind == "yaw_pitch_roll":
        other = "nadir" if angles[0].forward else "gimbal"
        zero = "straight down" if angles[0].forward else "the horizon"
        yield (
            f"pitch counts from {zero}: give --set block.angles={other}",
            lambda one: replace(one, forward=not one.forward).rotation,
        )
    if kind == "quaternion":
        yield "the quaternions are camera to world, not world to camera", lambda one: one.rotation.T
    for words, order, factors in _FAULTS[kind]:
        yield words, partial(_changed, order, factors)


def _changed(order: tuple[int, ...], factors: tuple[float, ...], angles: Angles) -> FloatArray:
    """Return the rotation (3, 3) of angles whose values are read in an order and multiplied by factors."""
    values = tuple(factor * angles.values[k] for k, factor in zip(order, factors, strict=True))
    return replace(angles, values=values).rotation


def _turned_in_camera(quarter_deg: float, angles: Angles) -> FloatArray:
    return rotation_z(quarter_deg) @ angles.rotation


def _turned(reading: Reading, turn_deg: float) -> Reading:
    turn = rotation_z(turn_deg).T
    return lambda one: reading(one) @ turn


def _turn_words(name: str, turn_deg: float, angles: list[Angles]) -> str:
    said = f"all {name} are off by {_rounded(abs(turn_deg))} degrees"
    convergence = float(np.median([abs(one.convergence_deg) for one in angles]))
    if convergence > _LEAST_TURN_DEG and abs(abs(turn_deg) - convergence) < _CONVERGENCE_DEG:
        return f"{said}, which is the meridian convergence: they count from grid north, not from true north"
    return said


def _rounded(turn_deg: float) -> str:
    return f"{turn_deg:.1f}" if abs(turn_deg) < _SMALL_TURN_DEG else f"{turn_deg:.0f}"


def _heading_deg(turns: FloatArray) -> float:
    """Angle about z, degrees, that most turns (N, 3, 3) have."""
    headings = np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1])
    # The median on the circle: the heading that lies nearest to most others.
    away = np.abs((headings[:, None] - headings[None] + np.pi) % (2.0 * np.pi) - np.pi)
    middle = headings[int(np.argmin(away.sum(axis=1)))]
    near = (headings - middle + np.pi) % (2.0 * np.pi) - np.pi
    turn_deg = float(np.rad2deg(middle + np.median(near)))
    quarter_deg = 90.0 * round(turn_deg / 90.0)
    return quarter_deg if quarter_deg and abs(turn_deg - quarter_deg) < _NEAR_QUARTER_DEG else turn_deg


def _median_deg(rotations: FloatArray, true: FloatArray, free_deg: float) -> float:
    """Median angle between attitudes, degrees, but for what all have in common by the frame's own error."""
    turns = _turns(rotations, true)
    return float(np.median(np.rad2deg((_of_the_frame(turns, free_deg).inv() * turns).magnitude())))


def _turns(rotations: FloatArray, true: FloatArray) -> Any:
    """Return the turns of the world (N) from each true attitude to the given one; rotations, true: (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(true.transpose(0, 2, 1) @ rotations)


def _of_the_frame(turns: Any, free_deg: float) -> Any:
    """Return the turn that all turns share by the frame's own error: a small tilt, and a heading up to free_deg."""
    from scipy.spatial.transform import Rotation

    common = np.median(turns.as_rotvec(degrees=True), axis=0)
    common[:2] *= np.linalg.norm(common[:2]) <= _FRAME_DEG
    common[2] *= abs(common[2]) <= free_deg
    return Rotation.from_rotvec(common, degrees=True)
