"""Filters on the same matches, judged by exact truth.

Input: mutual nearest neighbours between the features of a preset, without ratio unless --ratio gives one, thinned to
2 px in both images, on the rendered pairs where 30 to 80 % of them are correct (within 3 px of the truth and not
hidden). Direct RANSAC is one homography for the whole pair; it is swept over thresholds, and beside every clustered row
stands the smallest one that keeps as many correct matches in all, with the same filters before and after it.

Plane error: distance (larger of both directions) of every correct input match to the nearest plane of its cluster, for
direct RANSAC to the one homography, median over all. Sums over pairs; ms: median pair, one thread. A pair that a filter
does not verify keeps nothing, unless verifying is not its business (the graph alone). Writes OUT/filters.json and
OUT/filters.md; OUT/scenes keeps the rendered blocks, the same as those of `bench methods`.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aeromatch_cli.config import Settings, load, parse_method
from aeromatch_cli.data import BoolArray, Candidates, FloatArray, PairGeometry
from aeromatch_cli.evaluate.metrics import thin
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.geometry.planes import plane_distances_px
from aeromatch_cli.geometry.two_view import undistorted
from aeromatch_cli.lab.strategies.homography import Homography
from aeromatch_cli.lab.strategies.magsac import Magsac
from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.stages import filter as filtering
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.colour import Colour
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.filters.graph import Graph
from aeromatch_cli.strategies.filters.poselib import Poselib
from benchmarks import options, stamps
from benchmarks.peers.base import Options
from benchmarks.peers.ours import Preset
from benchmarks.processes import limit_threads
from benchmarks.scenes import Judged, rendered_scenes
from benchmarks.tables import Column, Row, grouped, median, number, percent, table, total, write_rows

SWEPT_PX = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 70, 100)
LOWEST, HIGHEST = 0.3, 0.8  # share of the input that is correct
EVERYTHING = 1e300  # false alarms that no pair reaches: direct RANSAC and peers are not held to the test of chance


@dataclass(frozen=True, eq=False)
class Input:
    """The matches of one pair and which of them are correct (M,)."""

    scene: str
    pair: tuple[str, str]
    candidates: Candidates
    geometry: PairGeometry
    correct: BoolArray
    seed: int


@dataclass(frozen=True)
class Variant:
    """A chain of filters by name. threshold_px: of direct RANSAC, else 0."""

    name: str
    chain: tuple[Any, ...]
    threshold_px: float = 0.0


def variants(threshold_px: float) -> list[Variant]:
    """Clustered RANSAC and the sweep of direct RANSAC, with and without colour and epipolar; peers; the graph."""
    found = []
    for before in ((), (Colour(),)):
        for after in ((), (Epipolar(),)):
            names = [*(one.name for one in before), "{}", *(one.name for one in after)]
            pattern = " + ".join(names)
            clustered = ClusteredRansac(threshold_px=threshold_px)
            found.append(Variant(pattern.format("clustered-ransac"), (*before, clustered, *after)))
            for swept_px in SWEPT_PX:
                direct = Homography(threshold_px=swept_px, max_false_alarms=EVERYTHING)
                found.append(Variant(pattern.format("homography"), (*before, direct, *after), swept_px))
    found.append(Variant("epipolar", (Epipolar(),)))
    found.append(Variant("magsac", (Magsac(threshold_px=threshold_px, max_false_alarms=EVERYTHING),)))
    poselib = Poselib(threshold_px=threshold_px, max_false_alarms=EVERYTHING)
    found.append(Variant("poselib", (poselib,)))
    graph = Graph(threshold_px=threshold_px)
    found += [Variant("graph", (graph,)), Variant("graph + poselib", (graph, poselib))]
    found.append(Variant("poselib + graph", (poselib, graph)))
    found.append(Variant("epipolar + graph", (Epipolar(), graph)))
    return found


def inputs(judged: Judged, args: argparse.Namespace) -> Iterator[Input]:
    """The matches of every judged pair of a scene whose share of correct ones lies in the range."""
    name, settings = parse_method(args.features)
    limits = Options(args.keypoints, "image", 1, args.seed, None)
    preset = Preset(judged.scene, limits, preset=name, settings=(*settings, *_matched(args)))
    known: dict[str, Any] = {}
    for pair in judged.pairs:
        for image in pair.images:
            if image not in known:
                known[image] = preset.features(image)
        features = [known[image] for image in pair.images]
        geometry = preset.context.geometry(preset.pair_of[(preset.id_of[pair.images[0]], preset.id_of[pair.images[1]])])
        matches = preset.context.settings.match(*features, geometry)
        found = filtering.candidates(matches, *((side.keypoints_px, side.colours) for side in features))
        found = found.take(thin(found.points0_px, found.points1_px, matches.scores))
        errors_px, hidden = judged.truth.errors(*pair.images, found.points0_px, found.points1_px)
        correct = ~hidden & (np.where(np.isfinite(errors_px), errors_px, np.inf) <= CORRECT_PX)
        if len(found) and LOWEST <= correct.mean() <= HIGHEST:
            yield Input(judged.scene.name, pair.images, found, geometry, correct, args.seed)


def _matched(args: argparse.Namespace) -> tuple[str, ...]:
    """What the matches that are filtered ask for beyond --features."""
    return "match=nearest", f"match.ratio={args.ratio}", "extract.colours=true"


def _settings(args: argparse.Namespace) -> Settings:
    name, settings = parse_method(args.features)
    return load(name, [*settings, *_matched(args)])


def row(variant: Variant, given: Input, threshold_px: float) -> Row:
    """What one variant does to one pair."""
    started = time.perf_counter()
    verdict = apply_chain(variant.chain, given.candidates, given.geometry, given.seed)
    seconds = time.perf_counter() - started
    judges = any(one.verifies for one in variant.chain)
    keep = verdict.keep & (verdict.state == "verified" or not judges)
    # Of the sweep they are asked for at one threshold only.
    errors_px = plane_errors_px(variant, given) if variant.threshold_px in (0, threshold_px) else ()
    return {
        "filter": variant.name,
        "threshold_px": variant.threshold_px,
        "scene": given.scene,
        "pair": " ".join(given.pair),
        "input": len(keep),
        "input_correct": int(given.correct.sum()),
        "verified": verdict.state == "verified",
        "correct": int((keep & given.correct).sum()),
        "wrong": int((keep & ~given.correct).sum()),
        "ms": round(1e3 * seconds, 3),
        "plane_errors_px": [round(float(min(e, 1e6)), 3) for e in errors_px],
    }


def plane_errors_px(variant: Variant, given: Input) -> FloatArray:
    """Distance of every correct match that earlier filters leave to its cluster's nearest plane; none for peers."""
    candidates, correct = given.candidates, given.correct
    for one in variant.chain:
        if isinstance(one, ClusteredRansac):
            return _to_own_planes(one, candidates, given)[correct]
        if isinstance(one, Homography):
            return _to_homography(one, candidates, given)[correct]
        keep = one(candidates, given.geometry, given.seed).keep
        candidates, correct = candidates.take(keep), correct[keep]
    return np.zeros(0)


