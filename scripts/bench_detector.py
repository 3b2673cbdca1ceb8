"""Keypoints of this project's detector beside SIFT, Key.Net and ALIKED, and the angles given to them, by exact truth.

Pairs of rendered blocks that no training has seen, by class of view angle. `source`: on the stored images; `ground`: on
the north-up ground views that preset `baseline` makes. Of each detector's keypoints those count whose true place the
other picture shows, too; of these the 1,000 strongest of either side (fewer where it finds fewer). Repeated: pairs of
them, one to one, within 3 px and within 1 px of the truth, px of the stored image, the larger of both directions.
Repeatability: repeated over the keypoints of the side that has fewer. Error: median of those repeated within 3 px.

Angles: SIFT keypoints of both pictures that are one place within 3 px at one size within a factor of 1.5. Error:
difference of both angles less the true turn between the pictures at that place. Where SIFT gives a place several
angles, those that agree best count.

Writes OUT/results.json row by row and OUT/table.md; OUT/scenes keeps rendered blocks and all figures: what depends on
nothing that changed is not made again, so that a killed run goes on where it was. Detectors and networks of angles are
named NAME, or LABEL=NAME, or LABEL=ours:FILE for other weights of this project's own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from common import errors_as_exits, fill_in, publish, size_px
from keypoint_bench.blocks import LoadedNetwork, blocks
from keypoint_bench.correspondence import in_overlap, partners
from keypoint_bench.detectors import DETECTORS, Detector, Keypoints
from keypoint_bench.figures import Store
from keypoint_bench.named import Named, make, named, without_paths
from keypoint_bench.orientations import (
    ORIENTERS,
    Orienter,
    Turned,
    disagreement_deg,
    orientation_row,
    turned_keypoints,
)
from keypoint_bench.pictures import GROUND, SOURCE, Picture, Pictures
from keypoint_bench.tables import detector_table, orientation_table
from methods.base import Options
from methods.results import write_rows
from methods.scenes import Judged, JudgedPair
from methods.worker import limit_threads

from aeromatch_cli.evaluate import RenderedTruth

Row = dict[str, Any]
# LoadedNetwork of a detector: enough that 1,000 lie in an overlap of a tenth of the picture.
MOST = 10_000
FULL = {"scenes": "city,suburb,hills,farmland", "pairs": 12, "size": "1000x750", "images": 24, "keypoints": 1000}
QUICK = {"scenes": "suburb", "pairs": 4, "size": "480x360", "images": 10, "keypoints": 200}


@dataclass(frozen=True, eq=False)
class Task:
    """keypoints: of either side of a pair. store: of figures."""

    keypoints: int
    store: Store


def shared_keypoints(
    truth: RenderedTruth, found: tuple[Keypoints, Keypoints], pictures: tuple[Picture, Picture], count: int
) -> list[Keypoints]:
    """The strongest `count` of either side that the other picture shows, too."""
    sides = ((found[0], pictures[0], pictures[1]), (found[1], pictures[1], pictures[0]))
    return [
        side.take(np.flatnonzero(in_overlap(truth, picture, side.points_px, other))[:count])
        for side, picture, other in sides
    ]


def detector_row(
    truth: RenderedTruth, found: tuple[Keypoints, Keypoints], pictures: tuple[Picture, Picture], count: int
) -> Row:
    """How many keypoints of a pair were found again, and how exactly."""
    sides = shared_keypoints(truth, found, pictures, count)
    stored = [picture.stored_px(side.points_px) for picture, side in zip(pictures, sides, strict=True)]
    again = partners(truth, pictures[0].image, stored[0], pictures[1].image, stored[1])
    return {
        "keypoints0": len(stored[0]),
        "keypoints1": len(stored[1]),
        "repeated_3px": len(again.errors_px),
        "repeated_1px": int((again.errors_px <= 1.0).sum()),
        "error_px": float(np.median(again.errors_px)) if len(again.errors_px) else None,
    }


def detector_rows(
    judged: Judged, truth: RenderedTruth, pictures: Pictures, methods: dict[Named, Detector], task: Task
) -> Iterator[Row]:
    """One row for each detector, frame and pair of a block."""
    for frame in (SOURCE, GROUND):
        for method, detector in methods.items():

            @cache
            def found(name: str, frame: str = frame, detector: Detector = detector) -> Keypoints:
                return detector(pictures(name, frame), MOST)

            for pair in judged.pairs:

                def made(pair: JudgedPair = pair, frame: str = frame, found: Callable[[str], Keypoints] = found) -> Row:
                    both = pictures(pair.images[0], frame), pictures(pair.images[1], frame)
                    return detector_row(truth, (found(pair.images[0]), found(pair.images[1])), both, task.keypoints)

                yield task.store.row(judged, pair, "detector", frame, method, made)


def orientation_rows(
    judged: Judged, truth: RenderedTruth, pictures: Pictures, methods: dict[Named, Orienter], task: Task
) -> Iterator[Row]:
    """One row for each network of angles, frame and pair of a block."""
    for frame in (SOURCE, GROUND):
        for pair in judged.pairs:

            @cache
            def shared(pair: JudgedPair = pair, frame: str = frame) -> Turned:
                both = pictures(pair.images[0], frame), pictures(pair.images[1], frame)
                return turned_keypoints(truth, both, MOST, 2 * task.keypoints)

            for method, orienter in methods.items():

                def made(orienter: Orienter = orienter, shared: Callable[[], Turned] = shared) -> Row:
                    turned = shared()
                    sides = zip(turned.pictures, turned.keypoints, strict=True)
                    angles0, angles1 = (orienter(picture, side) for picture, side in sides)
                    return orientation_row(disagreement_deg(angles0, angles1, turned.turn_deg))

                yield task.store.row(judged, pair, "orientation", frame, method, made)


def run(args: argparse.Namespace) -> list[Row]:
    """All rows, written as they come."""
    asked = LoadedNetwork(
        tuple(args.scenes.split(",")), args.flight, size_px(args.size), args.images, args.pairs, args.seed
    )
    options = Options(args.keypoints, "image", args.threads, args.seed, args.reference_weights)
    detectors = {method: make(DETECTORS, method, options) for method in named(args.detectors, DETECTORS)}
    orienters = {method: make(ORIENTERS, method, options) for method in named(args.orienters, ORIENTERS)}
    task = Task(args.keypoints, Store(args.out / "scenes" / "figures", args.keypoints))
    rows: list[Row] = []
    for judged, truth in blocks(args.out, asked):
        with tempfile.TemporaryDirectory() as scratch:
            pictures = Pictures(judged.scene, Path(scratch))
            for row in chain(
                detector_rows(judged, truth, pictures, detectors, task),
                orientation_rows(judged, truth, pictures, orienters, task),
            ):
                rows.append(row)
                write_rows(args.out / "results.json", rows)
        print(f"{judged.scene.name}: {len(judged.pairs)} pairs", file=sys.stderr, flush=True)
    return rows


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = f"scripts/bench_detector --detectors '{without_paths(args.detectors)}'"
    parts += f" --orienters '{without_paths(args.orienters)}'"
    parts += f" --scenes {args.scenes} --flight {args.flight} --pairs {args.pairs} --size {args.size}"
    parts += f" --images {args.images} --keypoints {args.keypoints} --seed {args.seed} --reference-weights DIR"
    return f"{parts} --out DIR"


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--detectors", default=",".join(DETECTORS), help="comma-separated; '' for none")
    add("--orienters", default=",".join(ORIENTERS), help="comma-separated; '' for none")
    add("--scenes", help="presets of rendered blocks, comma-separated")
    add("--flight", default="oblique", help="of rendered blocks")
    add("--pairs", type=int, help="of each block")
    add("--size", metavar="WxH", help="of rendered images")
    add("--images", type=int, help="of each block")
    add("--keypoints", type=int, help="of either side of a pair")
    add("--seed", type=int, default=0, help="another seed gives other blocks and pairs")
    add("--threads", type=int, default=2)
    add("--quick", action="store_true", help="one small block, few pairs")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of keynet, aliked and orinet")
    add("--readme", action="store_true", help="write the tables into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    fill_in(args, QUICK if args.quick else FULL)
    return args


def main() -> None:
    args = parse()
    limit_threads(args.threads)
    with errors_as_exits():
        rows = run(args)
    text = f"At most {args.keypoints} keypoints of either side, seed {args.seed}.\n\n"
    text += f"{detector_table(rows)}\n\n### Angles\n\n{orientation_table(rows)}\n"
    publish(text, args.out / "table.md", "bench_detector" if args.readme else None, command(args))


if __name__ == "__main__":
    main()
