"""Flight plans: strips, five-camera rigs, sweeps, orbits, arcs and mixtures of them, a planner for each in FLIGHTS.

Headings are clockwise from grid north (world y). A flight's own plan is (right, forward) of its heading; every flight
is centred on the world's origin. All cameras of a sortie sample the ground about equally finely.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.rotations import rotation_x, rotation_y, rotation_z
from aeromatch_cli.lab.synthetic.lenses import REAL, real_lens
from aeromatch_cli.lab.synthetic.stations import Exterior, Station, exterior_of, make_camera

FORWARD_OVERLAP, SIDE_OVERLAP = 0.70, 0.60
SECOND_HEIGHT_FACTOR = 1.35
# Focal lengths as shares of the picture width. An oblique camera is longer by the slant, for the same ground sampling.
_NADIR_FOCAL, _SWEEP_FOCAL = 0.9, 4.0
_OBLIQUE_TILT_DEG = 45.0
_OBLIQUE_FOCAL = _NADIR_FOCAL / float(np.cos(np.deg2rad(_OBLIQUE_TILT_DEG)))
_NADIR_ID, _SWEEP_ID = "1", "6"
# Direction of look against the heading, clockwise, of the oblique cameras of the rig: forward, back, left, right.
RIG_LOOKS_DEG: Mapping[str, float] = MappingProxyType({"2": 0.0, "3": 180.0, "4": -90.0, "5": 90.0})
# Less overlap than between nadir pictures: oblique pictures see the ground one flying height away from their station.
_RIG_FORWARD_OVERLAP, _RIG_SIDE_OVERLAP = 0.40, 0.40
# Roll angles of a sweep, first to the right. Frames of 14 degrees every 12.5 degrees overlap by a tenth.
SWEEP_ANGLES_DEG = tuple(float(v) for v in np.linspace(50.0, -50.0, 9))
_SWEEP_FORWARD_OVERLAP = 0.50
# At this distance of the strips, in flying heights, frames that look inwards from one strip meet frames of the other on
# the same ground, 35 to 50 degrees apart: tan 37.5 + tan 12.5 = 0.99, 2 tan 25 = 0.93, tan 50 - tan 12.5 = 0.97.
_SWEEP_STRIP_DISTANCE = 0.97
_ORBIT_TILTS_DEG = (45.0, 35.0, 55.0)
# Of an arc: the upper edge of a picture of 4:3 looks 76 to 84 degrees off straight down, at ground 2.4 to 4.1 times as
# far from the foot point as its middle.
_ARC_TILTS_DEG = (64.0, 60.0, 68.0)
_ARC_STEP_DEG = 8.0
_SECOND_HEADING_DEG = 75.0
_MIXED_SWEEP_DEG = 25.0
# Of a nadir flight with further strips across or tilted pictures: so many of all images are nadir ones along.
_ALONG_SHARE = 2.0 / 3.0
_ACROSS_DEG, _TILTED_DEG = 90.0, 30.0
# Sigmas of the wobble: height and plan position in flying heights, then tilt, heading in degrees. The long focal length
# of a sweep camera needs a steadier, higher aircraft.
_HEIGHT_SIGMA, _POSITION_SIGMA, _TILT_SIGMA_DEG, _HEADING_SIGMA_DEG = 0.03, 0.01, 2.0, 2.5
_SWEEP_STEADINESS = 0.25
_AIM_SIGMA, _ORBIT_ROLL_SIGMA_DEG = 0.02, 1.5


@dataclass(frozen=True)
class Order:
    """What a planner is asked for: so many pictures of that size, taken from height_m through that lens."""

    images: int
    width_px: int
    height_px: int
    height_m: float
    lens: str
    rng: np.random.Generator

    def camera(self, focal_share: float) -> Camera:
        """Of that many picture widths; a real lens is another one with each call."""
        if self.lens == REAL:
            return real_lens(self.rng, self.width_px, self.height_px, focal_share)
        return make_camera(self.lens, self.width_px, self.height_px, focal_share)

    def rig(self) -> dict[str, Camera]:
        """The nadir camera "1" and the oblique cameras "2" to "5", which differ a little as real ones do."""
        obliques = {key: self.camera(_OBLIQUE_FOCAL * (1.0 + 0.002 * k)) for k, key in enumerate(RIG_LOOKS_DEG)}
        return {_NADIR_ID: self.camera(_NADIR_FOCAL)} | obliques

    def steps_m(self, forward_overlap: float, side_overlap: float) -> tuple[float, float]:
        """Forward and side distance of pictures straight down with these overlaps, at the nadir camera's sampling."""
        gsd = self.height_m / (_NADIR_FOCAL * self.width_px)
        return (1.0 - forward_overlap) * self.height_px * gsd, (1.0 - side_overlap) * self.width_px * gsd

    @property
    def sweep_height_m(self) -> float:
        """From where the long camera samples the ground as finely as the nadir camera from height_m."""
        return self.height_m * _SWEEP_FOCAL / _NADIR_FOCAL


