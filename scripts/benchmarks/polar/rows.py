"""A row of figures for every method and pair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.frames import apply_homography, closest_similarity
from benchmarks.polar.blocks import BlockPair, block_pairs
from benchmarks.polar.grounds import KnownPair, apart, differences, errors, ground, known_pair, turn_deg
from benchmarks.polar.sides import RATIO, PolarResult, SiftPair, SiftResult, registered
from benchmarks.tables import Row

TIE_POINTS = 1000
# The similarity by least squares over fewer tie points.
FEW_TIE_POINTS, ADJUSTED = 250, "polar, adjusted"
RATIOS = (0.6, 0.7, 0.8, 0.9)
NEGATIVES = ("apart", "other ground", "apart", "saturated", "featureless")
RIGHT_PX = 3.0
_VERIFIED = 30  # matches of SIFT's that a comparison with it rests on
_GRID = 16  # cells along either side of the overlap that coverage counts
_REDUCED = 0.125
_ROOM = (2.0, 1.56)  # of a picture's width: two pictures side by side in any direction, and room to turn


@dataclass(frozen=True)
class Task:
    """size: width, height of the pictures. images: of a rendered block. out: where grounds and blocks are kept."""

    kinds: tuple[str, ...]
    size: tuple[int, int]
    images: int
    seed: int
    data: Path | None
    out: Path

    def ground(self, kind: str) -> NDArray[np.uint8]:
        wide = int(_ROOM[0] * self.size[0]), int(_ROOM[1] * self.size[0])
        return ground(kind, wide, self.seed, self.data, self.out)


def known_rows(task: Task, pairs: int, with_sift: int) -> Iterator[Row]:
    """Rows of all methods, pair by pair, of every kind of ground. with_sift: of so many pairs at full size too."""
    count = len(task.kinds)
    for index, kind in enumerate(task.kinds):
        wanted = pairs // count + (index < pairs % count)
        if not wanted:
            continue
        source = task.ground(kind)
        for number in range(wanted):
            pair = known_pair(source, task.size, np.random.default_rng([task.seed, _number(kind), number]))
            head = {"section": "known", "kind": kind, "pair": number, "size": _size(pair.first),
                    "overlap": pair.overlap, "valid": True}  # fmt: skip
            found = registered(pair.first, pair.second, TIE_POINTS)
            yield head | {"method": "polar"} | _of_polar(found) | _against_truth(found.matrix, found, pair)
            few = registered(pair.first, pair.second, FEW_TIE_POINTS)
            yield head | {"method": ADJUSTED} | _of_polar(few) | _against_truth(few.adjusted(), few, pair)
            scales = ((1.0,) if number * count + index < with_sift else ()) + (_REDUCED,)
            for scale in scales:
                other = SiftPair(pair.first, pair.second, scale).matched()
                name = "sift" if scale == 1.0 else f"sift at 1/{1.0 / scale:.0f}"
                yield head | {"method": name} | _of_sift(other) | _against_truth(other.matrix, other, pair)


def _size(picture: NDArray[np.uint8]) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def _of_polar(found: PolarResult) -> Row:
    proof = found.registration.evidence
    return {
        "seconds": round(found.seconds, 4), "seconds_tie_points": round(found.seconds_tie_points, 4),
        "accepted": found.registration.accepted, "reason": found.registration.reason,
        "agreeing": None if proof is None else round(proof.share, 3),
    }  # fmt: skip


def _of_sift(found: SiftResult) -> Row:
    return {
        "seconds": round(found.seconds, 4), "seconds_tie_points": round(found.seconds, 4), "accepted": found.accepted,
        "reason": "" if found.accepted else f"{found.inliers} matches agree",
    }  # fmt: skip


def _against_truth(matrix: FloatArray, found: PolarResult | SiftResult, pair: KnownPair) -> Row:
    size = pair.first.shape[1], pair.first.shape[0]
    translation, rotation, scale = errors(matrix, pair.truth, size)
    off = np.linalg.norm(apply_homography(pair.truth, found.points0) - found.points1, axis=1)
    right = off <= RIGHT_PX
    return {
        "translation_error_px": translation, "rotation_error_deg": rotation, "scale_error": scale,
        "right": translation <= RIGHT_PX, "tie_points": len(off), "tie_points_right": int(right.sum()),
        "tie_point_error_px": float(np.median(off)) if len(off) else None,
        "coverage": _coverage(found.points0[right], pair, size),
    }  # fmt: skip


def _coverage(points0: FloatArray, pair: KnownPair, size: tuple[int, int]) -> float:
    """Share of the cells of a 16 x 16 grid over picture 0, of those that picture 1 shows, which hold a right point."""
    cells = np.stack(np.meshgrid(np.arange(_GRID), np.arange(_GRID)), axis=-1).reshape(-1, 2)
    side = np.array(size) / _GRID
    there = apply_homography(pair.truth, (cells + 0.5) * side)
    shown = {tuple(cell) for cell in cells[((there >= 0.0) & (there < np.array(size))).all(axis=1)]}
    held = {tuple(cell) for cell in (points0 // side).astype(int)}
    return len(shown & held) / max(len(shown), 1)


def unknown_rows(task: Task, pairs: int) -> Iterator[Row]:
    """Rows of all methods, pair by pair, of every kind of block: with nothing told, and polar with the poses too."""
    for kind in task.kinds if pairs else ():
        for number, pair in enumerate(block_pairs(kind, task.size, task.images, pairs, task.seed, task.data, task.out)):
            head = {"section": "unknown", "kind": kind, "pair": number, "names": pair.names,
                    "size": _size(pair.first), "overlap": round(pair.overlap, 3), "valid": True}  # fmt: skip
            sift = SiftPair(pair.first, pair.second)
            reference = sift.matched(RATIO)
            usable = _registered(reference, pair) and int(reference.verified.sum()) >= _VERIFIED
            for ratio in RATIOS:
                found = sift.matched(ratio)
                right = {"right": _registered(found, pair)}
                yield head | {"method": f"sift {ratio}"} | _of_sift(found) | _judged(found, pair) | right
            for method, geometry in (("polar", None), ("polar, poses", pair.geometry)):
                mine = registered(pair.first, pair.second, TIE_POINTS, geometry)
                row = head | {"method": method} | _of_polar(mine) | _judged(mine, pair)
                right = mine.registration.accepted and pair.right(mine.points0, mine.points1)
                yield row | {"right": right} | (_against(mine, reference) if usable else {})


def _registered(found: SiftResult, pair: BlockPair) -> bool:
    return found.accepted and pair.right(found.points0[found.agree], found.points1[found.agree])


def _judged(found: PolarResult | SiftResult, pair: BlockPair) -> Row:
    score = pair.judged(found.points0, found.points1)
    return {
        "tie_points": score.kept, "tie_points_right": score.correct, "coverage": round(score.coverage, 4),
        "tie_point_error_px": None if np.isnan(score.median_error_px) else round(score.median_error_px, 4),
    }  # fmt: skip


def _against(mine: PolarResult, reference: SiftResult) -> Row:
    """Differences between both similarities over SIFT's verified matches; `translation_px` is how far it moves them.

    A similarity of tilted pictures depends on where they are looked at. Those of a RANSAC for similarities gather where
    one fits by chance, so all that a fundamental matrix explains are taken, and polar is asked at the same places, by
    its tie points around them: relief moves single places by more than the limits of the comparison.
    """
    good = reference.verified
    places = reference.points0[good]
    found, other = (closest_similarity(places, there) for there in (mine.places1(places), reference.points1[good]))
    middle = places.mean(axis=0)
    translation, rotation, scale = differences(found, other, middle)
    return {
        "translation_error_px": translation,
        "translation_px": float(np.linalg.norm(apply_homography(other, middle[None])[0] - middle)),
        "rotation_error_deg": rotation, "rotation_deg": abs(turn_deg(other)), "scale_error": scale,
    }  # fmt: skip


def honesty_rows(task: Task, negatives: int) -> Iterator[Row]:
    """Pairs of which none can be right: apart on one ground, of two grounds, saturated or featureless pictures."""
    grounds = {kind: task.ground(kind) for kind in task.kinds if negatives}
    for number in range(negatives):
        rng = np.random.default_rng([task.seed, 77, number])
        what = NEGATIVES[number % len(NEGATIVES)]
        kind = str(rng.choice(task.kinds))
        first, second = apart(grounds[kind], task.size, rng)
        if what != "apart":
            others = [other for other in task.kinds if other != kind] or [kind]
            second = apart(grounds[str(rng.choice(others))], task.size, rng)[1]
        if what == "saturated":
            first, second = (np.where(picture > 40, 255, picture).astype(np.uint8) for picture in (first, second))
        elif what == "featureless":
            second = np.clip(128 + 2.0 * rng.standard_normal(second.shape), 0, 255).astype(np.uint8)
        found = registered(first, second, 0)
        head = {"section": "honesty", "method": "polar", "kind": what, "pair": number, "size": _size(first)}
        yield head | {"ground": kind, "valid": False, "tie_points": len(found.points0)} | _of_polar(found)


def _number(kind: str) -> int:
    """The same wherever a kind stands in a list."""
    return int.from_bytes(kind.encode()[:4], "big")
