"""Least-squares registration in dynamic polar coordinates beside SIFT: time, accuracy, and what it says of failures.

known: pairs cut out of large flat grounds by a similarity (any turn, scale 0.8-1.25, overlap from 0.3, gain, offset,
noise): rendered grass, desert and farmland, and mosaics of real blocks. Nothing is told of the poses. SIFT on the same
pictures, and reduced to 1/8. unknown: pairs of real blocks and of rendered ones with relief, with and without their
poses, beside SIFT at four ratios. honesty: pairs from places apart on one ground, of different grounds, and of
saturated or featureless content. Errors as in methods: displacement at the overlap's middle in px of picture 1,
degrees, relative scale; of unknown pairs the differences to SIFT at ratio 0.8, where that is right. seconds: decoding
excluded on both sides; seconds_tie_points: grid and about 1,000 tie points included.

Writes OUT/results.json (a row for every method and pair) and OUT/polar.md. A section of no pairs, and kinds not asked
for, keep their rows of an earlier run into OUT. Grounds and blocks are kept in OUT/grounds.
"""

from __future__ import annotations

import argparse
import json
from itertools import chain
from pathlib import Path

import cv2
from common import size_px, write_readme
from polar_bench.grounds import REAL, RENDERED
from polar_bench.rows import Row, Task, honesty_rows, known_rows, unknown_rows
from polar_bench.tables import tables

from aeromatch_cli.workspace import write_text

# What every row holds, null where it has none.
ALWAYS = (
    "method", "kind", "pair", "seconds", "seconds_tie_points", "rotation_error_deg", "translation_error_px",
    "scale_error", "accepted", "valid", "tie_points", "coverage",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--data", type=Path, help="folder of real blocks, each with a folder images; without it rendered kinds alone")
    add("--size", default="1840x1350", help="of the pictures, WxH; real blocks of the unknown pairs keep theirs")
    add("--pairs", type=int, default=20, help="known pairs, over all kinds")
    add("--unknown", type=int, default=2, help="pairs of every block")
    add("--negatives", type=int, default=20, help="pairs of which none can be right")
    add("--kinds", help=f"of ground (default {','.join(RENDERED)}, and with --data {','.join(REAL)})")
    add("--images", type=int, default=6, help="of a rendered block of unknown pairs")
    add(
        "--sift",
        type=int,
        default=0,
        help="known pairs that SIFT takes at full size too, minutes each at 40 megapixels",
    )
    add("--threads", type=int, default=2)
    add("--seed", type=int, default=1)
    add("--readme", action="store_true", help="write the tables into the README, between the markers of this size")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    cv2.setNumThreads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    kinds = tuple(args.kinds.split(",")) if args.kinds else (*RENDERED, *(REAL if args.data else ()))
    if args.data is None and (real := [kind for kind in kinds if kind not in RENDERED]):
        parser.error(f"{', '.join(real)}: real blocks need --data")
    task = Task(kinds, size_px(args.size), args.images, args.seed, args.data, args.out / "grounds")
    made = {"known": args.pairs, "unknown": args.unknown, "honesty": args.negatives}
    path = args.out / "results.json"
    old: list[Row] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    rows = [
        row for row in old if not made[row["section"]] or (row["section"] != "honesty" and row["kind"] not in kinds)
    ]
    parts = (
        known_rows(task, args.pairs, args.sift),
        unknown_rows(task, args.unknown),
        honesty_rows(task, args.negatives),
    )
    for row in chain(*parts):
        row = dict.fromkeys(ALWAYS) | row
        rows.append(row)
        print(json.dumps(row), flush=True)
    write_text(path, json.dumps(rows, indent=1) + "\n")
    write_text(args.out / "polar.md", tables(rows))
    if args.readme:
        write_readme(tables(rows), f"bench_polar-{args.size}")


if __name__ == "__main__":
    main()
