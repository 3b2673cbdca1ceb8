"""What the views of an image cost: how many, how large, and how long its features take, for each of --methods.

Scenes and images are those of scripts/bench_methods with the same --seed, --pairs, --size, --images and --out; timed
from decoding to features on file, two threads. Writes OUT/views.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from common import errors_as_exits, publish, size_px
from methods import worker
from methods.base import Options
from methods.scenes import Judged, Selection, rendered
from methods.sources import code_digest
from methods.table import method, named_methods
from methods.view_costs import cost_table, view_costs

from aeromatch_cli.synthetic import PRESETS

THREADS = 2


def scenes(args: argparse.Namespace) -> Iterator[Judged]:
    """One after the other, rendered unless they are there."""
    folder = args.out / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    selection = Selection(args.condition, args.pairs, args.seed)
    code, size = code_digest("synthetic"), size_px(args.size)
    for preset in filter(None, args.scenes.split(",")):
        print(preset, file=sys.stderr, flush=True)
        yield rendered(folder, preset, selection, size_px=size, images=args.images, jobs=THREADS, code=code)


def measure(args: argparse.Namespace) -> str:
    """The table."""
    options = Options(args.keypoints, args.budget, THREADS, args.seed, None)
    names = named_methods(args.methods)
    costs = [cost for judged in scenes(args) for name in names for cost in view_costs(name, judged.scene, options)]
    return cost_table(costs)


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = [f"scripts/bench_views --methods '{args.methods}' --scenes {args.scenes} --condition {args.condition}"]
    parts += [f"--pairs {args.pairs} --seed {args.seed} --keypoints {args.keypoints} --budget {args.budget}"]
    return " ".join([*parts, f"--size {args.size} --images {args.images} --out DIR"])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--methods", default="baseline,fusion", help="presets, comma-separated, as in scripts/bench_methods")
    add("--scenes", default=",".join(PRESETS), help="comma-separated presets of rendered blocks")
    add("--condition", choices=("hard", "easy", "all"), default="all", help="all: half hard, half easy")
    add("--pairs", type=int, default=12, help="of each scene")
    add("--seed", type=int, default=0)
    add("--keypoints", type=int, default=2048)
    add("--budget", choices=("image", "view"), default="image")
    add("--size", metavar="WxH", default="1000x750")
    add("--images", type=int, default=24)
    add("--readme", action="store_true", help="write the table into the README")
    add("--out", type=Path, required=True)
    return parser.parse_args()


def main() -> None:
    args = parse()
    worker.limit_threads(THREADS)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    with errors_as_exits():
        for name in named_methods(args.methods):
            method(name.spec)
        text = measure(args) + "\n"
    publish(text, args.out / "views.md", "bench_views" if args.readme else None, command(args))


if __name__ == "__main__":
    main()
