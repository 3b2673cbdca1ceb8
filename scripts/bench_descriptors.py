"""This project's descriptors beside SIFT, TFeat and HardTFeat on the same patches, by exact truth.

Pairs of rendered blocks that no training has seen, by class of view angle and by whether one sun shone on both images.
Keypoints: of the 4,000 strongest of SIFT in the north-up ground views that preset `baseline` makes the strongest of
either side that the other image shows, too. Corresponding: one place within 3 px of stored pixels and one size within a
factor of 1.5, one to one. Every descriptor sees the same place, size and angle (upright, or --angles sift): networks
the same 32 x 32 patch of 6.4 sizes, SIFT its own support (6 sizes and the blur between its bins) in the picture.
Descriptors with context (ours+context) know the other keypoints and the picture around them.

FPR95: share of different places accepted at the distance that accepts 95 % of the corresponding ones; the different
ones are, for every corresponding pair, ten keypoints of the other image drawn at random from those farther than 10 px.
mAP: every keypoint of image 0 that corresponds to one, or to none within 10 px, has its nearest neighbour of image 1 as
answer, right within 3 px of its partner; area below precision over recall of the answers in the order of the ratio of
first to second distance (or of the distance), mean over pairs. Right: share of the corresponding keypoints whose
nearest neighbour is right.

Writes OUT/results.json row by row and OUT/table.md; OUT/scenes keeps rendered blocks and all figures: what depends on
nothing that changed is not made again, so that a killed run goes on where it was. Descriptors are named NAME, or
LABEL=NAME, or LABEL=ours:FILE for other weights of this project's own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from common import errors_as_exits, fill_in, publish, size_px
from keypoint_bench.blocks import LoadedNetwork, blocks
from keypoint_bench.correspondence import Partners, in_overlap, of_one_size, partners
from keypoint_bench.descriptors import DESCRIBERS, Describer, Side, make_side, strongest_sift
from keypoint_bench.figures import Store
from keypoint_bench.metrics import distances, false_positive_rate, nearest_neighbours
from keypoint_bench.named import Named, make, named, without_paths
from keypoint_bench.pictures import GROUND, Pictures
from keypoint_bench.tables import descriptor_table
from methods.base import Options
from methods.results import write_rows
from methods.scenes import Judged, JudgedPair
from methods.worker import limit_threads
from scipy.spatial import cKDTree

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.evaluate import RenderedTruth
from aeromatch_cli.workspace import stable_hash

Row = dict[str, Any]
# Keypoints that a picture offers; a pair has those of the overlap.
MOST = 4000
NEGATIVES, FAR_PX = 10, 10.0
FULL = {"scenes": "city,suburb,hills,farmland", "pairs": 12, "size": "1000x750", "images": 24, "keypoints": 1500}
QUICK = {"scenes": "suburb", "pairs": 4, "size": "480x360", "images": 12, "keypoints": 400}


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


def make_task(
    truth: RenderedTruth, pictures: Pictures, pair: JudgedPair, count: int, rng: np.random.Generator, *, upright: bool
) -> Task:
    """From the keypoints of both ground views of a pair."""
    both = pictures(pair.images[0], GROUND), pictures(pair.images[1], GROUND)
    sides = []
    for picture, other in (both, both[::-1]):
        table, own = strongest_sift(picture, MOST, upright=upright)
        rows = np.flatnonzero(in_overlap(truth, picture, table[:, :2], other))[:count]
        sides.append(make_side(picture, table, own, rows, upright=upright))
    first, second = (side.picture.stored_px(side.keypoints.points_px) for side in sides)
    found = partners(truth, pair.images[0], first, pair.images[1], second)
    found, _ = of_one_size(truth, both, (sides[0].keypoints, sides[1].keypoints), found)
    partner = np.full(len(first), -1)
    partner[found.rows0] = found.rows1
    there, _ = truth.truth.transfer(pair.images[0], first, pair.images[1])
    asked = (partner >= 0) | ~near(there, second, FAR_PX)
    return Task((sides[0], sides[1]), partner, asked, second, *different(second, found, rng))


def near(points_px: FloatArray, others_px: FloatArray, radius_px: float) -> BoolArray:
    """Which points (N, 2) have one of the others (M, 2) within the radius; those that are NaN have none."""
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
    figures = {
        "fpr95": false_positive_rate(same, other),
        "map_by_ratio": ranked.by_ratio,
        "map_by_distance": ranked.by_distance,
        "right": ranked.right,
    }
    counts = {"keypoints0": apart.shape[0], "keypoints1": apart.shape[1], "corresponding": len(rows0)}
    return counts | {name: round(value, 6) if np.isfinite(value) else None for name, value in figures.items()}


def rows_of(
    judged: Judged,
    truth: RenderedTruth,
    describers: dict[Named, Describer],
    args: argparse.Namespace,
    store: Store,
) -> Iterator[Row]:
    """One row for each descriptor and pair of a block."""
    with tempfile.TemporaryDirectory() as scratch:
        pictures = Pictures(judged.scene, Path(scratch))
        for pair in judged.pairs:

            @cache
            def task(pair: JudgedPair = pair) -> Task:
                rng = np.random.default_rng([args.seed, stable_hash(" ".join(pair.images)) % (1 << 32)])
                return make_task(truth, pictures, pair, args.keypoints, rng, upright=args.angles == "upright")

            suns = {truth.truth.sorties[name] for name in pair.images}
            light = {"suns": "one" if len(suns) == 1 else "two"}
            for method, describer in describers.items():

                def made(describer: Describer = describer, task: Callable[[], Task] = task) -> Row:
                    return descriptor_row(describer, task())

                yield store.row(judged, pair, "descriptor", GROUND, method, made) | light


def run(args: argparse.Namespace) -> list[Row]:
    """All rows, written as they come."""
    options = Options(args.keypoints, "image", args.threads, args.seed, args.reference_weights)
    describers = {method: make(DESCRIBERS, method, options) for method in named(args.descriptors, DESCRIBERS)}
    store = Store(args.out / "scenes" / "figures", [args.keypoints, args.angles, args.seed])
    rows: list[Row] = []
    for flight in args.flights.split(","):
        asked = LoadedNetwork(
            tuple(args.scenes.split(",")), flight, size_px(args.size), args.images, args.pairs, args.seed
        )
        for judged, truth in blocks(args.out, asked):
            for row in rows_of(judged, truth, describers, args, store):
                rows.append(row | {"flight": flight})
                write_rows(args.out / "results.json", rows)
            print(f"{judged.scene.name}, {flight}: {len(judged.pairs)} pairs", file=sys.stderr, flush=True)
    return rows


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = f"scripts/bench_descriptors --descriptors '{without_paths(args.descriptors)}' --angles {args.angles}"
    parts += f" --scenes {args.scenes} --flights {args.flights} --pairs {args.pairs} --size {args.size}"
    parts += f" --images {args.images} --keypoints {args.keypoints} --seed {args.seed} --reference-weights DIR"
    return f"{parts} --out DIR"


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--descriptors", default=",".join(DESCRIBERS), help="comma-separated")
    add("--angles", choices=("upright", "sift"), default="upright", help="of the keypoints: 0, or SIFT's own")
    add("--scenes", help="presets of rendered blocks, comma-separated")
    add("--flights", default="mixed,oblique", help="of rendered blocks, comma-separated; mixed has two suns")
    add("--pairs", type=int, help="of each block")
    add("--size", metavar="WxH", help="of rendered images")
    add("--images", type=int, help="of each block")
    add("--keypoints", type=int, help="of either side of a pair")
    add("--seed", type=int, default=0, help="another seed gives other blocks and pairs")
    add("--threads", type=int, default=2)
    add("--quick", action="store_true", help="small blocks, few pairs")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of tfeat and hardtfeat")
    add("--readme", action="store_true", help="write the table into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    fill_in(args, QUICK if args.quick else FULL)
    return args


def main() -> None:
    args = parse()
    limit_threads(args.threads)
    with errors_as_exits():
        rows = run(args)
    text = f"At most {args.keypoints} keypoints of either side, {args.angles}, seed {args.seed}.\n\n"
    text += f"{descriptor_table(rows)}\n"
    publish(text, args.out / "table.md", "bench_descriptors" if args.readme else None, command(args))


if __name__ == "__main__":
    main()
