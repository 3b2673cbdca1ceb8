"""Groups of images that final matches tie together become one.

A first pass may orient two parts of a block each by itself, straight views and oblique ones say, whose images only the
final pass can match. Points that both parts have triangulated lie in the same places: a similarity takes one part to
the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

# Points of two groups are the same place up to this share of the distance from which the images see them.
_SAME_SHARE = 0.02
# Groups are joined by so many such points, and where so large a share of the matched points agrees.
_FEWEST, _LEAST_SHARE = 30, 0.4

Similarity = tuple[float, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Part:
    """Images that were oriented together.

    kind: how it was placed in the world; a "given" part stays where it is. rotations: number -> (3, 3) cam_from_world,
    centers_m: number -> (3,). points_m: number -> (K, 3), where the image's keypoints were triangulated, NaN elsewhere.
    """

    kind: str
    rotations: Mapping[int, FloatArray]
    centers_m: Mapping[int, FloatArray]
    points_m: Mapping[int, FloatArray]

    def moved(self, by: Similarity) -> Part:
        """Return the part in another frame, by a similarity of scale, rotation and translation."""
        scale, rotation, shift_m = by
        return replace(
            self,
            rotations={i: r @ rotation.T for i, r in self.rotations.items()},
            centers_m={i: scale * rotation @ c + shift_m for i, c in self.centers_m.items()},
            points_m={i: scale * p @ rotation.T + shift_m for i, p in self.points_m.items()},
        )

    def distance_m(self) -> float:
        """Median distance of the points from the images that see them."""
        away = [np.linalg.norm(points - self.centers_m[i], axis=1) for i, points in self.points_m.items()]
        return float(np.nanmedian(np.concatenate([np.full(1, np.nan), *away])))


def joined(parts: Sequence[Part], matches: Mapping[tuple[int, int], IntArray]) -> list[Part]:
    """Return parts of which those that matched points tie have become one, in the frame of the first of them.

    parts: those placed by positions before others, the largest first. matches: verified ones (M, 2) by image numbers.
    """
    found = list(parts)
    while len(again := _joined_once(found, matches)) < len(found):  # a part may tie two that came before it
        found = again
    return again


def _joined_once(parts: Sequence[Part], matches: Mapping[tuple[int, int], IntArray]) -> list[Part]:
    found: list[Part] = []
    for part in parts:
        for row, target in enumerate(found):
            by = None if part.kind == "given" else _tie(target, part, matches)
            if by is not None:
                moved = part.moved(by)
                found[row] = replace(
                    target,
                    rotations={**target.rotations, **moved.rotations},
                    centers_m={**target.centers_m, **moved.centers_m},
                    points_m={**target.points_m, **moved.points_m},
                )
                break
        else:
            found.append(part)
    return found


def _tie(target: Part, part: Part, matches: Mapping[tuple[int, int], IntArray]) -> Similarity | None:
    """Return the similarity that takes a part to the target, None where too few points are the same."""
    here, there = [], []
    for (first, second), indices in matches.items():
        if first in target.points_m and second in part.points_m:
            ends = target.points_m[first][indices[:, 0]], part.points_m[second][indices[:, 1]]
        elif second in target.points_m and first in part.points_m:
            ends = target.points_m[second][indices[:, 1]], part.points_m[first][indices[:, 0]]
        else:
            continue
        both = np.isfinite(ends[0]).all(axis=1) & np.isfinite(ends[1]).all(axis=1)
        there.append(ends[0][both])
        here.append(ends[1][both])
    source, goal = (np.concatenate([np.zeros((0, 3)), *places]) for places in (here, there))
    return common_similarity(source, goal, _SAME_SHARE * target.distance_m())


def common_similarity(source: FloatArray, goal: FloatArray, tolerance: float) -> Similarity | None:
    """Return the similarity from source (N, 3) to goal (N, 3) that most points agree with; None where too few do.

    tolerance: largest distance of an agreeing point, in the goal's unit.
    """
    import pycolmap

    if len(source) < _FEWEST:
        return None
    options = pycolmap.RANSACOptions(max_error=tolerance, min_inlier_ratio=_LEAST_SHARE, random_seed=0)
    found: Any = pycolmap.estimate_sim3d_robust(source, goal, options)
    if found is None or found["num_inliers"] < max(_FEWEST, _LEAST_SHARE * len(source)):
        return None
    inliers = found["inlier_mask"]
    fit = pycolmap.estimate_sim3d(source[inliers], goal[inliers])  # the one found may come from few of them
    return None if fit is None else (float(fit.scale), fit.rotation.matrix(), fit.translation)
