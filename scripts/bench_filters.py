"""Filters on the same matches, judged by exact truth.

Input: mutual nearest neighbours between the features of a preset, without ratio unless --ratio gives one, thinned to
2 px in both images, on the rendered pairs where 30 to 80 % of them are correct (within 3 px of the truth and not
hidden). Direct RANSAC is one homography for the whole pair; it is swept over thresholds, and beside every clustered row
stands the smallest one that keeps as many correct matches in all, with the same filters before and after it.

Plane error: distance (larger of both directions) of every correct input match to the nearest plane of its cluster, for
direct RANSAC to the one homography, median over all. Sums over pairs; ms: median pair, one thread. A pair that a filter
does not verify keeps nothing, unless verifying is not its business (the graph alone). Writes OUT/filters/results.json
and OUT/filters/table.md; OUT/scenes keeps the rendered blocks, the same as those of scripts/bench_methods.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_methods import FULL
from common import errors_as_exits, publish, size_px
from methods.base import Options
from methods.ours import Preset
from methods.results import write_rows
from methods.scenes import MIXED, Judged, Selection, rendered
from methods.sources import code_digest
from methods.worker import limit_threads

from aeromatch_cli.config import parse_method
from aeromatch_cli.data import BoolArray, Candidates, FloatArray, PairGeometry
from aeromatch_cli.evaluate.metrics import thin
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.geometry.planes import plane_distances_px
from aeromatch_cli.geometry.two_view import undistorted
from aeromatch_cli.stages import filter as filtering
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.colour import Colour
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.filters.graph import Graph
from aeromatch_cli.strategies.filters.homography import Homography
from aeromatch_cli.strategies.filters.magsac import Magsac
from aeromatch_cli.strategies.filters.poselib import Poselib
from aeromatch_cli.synthetic import PRESETS
from aeromatch_cli.synthetic.flights import FLIGHTS

SWEPT_PX = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 70, 100)
LOWEST, HIGHEST = 0.3, 0.8  # share of the input that is correct
EVERYTHING = 1e300  # false alarms that no pair reaches: direct RANSAC and peers are not held to the test of chance
Row = dict[str, Any]


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
    """One line of the table. threshold_px: of direct RANSAC, else 0. surroundings: filters before and after it."""

    name: str
    chain: tuple[Any, ...]
    surroundings: str = ""
    threshold_px: float = 0.0

    @property
    def label(self) -> str:
        return f"{self.name} {self.threshold_px:g} px" if self.threshold_px else self.name


def variants(threshold_px: float) -> list[Variant]:
    """Clustered RANSAC and the sweep of direct RANSAC, with and without colour and epipolar; peers; the graph."""
    found = []
    for before in ((), (Colour(),)):
        for after in ((), (Epipolar(),)):
            words = "+".join(one.name for one in (*before, *after))
            names = [*(one.name for one in before), "{}", *(one.name for one in after)]
            pattern = " + ".join(names)
            clustered = ClusteredRansac(threshold_px=threshold_px)
            found.append(Variant(pattern.format("clustered-ransac"), (*before, clustered, *after), words))
            for swept_px in SWEPT_PX:
                direct = Homography(threshold_px=swept_px, max_false_alarms=EVERYTHING)
                found.append(Variant(pattern.format("homography"), (*before, direct, *after), words, swept_px))
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
    own = ("match=nearest", f"match.ratio={args.ratio}", "extract.colours=true")
    options = Options(args.keypoints, "image", 1, args.seed, None)
    preset = Preset(judged.scene, options, preset=name, settings=(*settings, *own))
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


def table(rows: Sequence[Row], threshold_px: float) -> str:
    """Markdown: every clustered row, its direct counterparts, and the peers."""
    columns = (
        "filter", "verified pairs", "kept", "correct", "of the input's correct", "wrong", "correctness",
        "plane error px", "of direct", "ms",
    )  # fmt: skip
    pairs = {(r["scene"], r["pair"]): (r["input"], r["input_correct"]) for r in rows}
    given, right = (sum(values) for values in zip(*pairs.values(), strict=True))
    scenes = ", ".join(f"{scene} {sum(s == scene for s, _ in pairs)}" for scene in dict.fromkeys(s for s, _ in pairs))
    lines = [
        f"{len(pairs)} pairs ({scenes}) with {given} matches, {right} of them correct ({100 * right / given:.1f} %).",
        "",
        "| " + " | ".join(columns) + " |",
        "|" + "---|" * len(columns),
    ]
    groups = {v: _of(rows, v) for v in variants(threshold_px)}
    for variant, members in groups.items():
        if variant.threshold_px:
            continue
        direct = {
            v.threshold_px: m for v, m in groups.items() if v.threshold_px and v.surroundings == variant.surroundings
        }
        is_clustered = "clustered" in variant.name
        base = _median_error(direct[threshold_px]) if is_clustered else 0.0
        lines.append(_line(variant.label, members, right, base))
        if is_clustered:
            name = variant.label.replace("clustered-ransac", "homography")
            lines.append(_line(f"{name} {threshold_px:g} px", direct[threshold_px], right, base))
            enough = [t for t, m in direct.items() if _sum(m, "correct") >= _sum(members, "correct")]
            fair = min(enough, default=max(SWEPT_PX))
            note = f"{name} {fair:g} px, as many correct" if enough else f"{name} {fair:g} px, never as many"
            lines.append(_line(note, direct[fair], right, base))
    return "\n".join(lines) + "\n"


def _of(rows: Sequence[Row], variant: Variant) -> list[Row]:
    return [r for r in rows if r["filter"] == variant.name and r["threshold_px"] == variant.threshold_px]


def _line(label: str, rows: Sequence[Row], right: int, direct_error_px: float) -> str:
    correct, wrong, error = _sum(rows, "correct"), _sum(rows, "wrong"), _median_error(rows)
    cells = [
        label,
        f"{sum(r['verified'] for r in rows)}",
        f"{correct + wrong}",
        f"{correct}",
        f"{100 * correct / right:.1f} %",
        f"{wrong}",
        f"{100 * correct / max(correct + wrong, 1):.1f} %",
        f"{error:.2f}" if np.isfinite(error) else "-",
        f"{error / direct_error_px:.2f}" if np.isfinite(error) and direct_error_px > 0 else "-",
        f"{np.median([r['ms'] for r in rows]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _sum(rows: Sequence[Row], field: str) -> int:
    return int(sum(r[field] for r in rows))


def _median_error(rows: Sequence[Row]) -> float:
    """Over the correct matches of all pairs, NaN without any."""
    errors = np.concatenate([np.asarray(r["plane_errors_px"], dtype=np.float64) for r in rows])
    return float(np.median(errors)) if len(errors) else float("nan")


def run(args: argparse.Namespace) -> list[Row]:
    """All rows, written scene by scene."""
    folder = args.out / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    (args.out / "filters").mkdir(exist_ok=True)
    code, selection = code_digest("synthetic"), Selection("all", args.pairs, args.seed)
    rows: list[Row] = []
    for preset in filter(None, args.scenes.split(",")):
        asked = {"size_px": size_px(args.size), "images": args.images, "jobs": 2, "code": code, "flight": args.flight}
        judged = rendered(folder, preset, selection, **asked)
        found = list(inputs(judged, args))
        print(f"{preset}: {len(found)} of {len(judged.pairs)} pairs are 30 to 80 % correct", file=sys.stderr)
        if found and not rows:  # imports and caches are not timed
            for variant in variants(args.threshold):
                row(variant, found[0], args.threshold)
        rows += [row(variant, given, args.threshold) for given in found for variant in variants(args.threshold)]
        write_rows(args.out / "filters" / "results.json", rows)
    return rows


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = f"scripts/bench_filters --features '{args.features}' --scenes {args.scenes} --pairs {args.pairs}"
    parts += f" --seed {args.seed} --keypoints {args.keypoints} --threshold {args.threshold} --size {args.size}"
    parts += f" --images {args.images}"
    if (args.flight, args.ratio) != (MIXED, 1.0):
        parts += f" --flight {args.flight} --ratio {args.ratio}"
    return f"{parts} --out DIR"


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--features", default="baseline", help="preset, with settings in brackets, whose features are matched")
    add("--scenes", default=FULL["scenes"], help=f"comma-separated presets of rendered blocks: {', '.join(PRESETS)}")
    add("--pairs", type=int, default=FULL["pairs"], help="of each scene, before the share of correct matches chooses")
    add("--seed", type=int, default=0, help="another seed gives other scenes, pairs and samples")
    add("--keypoints", type=int, default=FULL["keypoints"], help="descriptors per image")
    add("--threshold", type=int, default=3, choices=SWEPT_PX, help="of clustered RANSAC and of the peers, px")
    add("--ratio", type=float, default=1.0, help="of the input's nearest to its second; 1: none")
    add("--flight", default=MIXED, help=f"of the rendered blocks: {', '.join(FLIGHTS)}")
    add("--size", metavar="WxH", default=FULL["size"], help="of rendered images")
    add("--images", type=int, default=FULL["images"], help="of each rendered block")
    add("--readme", action="store_true", help="write the table into the README")
    add("--out", type=Path, required=True)
    return parser.parse_args()


def main() -> None:
    args = parse()
    limit_threads(1)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    with errors_as_exits():
        rows = run(args)
    if not rows:
        raise SystemExit("no pair is 30 to 80 % correct: give another --seed, --scenes or more --pairs")
    name = "bench_filters" if args.flight == MIXED else f"bench_filters_{args.flight}"
    text = table(rows, args.threshold)
    publish(text, args.out / "filters" / "table.md", name if args.readme else None, command(args))


if __name__ == "__main__":
    main()
