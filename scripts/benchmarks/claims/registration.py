"""Paper B, J. Geo-inf. Sci. 2019(10): least-squares registration in dynamic polar coordinates beside SIFT.

known: pairs cut out of flat ground with detail at full size (7360 x 5400). unknown: pairs of rendered ground with
relief, and of real blocks, of which nothing is told. grid: the same least squares, from the same start, on samples
that are placed otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aeromatch_cli.config import Settings, load
from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.frames import apply_homography, closest_similarity
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.strategies.matchers.polar import Polar
from aeromatch_cli.strategies.matchers.polar.fit import Fit, Grid, fit, polar_grid
from aeromatch_cli.strategies.matchers.polar.level import Level
from aeromatch_cli.strategies.matchers.polar.pyramid import FINEST_PX, rescaled
from benchmarks.claims.grounds import GROUNDS, KnownPair, differences, errors, ground, known_pair, turn_deg
from benchmarks.claims.sides import PolarResult, Shot, SiftResult, registered, sift, unknown_geometry
from benchmarks.claims.work import Unit, rendered
from benchmarks.scenes import Judged, Selection, real
from benchmarks.tables import Row, plain

CODE = (
    "strategies/matchers/polar", "strategies/extractors/grid.py", "geometry", "images",
    "benchmarks/claims/registration.py", "benchmarks/claims/grounds.py", "benchmarks/claims/sides.py",
)  # fmt: skip
PAIRS = 2
RENDERED, REAL = ("grass",), ("seneca", "caliterra")
UNKNOWN_SIZE, UNKNOWN_IMAGES, UNKNOWN_PAIRS, LEAST_OVERLAP = "1840x1350", 5, 10, 0.3
GRID_SIZE, GRID_PAIRS, SAMPLES = (1840, 1350), 12, 20_000
# How far off the start of a comparison of grids is: shift of the middle (share of the radius), turn, scale.
_NEAR, _FAR = (0.002, 0.05, 1.001), (0.01, 0.6, 1.01)
_ALIKE_PX = 0.3  # of the finest level: a fit that ends nearer to the truth has found it
COMPARED = 5  # pairs of each kind
_FEWEST = 30  # right matches of SIFT's that a comparison with it rests on


def units(seed: int, size: tuple[int, int], data: Path | None, out: Path) -> list[Unit]:
    grids = [Unit(f"grids, {kind}", grid_rows, (kind, seed), CODE) for kind in GROUNDS]
    kinds, code = (*RENDERED, *(REAL if data else ())), (*CODE, "lab/synthetic")
    unknown = [Unit(f"unknown, {kind}", unknown_rows, (kind, seed, data, out), code) for kind in kinds]
    known = [Unit(f"known, {kind}", known_rows, (kind, size, seed), CODE, alone=True) for kind in GROUNDS]
    return grids + unknown + known


def settings() -> list[Settings]:
    return [load("polar")]


def known_rows(kind: str, size: tuple[int, int], seed: int) -> list[Row]:
    source = ground(kind, size, seed)
    return [_known(known_pair(source, size, np.random.default_rng([seed, 5, n])), kind, n) for n in range(PAIRS)]


def _known(pair: KnownPair, kind: str, number: int) -> Row:
    mine, other = registered(pair.first, pair.second), sift(pair.first, pair.second)
    row: Row = {"paper": "B", "section": "known", "kind": kind, "pair": number, "overlap": pair.overlap}
    row |= {"accepted": mine.accepted, "sift_accepted": other.accepted, "sift_seconds": other.seconds}
    row |= dict(zip(("seconds", "exact_seconds", "tie_point_seconds"), mine.seconds, strict=True))
    size = pair.first.shape[1], pair.first.shape[0]
    for name, matrix in (("", mine.matrix), ("exact_", mine.exact), ("sift_", other.matrix)):
        found = errors(matrix, pair.truth, size)
        row |= {f"{name}{what}": value for what, value in zip(("px", "deg", "scale"), found, strict=True)}
    if other.accepted:
        middle = other.points0[other.agree].mean(axis=0)
        for name, matrix in (("", mine.matrix), ("exact_", mine.exact)):
            row |= _against(matrix, other.matrix, middle, name)
    return {key: plain(value) for key, value in row.items()}


def _against(found: FloatArray, other: FloatArray, place: FloatArray, name: str) -> Row:
    """How a similarity differs from SIFT's at a place: px, share of what that moves it by, and turn."""
    off_px, off_deg, _ = differences(found, other, place)
    moved = float(np.linalg.norm(apply_homography(other, place[None])[0] - place))
    return {
        f"{name}against_px": off_px, f"{name}against_share": off_px / moved, f"{name}against_deg": off_deg,
        "turn_deg": abs(turn_deg(other)),
    }  # fmt: skip


