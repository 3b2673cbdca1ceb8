"""Georeferencing places an oriented model in the world by the given positions, else levels it by the ground that it
sees.

A mapper gives poses and points up to a similarity. Positions that are spread in two directions determine it, the
worse the closer they lie together; positions along one line leave the turn about the line open; without positions the
whole orientation and the scale are open. What is open is taken from the tilts that the cameras have measured, where
these agree with each other, else from the terrain: the plane near most of its points is about level, the cameras are
above it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.sfm.bundle.network import drift_of

# Without positions the median flying height becomes this many units.
LOCAL_FLYING_HEIGHT = 100.0
# Positions count as agreeing up to this many standard deviations, or this share of the block's extent.
_AGREE_SIGMAS = 3.0
_AGREE_EXTENT = 0.01
# The error that is allowed doubles until this share of the positions agrees.
_LEAST_AGREEING = 0.6
# Positions that do not agree to this share of the extent either are not those of the images; nor to this share of their
# median distance from the middle, where there are so many: chance has places that near.
_BELIEVED_EXTENT, _BELIEVED_SPREAD, _BELIEVED_MANY = 0.1, 0.4, 8
# Where fewer than this share agree within their standard deviations, and what neighbours are off by agrees to this
# correlation, errors have a common cause (a delay between GPS and shutter, say), which no average takes away: the block
# is levelled as if they were larger by this factor.
_TRUSTED = 0.85
_COMMON = 0.5
_DOUBTFUL = 5.0
# A stated standard deviation counts as much as so many residuals, from which it is estimated once more.
_STATED_RESIDUALS = 3.0
SIMILARITY_UNKNOWNS = 7
# Delays of positions that are tried, seconds, so many to either side; one is taken that leaves this share of what they
# are off by.
_MOST_DELAY_S, _DELAYS, _DELAY_BETTER = 2.0, 80, 0.3
# How far from level the plane through most points of a terrain usually is, and from how many independent heights it
# comes: a roof or a hillside lifts many points together.
_LEVEL_SIGMA_DEG = 3.0
_HEIGHTS = 4.0
# Planes that are tried through three of so many points at least and at most; one counts where this share of all points
# is nearer to it by this factor. In a valley each side has half of them, and what fits all of them best is right.
_PLANES, _PLANE_POINTS, _NEAR_SHARE, _CLEARLY = 300, (30, 2000), 0.7, 0.7
# The mean of measured tilts is no better than this, whatever their number; they count where they agree to so many
# degrees with each other, and with the terrain to so many, or standard deviations of the terrain.
_TILT_SIGMA_DEG = 1.0
_TILTS_AGREE_DEG, _TILTS_PLAUSIBLE_DEG, _TILTS_PLAUSIBLE_SIGMAS = 10.0, 30.0, 3.0
# Tilts that contradict positions and terrain together by so many standard deviations have a fault in common: an angle
# of another convention, a camera mounted askew. There the terrain counts less: it may be a slope.
_TILTS_WRONG_SIGMAS, _SLOPE_SIGMA_DEG = 4.0, 6.0
# Weights fall beyond this distance from the mean.
_TILTS_NEAR_DEG = 3.0
_LEAST_TILTS = 3


@dataclass(frozen=True, eq=False)
class Placement:
    """World point = scale * rotation @ model point + translation_m.

    kind: "positions" (by positions, and by the terrain as far as these leave it open) or "level" (no positions: level
    by the terrain, scale and origin arbitrary). agreeing: (N,) which positions were used; False where there is none.
    trusted: whether nearly all positions agree with the pictures as well as their standard deviations say.
    contradiction: why given positions were not used: "mirrored" (they fit only with the ground above the cameras),
    "scattered" (they do not fit), else "". level_sigma_deg: how exactly tilts or terrain say where up is. sigma_factor:
    standard deviations of the positions, as the pictures show them, over those stated. north_sigma_deg: how exactly
    positions say where north is. by_tilts: whether measured tilts say where up is, not the terrain.
    """

    scale: float
    rotation: FloatArray
    translation_m: FloatArray
    kind: str
    agreeing: BoolArray
    trusted: bool
    contradiction: str = ""
    level_sigma_deg: float = np.inf
    sigma_factor: float = 1.0
    by_tilts: bool = False
    north_sigma_deg: float = np.inf

    def points(self, points: FloatArray) -> FloatArray:
        """World points (N, 3) of model points (N, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation_m)

    def rotations(self, cam_from_model: FloatArray) -> FloatArray:
        """Rotations (N, 3, 3) cam_from_world of rotations cam_from_model."""
        return np.asarray(cam_from_model @ self.rotation.T)


