"""Pictures that keypoints are looked for in (a stored image or its ground view), and which keypoints of two pictures of
a rendered block are one and the same place, by exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.rendered import RenderedTruth
from benchmarks.peers.base import Scene
from benchmarks.peers.ground import GroundViews
from benchmarks.views import ImageView, away_from_unseen, filled, inside

SOURCE, GROUND = "source", "ground"


@dataclass(frozen=True, eq=False)
class Picture(ImageView):
    """colours: (H, W, 3) uint8 RGB. gray: (H, W) uint8. seen: (H, W), False where the view has seen nothing."""

    colours: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    seen: BoolArray

    @cached_property
    def filled_gray(self) -> NDArray[np.uint8]:
        """(H, W), what was not seen filled from beside, so that its edge draws no keypoints."""
        return filled(np.repeat(self.gray[..., None], 3, axis=2), self.seen)[..., 0].copy()

    def shows(self, stored_px: FloatArray) -> BoolArray:
        """Whether this picture has seen what lies at stored pixels (N, 2)."""
        found = inside(stored_px, self.camera)
        rows = np.flatnonzero(found)
        points = self.from_stored(np.asarray(stored_px)[rows])
        last = np.array(self.seen.shape[::-1]) - 0.5
        within = ((points >= -0.5) & (points <= last)).all(axis=1)
        found[rows] = within & away_from_unseen(points, self.seen, 0.0)
        return found


class Pictures:
    """The pictures of a scene, each made once. frame: SOURCE or GROUND."""

    def __init__(self, scene: Scene, workspace: Path) -> None:
        self._scene = scene
        self._views = GroundViews(scene, workspace)
        self._made: dict[tuple[str, str], Picture] = {}

    def __call__(self, image: str, frame: str) -> Picture:
        if (image, frame) not in self._made:
            self._made[image, frame] = self._on_ground(image) if frame == GROUND else self._source(image)
        return self._made[image, frame]

    def _source(self, image: str) -> Picture:
        pixels = read_pixels(self._scene.images / image, colour=True)
        gray = to_gray8(pixels)
        return Picture(image, self._scene.cameras[image], None, pixels, gray, np.ones(gray.shape, bool))

    def _on_ground(self, image: str) -> Picture:
        found, colours, seen = self._views(image)
        return Picture(image, self._scene.cameras[image], found.view, colours, to_gray8(colours), seen)


RADIUS_PX = 3.0
# Candidates are looked for around where nine points about a keypoint land: at a roof's edge they land apart.
_AROUND_PX = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
_SLACK_PX = 2.0
SIZE_RATIO = 1.5
# Steps of the local change from one picture to the other, and how far apart the turns of both may be.
_STEPS_PX, _TURNS_APART_DEG = (1.5, 3.0), 5.0
_STRETCH = 6.0  # surfaces seen flatter than this against one another have no turn worth the name


@dataclass(frozen=True, eq=False)
class Keypoints:
    """points_px: (N, 2) of the picture, strongest first. sizes_px: (N,) diameters. angles_deg: (N,), x towards y."""

    points_px: FloatArray
    sizes_px: FloatArray
    angles_deg: FloatArray

    def take(self, rows: IntArray) -> Keypoints:
        return Keypoints(self.points_px[rows], self.sizes_px[rows], self.angles_deg[rows])


@dataclass(frozen=True, eq=False)
class Partners:
    """rows0, rows1: (M,) keypoints of either side that are one place, one to one. errors_px: (M,) of stored pixels, the
    larger of both directions."""

    rows0: IntArray
    rows1: IntArray
    errors_px: FloatArray


def in_overlap(truth: RenderedTruth, picture: Picture, points_px: FloatArray, other: Picture) -> BoolArray:
    """Which points (N, 2) of a picture show what the other picture sees, too."""
    stored = picture.stored_px(points_px)
    there, hidden = truth.truth.transfer(picture.image, stored, other.image)
    return np.asarray(~hidden & other.shows(there))


def partners(truth: RenderedTruth, name0: str, stored0_px: FloatArray, name1: str, stored1_px: FloatArray) -> Partners:
    """Of keypoints at stored pixels (N0, 2) and (N1, 2), within RADIUS_PX, hidden ones never.

    The smallest error goes first, so that those within a smaller radius are the partners of that radius.
    """
    from scipy.spatial import cKDTree

    found = [np.zeros((0, 2), np.int64)]
    sides = ((name0, stored0_px, name1, stored1_px, 1), (name1, stored1_px, name0, stored0_px, -1))
    for name, points, other, others, turn in sides:
        if not len(points) or not len(others):
            continue
        around = (points[:, None] + _AROUND_PX).reshape(-1, 2)
        there, _ = truth.truth.transfer(name, around, other)
        known = np.flatnonzero(np.isfinite(there).all(axis=1))
        near = cKDTree(others).query_ball_point(there[known], RADIUS_PX + _SLACK_PX)
        rows = np.repeat(known // len(_AROUND_PX), [len(one) for one in near])
        mates = np.fromiter((mate for one in near for mate in one), np.int64)
        found.append(np.column_stack([rows, mates])[:, ::turn])
    pairs = np.unique(np.concatenate(found), axis=0)
    if not len(pairs):
        return Partners(pairs[:, 0], pairs[:, 1], np.zeros(0))
    errors, hidden = truth.errors(name0, name1, stored0_px[pairs[:, 0]], stored1_px[pairs[:, 1]])
    good = np.flatnonzero(~hidden & (np.nan_to_num(errors, nan=np.inf) <= RADIUS_PX))
    chosen = good[one_to_one(pairs[good], errors[good])]
    return Partners(pairs[chosen, 0], pairs[chosen, 1], errors[chosen])


def of_one_size(
    truth: RenderedTruth, pictures: tuple[Picture, Picture], sides: tuple[Keypoints, Keypoints], found: Partners
) -> tuple[Partners, FloatArray]:
    """The partners whose sizes agree, too, within SIZE_RATIO, and whose turn is known; and that turn, degrees."""
    first, second = sides[0].take(found.rows0), sides[1].take(found.rows1)
    change = local_change(truth, pictures[0], first.points_px, pictures[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(np.log(second.sizes_px / (first.sizes_px * change.scale)))
    kept = np.flatnonzero(change.known & (apart <= np.log(SIZE_RATIO)))
    return Partners(found.rows0[kept], found.rows1[kept], found.errors_px[kept]), change.turn_deg[kept]


def one_to_one(pairs: IntArray, errors: FloatArray) -> IntArray:
    """Rows of pairs (N, 2) that are taken when the one of smallest error goes first and each number goes once."""
    taken0: set[int] = set()
    taken1: set[int] = set()
    chosen = []
    for row in np.lexsort((pairs[:, 1], pairs[:, 0], errors)):
        first, second = (int(number) for number in pairs[row])
        if first not in taken0 and second not in taken1:
            taken0.add(first)
            taken1.add(second)
            chosen.append(row)
    return np.array(chosen, np.int64)


@dataclass(frozen=True, eq=False)
class LocalChange:
    """How the neighbourhoods of points (N,) look in another picture.

    turn_deg: x towards y. scale: square root of the area's. known: where the surface is smooth and seen well enough.
    """

    turn_deg: FloatArray
    scale: FloatArray
    known: BoolArray


def local_change(truth: RenderedTruth, picture0: Picture, points_px: FloatArray, picture1: Picture) -> LocalChange:
    """From picture 0 at points (N, 2) to picture 1, by differences of exact places."""
    jacobians = [_jacobian(truth, picture0, points_px, picture1, step) for step in _STEPS_PX]
    (turn, scale, good), (turn_wide, _, good_wide) = (_parts(jacobian) for jacobian in jacobians)
    known = good & good_wide & (np.abs(wrapped_deg(turn - turn_wide)) < _TURNS_APART_DEG)
    return LocalChange(turn, scale, known)


def wrapped_deg(angles_deg: FloatArray) -> FloatArray:
    """In [-180, 180)."""
    return np.asarray((angles_deg + 180.0) % 360.0 - 180.0)


def _jacobian(
    truth: RenderedTruth, picture0: Picture, points_px: FloatArray, picture1: Picture, step: float
) -> FloatArray:
    """(N, 2, 2) of picture 1 by picture 0."""
    columns = []
    for axis in np.eye(2):
        ends = []
        for side in (step, -step):
            stored = picture0.stored_px(points_px + side * axis)
            there, _ = truth.truth.transfer(picture0.image, stored, picture1.image)
            ends.append(picture1.from_stored(there))
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.stack(columns, axis=2)


def _parts(jacobians: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Turn in degrees and scale (N,) of the rotation nearest to each, and whether it has one."""
    (a, b), (c, d) = jacobians.transpose(1, 2, 0)
    determinant = a * d - b * c
    with np.errstate(invalid="ignore"):
        scale = np.sqrt(np.maximum(determinant, 0.0))
        # Largest over smallest singular value by the sum of squares: s0^2 + s1^2 = |J|^2, s0 s1 = det.
        squares = a * a + b * b + c * c + d * d
        good = (determinant > 0.0) & (squares < (_STRETCH + 1.0 / _STRETCH) * determinant)
    return np.rad2deg(np.arctan2(c - b, a + d)), scale, np.asarray(good)
