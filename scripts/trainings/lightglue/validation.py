"""Recall at the mutual ratio test's own precision, and whether scores mean what they say, on pairs never trained on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from aeromatch_cli.nets.lightglue import LightGlue
from aeromatch_cli.nets.lightglue_file import Calibration
from aeromatch_cli.strategies.matchers.descriptors.scan import mutual_nearest
from trainings.lightglue.batches import as_side, expected, unit
from trainings.lightglue.blocks import Pair
from trainings.lightglue.sides import NONE, UNKNOWN, Array

RATIO, LEAST_SCORE = 0.8, 0.01
LIKE_OCTAVES, LIKE_DEG = 0.5, 30.0
SIGMA = 0.03  # of expected places, half a picture is 1
EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


@dataclass(frozen=True, eq=False)
class Found:
    """Matches of many pairs together: scores (M,), whether each is right (M,), and how many there were to find."""

    scores: Array
    right: Array
    possible: int

    @property
    def recall(self) -> float:
        return float(self.right.sum()) / max(self.possible, 1)

    @property
    def precision(self) -> float:
        return float(self.right.mean()) if len(self.right) else 1.0

    def recall_at(self, precision: float) -> float:
        """Largest recall of the best-scored matches among which as large a share is right."""
        order = np.argsort(-self.scores, kind="stable")
        right = np.cumsum(self.right[order])
        good = right / np.arange(1, len(right) + 1) >= precision
        return float(right[good].max(initial=0)) / max(self.possible, 1)

    def least_score_at(self, precision: float) -> float:
        """Score of the last match that `recall_at` takes; infinite where it takes none."""
        order = np.argsort(-self.scores, kind="stable")
        good = np.flatnonzero(np.cumsum(self.right[order]) / np.arange(1, len(order) + 1) >= precision)
        return float(self.scores[order[good[-1]]]) if len(good) else np.inf

    def wrong_at(self, recall: float) -> int:
        """Wrong matches among the best-scored ones that reach a recall; -1 where none do."""
        order = np.argsort(-self.scores, kind="stable")
        right = np.cumsum(self.right[order])
        enough = np.flatnonzero(right >= recall * self.possible)
        return int(enough[0] + 1 - right[enough[0]]) if len(enough) else -1

    def reliability(self, calibration: Calibration) -> list[tuple[float, float, int, float, float]]:
        """Per bin of calibrated scores that is not empty: its edges, matches, mean score, share of right ones."""
        scores = calibration.calibrated(self.scores)
        rows = []
        for low, high in pairwise(EDGES):
            which = (scores > low) & (scores <= high)
            if which.any():
                rows.append((low, high, int(which.sum()), float(scores[which].mean()), float(self.right[which].mean())))
        return rows


def together(parts: Sequence[Found]) -> Found:
    return Found(
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.right for part in parts]),
        sum(part.possible for part in parts),
    )


def fitted(found: Found) -> Calibration:
    """Slope and offset of largest likelihood (logistic regression on log odds, Newton's method)."""
    bounded = np.clip(found.scores.astype(np.float64), 1e-9, 1.0 - 1e-9)
    columns = np.stack([np.log(bounded / (1.0 - bounded)), np.ones(len(bounded))], axis=1)
    weights = np.array([1.0, 0.0])
    for _ in range(30):
        odds = 1.0 / (1.0 + np.exp(-columns @ weights))
        slope = columns.T @ (found.right - odds)
        bend = (columns * (odds * (1.0 - odds))[:, None]).T @ columns
        weights = weights + np.linalg.solve(bend + 1e-9 * np.eye(2), slope)
    return Calibration(float(weights[0]), float(weights[1]))


def judged(answers: Iterable[tuple[Pair, Array, Array]]) -> Found:
    """answers: pair, matches (M, 2) as rows of its sides, scores (M,). What truth does not know is left out.

    A match is right where it leads to the place of the keypoint's partner, which may be described there twice.
    """
    scores, right, possible = [np.zeros(0)], [np.zeros(0, bool)], 0
    for pair, indices, values in answers:
        partner = pair.truth.of0[indices[:, 0]]
        known = (partner != UNKNOWN) & (pair.truth.of1[indices[:, 1]] != UNKNOWN)
        scores.append(values[known])
        places = pair.side1.places_px
        right.append(((partner >= 0) & (places[partner] == places[indices[:, 1]]).all(axis=1))[known])
        possible += int((pair.truth.of0 >= 0).sum())
    return Found(np.concatenate(scores), np.concatenate(right), possible)


def by_ratio(pair: Pair) -> tuple[Array, Array]:
    """The mutual ratio test: matches (M, 2) and 1 - d1/d2."""
    side0, side1 = pair.side0, pair.side1
    rows, columns, ratios = mutual_nearest(
        side0.descriptors.astype(np.float32),
        side1.descriptors.astype(np.float32),
        np.arange(len(side1.points_px)),
        ratio=RATIO,
    )
    return np.stack([rows, columns], axis=1), 1.0 - ratios


def by_network(network: LightGlue, pair: Pair, sigma: float | None = None) -> tuple[Array, Array]:
    """Matches (M, 2) and scores, all layers, nothing pruned. sigma: of places that are expected, None: of none."""
    device = next(network.parameters()).device
    grounds = [None, None]
    if sigma is not None:
        grounds = [[one] for one in expected(pair.side0, pair.side1, pair.truth, sigma, np.random.default_rng(0))]
    both = zip((pair.side0, pair.side1), grounds, strict=True)
    sides = [unit(as_side([side], ground).to(device)) for side, ground in both]
    indices, scores = network.match(*sides, threshold=LEAST_SCORE, depth_confidence=-1.0, width_confidence=-1.0)
    return indices.cpu().numpy(), scores.cpu().numpy()


def thinned(pairs: Sequence[Pair], keypoints: int, limit: int) -> list[Pair]:
    """Every so many-th pair, `limit` of them, with at most `keypoints` on either side (the first ones of a shuffle)."""
    step = max(1, len(pairs) // limit)
    return [_cut(pair, keypoints) for pair in pairs[::step][:limit]]


def _cut(pair: Pair, keypoints: int) -> Pair:
    rng = np.random.default_rng(0)
    rows0, rows1 = (np.sort(rng.permutation(len(s.points_px))[:keypoints]) for s in (pair.side0, pair.side1))
    return Pair(pair.side0.take(rows0), pair.side1.take(rows1), pair.truth.take(rows0, rows1), pair.two_suns)


Answer = tuple[Pair, Array, Array]


def answered(network: LightGlue, pairs: Sequence[Pair]) -> tuple[list[Answer], list[Answer]]:
    """Matches of the ratio test and of the network in the same pairs."""
    return [(pair, *by_ratio(pair)) for pair in pairs], [(pair, *by_network(network, pair)) for pair in pairs]


def compared(network: LightGlue, pairs: Sequence[Pair]) -> tuple[Found, Found]:
    """What the ratio test and the network find in the same pairs."""
    ratio, own = answered(network, pairs)
    return judged(ratio), judged(own)


def of_like_look(pair: Pair) -> Array:
    """Which keypoints of image 0 that have a partner (P,) have one of like size and turn.

    Truth knows places alone: the others are different things that happen to lie within CORRECT_PX. Like: within
    LIKE_OCTAVES and LIKE_DEG of the pair's median.
    """
    side0, side1 = pair.side0, pair.side1
    rows = np.flatnonzero(pair.truth.of0 >= 0)
    mates = pair.truth.of0[rows]
    octaves = np.log2(side1.sizes_px[mates] / side0.sizes_px[rows])
    turns = np.exp(1j * (side1.angles_rad[mates] - side0.angles_rad[rows]))
    usual = np.median(turns.real) + 1j * np.median(turns.imag)
    off_deg = np.abs(np.rad2deg(np.angle(turns * np.conj(usual))))
    return np.asarray((np.abs(octaves - np.median(octaves)) <= LIKE_OCTAVES) & (off_deg <= LIKE_DEG))


def recalls(answers: Iterable[Answer], least_score: float) -> tuple[float, ...]:
    """Share of the partners that are of like look, recall of these, and of the others, by matches of such scores.

    Not a number where there is none.
    """
    alike, found = [np.zeros(0, bool)], [np.zeros(0, bool)]
    for pair, indices, scores in answers:
        rows, places = np.flatnonzero(pair.truth.of0 >= 0), pair.side1.places_px
        if not len(rows):
            continue
        match = np.full(len(pair.side0.points_px), NONE)
        kept = indices[scores >= least_score]
        match[kept[:, 0]] = kept[:, 1]
        same = (places[match[rows]] == places[pair.truth.of0[rows]]).all(axis=1)
        alike.append(of_like_look(pair))
        found.append((match[rows] != NONE) & same)
    like, right = np.concatenate(alike), np.concatenate(found)
    return tuple(float(part.mean()) if len(part) else math.nan for part in (like, right[like], right[~like]))


def report(network: LightGlue, sets: dict[str, list[Pair]]) -> dict[str, dict[str, float]]:
    """Figures by set: the ratio test's recall and precision, and the network's recall there."""
    rows = {}
    for name, pairs in sets.items():
        ratio, own = compared(network, pairs)
        rows[name] = {
            "pairs": len(pairs),
            "ratio_precision": ratio.precision,
            "ratio_recall": ratio.recall,
            "recall": own.recall_at(ratio.precision),
            "recall_with_poses": judged((pair, *by_network(network, pair, SIGMA)) for pair in pairs).recall_at(
                ratio.precision
            ),
            "recall_at_0.1": _above(own, 0.1).recall,
            "precision_at_0.1": _above(own, 0.1).precision,
            "ratio_wrong": int((~ratio.right).sum()),
            "wrong_at_its_recall": own.wrong_at(ratio.recall),
        }
    return rows


def _above(found: Found, threshold: float) -> Found:
    kept = found.scores >= threshold
    return Found(found.scores[kept], found.right[kept], found.possible)