def place(
    centers: FloatArray,
    points: FloatArray,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    ups: FloatArray | None = None,
) -> Placement:
    """Return the similarity from a model to the world.

    centers: (N, 3) projection centres in the model; points: (P, 3) its points; positions_m: (N, 3) given positions in
    the world, NaN where there is none; sigmas_m: (N,) their standard deviations. ups: (N, 3) unit vectors upwards in
    the model by the tilt that each camera has measured, NaN where it has none.
    """
    by_terrain = _terrain(centers, points)
    vertical = _vertical(by_terrain, ups)
    known: BoolArray = np.asarray(np.isfinite(positions_m).all(axis=1))
    found = _by_positions(centers[known], positions_m[known], sigmas_m[known]) if known.sum() >= 2 else None
    if found is None:
        return _level(centers, points, known, vertical)
    contradiction = found.contradiction
    if not contradiction and _upside_down(found, centers[known], positions_m[known], sigmas_m[known], vertical):
        contradiction = "mirrored"
    if contradiction:
        return replace(_level(centers, points, known, vertical), contradiction=contradiction)
    agreeing = np.zeros(len(centers), dtype=bool)
    agreeing[np.flatnonzero(known)[found.agreeing]] = True
    found = replace(found, agreeing=agreeing)
    used_m = positions_m[agreeing]
    stated_m = float(np.median(sigmas_m[agreeing]))
    sigma_m = _sigma_m(found, found.points(centers[agreeing]) - used_m, used_m, stated_m)
    found = replace(found, sigma_factor=sigma_m / max(stated_m, 1e-9))
    measured = _Measured(centers[agreeing], used_m, max(sigma_m, 1e-9))
    # Against the terrain alone positions are as exact as they agree with each other.
    drift = drift_of(stated_m, used_m[:, :2] - used_m[:, :2].mean(axis=0))
    drifting = replace(measured, drift=drift)
    # Tilts that the terrain agrees with are no error of the mounting, however steeply such positions rise.
    confirmed = drift > 0.0 and _agree(by_terrain, vertical)
    if vertical is by_terrain or (not confirmed and _off_level(found, drifting, by_terrain, vertical)):
        return _levelled(found, measured, by_terrain)[0]
    return _levelled(replace(found, by_tilts=True), drifting, vertical)[0]


def height_steps_m(
    centers: FloatArray,
    points: FloatArray,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    ups: FloatArray,
    flights: IntArray,
) -> FloatArray:
    """Return by how much (N,) the given heights of an image's flight lie above those of the flight of most images.

    Two batteries, two zeros of the barometer or the receiver: between parallel strips such a step tilts the block. It
    is taken for one where the measured tilts agree with each other, contradict the positions, and agree with them once
    the flights' heights are moved; else all are zero. Arguments as of `place`; flights: (N,) numbers.
    """
    none = np.zeros(len(centers))
    by_terrain = _terrain(centers, points)
    vertical = _vertical(by_terrain, ups)
    known = np.isfinite(positions_m).all(axis=1)
    numbers, counts = np.unique(flights[known], return_counts=True)
    if (
        vertical is by_terrain
        or len(numbers) < 2
        or not _contradict(centers[known], positions_m[known], sigmas_m[known], by_terrain, vertical)
    ):
        return none
    level = _Measured(centers[known], positions_m[known], 1.0)
    turned = centers @ _level_start(level, vertical.up).T
    scale = _Measured(turned[known] * [1.0, 1.0, 0.0], positions_m[known] * [1.0, 1.0, 0.0], 1.0).fit(np.eye(3))[0]
    above_m = positions_m[:, 2] - scale * turned[:, 2]
    of_flight = {n: float(np.median(above_m[known & (flights == n)])) for n in numbers.tolist()}
    most = of_flight[int(numbers[np.argmax(counts)])]
    steps_m = np.array([of_flight.get(int(n), most) - most for n in flights])
    moved_m = positions_m - steps_m[:, None] * [0.0, 0.0, 1.0]
    still = _contradict(centers[known], moved_m[known], sigmas_m[known], by_terrain, vertical)
    return none if still else steps_m


