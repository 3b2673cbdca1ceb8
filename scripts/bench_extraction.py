"""Seconds that an image takes to have its features, by extractor; decoding is not counted.

One rendered oblique picture, --keypoints descriptors, one process with --threads threads; a row is the median of --runs
calls of the strategy after one that warms it up; with a CUDA device the networks have rows there, too. Upright: as in
views with north up, where no angle is asked for. Writes OUT/extraction/results.json and OUT/extraction/table.md.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from common import errors_as_exits, publish, size_px
from methods.goal_tables import markdown
from methods.results import write_rows
from methods.worker import limit_threads

from aeromatch_cli.nets.precision import has_bfloat16

# Row of the table: settings of `extract`.
VARIANTS: dict[str, dict[str, Any]] = {
    "SIFT, upright": {"name": "sift", "orientation": "upright"},
    "SIFT": {"name": "sift", "orientation": "gradient"},
    "learned, upright": {"name": "learned", "orientation": "upright"},
    "learned": {"name": "learned", "orientation": "network"},
    "learned, context": {"name": "learned", "orientation": "network", "context": True},
    "learned, float32": {"name": "learned", "orientation": "network", "precision": "float32"},
}
Row = dict[str, Any]


def picture(args: argparse.Namespace) -> Any:
    """(H, W) uint8: the first tilted one of a rendered city."""
    import cv2

    from aeromatch_cli.synthetic import render_block

    width, height = size_px(args.size)
    folder = args.out / "scenes" / f"extraction-{args.size}-{args.seed}"
    render_block(
        folder, "city", seed=args.seed, width_px=width, height_px=height, images=5, flight="oblique",
        jobs=args.threads,
    )  # fmt: skip
    return cv2.imread(str(sorted((folder / "images").iterdir())[1]), cv2.IMREAD_GRAYSCALE)


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    import cv2
    import numpy as np
    import torch

    from aeromatch_cli.data import Camera, View
    from aeromatch_cli.strategies import ViewPixels
    from aeromatch_cli.strategies.extractors import EXTRACTORS

    gray = picture(args)
    height, width = gray.shape
    camera = Camera("PINHOLE", width, height, (float(width), float(width), (width - 1) / 2, (height - 1) / 2))
    view = View("source", width, height, np.eye(3), is_source=True, angle_deg=0.0)
    views = (ViewPixels(view, gray, None),)
    cv2.setNumThreads(args.threads)
    torch.set_num_threads(args.threads)
    variants = dict(VARIANTS)
    if torch.cuda.is_available():
        learned = {name: s for name, s in VARIANTS.items() if s["name"] == "learned"}
        variants |= {f"{name}, CUDA": settings | {"device": "auto"} for name, settings in learned.items()}
    for name, settings in variants.items():
        extractor: Any = EXTRACTORS[settings["name"]](**settings, keypoints=args.keypoints)
        seconds, found = timed(lambda extractor=extractor: extractor(camera, views), args.runs)
        row = {"extractor": name, "size": args.size, "descriptors": len(found.descriptors)}
        yield row | {"seconds": round(seconds, 4)}


def timed(call: Callable[[], Any], runs: int) -> tuple[float, Any]:
    """Median seconds of some calls after the first, and what it returned."""
    value, seconds = call(), []
    for _ in range(runs):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds), value


def table(rows: list[Row]) -> str:
    lines = [
        [row["extractor"], str(row["descriptors"]), f"{row['seconds']:.2f}", f"{1.0 / row['seconds']:.2f}"]
        for row in rows
    ]
    return markdown(("extractor", "descriptors", "seconds", "images a second"), lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--size", metavar="WxH", default="2000x1500", help="of the picture")
    add("--keypoints", type=int, default=4000, help="descriptors of the picture")
    add("--runs", type=int, default=5, help="of which the median counts")
    add("--threads", type=int, default=2)
    add("--seed", type=int, default=1, help="another seed gives another picture")
    add("--readme", action="store_true", help="write the table into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    limit_threads(args.threads)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    with errors_as_exits():
        rows = list(rows_of(args))
    write_rows(args.out / "extraction" / "results.json", rows)
    asked = f"--size {args.size} --keypoints {args.keypoints} --runs {args.runs} --threads {args.threads}"
    command = f"scripts/bench_extraction {asked} --seed {args.seed} --out DIR"
    # A processor without bfloat16 has a table of its own.
    kind = "" if has_bfloat16() else "_float32"
    markers = f"bench_extraction{kind}" if args.readme else None
    publish(table(rows) + "\n", args.out / "extraction" / "table.md", markers, command)


if __name__ == "__main__":
    main()
