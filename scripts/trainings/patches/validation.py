"""How well descriptors tell places apart on pairs of pictures that no training saw.

FPR95: share of pairs of different places that are closer than 95 % of the pairs of one place (Brown, Hua and Winder,
IEEE TPAMI 33(1), 2011). mAP: the patches of one picture look for theirs among those of the other; average precision of
the nearest neighbours by distance, mean over pairs of pictures (Balntas et al., HPatches, CVPR 2017, matching).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.strategies.extractors.detection import root_sift
from trainings.patches.draws import cropped, jitters_deg
from trainings.patches.tracks import Tracks

Describe = Callable[[NDArray[np.uint8]], FloatArray]  # (N, 32, 32) -> (N, C)
LEAST, MOST = 40, 400  # tracks that a pair of pictures has in common
ANGLES_DEG = (0.0, 20.0, 40.0, 60.0, 180.0)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two pictures: patches0, patches1 (N, 32, 32) of the same places. place_m: (N, 3); reach_m: (N,). angle_deg: the
    median angle between both pictures' rays. two_suns: whether the light differs. kind: ground, source or light."""

    patches0: NDArray[np.uint8]
    patches1: NDArray[np.uint8]
    place_m: FloatArray
    reach_m: FloatArray
    angle_deg: float
    two_suns: bool
    kind: str


def pairs_of(unseen: Mapping[str, Tracks], most: int = MOST) -> list[Pair]:
    """Every pair of pictures of every scene with tracks enough, cut askew as in training; always the same."""
    found = []
    for name, tracks in sorted(unseen.items()):
        upright = name.endswith(".ground")
        kind = "light" if name.startswith("homographies") else name.rpartition(".")[2]
        rng = np.random.default_rng([len(tracks.track), 41])
        turns = jitters_deg(upright, len(tracks.track), rng)
        patches = cropped(torch.from_numpy(tracks.patches), turns, np.ones(len(turns)), rng)
        crops = (patches[:, 0] * 255.0).round().clamp(0, 255).to(torch.uint8).numpy()
        for scene in np.unique(tracks.scene):
            of_scene = np.flatnonzero(tracks.scene[tracks.track] == scene)
            for picture0, picture1 in combinations(np.unique(tracks.picture[of_scene]), 2):
                rows = [of_scene[tracks.picture[of_scene] == picture] for picture in (picture0, picture1)]
                pair = _pair(tracks, crops, rows, kind, most, rng)
                found += [pair] if pair else []
    return found


def _pair(
    tracks: Tracks, crops: NDArray[np.uint8], rows: list[IntArray], kind: str, most: int, rng: np.random.Generator
) -> Pair | None:
    common, at0, at1 = np.intersect1d(tracks.track[rows[0]], tracks.track[rows[1]], return_indices=True)
    if len(common) < LEAST:
        return None
    chosen = rng.permutation(len(common))[:most]
    row0, row1, track = rows[0][at0[chosen]], rows[1][at1[chosen]], common[chosen]
    cosine = (tracks.ray[row0] * tracks.ray[row1]).sum(axis=1)
    angle = float(np.median(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    two_suns = bool(tracks.sun[row0[0]] != tracks.sun[row1[0]])
    return Pair(crops[row0], crops[row1], tracks.place_m[track], tracks.reach_m[track], angle, two_suns, kind)


def sift(patches: NDArray[np.uint8]) -> FloatArray:
    """(N, 128) RootSIFT of patches (N, 32, 32), whose keypoint of 5 px lies in the middle."""
    extractor = cv2.SIFT.create(enable_precise_upscale=True)
    layer = 2  # of the first octave: a blur of 1.6 px times 2^(2/3), which finds keypoints of 5 px
    keypoint = cv2.KeyPoint(15.5, 15.5, 5.0, 0.0, 1.0, layer << 8)
    found = [extractor.compute(patch, [keypoint])[1][0] for patch in patches]
    values = root_sift(np.stack(found)).astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def scores(describe: Describe, pairs: Sequence[Pair]) -> list[tuple[FloatArray, FloatArray, float]]:
    """Of every pair: distances of right pairs (N,), of wrong ones (M,), and the average precision."""
    found = []
    sides = describe(np.concatenate([np.concatenate([pair.patches0, pair.patches1]) for pair in pairs]))
    first = 0
    for pair in pairs:
        count = len(pair.patches0)
        a, b = sides[first : first + count], sides[first + count : first + 2 * count]
        first += 2 * count
        apart = np.sqrt(np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2.0 * a @ b.T, 0.0))
        far = np.linalg.norm(pair.place_m[:, None] - pair.place_m[None], axis=2)
        wrong = far > np.maximum(pair.reach_m[:, None], pair.reach_m[None])
        found.append((apart.diagonal().copy(), _some(apart[wrong]), average_precision(apart, wrong)))
    return found


def _some(values: FloatArray, most: int = 4000) -> FloatArray:
    return values[:: max(1, len(values) // most)]


def average_precision(apart: FloatArray, wrong: BoolArray) -> float:
    """Of nearest neighbours by distance. apart: (N, N), row i's own is column i; wrong: (N, N) surely another place;
    columns that are neither are left out. Every row counts, found or not."""
    allowed = wrong | np.eye(len(apart), dtype=bool)
    values = np.where(allowed, apart, np.inf)
    nearest = values.argmin(axis=1)
    right = (nearest == np.arange(len(apart)))[np.argsort(values.min(axis=1), kind="stable")]
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    return float((precision * right).sum() / len(right))


def fpr95(right: FloatArray, wrong: FloatArray) -> float:
    return float((wrong <= np.quantile(right, 0.95)).mean())


def table(describe: Describe, pairs: Sequence[Pair]) -> dict[str, dict[str, float]]:
    """FPR95 and mAP by kind of picture, view angle and light, and how many pairs of pictures they are of."""
    found = scores(describe, pairs)
    rows: dict[str, list[int]] = {"all": list(range(len(pairs)))}
    for index, pair in enumerate(pairs):
        names = [pair.kind]
        if pair.kind != "light":
            low = max(edge for edge in ANGLES_DEG if edge <= pair.angle_deg)
            names.append(f"{pair.kind}, {low:.0f}+ degrees")
            names.append(f"{pair.kind}, {'two suns' if pair.two_suns else 'one sun'}")
        for name in names:
            rows.setdefault(name, []).append(index)
    out: dict[str, dict[str, float]] = {}
    for name, which in sorted(rows.items()):
        right, wrong = (np.concatenate([found[i][side] for i in which]) for side in (0, 1))
        mean = float(np.mean([found[i][2] for i in which]))
        out[name] = {"fpr95": round(fpr95(right, wrong), 4), "map": round(mean, 4), "pairs": len(which)}
    return out


def tfeat(weights: Any) -> Describe:
    """TFeat or HardTFeat (kornia) with these weights, lengths normalised."""
    from benchmarks.peers.kornia_peers import in_tfeat_words
    from kornia.feature import TFeat

    network: Any = TFeat(pretrained=False)
    network.load_state_dict(in_tfeat_words(weights))
    network.eval()

    def describe(patches: NDArray[np.uint8]) -> FloatArray:
        with torch.inference_mode():
            parts = torch.from_numpy(patches)[:, None].float().split(512)
            values = torch.cat([network(part / 255.0) for part in parts])
            return np.asarray(torch.nn.functional.normalize(values, dim=1).numpy())

    return describe
