"""Seconds that an image takes to have its features, by extractor; decoding is not counted.

One rendered oblique picture, --keypoints descriptors, one process with --threads threads; a row is the median of --runs
calls of the strategy after one that warms it up; with a CUDA device the networks have rows there, too. Upright: as in
views with north up, where no angle is asked for. Writes OUT/extraction.json and OUT/extraction.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

from aeromatch_cli.nets.precision import has_bfloat16
from aeromatch_cli.strategies.extractors import EXTRACTORS
from benchmarks import options, stamps
from benchmarks.processes import limit_threads, median_seconds
from benchmarks.scenes import render_once
from benchmarks.tables import Column, Row, table, write_rows

# Row of the table: settings of `extract`.
VARIANTS: dict[str, dict[str, Any]] = {
    "SIFT, upright": {"name": "sift", "orientation": "upright"},
    "SIFT": {"name": "sift", "orientation": "gradient"},
    "learned, upright": {"name": "learned", "orientation": "upright"},
    "learned": {"name": "learned", "orientation": "network"},
    "learned, context": {"name": "learned", "orientation": "network", "context": True},
    "learned, float32": {"name": "learned", "orientation": "network", "precision": "float32"},
}
_COLUMNS: tuple[Column[Row], ...] = (
    ("descriptors", lambda row: row["descriptors"]),
    ("seconds", lambda row: f"{row['seconds']:.2f}"),
    ("images a second", lambda row: f"{1.0 / row['seconds']:.2f}"),
)


def picture(args: argparse.Namespace) -> Any:
    """(H, W) uint8: the first tilted one of a rendered city."""
    import cv2

    width_px, height_px = options.size_px(args.size)
    size = {"width_px": width_px, "height_px": height_px, "images": 5}
    folder = render_once(args.out / "scenes", "city", seed=args.seed, flight="oblique", **size)
    return cv2.imread(str(sorted((folder / "images").iterdir())[1]), cv2.IMREAD_GRAYSCALE)


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    import cv2
    import numpy as np
    import torch

    from aeromatch_cli.data import Camera, View
    from aeromatch_cli.strategies import ViewPixels

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
        seconds, found = median_seconds(lambda extractor=extractor: extractor(camera, views), args.runs)
        row = {"extractor": name, "size": args.size, "descriptors": len(found.descriptors)}
        yield row | {"seconds": round(seconds, 4)}


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("extraction", __doc__)
    add = parser.add_argument
    add("--size", metavar="WxH", default="2000x1500", help="of the picture")
    add("--keypoints", type=options.positive, default=4000, help="descriptors of the picture")
    add("--runs", type=options.positive, default=5, help="of which the median counts")
    add("--threads", type=options.positive, default=2)
    add("--seed", type=int, default=1, help="another seed gives another picture")
    options.add_output(parser)
    args = options.parse(parser, arguments)
    limit_threads(args.threads)
    rows = list(rows_of(args))
    write_rows(args.out / "extraction.json", rows)
    text = table(("extractor",), (((row["extractor"],), row) for row in rows), _COLUMNS)
    strategies = (EXTRACTORS[settings["name"]](**settings) for settings in VARIANTS.values())
    options.publish(
        args, text + "\n", args.out / "extraction.md",
        # A processor without bfloat16 has a table of its own.
        table="bench_extraction" if has_bfloat16() else "bench_extraction_float32",
        command=options.command_line(parser, args), versions=stamps.of_strategies("extract", *strategies),
    )  # fmt: skip