@dataclass(frozen=True)
class _Spot:
    """Where an aircraft is to be: plan position in the world and heading."""

    x_m: float
    y_m: float
    heading_deg: float


def _spot(right_m: float, forward_m: float, heading_deg: float) -> _Spot:
    """The spot at a place of the plan of a flight of that heading."""
    s, c = np.sin(np.deg2rad(heading_deg)), np.cos(np.deg2rad(heading_deg))
    return _Spot(float(right_m * c + forward_m * s), float(forward_m * c - right_m * s), heading_deg)


def _strips(count: int, strips: int, forward_m: float, side_m: float, heading_deg: float = 0.0) -> Iterator[_Spot]:
    """`count` spots in parallel strips, flown to and fro along the heading; the last strip may be shorter."""
    longest = -(-count // strips)
    for k in range(count):
        strip, step = divmod(k, longest)
        there = strip % 2 == 0
        along = (step - 0.5 * (longest - 1)) * forward_m
        spot = _spot((strip - 0.5 * (strips - 1)) * side_m, along if there else -along, heading_deg)
        yield spot if there else _Spot(spot.x_m, spot.y_m, heading_deg + 180.0)


def _nadir_strips(order: Order, height_m: float, heading_deg: float = 0.0) -> Iterator[_Spot]:
    """Strips 3:2 longer than the block is wide, with the overlaps of a nadir flight."""
    forward_m, side_m = order.steps_m(FORWARD_OVERLAP, SIDE_OVERLAP)
    scale = height_m / order.height_m
    strips = max(1, round(float(np.sqrt(order.images / 1.5))))
    return _strips(order.images, strips, scale * forward_m, scale * side_m, heading_deg)


def _shot(spot: _Spot, height_m: float, mount: FloatArray, wobble: FloatArray) -> Exterior:
    """Exterior orientation of a camera mounted by aircraft_from_photo (3, 3) at a spot.

    Aircraft axes: x right, y forward, z up. wobble: (6,) standard normal or smaller, one for all cameras of a rig.
    """
    position = np.array([spot.x_m, spot.y_m, height_m])
    position = position + height_m * wobble[:3] * [_POSITION_SIGMA, _POSITION_SIGMA, _HEIGHT_SIGMA]
    pitch, roll = _TILT_SIGMA_DEG * wobble[3:5]
    heading = spot.heading_deg - _HEADING_SIGMA_DEG * wobble[5]
    return exterior_of(position, rotation_z(-heading) @ rotation_x(pitch) @ rotation_y(roll) @ mount)


def _look(direction_deg: float, off_nadir_deg: float) -> FloatArray:
    """aircraft_from_photo of a camera that looks so far off straight down, in that direction clockwise from ahead.

    The top of the picture points the way it looks, as on a rig where every oblique camera has the horizon on top.
    """
    return rotation_z(-direction_deg) @ rotation_x(off_nadir_deg)


def _mount(camera_id: str) -> FloatArray:
    """aircraft_from_photo of a camera of the rig."""
    return np.eye(3) if camera_id == _NADIR_ID else _look(RIG_LOOKS_DEG[camera_id], _OBLIQUE_TILT_DEG)


_Planned = tuple[Mapping[str, Camera], list[Station]]


def _plan_nadir(order: Order) -> _Planned:
    stations = [_nadir_station(order, spot, order.height_m, 0) for spot in _nadir_strips(order, order.height_m)]
    return {_NADIR_ID: order.camera(_NADIR_FOCAL)}, stations


def _nadir_station(order: Order, spot: _Spot, height_m: float, sortie: int) -> Station:
    return Station(
        _shot(spot, height_m, np.eye(3), order.rng.standard_normal(6)), _NADIR_ID, sortie, height_m, spot.heading_deg
    )


def _plan_cross(order: Order) -> _Planned:
    """Strips along, and fewer across them at the same height."""
    along = round(_ALONG_SHARE * order.images)
    spots = [
        *_nadir_strips(replace(order, images=along), order.height_m),
        *_nadir_strips(replace(order, images=order.images - along), order.height_m, _ACROSS_DEG),
    ]
    return {_NADIR_ID: order.camera(_NADIR_FOCAL)}, [_nadir_station(order, s, order.height_m, 0) for s in spots]


def _plan_two_heights(order: Order) -> _Planned:
    """The same strips twice, half of the pictures from higher up."""
    low = -(-order.images // 2)
    stations = []
    for images, height_m in ((low, order.height_m), (order.images - low, SECOND_HEIGHT_FACTOR * order.height_m)):
        spots = _nadir_strips(replace(order, images=images), height_m)
        stations += [_nadir_station(order, spot, height_m, 0) for spot in spots]
    return {_NADIR_ID: order.camera(_NADIR_FOCAL)}, stations


def _plan_tilted(order: Order) -> _Planned:
    """Nadir strips along, and strips across them whose pictures look ahead."""
    along = round(_ALONG_SHARE * order.images)
    nadir = _nadir_strips(replace(order, images=along), order.height_m)
    stations = [_nadir_station(order, spot, order.height_m, 0) for spot in nadir]
    for spot in _nadir_strips(replace(order, images=order.images - along), order.height_m, _ACROSS_DEG):
        exterior = _shot(spot, order.height_m, _look(0.0, _TILTED_DEG), order.rng.standard_normal(6))
        stations.append(Station(exterior, _NADIR_ID, 0, order.height_m, spot.heading_deg))
    return {_NADIR_ID: order.camera(_NADIR_FOCAL)}, stations


def _plan_oblique(order: Order) -> _Planned:
    return _plan_rig(order, _RIG_FORWARD_OVERLAP, _RIG_SIDE_OVERLAP)


def _plan_dense_rig(order: Order) -> _Planned:
    """Two strips at least: positions along one line leave the turn about it open."""
    return _plan_rig(order, FORWARD_OVERLAP, SIDE_OVERLAP, fewest_strips=2)


def _plan_rig(order: Order, forward_overlap: float, side_overlap: float, fewest_strips: int = 1) -> _Planned:
    """Few strips and long ones: forward and back pictures meet two flying heights apart on the same strip."""
    cameras = order.rig()
    count = -(-order.images // len(cameras))
    strips = max(fewest_strips, round(float(np.sqrt(count / 3.0))))
    stations = []
    for spot in _strips(count, strips, *order.steps_m(forward_overlap, side_overlap)):
        wobble = order.rng.standard_normal(6)
        for camera_id in cameras:
            exterior = _shot(spot, order.height_m, _mount(camera_id), wobble)
            stations.append(Station(exterior, camera_id, 0, order.height_m, spot.heading_deg))
    return cameras, stations[: order.images]


def _plan_sweep(order: Order) -> _Planned:
    """Sweeps from right to left, so that a short last sweep still looks at the strip beside it."""
    height, frames = order.sweep_height_m, len(SWEEP_ANGLES_DEG)
    advance_m, _ = order.steps_m(_SWEEP_FORWARD_OVERLAP, SIDE_OVERLAP)
    sweeps = -(-order.images // frames)
    strips = 1 if sweeps == 1 else max(2, round(float(np.sqrt(sweeps / 8.0))))
    stations = []
    for start in _strips(sweeps, strips, advance_m, _SWEEP_STRIP_DISTANCE * height):
        for frame, angle_deg in enumerate(SWEEP_ANGLES_DEG):
            moved = _spot(0.0, (frame / frames - 0.5) * advance_m, start.heading_deg)
            spot = _Spot(start.x_m + moved.x_m, start.y_m + moved.y_m, start.heading_deg)
            stations.append(_sweep_station(order, spot, height, angle_deg, 0))
    return {_SWEEP_ID: order.camera(_SWEEP_FOCAL)}, stations[: order.images]


def _sweep_station(order: Order, spot: _Spot, height_m: float, angle_deg: float, sortie: int) -> Station:
    wobble = _SWEEP_STEADINESS * order.rng.standard_normal(6)
    # Rolled to look to the right by the angle: the top of the picture stays ahead.
    return Station(_shot(spot, height_m, rotation_y(-angle_deg), wobble), _SWEEP_ID, sortie, height_m, spot.heading_deg)


def _plan_orbit(order: Order) -> _Planned:
    """Three circles at one distance from the middle, taken in turn, so that neighbours differ in tilt as well."""
    return _around_the_middle(order, [360.0 * k / order.images for k in range(order.images)], _ORBIT_TILTS_DEG)


def _plan_arc(order: Order) -> _Planned:
    """Strongly oblique pictures from one side, as of a drone that passes a site: their upper half looks far beyond."""
    step_deg, middle = min(_ARC_STEP_DEG, 360.0 / order.images), 0.5 * (order.images - 1)
    return _around_the_middle(order, [step_deg * (k - middle) for k in range(order.images)], _ARC_TILTS_DEG)


def _around_the_middle(order: Order, headings_deg: Sequence[float], tilts_deg: Sequence[float]) -> _Planned:
    """Pictures of the middle of the block, from one distance, a heading each, the tilts in turn."""
    distance_m = order.height_m / float(np.cos(np.deg2rad(_OBLIQUE_TILT_DEG)))
    stations = []
    for k, heading_deg in enumerate(headings_deg):
        tilt = np.deg2rad(tilts_deg[k % len(tilts_deg)])
        wobble = order.rng.standard_normal(6)
        foot = _spot(0.0, -distance_m * float(np.sin(tilt)), heading_deg)
        height_m = distance_m * float(np.cos(tilt))
        position = np.array([foot.x_m, foot.y_m, height_m])
        position += order.height_m * _POSITION_SIGMA * wobble[:3]
        aim = np.append(order.height_m * _AIM_SIGMA * wobble[3:5], 0.0) - position
        direction = float(np.rad2deg(np.arctan2(aim[0], aim[1])))
        tilted = float(np.rad2deg(np.arctan2(np.hypot(aim[0], aim[1]), -aim[2])))
        photo = _look(direction, tilted) @ rotation_z(_ORBIT_ROLL_SIGMA_DEG * wobble[5])
        stations.append(
            Station(exterior_of(position, photo), "2", 0, height_m, heading_deg + 90.0)
        )  # around the middle
    return {"2": order.camera(_OBLIQUE_FOCAL)}, stations


def _plan_two_flights(order: Order) -> _Planned:
    first = -(-order.images // 2)
    second_m = order.height_m * SECOND_HEIGHT_FACTOR
    halves = (first, order.height_m, 0.0), (order.images - first, second_m, _SECOND_HEADING_DEG)
    stations = []
    for sortie, (images, height_m, heading_deg) in enumerate(halves):
        spots = _nadir_strips(replace(order, images=images), height_m, heading_deg)
        stations += [_nadir_station(order, spot, height_m, sortie) for spot in spots]
    return {_NADIR_ID: order.camera(_NADIR_FOCAL)}, stations


def _plan_mixed(order: Order) -> _Planned:
    """Both sorties, in each a quarter of a round for every kind of picture, all over the same ground.

    A round is 24 pictures: per sortie four nadir, four oblique from two opposite sides and four sweep frames from two
    sides. Further rounds look at ground beside it, their obliques from the other two sides. The pictures are given in
    the order of sorties and cameras, those of few images spread over all kinds.
    """
    cameras = order.rig() | {_SWEEP_ID: order.camera(_SWEEP_FOCAL)}
    stations: list[Station] = []
    while len(stations) < order.images:
        stations += _mixed_round(order, len(stations) // 24)
    return cameras, sorted(stations[: order.images], key=lambda s: (s.sortie, s.camera_id))


def _mixed_round(order: Order, number: int) -> Iterator[Station]:
    forward_m, side_m = order.steps_m(FORWARD_OVERLAP, SIDE_OVERLAP)
    advance_m, _ = order.steps_m(_SWEEP_FORWARD_OVERLAP, SIDE_OVERLAP)
    sweep_foot_m = order.sweep_height_m * float(np.tan(np.deg2rad(_MIXED_SWEEP_DEG)))
    for k in range(4):
        side, ahead = (-1.0 if k % 2 == 0 else 1.0), (-1.0 if k < 2 else 1.0)
        for sortie in range(2):
            scale = SECOND_HEIGHT_FACTOR if sortie else 1.0
            height_m, sweep_m = scale * order.height_m, scale * order.sweep_height_m
            spot = _mixed_spot(order, number, sortie, 0.5 * side * side_m, 0.5 * ahead * forward_m)
            yield _nadir_station(order, spot, height_m, sortie)
            # The second sortie crosses the first: its left and right cameras look where forward and back did. From one
            # flying height away the camera sees the middle of the round; a tenth nearer or farther makes four spots.
            camera_id = (("2", "3"), ("4", "5"))[(sortie + number) % 2][k % 2]
            away_m, look = (1.0 + 0.1 * ahead) * order.height_m, np.deg2rad(RIG_LOOKS_DEG[camera_id])
            spot = _mixed_spot(order, number, sortie, -away_m * float(np.sin(look)), -away_m * float(np.cos(look)))
            exterior = _shot(spot, height_m, _mount(camera_id), order.rng.standard_normal(6))
            yield Station(exterior, camera_id, sortie, height_m, spot.heading_deg)
            spot = _mixed_spot(order, number, sortie, -side * sweep_foot_m, 0.5 * ahead * advance_m)
            yield _sweep_station(order, spot, sweep_m, side * _MIXED_SWEEP_DEG, sortie)


def _mixed_spot(order: Order, number: int, sortie: int, right_m: float, forward_m: float) -> _Spot:
    """The spot of a sortie at a place of the first sortie's plan around the middle of a round, grown by its height."""
    scale, heading_deg = (SECOND_HEIGHT_FACTOR, _SECOND_HEADING_DEG) if sortie else (1.0, 0.0)
    spot = _spot(scale * right_m, scale * forward_m, heading_deg)
    # Middles of the rounds lie on a sunflower spiral: evenly spread, and each near the others.
    middle = _spot(0.0, 0.25 * order.height_m * float(np.sqrt(number)), 137.508 * number)
    return _Spot(spot.x_m + middle.x_m, spot.y_m + middle.y_m, heading_deg)


FLIGHTS: Mapping[str, Callable[[Order], _Planned]] = MappingProxyType(
    {
        "nadir": _plan_nadir,
        "oblique": _plan_oblique,
        "sweep": _plan_sweep,
        "orbit": _plan_orbit,
        "arc": _plan_arc,
        "two-flights": _plan_two_flights,
        "mixed": _plan_mixed,
        "cross": _plan_cross,
        "two-heights": _plan_two_heights,
        "tilted": _plan_tilted,
        "dense-rig": _plan_dense_rig,
    }
)