def _contradict(
    centers: FloatArray,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    by_terrain: _Vertical,
    by_tilts: _Vertical,
) -> bool:
    """Whether measured tilts contradict what positions and terrain say together of where up is; also where positions
    say nothing."""
    found = _by_positions(centers, positions_m, sigmas_m)
    if found is None or found.agreeing.sum() < 2:
        return True
    used, used_m = centers[found.agreeing], positions_m[found.agreeing]
    stated_m = float(np.median(sigmas_m[found.agreeing]))
    sigma_m = max(_sigma_m(found, found.points(used) - used_m, used_m, stated_m), 1e-9)
    return _off_level(found, _Measured(used, used_m, sigma_m), by_terrain, by_tilts)


@dataclass(frozen=True, eq=False)
class _Vertical:
    """up: (3,) unit vector in the model, with its standard deviation."""

    up: FloatArray
    sigma_deg: float


@dataclass(frozen=True, eq=False)
class _Measured:
    """Centres in the model (N, 3), their positions in the world (N, 3), and the standard deviation of these; drift: of
    the slope of their heights that receivers without corrections have in common, metres per metre."""

    centers: FloatArray
    positions_m: FloatArray
    sigma_m: float
    drift: float = 0.0

    def fit(self, rotation: FloatArray) -> tuple[float, FloatArray]:
        """Scale and translation (3,) that go best with a rotation."""
        turned = self.centers @ rotation.T
        arms, arms_m = turned - turned.mean(axis=0), self.positions_m - self.positions_m.mean(axis=0)
        scale = float((arms * arms_m).sum() / max(float((arms**2).sum()), 1e-300))
        return scale, self.positions_m.mean(axis=0) - scale * turned.mean(axis=0)

    def off(self, rotation: FloatArray) -> FloatArray:
        """(N, 3) residuals with that rotation, in standard deviations."""
        scale, translation_m = self.fit(rotation)
        return np.asarray((scale * self.centers @ rotation.T + translation_m - self.positions_m) / self.sigma_m)


def delay_s(centers: FloatArray, positions_m: FloatArray, velocities_m_s: FloatArray) -> float:
    """Return by how much positions lag behind the exposures, seconds; 0 where that does not make them fit far better.

    Roughly, as a start: an adjustment finds it exactly. centers, positions_m: (N, 3) as of `place`; velocities_m_s:
    (N, 3) of the aircraft, zero where they are not known.
    """
    known = np.isfinite(positions_m).all(axis=1) & (np.abs(velocities_m_s).sum(axis=1) > 0.0)
    if known.sum() <= SIMILARITY_UNKNOWNS:
        return 0.0
    own, given_m, moved_m_s = centers[known], positions_m[known], velocities_m_s[known]

    def off_m(late_s: float) -> float:
        places_m = given_m - late_s * moved_m_s
        return float(np.median(_errors(similarity(own, places_m), own, places_m)))

    tried = np.linspace(-_MOST_DELAY_S, _MOST_DELAY_S, 2 * _DELAYS + 1)
    best = float(min(tried, key=off_m))
    return best if off_m(best) < _DELAY_BETTER * off_m(0.0) else 0.0


def _vertical(by_terrain: _Vertical, ups: FloatArray | None) -> _Vertical:
    """Up by the measured tilts, where these agree, else by the terrain."""
    measured = np.zeros((0, 3)) if ups is None else ups[np.isfinite(ups).all(axis=1)]
    if len(measured) < _LEAST_TILTS:
        return by_terrain
    up = np.median(measured, axis=0)
    for _ in range(10):
        apart_deg = np.rad2deg(np.arccos(np.clip(measured @ up / np.linalg.norm(up), -1.0, 1.0)))
        up = np.average(measured, axis=0, weights=1.0 / (1.0 + (apart_deg / _TILTS_NEAR_DEG) ** 2))
    up = up / np.linalg.norm(up)
    apart_deg = np.rad2deg(np.arccos(np.clip(measured @ up, -1.0, 1.0)))
    most_deg = min(max(_TILTS_PLAUSIBLE_DEG, _TILTS_PLAUSIBLE_SIGMAS * by_terrain.sigma_deg), 90.0)
    plausible = up @ by_terrain.up > np.cos(np.deg2rad(most_deg))
    spread_deg = float(np.median(apart_deg))
    sigma_deg = float(np.hypot(_TILT_SIGMA_DEG, spread_deg / np.sqrt(len(measured))))
    return _Vertical(up, sigma_deg) if plausible and spread_deg < _TILTS_AGREE_DEG else by_terrain


