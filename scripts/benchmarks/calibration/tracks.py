"""Which images see which ground, and tracks as SIFT would find them: short, of like views, some of them wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import normalise, project
from aeromatch_cli.lab.synthetic.raycast import RayCaster

# A point counts as seen when nothing stands more than this in front of it.
_TOLERANCE_M = 2e-3
# Farther away, in flying heights, an oblique picture has no tie points.
_FARTHEST = 3.0
# An assumption: SIFT matches less and less as views differ, weight exp(-(angle / 25 degrees)^2), and nothing beyond 60.
_LIKE_VIEW_DEG, _MOST_DEG = 25.0, 60.0
# An assumption, too: tracks have two images or more and end at each with this probability; means come out near 3.2.
_END = 0.4
# A wrong match is so many pixels along the epipolar line away from where the point is.
_WRONG_PX = (3.0, 30.0)


@dataclass(frozen=True, eq=False)
class Picture:
    """One simulated picture: its name, exact lens and pose, and the height it was flown at."""

    image_id: str
    camera_id: str
    camera: Camera
    pose: Pose
    height_m: float

    def rotation(self) -> FloatArray:
        assert self.pose.world_rotation is not None
        return self.pose.world_rotation

    def project(self, points_m: FloatArray) -> FloatArray:
        return project(self.camera, self.rotation(), self.pose.center_m, points_m)


@dataclass(frozen=True, eq=False)
class Sight:
    """Ground points (P, 3), the picture each was found in (P,), and where the pictures (N) see them.

    places_px: (N, P, 2) exact pixels, NaN where a picture does not see the point.
    """

    points_m: FloatArray
    anchor: IntArray
    places_px: FloatArray

    @property
    def seen(self) -> BoolArray:
        """(P, N)."""
        return np.asarray(np.isfinite(self.places_px[:, :, 0]).T)

    def take(self, which: IntArray | BoolArray) -> Sight:
        return Sight(self.points_m[which], self.anchor[which], self.places_px[:, which])


def look(pictures: Sequence[Picture], caster: RayCaster, rng: np.random.Generator, per_image: int) -> Sight:
    """Ground points on a jittered grid of about per_image pixels of every picture, and who else sees them."""
    found = [_ground(picture, caster, rng, per_image) for picture in pictures]
    points_m = np.concatenate(found)
    anchor = np.repeat(np.arange(len(pictures)), [len(points) for points in found])
    return Sight(points_m, anchor, np.stack([_places(picture, caster, points_m) for picture in pictures]))


def _ground(picture: Picture, caster: RayCaster, rng: np.random.Generator, count: int) -> FloatArray:
    width, height = picture.camera.width_px, picture.camera.height_px
    columns = max(1, round(float(np.sqrt(count * width / height))))
    rows = max(1, round(count / columns))
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    pixels = (cells + rng.uniform(0.0, 1.0, cells.shape)) * [width / columns, height / rows] - 0.5
    directions = np.column_stack([normalise(picture.camera, pixels), np.ones(len(pixels))]) @ picture.rotation()
    hits = caster.first_hits(picture.pose.center_m, directions)
    reach_m = hits.distances * np.linalg.norm(directions, axis=1)
    hit = reach_m < _FARTHEST * picture.height_m
    return np.asarray(picture.pose.center_m + hits.distances[hit, None] * directions[hit])


def _places(picture: Picture, caster: RayCaster, points_m: FloatArray) -> FloatArray:
    """Exact pixels (P, 2) of points, NaN outside the picture, behind something else, and too far away."""
    places = picture.project(points_m)
    along = points_m - picture.pose.center_m
    away_m = np.linalg.norm(along, axis=1)
    last = np.array([picture.camera.width_px, picture.camera.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        inside = np.all((places >= -0.5) & (places <= last), axis=1) & (away_m < _FARTHEST * picture.height_m)
    asked = np.flatnonzero(inside)
    hits = caster.first_hits(picture.pose.center_m, along[asked])
    inside[asked] = hits.distances >= 1.0 - _TOLERANCE_M / away_m[asked]
    return np.where(inside[:, None], places, np.nan)


def chosen(sight: Sight, pictures: Sequence[Picture], rng: np.random.Generator) -> BoolArray:
    """(P, N) which images have a point in their tracks: its anchor, and such with views like it, as SIFT has them."""
    seen = sight.seen
    centers_m = np.array([picture.pose.center_m for picture in pictures])
    rays = sight.points_m[:, None] - centers_m
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    own = rays[np.arange(len(rays)), sight.anchor]
    angle_deg = np.rad2deg(np.arccos(np.clip(np.einsum("pni,pi->pn", rays, own), -1.0, 1.0)))
    # The largest of weight x random numbers, by Gumbel's trick: drawing without replacement.
    score = -((angle_deg / _LIKE_VIEW_DEG) ** 2) + rng.gumbel(size=seen.shape)
    score[~seen | (angle_deg > _MOST_DEG)] = -np.inf
    score[np.arange(len(rays)), sight.anchor] = np.inf
    rank = np.argsort(np.argsort(-score, axis=1), axis=1)
    length = 1 + rng.geometric(_END, len(rays))
    kept = (rank < length[:, None]) & (score > -np.inf)
    return np.asarray(kept & (kept.sum(axis=1) >= 2)[:, None])


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Of one image: pixels (K, 2) float32, row of the true point (K,), and whether it shows another place (K,)."""

    pixels: FloatArray
    point: IntArray
    wrong: BoolArray


def measured(
    sight: Sight, member: BoolArray, pictures: Sequence[Picture], rng: np.random.Generator, sigma_px: float,
    wrong_share: float,
) -> Mapping[str, Keypoints]:  # fmt: skip
    """Keypoints of every image, in random order, with noise and wrong matches."""
    found = {}
    for number, picture in enumerate(pictures):
        point = rng.permutation(np.flatnonzero(member[:, number]))
        exact = sight.places_px[number, point]
        # Along the line that the ray of the anchor is in this picture: no epipolar test tells it.
        origins_m = np.array([pictures[k].pose.center_m for k in sight.anchor[point]])
        farther = sight.points_m[point] + 1e-2 * (sight.points_m[point] - origins_m)
        step = picture.project(farther) - exact
        length = np.linalg.norm(step, axis=1)
        movable = (sight.anchor[point] != number) & (length > 1e-3)
        wrong = movable & (rng.random(len(point)) < wrong_share * len(point) / max(movable.sum(), 1))
        away_px = rng.uniform(*_WRONG_PX, len(point)) * rng.choice([-1.0, 1.0], len(point))
        moved = np.where(wrong[:, None], step * (away_px / np.where(movable, length, 1.0))[:, None], 0.0)
        pixels = exact + moved + sigma_px * rng.standard_normal(exact.shape)
        found[picture.image_id] = Keypoints(pixels.astype(np.float32), point, wrong)
    return found


def spread(sight: Sight, count: int) -> Sight:
    """At most `count` points that three pictures or more see, far apart from each other in plan."""
    many = sight.take(sight.seen.sum(axis=1) >= 3)
    if len(many.points_m) <= count:
        return many
    plan_m = many.points_m[:, :2]
    picked = [int(np.argmax(many.seen.sum(axis=1)))]
    nearest = np.full(len(plan_m), np.inf)
    for _ in range(count - 1):
        nearest = np.minimum(nearest, np.linalg.norm(plan_m - plan_m[picked[-1]], axis=1))
        picked.append(int(np.argmax(nearest)))
    return many.take(np.array(picked))
