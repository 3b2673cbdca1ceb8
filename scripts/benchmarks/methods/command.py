"""This project's presets beside the peers: same pairs, images, size and budget, seeds fixed, judged by truth.

A method is a peer or a preset, with settings in brackets as in `--set`, and a short label before it where the name gets
long: 'opencv-sift,baseline,plain=fusion[enhance=none,simulate=none]'.
Rendered scenes (one block of --flight each) are judged by their exact geometry, real blocks
(DATA/BLOCK/images, DATA/BLOCK/reference) by the epipolar lines of their reference poses. A pair is hard where the
shadow share is 20 % or more or the view angle 30 degrees or more (in a real block also where one image is 1.6 times as
bright as the other), and overlaps by a fifth at least.

--reference and --unprocessed name two of the methods: the goals compare every other one with them. --poses both runs
the presets with exact and with noisy poses (rendered scenes), and says what the noise costs.

Every method runs in a process of its own per scene, two threads. A row's seconds are those of both images' features
(decoding included), matching and verification; start-up is not timed. peak_mb is the largest resident memory meanwhile.
Writes OUT/results.json row by row and OUT/table.md. OUT/scenes keeps rendered blocks, reduced images and what every
method answered: what depends on nothing that changed is not made again, so that a killed run goes on where it was.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from aeromatch_cli.config import FAMILIES
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic import PRESETS
from benchmarks import options, stamps
from benchmarks.methods.goals import Comparison
from benchmarks.methods.results import PARTS, make_row, tables
from benchmarks.methods.worker import measure
from benchmarks.peers.base import Options
from benchmarks.peers.table import (
    CLASSICAL,
    NEED_WEIGHTS,
    PEERS,
    Named,
    check_method,
    named_methods,
    reads_poses,
    settings_of,
)
from benchmarks.processes import limit_threads
from benchmarks.scenes import CONDITIONS, MIN_OVERLAP, Judged, Selection, real, rendered_scenes, with_noisy_poses
from benchmarks.tables import Row, write_rows

THREADS = 2
REAL_MAX_SIZE_PX = 1000
QUICK = {"scenes": "city,grass", "pairs": 4, "size": "480x360", "images": 12, "keypoints": 512}
# A pair's answer depends on these; nothing is exported.
_FAMILIES = tuple(family for family in FAMILIES if family != "export")


def scenes(args: argparse.Namespace) -> Iterator[Judged]:
    """One after the other, each made when it is needed."""
    yield from (judged for _, judged in rendered_scenes(args, args.condition))
    for block in args.blocks:
        selection = Selection(args.condition, args.pairs, args.seed)
        yield real(args.out / "scenes", args.data, block, selection, max_size_px=args.max_size)


def poses_of(name: Named, judged: Judged, asked: str) -> list[Judged]:
    """The scene with the poses that a method is to be measured with: peers on pictures read none, real blocks have one
    set."""
    noisy = None if not reads_poses(name.spec) or asked == "exact" else with_noisy_poses(judged)
    if noisy is None:
        return [judged]
    return [noisy] if asked == "noisy" else [judged, noisy]


def rows_of(name: Named, judged: Judged, limits: Options, store: Path) -> Iterator[Row]:
    """Of one method on one scene, pair by pair."""
    answers = measure(name.spec, judged, limits, store)
    for pair, (key, measured) in zip(judged.pairs, answers, strict=True):
        found = measured.found
        answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
        score = judged.truth.judge(*pair.images, *answer)
        yield make_row(name, judged, pair, score, measured, limits, key)


def run(args: argparse.Namespace, methods: list[Named]) -> list[Row]:
    """All rows, written as they come."""
    limits = Options(args.keypoints, args.budget, THREADS, args.seed, args.reference_weights)
    rows: list[Row] = []
    total = (len(args.scenes) * len(args.flights) + len(args.blocks)) * len(methods)
    started, done = time.monotonic(), 0
    for judged in scenes(args):
        if len(judged.pairs) < args.pairs:
            found = f"{len(judged.pairs)} {args.condition} pairs with overlap >= {MIN_OVERLAP:.0%}"
            print(f"{judged.scene.name} has only {found}, {args.pairs} were asked for", file=sys.stderr)
        for name in methods if judged.pairs else ():
            before = time.monotonic()
            poses = args.poses if args.noisy_methods is None or name.label in args.noisy_methods else "exact"
            for posed in poses_of(name, judged, poses):
                for row in rows_of(name, posed, limits, args.out / "scenes" / "found"):
                    rows.append(row)
                    write_rows(args.out / "results.json", rows)
            done += 1
            left = (time.monotonic() - started) / done * (total - done)
            print(
                f"{judged.scene.name} {name.label}: {len(judged.pairs)} pairs, {time.monotonic() - before:.0f} s; "
                f"{done} of {total}, about {left / 60:.0f} min left",
                file=sys.stderr,
            )
    return rows


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("methods", __doc__)
    add = parser.add_argument
    default = ",".join((*CLASSICAL, "baseline"))
    add("--methods", default=default, help=f"comma-separated: {', '.join(PEERS)}, or presets")
    about = "all: half hard, half easy; angles: a quarter of each class of view angle"
    add("--condition", choices=tuple(CONDITIONS), default="all", help=about)
    options.add_rendered(parser, scenes=",".join(PRESETS), pairs=16, size="1000x750", images=24, flights="mixed")
    add("--keypoints", type=options.positive, default=2048, help="descriptors per image (or view), exactly")
    add("--budget", choices=("image", "view"), default="image", help="what --keypoints is counted over")
    add("--poses", choices=("exact", "noisy", "both"), default="exact", help="what presets get; both: a row for each")
    about = "comma-separated labels: only these with noisy poses, the others with exact"
    add("--noisy-methods", type=options.names, metavar="LABELS", help=about)
    add("--reference", help="the method whose weak pairs the goals are about, as in --methods: opencv-sift")
    add("--unprocessed", help="the method without enhancement and views that the goals compare with")
    add("--reference-weights", type=Path, metavar="DIR", help=f"weights of {', '.join(NEED_WEIGHTS)}")
    add("--data", type=Path, metavar="DIR", help="folder of real blocks")
    add("--blocks", type=options.names, default="", help="names of real blocks, comma-separated")
    add("--max-size", type=options.positive, default=REAL_MAX_SIZE_PX, help="longer side of real images, px")
    about = f"what --docs writes, comma-separated: {', '.join(PARTS)}"
    add("--tables", type=options.names, default="condition,scene,angle", help=about)
    options.add_output(parser)
    return parser


def check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> tuple[list[Named], Comparison]:
    """The methods, and which of them are compared with. Raises ConfigError on what cannot be run."""
    if args.blocks and args.data is None:
        parser.error("--blocks needs --data: the folder that holds BLOCK/images and BLOCK/reference")
    if unknown := set(args.tables) - set(PARTS):
        parser.error(f"--tables: {', '.join(sorted(unknown))} is none of {', '.join(PARTS)}")
    methods = named_methods(args.methods)
    for name in methods:
        check_method(name.spec)
        if name.spec in NEED_WEIGHTS and args.reference_weights is None:
            raise ConfigError(f"{name.spec} needs --reference-weights DIR")
    if unknown := set(args.noisy_methods or ()) - {name.label for name in methods}:
        raise ConfigError(f"--noisy-methods: {', '.join(sorted(unknown))} is none of --methods")
    return methods, Comparison.among(methods, args.reference, args.unprocessed)


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments, QUICK)
    limit_threads(THREADS)
    methods, comparison = check(parser, args)
    rows = run(args, methods)
    if not rows:
        raise ConfigError(f"no scene has a pair of condition {args.condition}: give another --seed or --condition")
    options.publish(
        args, tables(rows, comparison), args.out / "table.md",
        table="bench_methods", command=options.command_line(parser, args),
        versions=stamps.of_settings(*settings_of(methods), families=_FAMILIES),
        page_text=tables(rows, comparison, args.tables),
    )  # fmt: skip