def similarity(source: FloatArray, target: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return scale, rotation (3, 3) and translation (3,) that take source (N, 3) to target (N, 3) best (Umeyama
    1991)."""
    middle0, middle1 = source.mean(axis=0), target.mean(axis=0)
    u, strengths, vt = np.linalg.svd((target - middle1).T @ (source - middle0))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = u * signs @ vt
    spread = float(((source - middle0) ** 2).sum())
    scale = float((strengths * signs).sum() / spread) if spread > 0.0 else 1.0
    return scale, rotation, middle1 - scale * rotation @ middle0


def _by_positions(centers: FloatArray, positions_m: FloatArray, sigmas_m: FloatArray) -> Placement | None:
    """The similarity that most positions agree with, or None where they are all in one place."""
    extent_m = float(np.linalg.norm(np.ptp(positions_m, axis=0)))
    # Heights alone scale nothing: where a file states one place for all images, their barometer goes on.
    across_m = float(np.linalg.norm(np.ptp(positions_m[:, :2], axis=0)))
    if across_m <= float(np.median(sigmas_m)) * 1e-3 or np.linalg.norm(np.ptp(centers, axis=0)) <= 0.0:
        return None
    limits_m = np.maximum(_AGREE_SIGMAS * sigmas_m, _AGREE_EXTENT * extent_m)
    rng = np.random.default_rng(0)
    samples = [rng.choice(len(centers), size=min(3, len(centers)), replace=False) for _ in range(500)]
    fits = [similarity(centers[s], positions_m[s]) for s in samples]
    errors_m = np.array([_errors(fit, centers, positions_m) for fit in fits])
    for factor in 2.0 ** np.arange(8):
        agree = errors_m <= factor * limits_m
        best = int(np.argmax(agree.sum(axis=1)))
        if agree[best].sum() >= max(2, _LEAST_AGREEING * len(centers)):
            break
    chosen = agree[best]
    fit = fits[best]
    for _ in range(10):
        fit = similarity(centers[chosen], positions_m[chosen])
        again = _errors(fit, centers, positions_m) <= factor * limits_m
        if (again == chosen).all() or again.sum() < 2:
            break
        chosen = again
    if fit[0] <= 0.0:
        return None
    found_m = _errors(fit, centers, positions_m)
    trusted = float((found_m <= limits_m).mean()) >= _TRUSTED
    believed = float((found_m <= _loose_m(positions_m, sigmas_m)).mean()) >= _LEAST_AGREEING
    return Placement(*fit, "positions", chosen, trusted, "" if believed else "scattered")


def _upside_down(
    found: Placement, centers: FloatArray, positions_m: FloatArray, sigmas_m: FloatArray, vertical: _Vertical
) -> bool:
    """Whether positions fit only with the ground above the cameras: seen from below they are mirrored.

    Positions along one line fit either way.
    """
    up = vertical.up
    if (found.rotation @ up)[2] >= 0.0:
        return False
    # Points below the centres keep the fit upright.
    depth = float(np.linalg.norm(np.ptp(centers, axis=0)))
    down_m = found.scale * depth * np.array([0.0, 0.0, 1.0])
    fit = similarity(
        np.concatenate([centers, centers - depth * up]), np.concatenate([positions_m, positions_m - down_m])
    )
    return float((_errors(fit, centers, positions_m) <= _loose_m(positions_m, sigmas_m)).mean()) < _LEAST_AGREEING


def _loose_m(positions_m: FloatArray, sigmas_m: FloatArray) -> FloatArray:
    """(N,) errors beyond which positions are not those of the images."""
    share_m = _BELIEVED_EXTENT * float(np.linalg.norm(np.ptp(positions_m, axis=0)))
    if len(positions_m) >= _BELIEVED_MANY:
        apart_m = np.linalg.norm(positions_m - np.median(positions_m, axis=0), axis=1)
        share_m = max(share_m, _BELIEVED_SPREAD * float(np.median(apart_m)))
    return np.asarray(np.maximum(_AGREE_SIGMAS * sigmas_m, share_m))


def _errors(fit: tuple[float, FloatArray, FloatArray], centers: FloatArray, positions_m: FloatArray) -> FloatArray:
    scale, rotation, translation_m = fit
    return np.asarray(np.linalg.norm(scale * centers @ rotation.T + translation_m - positions_m, axis=1))


def _level(centers: FloatArray, points: FloatArray, known: BoolArray, vertical: _Vertical) -> Placement:
    """Level, the median flying height LOCAL_FLYING_HEIGHT, the middle of the cameras at x = y = 0."""
    rotation = _level_axes(vertical.up)
    ground = float(np.median((points @ rotation.T)[:, 2]))
    flying = float(np.median((centers @ rotation.T)[:, 2])) - ground
    scale = LOCAL_FLYING_HEIGHT / max(flying, 1e-12)
    middle = np.array([*np.median((centers @ rotation.T)[:, :2], axis=0), ground])
    return Placement(scale, rotation, -scale * middle, "level", np.zeros_like(known), trusted=False)


def _sigma_m(found: Placement, errors_m: FloatArray, used_m: FloatArray, stated_m: float) -> float:
    """Standard deviation of the positions used (N, 3), as stated and by what they are off the model (N, 3)."""
    spare = max(errors_m.size - SIMILARITY_UNKNOWNS, 0)  # so many errors are seen, the others are in the fit
    squares = _STATED_RESIDUALS * stated_m**2 + float((errors_m**2).sum())
    sigma_m = float(np.sqrt(squares / (_STATED_RESIDUALS + spare)))
    shared = not found.trusted and _common(errors_m, used_m) > _COMMON
    return sigma_m * (_DOUBTFUL if shared else 1.0)


def _common(errors_m: FloatArray, places_m: FloatArray) -> float:
    """Correlation of errors (N, 3) with those of the nearest place (N, 3)."""
    from scipy.spatial import cKDTree

    near = cKDTree(places_m).query(places_m, k=2)[1]
    others = np.where(near[:, 0] == np.arange(len(near)), near[:, 1], near[:, 0])  # two may lie in one place
    nearest = errors_m[others]
    return float((errors_m * nearest).sum() / max((errors_m**2).sum(), 1e-12))


def _agree(first: _Vertical, second: _Vertical) -> bool:
    apart_deg = np.rad2deg(np.arccos(np.clip(first.up @ second.up, -1.0, 1.0)))
    return bool(apart_deg <= _AGREE_SIGMAS * np.hypot(first.sigma_deg, second.sigma_deg))


def _off_level(found: Placement, measured: _Measured, by_terrain: _Vertical, by_tilts: _Vertical) -> bool:
    """Whether the tilts contradict what positions and terrain say together of where up is."""
    slope = replace(by_terrain, sigma_deg=max(_SLOPE_SIGMA_DEG, by_terrain.sigma_deg))
    without, covariance = _levelled(found, measured, slope)
    off_deg = np.rad2deg(np.arccos(np.clip((without.rotation @ by_tilts.up)[2], -1.0, 1.0)))
    sigma_deg = float(np.hypot(np.rad2deg(np.sqrt(np.diag(covariance)[:2].mean())), by_tilts.sigma_deg))
    return bool(off_deg > _TILTS_WRONG_SIGMAS * sigma_deg)


def _levelled(found: Placement, measured: _Measured, vertical: _Vertical) -> tuple[Placement, FloatArray]:
    """The most probable attitude of the block, and the covariance (3, 3) of a small turn of it, square radian.

    Positions, whose heights may have a slope in common, and tilts or terrain, which say where up is with their own
    standard deviation, are weighed against each other by least squares. Positions along one line say nothing of the
    turn about it: what they fit best is chance there, and no place to start from. So the search starts level, too.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    arms_m = measured.positions_m[:, :2] - measured.positions_m[:, :2].mean(axis=0)

    def off(unknowns: FloatArray, start: FloatArray) -> FloatArray:
        turn, slopes = unknowns[:3], unknowns[3:]
        rotation = Rotation.from_rotvec(turn).as_matrix() @ start
        positions = measured.off(rotation)
        positions[:, 2] += measured.drift * (arms_m @ slopes) / measured.sigma_m
        up = rotation @ vertical.up
        away = np.cross(up, [0.0, 0.0, 1.0])[:2]
        if up[2] < 0.0:  # beyond a right angle the sine falls again
            away = away / max(float(np.linalg.norm(away)), 1e-9) * (1.0 - up[2])
        return np.concatenate([positions.ravel(), away / np.deg2rad(vertical.sigma_deg), slopes])

    best = np.inf, found.rotation
    for start in (_level_start(measured, vertical.up), found.rotation):
        solved = least_squares(off, np.zeros(5), x_scale=[0.1, 0.1, 0.1, 1.0, 1.0], args=(start,))
        rotation = Rotation.from_rotvec(solved.x[:3]).as_matrix() @ start
        if solved.cost < best[0] and measured.fit(rotation)[0] > 0.0:  # a negative scale is a reflection
            best = solved.cost, rotation
    rotation = best[1]
    small = least_squares(off, np.append(np.zeros(3), solved.x[3:]), max_nfev=1, args=(rotation,)).jac
    covariance = np.linalg.inv(small.T @ small + 1e-9 * np.eye(5))[:3, :3]
    scale, translation_m = measured.fit(rotation)
    placed = replace(
        found, scale=scale, rotation=rotation, translation_m=translation_m, level_sigma_deg=vertical.sigma_deg,
        north_sigma_deg=float(np.rad2deg(np.sqrt(covariance[2, 2]))),
    )  # fmt: skip
    return placed, covariance


def _level_start(measured: _Measured, up: FloatArray) -> FloatArray:
    """The rotation (3, 3) that makes up vertical, with the heading that fits the positions best."""
    level = _level_axes(up)
    arms = (measured.centers - measured.centers.mean(axis=0)) @ level.T
    arms_m = measured.positions_m - measured.positions_m.mean(axis=0)
    across = float((arms[:, 0] * arms_m[:, 1] - arms[:, 1] * arms_m[:, 0]).sum())
    heading = np.arctan2(across, float((arms[:, :2] * arms_m[:, :2]).sum()))
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ level)


