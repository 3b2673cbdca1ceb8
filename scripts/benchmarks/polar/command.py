"""Least-squares registration in dynamic polar coordinates beside SIFT: time, accuracy, and what it says of failures.

known: pairs cut out of large flat grounds by a similarity (any turn, scale 0.8-1.25, overlap from 0.3, gain, offset,
noise): rendered grass, desert and farmland, and mosaics of real blocks. Nothing is told of the poses. SIFT on the same
pictures, and reduced to 1/8. unknown: pairs of real blocks and of rendered ones with relief, with and without their
poses, beside SIFT at four ratios. honesty: pairs from places apart on one ground, of different grounds, and of
saturated or featureless content. Errors as in methods: displacement at the overlap's middle in px of picture 1,
degrees, relative scale; `polar, adjusted`: of the similarity by least squares over about 250 tie points, whose seconds
are those with tie points; of unknown pairs the differences to SIFT at ratio 0.8, where that is right. seconds: decoding
excluded on both sides; seconds_tie_points: grid and about 1,000 tie points included.

Writes OUT/polar.json (a row for every method and pair) and OUT/polar.md. A section of no pairs, and kinds not asked
for, keep their rows of an earlier run into OUT. Grounds and blocks are kept in OUT/grounds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import cv2

from aeromatch_cli.config import load
from benchmarks import options, stamps
from benchmarks.polar.grounds import REAL, RENDERED
from benchmarks.polar.rows import Task, honesty_rows, known_rows, unknown_rows
from benchmarks.polar.tables import tables
from benchmarks.tables import Row, write_rows

# What every row holds, null where it has none.
ALWAYS = (
    "method", "kind", "pair", "seconds", "seconds_tie_points", "rotation_error_deg", "translation_error_px",
    "scale_error", "accepted", "valid", "tie_points", "coverage",
)  # fmt: skip


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("polar", __doc__)
    add = parser.add_argument
    add("--data", type=Path, help="folder of real blocks, each with a folder images; without it rendered kinds alone")
    add("--size", default="1840x1350", help="of the pictures, WxH; real blocks of the unknown pairs keep theirs")
    add("--pairs", type=int, default=20, help="known pairs, over all kinds")
    add("--unknown", type=int, default=2, help="pairs of every block")
    add("--negatives", type=int, default=20, help="pairs of which none can be right")
    about = f"of ground (default {','.join(RENDERED)}, and with --data {','.join(REAL)})"
    add("--kinds", type=options.names, help=about)
    add("--images", type=int, default=6, help="of a rendered block of unknown pairs")
    about = "known pairs that SIFT takes at full size too, minutes each at 40 megapixels"
    add("--sift", type=int, default=0, help=about)
    add("--threads", type=int, default=2)
    add("--seed", type=int, default=1)
    options.add_output(parser)
    return parser


def run(args: argparse.Namespace) -> list[Row]:
    """Rows of what is asked for, after those of an earlier run that is not."""
    task = Task(tuple(args.kinds), options.size_px(args.size), args.images, args.seed, args.data, args.out / "grounds")
    made = {"known": args.pairs, "unknown": args.unknown, "honesty": args.negatives}
    path = args.out / "polar.json"
    old: list[Row] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    other_kind = [row["section"] != "honesty" and row["kind"] not in task.kinds for row in old]
    rows = [row for row, other in zip(old, other_kind, strict=True) if other or not made[row["section"]]]
    known, unknown = known_rows(task, args.pairs, args.sift), unknown_rows(task, args.unknown)
    for row in chain(known, unknown, honesty_rows(task, args.negatives)):
        rows.append(dict.fromkeys(ALWAYS) | row)
        print(json.dumps(rows[-1]), flush=True)
    write_rows(path, rows)
    return rows


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments)
    args.kinds = args.kinds or [*RENDERED, *(REAL if args.data else ())]
    if args.data is None and (real := [kind for kind in args.kinds if kind not in RENDERED]):
        parser.error(f"{', '.join(real)}: real blocks need --data")
    cv2.setNumThreads(args.threads)
    options.publish(
        args, tables(run(args)), args.out / "polar.md", table=f"bench_polar-{args.size}",
        command=options.command_line(parser, args),
        versions=stamps.of_settings(load("polar"), families=("extract", "match")),
    )  # fmt: skip