def _to_own_planes(one: ClusteredRansac, candidates: Candidates, given: Input) -> FloatArray:
    planes, usable = one.find_planes(candidates, given.geometry, given.seed)
    points0, points1, _ = undistorted(candidates.points0_px, candidates.points1_px, given.geometry)
    own = planes.plane_cluster_idx[:, None] == planes.cluster_idx
    distances = np.where(own, plane_distances_px(planes.homographies, points0, points1), np.inf)
    errors = np.full(len(usable), np.inf)
    errors[usable] = distances.min(axis=0, initial=np.inf)
    return errors


def _to_homography(one: Homography, candidates: Candidates, given: Input) -> FloatArray:
    verdict = one(candidates, given.geometry, given.seed)
    if verdict.errors_px is None:
        return np.full(len(candidates), np.inf)
    return np.asarray(verdict.errors_px, dtype=np.float64)


def table_of(rows: Sequence[Row], threshold_px: float) -> str:
    """Every clustered row, its direct counterparts, and the peers."""
    pairs = {(r["scene"], r["pair"]): (r["input"], r["input_correct"]) for r in rows}
    given, right = (sum(values) for values in zip(*pairs.values(), strict=True))
    scenes = ", ".join(f"{scene} {sum(s == scene for s, _ in pairs)}" for scene in dict.fromkeys(s for s, _ in pairs))
    head = f"{len(pairs)} pairs ({scenes}) with {given} matches, {right} of them correct ({100 * right / given:.1f} %)."
    found = dict(grouped(rows, "filter", "threshold_px"))
    lines = []
    for variant in variants(threshold_px):
        own = found[variant.name, variant.threshold_px]
        if variant.threshold_px:
            continue
        if "clustered" not in variant.name:
            lines.append(((variant.name,), (own, math.nan)))
            continue
        name = variant.name.replace("clustered-ransac", "homography")
        direct = {swept_px: found[name, swept_px] for swept_px in SWEPT_PX}
        error_px = _median_error(direct[threshold_px])
        enough = [px for px, members in direct.items() if total(members, "correct") >= total(own, "correct")]
        fair = min(enough, default=max(SWEPT_PX))
        note = "as many correct" if enough else "never as many"
        lines.append(((variant.name,), (own, error_px)))
        lines.append(((f"{name} {threshold_px:g} px",), (direct[threshold_px], error_px)))
        lines.append(((f"{name} {fair:g} px, {note}",), (direct[fair], error_px)))
    return f"{head}\n\n{table(('filter',), lines, _columns(right))}\n"