def scenes(seed: int, out: Path) -> list[tuple[object, ...]]:
    """Arguments of `work.rendered`."""
    return [(kind, "nadir", UNKNOWN_SIZE, UNKNOWN_IMAGES, UNKNOWN_PAIRS, "all", seed, out) for kind in RENDERED]


def unknown_rows(kind: str, seed: int, data: Path | None, out: Path) -> list[Row]:
    if kind in RENDERED:
        judged = rendered(kind, "nadir", UNKNOWN_SIZE, UNKNOWN_IMAGES, UNKNOWN_PAIRS, "all", seed, out)
    else:
        assert data is not None
        longest = int(UNKNOWN_SIZE.partition("x")[0])
        judged = real(out / "scenes", data, kind, Selection("all", UNKNOWN_PAIRS, seed), max_size_px=longest)
    pairs = [pair for pair in judged.pairs if pair.conditions.overlap >= LEAST_OVERLAP]
    return [_unknown(judged, pair.images, kind) for pair in pairs[:COMPARED]]


def _unknown(judged: Judged, names: tuple[str, str], kind: str) -> Row:
    first, second = (read_pixels(judged.scene.images / name, colour=False) for name in names)
    mine, other = registered(first, second), sift(first, second)
    row: Row = {"paper": "B", "section": "unknown", "kind": kind, "pair": " ".join(names), "accepted": mine.accepted}
    places, there = _right(judged, names, other)
    row |= {"sift_seconds": other.seconds, "sift_accepted": len(places) >= _FEWEST}
    row |= dict(zip(("seconds", "exact_seconds", "tie_point_seconds"), mine.seconds, strict=True))
    if mine.accepted and row["sift_accepted"]:
        row |= _by_registration(mine, places, closest_similarity(places, there))
    return {key: plain(value) for key, value in row.items()}


def _by_registration(mine: PolarResult, places: FloatArray, straight: FloatArray) -> Row:
    """By the registration's homography alone, and with tie points, which follow relief, at the places of SIFT's."""
    middle = places.mean(axis=0)
    warped = apply_homography(mine.registered.registration.warp, places)
    return _against(closest_similarity(places, warped), straight, middle, "") | _against(
        closest_similarity(places, mine.places1(places)), straight, middle, "exact_"
    )


def _right(judged: Judged, names: tuple[str, str], found: SiftResult) -> tuple[FloatArray, FloatArray]:
    """Places (N, 2) in both pictures of SIFT's verified matches that are right by the block's truth."""
    verified = found.verified
    points0, points1 = found.points0[verified], found.points1[verified]
    nothing, equal = np.zeros((0, 2)), np.ones(len(points0))
    right = judged.truth.judge(*names, nothing, nothing, points0, points1, equal).correct_idx
    return points0[right], points1[right]