def _level_axes(up: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes the unit vector up to (0, 0, 1)."""
    east = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    east /= np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


def _terrain(centers: FloatArray, points: FloatArray) -> _Vertical:
    """The normal of the plane through most points, towards the cameras; far points and outliers weigh less.

    A plane through a narrow strip of rough ground is known less exactly: by its roughness over its width. Where houses
    stand at one side of it, what fits all points best is no place to start from: planes through three points are tried.
    """
    plane = _plane(points, np.ones(len(points)))
    least, most = _PLANE_POINTS
    if len(points) >= least:
        rng = np.random.default_rng(0)
        some = points if len(points) <= most else points[rng.choice(len(points), most, replace=False)]
        nearer = _plane(some, _near(some, *_plane_of_three(some, rng)))
        plane = nearer if nearer[3] < _CLEARLY * plane[3] else plane
    middle, normal, rough_deg, _ = plane
    side = float(np.median((centers - middle) @ normal))
    return _Vertical(normal if side >= 0.0 else -normal, float(np.hypot(_LEVEL_SIGMA_DEG, rough_deg)))


def _plane(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
    """A point (3,) and the normal (3,) of a plane through most points, how exactly those that it goes through determine
    it, degrees, and by how much _NEAR_SHARE of the points are off it at most. weights: (P,), of the first step."""
    middle, sizes, normal = np.zeros(3), np.ones(3), np.zeros(3)
    for _ in range(10):
        middle = np.average(points, axis=0, weights=weights)
        sizes, axes = np.linalg.svd((points - middle) * np.sqrt(weights)[:, None], full_matrices=False)[1:]
        normal = axes[2]
        weights = _near(points, middle, normal)
    rough_deg = float(np.rad2deg(np.arctan2(sizes[2], np.sqrt(_HEIGHTS) * sizes[1])))
    return middle, normal, rough_deg, float(np.quantile(np.abs((points - middle) @ normal), _NEAR_SHARE))


def _near(points: FloatArray, middle: FloatArray, normal: FloatArray) -> FloatArray:
    """(P,) weights of points, the smaller the farther they are off a plane."""
    off = (points - middle) @ normal
    scale = 1.4826 * float(np.median(np.abs(off))) or 1e-12
    return np.asarray(1.0 / (1.0 + (off / (2.0 * scale)) ** 2) ** 2)


def _plane_of_three(points: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A point and the normal (3,) of that plane through three points from which _NEAR_SHARE of all points are least
    off."""
    corners = points[rng.integers(len(points), size=(_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-300)[:, None]
    off = np.quantile(np.abs((points[None] - corners[:, :1]) @ normals[:, :, None])[:, :, 0], _NEAR_SHARE, axis=1)
    best = int(np.argmin(np.where(lengths > 0.0, off, np.inf)))
    return corners[best, 0], normals[best]
