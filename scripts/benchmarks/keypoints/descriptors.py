"""Descriptors that are compared, all of the same patches (one place, size and angle a keypoint), and their figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.fingerprints import stable_hash
from aeromatch_cli.lab.rendered import RenderedTruth
from aeromatch_cli.strategies.extractors.detection import Raw
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of
from benchmarks.keypoints.correspondence import (
    Keypoints,
    Partners,
    Picture,
    Pictures,
    in_overlap,
    of_one_size,
    partners,
)
from benchmarks.keypoints.detectors import strongest_sift
from benchmarks.keypoints.figures import Asked
from benchmarks.peers.base import Options
from benchmarks.peers.kornia_peers import HARD_TFEAT, TFEAT, on_patches, tfeat
from benchmarks.tables import Row, plain

# Keypoints that a picture offers; a pair has those of the overlap.
MOST = 4000
NEGATIVES, FAR_PX = 10, 10.0


@dataclass(frozen=True, eq=False)
class Side:
    """One picture of a pair with its keypoints of the overlap, in the order of the descriptors.

    every: all keypoints that the picture offers, wherever; rows: (N,) those of the overlap among them. patches: (N, 32,
    32) uint8, cut along the keypoints' angles. own: OpenCV's keypoints (N) of the same place, size and angle, whose
    octaves SIFT needs.
    """

    picture: Picture
    every: Keypoints
    rows: IntArray
    patches: NDArray[np.uint8]
    own: tuple[Any, ...]

    @property
    def keypoints(self) -> Keypoints:
        return self.every.take(self.rows)


class Describer(Protocol):
    def __call__(self, side: Side) -> NDArray[np.float32]:
        """(N, C), compared by Euclidean distance."""
        ...


class Sift:
    """OpenCV's SIFT at the keypoints; root: square roots of the L1-normalised values (RootSIFT)."""

    def __init__(self, options: Options, *, root: bool = False) -> None:
        del options
        self.root = root

    def __call__(self, side: Side) -> NDArray[np.float32]:
        import cv2

        detector = cv2.SIFT.create(enable_precise_upscale=True)
        kept, values = detector.compute(side.picture.filled_gray, list(side.own))
        if len(kept) != len(side.own):
            raise RuntimeError(f"OpenCV described {len(kept)} of {len(side.own)} keypoints")
        found = np.asarray(values, np.float32).reshape(-1, 128)
        if not self.root:
            return found
        return np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1.0))


class TFeat:
    """TFeat through kornia, or HardTFeat, which has the same layers and other weights."""

    def __init__(self, options: Options, *, weights: str) -> None:
        self.network = tfeat(options, weights)

    def __call__(self, side: Side) -> NDArray[np.float32]:
        found = on_patches(self.network, side.patches, 128)
        return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


class Own:
    """This project's descriptor without context; weights: a file other than the shipped one."""

    def __init__(self, options: Options, weights: Path | None = None) -> None:
        from aeromatch_cli.nets.geodesc import load_geodesc

        del options
        self.network: Any = load_geodesc(weights) if weights else load_geodesc()

    def __call__(self, side: Side) -> NDArray[np.float32]:
        from aeromatch_cli.nets.geodesc import describe

        return describe(side.patches, self.network)


class OwnWithContext(Own):
    """The same with context: all keypoints of the picture, not only those that the other one shows, are around."""

    def __call__(self, side: Side) -> NDArray[np.float32]:
        from aeromatch_cli.nets.geodesc import describe
        from aeromatch_cli.strategies.extractors.context import with_context

        every, nothing = side.every, np.zeros(len(side.every.points_px))
        plain = describe(patches_of(side.picture, every), self.network)
        raw = Raw(
            source_px=every.points_px,
            source_sizes_px=every.sizes_px,
            points_px=every.points_px,
            sizes_px=every.sizes_px,
            orientations_deg=every.angles_deg,
            responses=nothing,
            octaves=nothing.astype(np.int32),
            view_idx=nothing.astype(np.int32),
        )
        return with_context(plain, raw, side.picture.gray)[side.rows]