def plain_polar(radius_px: int, step_px: float) -> FloatArray:
    """As many samples as the dynamic grid has, equally many on every ring."""
    dynamic = polar_grid(float(radius_px), step_px)
    rings = len(dynamic.counts)
    each = round(len(dynamic.offsets_px) / rings)
    angles = 2.0 * np.pi * np.arange(each) / each
    offsets = dynamic.radii_px[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(offsets.reshape(-1, 2))


def cartesian(radius_px: int, step_px: float) -> FloatArray:
    """A square grid in the same circle, one sample to the square of the step as well."""
    steps = np.arange(-radius_px, radius_px + step_px, step_px)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(offsets[np.hypot(*offsets.T) <= radius_px])


LAYOUTS: Mapping[str, Grid | None] = {"dynamic polar": None, "plain polar": plain_polar, "Cartesian": cartesian}


def equal_samples(levels: tuple[Level, Level], truth: FloatArray) -> dict[str, int]:
    """Layout -> samples to ask `fit` for, so that of all layouts as many lie in both pictures: those of the plain polar
    grid crowd in the middle of the overlap, and fewer of them fall outside."""
    used = {layout: fit(*levels, truth, samples=SAMPLES, grid=grid) for layout, grid in LAYOUTS.items()}
    wanted = used["dynamic polar"]
    if wanted is None:
        return dict.fromkeys(LAYOUTS, SAMPLES)
    return {layout: round(SAMPLES * wanted.samples / one.samples) if one else SAMPLES for layout, one in used.items()}


def grid_rows(kind: str, seed: int) -> list[Row]:
    """Least squares on the finest level from starts a little and farther off, on every layout of samples."""
    source = ground(kind, GRID_SIZE, seed)
    rows: list[Row] = []
    for number in range(GRID_PAIRS):
        pair = known_pair(source, GRID_SIZE, np.random.default_rng([seed, 6, number]))
        shots = Shot(pair.first), Shot(pair.second)
        found = Polar().registered(*shots, unknown_geometry(pair.first, pair.second))
        if not found.registration.accepted:
            continue
        levels, scale = found.levels.at(FINEST_PX, even=False), found.levels.scale(FINEST_PX)
        truth = rescaled(pair.truth, 1.0, scale)
        asked = equal_samples(levels, truth)
        rng = np.random.default_rng([seed, 7, number])
        way = rng.uniform(0.0, 2.0 * np.pi)
        for distance, off in (("near", _NEAR), ("far", _FAR)):
            start = _off(truth, off, way, levels[0].size_px)
            for layout, grid in LAYOUTS.items():
                done = fit(*levels, start, samples=asked[layout], grid=grid)
                head = {"paper": "B", "section": "grid", "kind": kind, "pair": number, "start": distance}
                rows.append(head | {"layout": layout} | _fitted(done, truth, scale, pair, shots[0]))
    return rows


def _off(truth: FloatArray, off: tuple[float, float, float], way: float, size: tuple[int, int]) -> FloatArray:
    """A similarity so far from the truth, about the middle of side 0."""
    share, turn, factor = off
    middle, shift = (np.array(size) - 1.0) / 2.0, share * max(size) * np.array([np.cos(way), np.sin(way)])
    cosine, sine = factor * np.cos(np.deg2rad(turn)), factor * np.sin(np.deg2rad(turn))
    linear = np.array([[cosine, -sine], [sine, cosine]])
    moved = np.vstack([np.column_stack([linear, middle + shift - linear @ middle]), [0.0, 0.0, 1.0]])
    return np.asarray(truth @ moved)


def _fitted(done: Fit | None, truth: FloatArray, scale: float, pair: KnownPair, shot: Shot) -> Row:
    if done is None:
        return {"found": False, "samples": 0, "px": None, "deg": None, "scale": None}
    px, deg, factor = errors(rescaled(done.matrix, scale, 1.0), pair.truth, (shot.width_px, shot.height_px))
    found = px * scale <= _ALIKE_PX
    values = {"px": px, "deg": deg, "scale": factor} if found else dict.fromkeys(("px", "deg", "scale"))
    return {"found": found, "samples": done.samples} | {key: plain(value) for key, value in values.items()}
