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
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from common import errors_as_exits, fill_in, publish, size_px, write_readme
from methods import worker
from methods.base import Options
from methods.goals import Comparison, Row
from methods.results import PARTS, make_row, tables, write_rows
from methods.scenes import CONDITIONS, MIN_OVERLAP, Judged, JudgedPair, Selection, real, rendered, with_noisy_poses
from methods.sources import GROUND_CODE, OUR_CODE, PEER_CODE, code_digest, versions
from methods.store import read_measured, write_measured
from methods.table import CLASSICAL, NEED_WEIGHTS, PEERS, Named, method, named_methods, reads_poses, split_methods
from methods.worker import Measured

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.synthetic import PRESETS
from aeromatch_cli.synthetic.flights import FLIGHTS
from aeromatch_cli.workspace import fingerprint

THREADS = 2
REAL_MAX_SIZE_PX = 1000
# What a plain run and --quick do where an option is not given.
FULL = {"scenes": ",".join(PRESETS), "pairs": 16, "size": "1000x750", "images": 24, "keypoints": 2048}
QUICK = {"scenes": "city,grass", "pairs": 4, "size": "480x360", "images": 12, "keypoints": 512}


def scenes(args: argparse.Namespace, selection: Selection) -> Iterator[Judged]:
    """One after the other, each made when it is needed."""
    folder = args.out / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    code = code_digest("synthetic")
    for preset in filter(None, args.scenes.split(",")):
        asked = {"size_px": size_px(args.size), "images": args.images, "flight": args.flight}
        yield rendered(folder, preset, selection, jobs=THREADS, code=code, **asked)
    for block in filter(None, args.blocks.split(",")):
        yield real(folder, args.data, block, selection, max_size_px=args.max_size)


def measure(spec: str, judged: Judged, options: Options, store: Path) -> Iterator[tuple[str, Measured]]:
    """Key and answer of one method for every pair of a scene, in order; what the store has is not made again."""
    # What an answer depends on, the judge left out. Most peers read nothing of stages, strategies and presets.
    if spec in PEERS:
        code, settings = (GROUND_CODE if reads_poses(spec) else PEER_CODE), None
    else:
        code, settings = OUR_CODE, load(*parse_method(spec)).model_dump(mode="json")
    basis = [spec, settings, judged.key, vars(options) | {"weights": None}, code_digest(*code), versions()]
    keys = [fingerprint(basis, pair.images)[:16] for pair in judged.pairs]
    if all((store / f"{key}.npz").is_file() for key in keys):
        yield from ((key, read_measured(store / f"{key}.npz")) for key in keys)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, worker.start, (spec, judged.scene, options)) as process:
        for pair, key in zip(judged.pairs, keys, strict=True):
            path = store / f"{key}.npz"
            if not path.is_file():
                try:
                    write_measured(path, process.submit(worker.run_pair, pair.images).result())
                except BrokenProcessPool as error:
                    raise SystemExit(f"{spec} on {judged.scene.name}: its process died ({error})") from error
            yield key, read_measured(path)


def judged_row(name: Named, judged: Judged, pair: JudgedPair, options: Options, key: str, measured: Measured) -> Row:
    """The row of one pair."""
    found = measured.found
    score = judged.truth.judge(
        *pair.images, found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
    )
    return make_row(name, judged, pair, score, measured, options, key)


def poses_of(name: Named, judged: Judged, asked: str) -> list[Judged]:
    """The scene with the poses that a method is to be measured with: peers on pictures read none, real blocks have one
    set."""
    noisy = None if not reads_poses(name.spec) or asked == "exact" else with_noisy_poses(judged)
    if noisy is None:
        return [judged]
    return [noisy] if asked == "noisy" else [judged, noisy]