def _columns(right: int) -> tuple[Column[tuple[Sequence[Row], float]], ...]:
    """Of rows, and the plane error of direct RANSAC to compare theirs with. right: correct matches of the input."""

    def correctness(rows: Sequence[Row]) -> float:
        return total(rows, "correct") / max(total(rows, "correct") + total(rows, "wrong"), 1)

    return (
        ("verified pairs", lambda both: number(total(both[0], "verified"))),
        ("kept", lambda both: number(total(both[0], "correct") + total(both[0], "wrong"))),
        ("correct", lambda both: number(total(both[0], "correct"))),
        ("of the input's correct", lambda both: percent(total(both[0], "correct") / right, 1)),
        ("wrong", lambda both: number(total(both[0], "wrong"))),
        ("correctness", lambda both: percent(correctness(both[0]), 1)),
        ("plane error px", lambda both: number(_median_error(both[0]), 2)),
        ("of direct", lambda both: number(_median_error(both[0]) / both[1] if both[1] else math.nan, 2)),
        ("ms", lambda both: number(median(both[0], "ms"), 1)),
    )


def _median_error(rows: Sequence[Row]) -> float:
    """Over the correct matches of all pairs, NaN without any."""
    errors = np.concatenate([np.asarray(r["plane_errors_px"], dtype=np.float64) for r in rows])
    return float(np.median(errors)) if len(errors) else math.nan


def run(args: argparse.Namespace) -> list[Row]:
    """All rows, written scene by scene."""
    rows: list[Row] = []
    for _, judged in rendered_scenes(args, "all"):
        found = list(inputs(judged, args))
        print(f"{judged.scene.name}: {len(found)} of {len(judged.pairs)} pairs are 30 to 80 % correct", file=sys.stderr)
        if found and not rows:  # imports and caches are not timed
            for variant in variants(args.threshold):
                row(variant, found[0], args.threshold)
        rows += [row(variant, given, args.threshold) for given in found for variant in variants(args.threshold)]
        write_rows(args.out / "filters.json", rows)
    return rows


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("filters", __doc__)
    add = parser.add_argument
    add("--features", default="baseline", help="preset, with settings in brackets, whose features are matched")
    # Its pairs, before the share of correct matches chooses.
    options.add_rendered(parser, scenes=",".join(PRESETS), pairs=16, size="1000x750", images=24, flights="mixed")
    add("--keypoints", type=options.positive, default=2048, help="descriptors per image")
    add("--threshold", type=int, default=3, choices=SWEPT_PX, help="of clustered RANSAC and of the peers, px")
    add("--ratio", type=float, default=1.0, help="of the input's nearest to its second; 1: none")
    options.add_output(parser)
    return parser


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments)
    limit_threads(1)
    rows = run(args)
    if not rows:
        raise SystemExit("no pair is 30 to 80 % correct: give another --seed, --scenes or more --pairs")
    versions = stamps.of_settings(_settings(args), families=("pairs", "enhance", "simulate", "extract", "match"))
    for variant in variants(args.threshold):
        versions |= stamps.of_strategies("filter", *variant.chain)
    options.publish(
        args, table_of(rows, args.threshold), args.out / "filters.md",
        table="_".join(["bench_filters", *(flight for flight in args.flights if flight != "mixed")]),
        command=options.command_line(parser, args), versions=versions,
    )  # fmt: skip