DESCRIBERS: Mapping[str, Callable[..., Describer]] = {
    "sift": Sift,
    "rootsift": partial(Sift, root=True),
    "tfeat": partial(TFeat, weights=TFEAT),
    "hardtfeat": partial(TFeat, weights=HARD_TFEAT),
    "ours": Own,
    "ours+context": OwnWithContext,
}


def make_side(picture: Picture, table: FloatArray, own: Sequence[Any], rows: IntArray, *, upright: bool) -> Side:
    """A side of the rows x, y, size, angle of OpenCV's keypoints, `rows` of them in the overlap; upright: angles 0."""
    import cv2

    every = Keypoints(table[:, :2], table[:, 2], np.zeros(len(table)) if upright else table[:, 3])
    shown = every.take(rows)
    turned = tuple(
        cv2.KeyPoint(*own[row].pt, own[row].size, float(angle), own[row].response, own[row].octave)
        for row, angle in zip(rows, shown.angles_deg, strict=True)
    )
    return Side(picture, every, rows, patches_of(picture, shown), turned)


def patches_of(picture: Picture, keypoints: Keypoints) -> NDArray[np.uint8]:
    """(N, 32, 32), cut along the keypoints' angles."""
    return cut_patches(levels_of(picture.gray), keypoints.points_px, keypoints.sizes_px, keypoints.angles_deg)


@dataclass(frozen=True, eq=False)
class Task:
    """What descriptors are asked about one pair.

    partner: (N,) of side 0's keypoints among side 1's (M), -1 without. asked: (N,) those that correspond to one, or to
    none. stored1_px: (M, 2). different0, different1: rows of different places.
    """

    sides: tuple[Side, Side]
    partner: IntArray
    asked: BoolArray
    stored1_px: FloatArray
    different0: IntArray
    different1: IntArray


def descriptor_figures(truth: RenderedTruth, pictures: Pictures, asked: Asked) -> Callable[..., Row]:
    """How well each descriptor tells places apart."""

    @lru_cache(maxsize=1)
    def task(images: tuple[str, str], frame: str) -> Task:
        both = pictures(images[0], frame), pictures(images[1], frame)
        rng = np.random.default_rng([asked.seed, stable_hash(" ".join(images)) % (1 << 32)])
        return make_task(truth, both, asked.keypoints, rng, upright=asked.upright)

    return lambda images, frame, describer: descriptor_row(describer, task(images, frame))


def make_task(
    truth: RenderedTruth, both: tuple[Picture, Picture], count: int, rng: np.random.Generator, *, upright: bool
) -> Task:
    """From the keypoints of both pictures of a pair."""
    sides = []
    for picture, other in (both, both[::-1]):
        table, own = strongest_sift(picture, MOST, once=3 if upright else 0)
        rows = np.flatnonzero(in_overlap(truth, picture, table[:, :2], other))[:count]
        sides.append(make_side(picture, table, own, rows, upright=upright))
    first, second = (side.picture.stored_px(side.keypoints.points_px) for side in sides)
    found = partners(truth, both[0].image, first, both[1].image, second)
    found, _ = of_one_size(truth, both, (sides[0].keypoints, sides[1].keypoints), found)
    partner = np.full(len(first), -1)
    partner[found.rows0] = found.rows1
    there, _ = truth.truth.transfer(both[0].image, first, both[1].image)
    asked = (partner >= 0) | ~near(there, second, FAR_PX)
    return Task((sides[0], sides[1]), partner, asked, second, *different(second, found, rng))


def near(points_px: FloatArray, others_px: FloatArray, radius_px: float) -> BoolArray:
    """Which points (N, 2) have one of the others (M, 2) within the radius; those that are NaN have none."""
    from scipy.spatial import cKDTree

    if not len(others_px):
        return np.zeros(len(points_px), bool)
    apart, _ = cKDTree(others_px).query(np.nan_to_num(points_px, nan=1e9))
    return np.asarray(apart <= radius_px)


