"""Keypoints of this project, their angles and descriptors beside those of others, on the same pairs, by exact truth.

Pairs of rendered blocks that no training has seen, by class of view angle. `source`: on the stored images; `ground`: on
the north-up ground views that preset `baseline` makes. What is compared is named NAME, or LABEL=NAME, or
LABEL=ours:FILE for other weights of this project's own.

--detectors   Of each detector's keypoints those count whose true place the other picture shows, too; of these the
              strongest of either side (fewer where it finds fewer). Repeated: pairs of them, one to one, within 3 px
              and within 1 px of the truth, px of the stored image, the larger of both directions. Repeatability:
              repeated over the keypoints of the side that has fewer. Error: median of those repeated within 3 px.
--orienters   Angles: SIFT keypoints of both pictures that are one place within 3 px at one size within a factor of
              1.5. Error: difference of both angles less the true turn between the pictures at that place. Where SIFT
              gives a place several angles, those that agree best count.

--descriptors Of the 4,000 strongest keypoints of SIFT in the ground views the strongest of either side that the other
              image shows, too; corresponding as above, one to one. Every descriptor sees the same place, size and angle
              (upright, or --angles sift): networks the same 32 x 32 patch of 6.4 sizes, SIFT its own support (6 sizes
              and the blur between its bins) in the picture. Descriptors with context (ours+context) know the other
              keypoints and the picture around them. FPR95: share of different places accepted at the distance that
              accepts 95 % of the corresponding ones; the different ones are, for every corresponding pair, ten
              keypoints of the other image drawn at random from those farther than 10 px. mAP: every keypoint of image 0
              that corresponds to one, or to none within 10 px, has its nearest neighbour of image 1 as answer, right
              within 3 px of its partner; area below precision over recall of the answers in the order of the ratio of
              first to second distance (or of the distance), mean over pairs. Right: share of the corresponding
              keypoints whose nearest neighbour is right.

Writes OUT/keypoints.json row by row, OUT/bench_detector.md and OUT/bench_descriptors.md; OUT/scenes keeps rendered
blocks and all figures: what depends on nothing that changed is not made again, so that a killed run goes on where it
was.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from aeromatch_cli.config import load
from aeromatch_cli.lab.rendered import RenderedTruth
from benchmarks import options, stamps
from benchmarks.keypoints.correspondence import GROUND, SOURCE, Pictures
from benchmarks.keypoints.descriptors import DESCRIBERS, descriptor_figures
from benchmarks.keypoints.detectors import DETECTORS, detector_figures
from benchmarks.keypoints.figures import Asked, Named, Store, make, named, without_paths
from benchmarks.keypoints.orientations import ORIENTERS, orientation_figures
from benchmarks.keypoints.tables import descriptor_table, detector_table, orientation_table
from benchmarks.peers.base import Options
from benchmarks.processes import limit_threads
from benchmarks.scenes import Judged, rendered_scenes
from benchmarks.tables import Row, write_rows


@dataclass(frozen=True)
class Kind:
    """What is compared: an option's name, who there is, how figures of a pair are made, on what, and their table."""

    option: str
    known: Mapping[str, Callable[..., Any]]
    figures: Callable[..., Callable[..., Row]]
    frames: tuple[str, ...]
    table: Callable[[Sequence[Row]], str]


KINDS = (
    Kind("detectors", DETECTORS, detector_figures, (SOURCE, GROUND), detector_table),
    Kind("orienters", ORIENTERS, orientation_figures, (SOURCE, GROUND), orientation_table),
    Kind("descriptors", DESCRIBERS, descriptor_figures, (GROUND,), descriptor_table),
)
# Table of docs/results, the kinds that it shows, each below its title, and this project's networks among them.
TABLES = (
    ("bench_detector", {"detectors": "", "orienters": "### Angles"}, ("detector", "orientation")),
    ("bench_descriptors", {"descriptors": ""}, ("geodesc", "context")),
)
QUICK = {"scenes": "suburb", "pairs": 4, "size": "480x360", "images": 10, "keypoints": 200}
# A kind, and those of it that are asked for, made.
Asking = tuple[Kind, Mapping[Named, Any]]


def rows_of(
    judged: Judged, kinds: Sequence[tuple[Kind, Mapping[Named, Any]]], asked: Asked, store: Store
) -> Iterator[Row]:
    """One row for each method, frame and pair of a block."""
    truth = judged.truth
    assert isinstance(truth, RenderedTruth)
    with tempfile.TemporaryDirectory() as scratch:
        pictures = Pictures(judged.scene, Path(scratch))
        for kind, methods in kinds:
            figures = kind.figures(truth, pictures, asked)
            for frame in kind.frames:
                for pair in judged.pairs:
                    suns = {truth.truth.sorties[name] for name in pair.images}
                    light = {"suns": "one" if len(suns) == 1 else "two"}
                    for method, one in methods.items():
                        made = partial(figures, pair.images, frame, one)
                        yield store.row(judged, pair, kind.option, frame, method, made) | light


def run(args: argparse.Namespace) -> list[Row]:
    """All rows, written as they come."""
    limits = Options(args.keypoints, "image", args.threads, args.seed, args.reference_weights)
    kinds = [
        (kind, {one: make(kind.known, one, limits) for one in named(getattr(args, kind.option), kind.known)})
        for kind in KINDS
    ]
    asked = Asked(args.keypoints, args.seed, args.angles == "upright")
    store = Store(args.out / "scenes" / "figures", asked)
    rows: list[Row] = []
    for flight, judged in rendered_scenes(args, "angles"):
        for row in rows_of(judged, kinds, asked, store):
            rows.append(row | {"flight": flight})
            write_rows(args.out / "keypoints.json", rows)
        print(f"{judged.scene.name}, {flight}: {len(judged.pairs)} pairs", file=sys.stderr, flush=True)
    return rows


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("keypoints", __doc__)
    add = parser.add_argument
    for kind in KINDS:
        add(f"--{kind.option}", default=",".join(kind.known), help="comma-separated; '' for none")
    about = "of keypoints that are described: 0, or SIFT's own"
    add("--angles", choices=("upright", "sift"), default="upright", help=about)
    scenes = "city,suburb,hills,farmland"
    options.add_rendered(parser, scenes=scenes, pairs=12, size="1000x750", images=24, flights="mixed,oblique")
    add("--keypoints", type=options.positive, default=1000, help="of either side of a pair")
    add("--threads", type=options.positive, default=2)
    add("--reference-weights", type=Path, metavar="DIR", help="weights of what is not this project's")
    options.add_output(parser, tables=2)
    return parser


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments, QUICK)
    limit_threads(args.threads)
    rows = run(args)
    shown = {kind.option: without_paths(getattr(args, kind.option)) for kind in KINDS}
    ground_views = stamps.of_settings(load("baseline"), families=("pairs", "simulate"))
    for table, titles, networks in TABLES:
        parts = [f"At most {args.keypoints} keypoints of either side, {args.angles}, seed {args.seed}."]
        for kind in KINDS:
            if kind.option in titles and shown[kind.option]:
                parts += [titles[kind.option], kind.table(rows)]
        if len(parts) > 1:
            options.publish(
                args, "\n\n".join(filter(None, parts)) + "\n", args.out / f"{table}.md", table=table,
                command=options.command_line(parser, args, **shown),
                versions=ground_views | stamps.of_networks(*networks),
            )  # fmt: skip