def run(args: argparse.Namespace, names: list[Named]) -> list[Row]:
    """All rows, written as they come."""
    options = Options(args.keypoints, args.budget, THREADS, args.seed, args.reference_weights)
    selection = Selection(args.condition, args.pairs, args.seed)
    store = args.out / "scenes" / "found"
    store.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    total = len(list(filter(None, args.scenes.split(",") + args.blocks.split(",")))) * len(names)
    noisy = None if args.noisy_methods is None else split_methods(args.noisy_methods)
    started, done = time.monotonic(), 0
    for judged in scenes(args, selection):
        if len(judged.pairs) < args.pairs:
            found = f"{len(judged.pairs)} {args.condition} pairs with overlap >= {MIN_OVERLAP:.0%}"
            print(f"{judged.scene.name} has only {found}, {args.pairs} were asked for", file=sys.stderr)
        for name in names if judged.pairs else ():
            before = time.monotonic()
            poses = args.poses if noisy is None or name.label in noisy else "exact"
            for posed in poses_of(name, judged, poses):
                answers = measure(name.spec, posed, options, store)
                for pair, (key, measured) in zip(posed.pairs, answers, strict=True):
                    rows.append(judged_row(name, posed, pair, options, key, measured))
                    write_rows(args.out / "results.json", rows)
            done += 1
            left = (time.monotonic() - started) / done * (total - done)
            print(
                f"{judged.scene.name} {name.label}: {len(judged.pairs)} pairs, {time.monotonic() - before:.0f} s; "
                f"{done} of {total}, about {left / 60:.0f} min left",
                file=sys.stderr,
            )
    return rows


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = [f"scripts/bench_methods --methods '{args.methods}' --scenes {args.scenes or repr('')}"]
    parts += [f"--condition {args.condition} --pairs {args.pairs} --seed {args.seed} --keypoints {args.keypoints}"]
    parts += [f"--budget {args.budget} --size {args.size} --images {args.images}"]
    if args.flight != "mixed":
        parts.append(f"--flight {args.flight}")
    if args.blocks:
        parts.append(f"--data DIR --blocks {args.blocks} --max-size {args.max_size}")
    if args.reference_weights:
        parts.append("--reference-weights DIR")
    if args.poses != "exact":
        parts.append(f"--poses {args.poses}")
    if args.noisy_methods:
        parts.append(f"--noisy-methods '{args.noisy_methods}'")
    if args.reference:
        parts.append(f"--reference '{args.reference}'")
    if args.unprocessed:
        parts.append(f"--unprocessed '{args.unprocessed}'")
    return " ".join([*parts, "--out DIR"])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--methods", help=f"comma-separated: {', '.join(PEERS)}, or presets; default: all classical peers and baseline")
    add("--scenes", help=f"comma-separated presets of rendered blocks: {', '.join(PRESETS)}; '' for none")
    add("--flight", choices=tuple(FLIGHTS), default="mixed", help="of rendered blocks")
    about = "all: half hard, half easy; angles: a quarter of each class of view angle"
    add("--condition", choices=tuple(CONDITIONS), default="all", help=about)
    add("--pairs", type=int, help="judged pairs of each scene")
    add("--seed", type=int, default=0, help="another seed gives other scenes, pairs and samples")
    add("--keypoints", type=int, help="descriptors per image (or view), exactly")
    add("--budget", choices=("image", "view"), default="image", help="what --keypoints is counted over")
    add("--size", metavar="WxH", help="of rendered images")
    add("--images", type=int, help="of each rendered block")
    add("--quick", action="store_true", help="small images, few pairs: two minutes")
    add("--poses", choices=("exact", "noisy", "both"), default="exact", help="what presets get; both: a row for each")
    add("--noisy-methods", metavar="LABELS", help="comma-separated: only these with noisy poses, the others with exact")
    add("--reference", help="the method whose weak pairs the goals are about, as in --methods: opencv-sift")
    add("--unprocessed", help="the method without enhancement and views that the goals compare with")
    add("--reference-weights", type=Path, metavar="DIR", help=f"weights of {', '.join(NEED_WEIGHTS)}")
    add("--data", type=Path, metavar="DIR", help="folder of real blocks")
    add("--blocks", default="", help="names of real blocks, comma-separated")
    add("--max-size", type=int, default=REAL_MAX_SIZE_PX, help="longer side of real images, px")
    add("--tables", default="condition,scene,angle", help=f"what --readme writes, comma-separated: {', '.join(PARTS)}")
    add("--readme", nargs="?", const="bench_methods", metavar="NAME", help="write tables between the README's markers")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    fill_in(args, QUICK if args.quick else FULL)
    if args.methods is None:
        args.methods = ",".join((*CLASSICAL, "baseline"))
    if args.blocks and args.data is None:
        parser.error("--blocks needs --data: the folder that holds BLOCK/images and BLOCK/reference")
    if unknown := set(args.tables.split(",")) - set(PARTS):
        parser.error(f"--tables: {', '.join(sorted(unknown))} is none of {', '.join(PARTS)}")
    if args.pairs < 1 or args.keypoints < 1:
        parser.error("--pairs and --keypoints must be at least 1")
    return args


def main() -> None:
    args = parse()
    worker.limit_threads(THREADS)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    with errors_as_exits():
        names = named_methods(args.methods)
        for name in names:
            method(name.spec)
            if name.spec in NEED_WEIGHTS and args.reference_weights is None:
                raise ConfigError(f"{name.spec} needs --reference-weights DIR")
        comparison = Comparison.among(names, args.reference, args.unprocessed)
        unknown = set(split_methods(args.noisy_methods or "")) - {name.label for name in names}
        if unknown:
            raise ConfigError(f"--noisy-methods: {', '.join(sorted(unknown))} is none of --methods")
        rows = run(args, names)
        if not rows:
            raise ConfigError(f"no scene has a pair of condition {args.condition}: give another --seed or --condition")
    text = tables(rows, comparison)
    publish(text, args.out / "table.md")
    if args.readme:
        chosen = tables(rows, comparison, tuple(args.tables.split(",")))
        write_readme(f"    {command(args)}\n\n{chosen}", args.readme)


if __name__ == "__main__":
    main()