def different(stored1: FloatArray, found: Partners, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Rows of image 0 and 1 that are different places: for every corresponding pair NEGATIVES at random."""
    rows0, rows1 = np.repeat(found.rows0, NEGATIVES), np.repeat(found.rows1, NEGATIVES)
    drawn = rng.integers(len(stored1), size=len(rows1)) if len(stored1) else rows1
    far = np.linalg.norm(stored1[drawn] - stored1[rows1], axis=1) > FAR_PX
    return rows0[far], drawn[far]


def descriptor_row(describer: Describer, task: Task) -> Row:
    """Figures of one descriptor on one pair."""
    apart = distances(describer(task.sides[0]), describer(task.sides[1]))
    ranked = nearest_neighbours(apart, task.partner, task.stored1_px, task.asked)
    rows0 = np.flatnonzero(task.partner >= 0)
    same, other = apart[rows0, task.partner[rows0]], apart[task.different0, task.different1]
    counts = {"keypoints0": apart.shape[0], "keypoints1": apart.shape[1], "corresponding": len(rows0)}
    figures = {"map_by_ratio": ranked.by_ratio, "map_by_distance": ranked.by_distance, "right": ranked.right}
    figures |= {"fpr95": false_positive_rate(same, other)}
    return counts | {name: plain(value) for name, value in figures.items()}


RECALL, SAME_PX = 0.95, 3.0


def distances(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, M) Euclidean distances of descriptors (N, C) and (M, C)."""
    squares = (first * first).sum(axis=1)[:, None] + (second * second).sum(axis=1) - 2.0 * (first @ second.T)
    return np.sqrt(np.maximum(squares, 0.0))


def false_positive_rate(same: FloatArray, other: FloatArray, recall: float = RECALL) -> float:
    """Share of distances (N,) between different places that the threshold accepts which accepts `recall` of those (M,)
    between one and the same; FPR95 at its default. NaN without any."""
    if not len(same) or not len(other):
        return float("nan")
    threshold = np.sort(same)[int(np.ceil(recall * len(same))) - 1]
    return float((other <= threshold).mean())


def average_precision(scores: FloatArray, correct: BoolArray, possible: int) -> float:
    """Area below precision over recall of answers (N,) taken by score, the largest first; possible: all that could be
    correct. Equal scores come in one step. NaN where nothing is possible."""
    if possible == 0:
        return float("nan")
    order = np.argsort(-scores, kind="stable")
    hits, ends = np.cumsum(correct[order]), np.flatnonzero(np.append(np.diff(scores[order]) != 0, True))
    gained = np.diff(np.concatenate([[0], hits[ends]])) if len(scores) else np.zeros(0)
    precision = hits[ends] / (ends + 1.0) if len(scores) else np.zeros(0)
    return float((gained * precision).sum() / possible)


@dataclass(frozen=True)
class Ranked:
    """Average precision of the nearest neighbours of a pair: by_ratio: those ordered by the ratio of first to second
    distance; by_distance: by the first. right: share of the possible that are right, whatever the order."""

    by_ratio: float
    by_distance: float
    right: float


def nearest_neighbours(
    apart: NDArray[np.float32], partner: IntArray, places1_px: FloatArray, asked: BoolArray
) -> Ranked:
    """Of distances (N, M): every keypoint of side 0 that is asked (N,) has its nearest of side 1 as answer.

    partner: (N,) of side 1, -1 without one. An answer is right where it lies within SAME_PX of the partner, places1_px
    (M, 2): a place may have keypoints of several sizes.
    """
    apart, partner = apart[asked], partner[asked]
    possible = int((partner >= 0).sum())
    if apart.shape[1] < 2 or not possible:
        return Ranked(float("nan"), float("nan"), float("nan"))
    two = np.partition(apart, 1, axis=1)[:, :2].astype(np.float64)
    off = np.linalg.norm(places1_px[apart.argmin(axis=1)] - places1_px[partner], axis=1)
    correct = (partner >= 0) & (off <= SAME_PX)
    by_ratio = average_precision(-two[:, 0] / np.maximum(two[:, 1], 1e-12), correct, possible)
    by_distance = average_precision(-two[:, 0], correct, possible)
    return Ranked(by_ratio, by_distance, float(correct.sum() / possible))
