"""The claims of the three papers' abstracts, each beside the paper's own baseline, this project's step alone and its
whole; and ablations that say whether a step is real.

Everything is judged by exact truth, but for --data, whose pairs of real blocks join the experiment with unknown
parameters of paper B. A claim is beaten where the whole 90 % bootstrap interval over pairs lies beyond the paper's
figure, met where the estimate reaches it. Seconds are of the processor. Writes OUT/claims.json and OUT/claims.md;
OUT/scenes and OUT/rows keep what was made, so that a killed run goes on where it was. SIFT at 40 megapixels takes 10 GB
of memory.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aeromatch_cli.config import FAMILIES
from benchmarks import options, stamps
from benchmarks.claims import features, registration, shadow
from benchmarks.claims.page import legend, tables
from benchmarks.claims.work import made, prepare
from benchmarks.tables import write_rows

JOBS = 2
QUICK = {"pairs": 2, "size": "1600x1200"}


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("claims", __doc__)
    add = parser.add_argument
    add("--seed", type=int, default=1, help="another seed gives other blocks, grounds, pairs and samples")
    add("--data", type=Path, metavar="DIR", help="folder of real blocks (seneca, caliterra)")
    add("--reference-weights", type=Path, metavar="DIR", help="folder that may hold superpoint_v1.pth")
    add("--pairs", type=options.positive, default=8, help="of each rendered block of papers A and C")
    add("--size", metavar="WxH", default="7360x5400", help="of paper B's pictures with known parameters")
    options.add_output(parser)
    return parser


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments, QUICK)
    seed, pairs, out = args.seed, args.pairs, args.out
    try:
        size = options.size_px(args.size)
    except ValueError:
        parser.error(f"--size {args.size}: write WIDTHxHEIGHT in pixels, as 7360x5400")
    weights = args.reference_weights
    if weights is not None and not (weights / "superpoint_v1.pth").is_file():
        print(f"{weights} does not hold superpoint_v1.pth: SuperPoint is not run", file=sys.stderr)
    scenes = [*shadow.scenes(seed, pairs, out), *features.scenes(seed, pairs, out), *registration.scenes(seed, out)]
    prepare(scenes, JOBS)
    units = [
        *shadow.units(seed, pairs, out),
        *features.units(seed, pairs, weights, out),
        *registration.units(seed, size, args.data, out),
    ]
    rows = made(units, out / "rows", JOBS)
    write_rows(out / "claims.json", rows)
    text = f"Seed {seed}. The arms:\n\n{legend()}\n\n{tables(rows)}"
    settings = [one for part in (shadow, registration, features) for one in part.settings()]
    versions = stamps.of_settings(*settings, families=[family for family in FAMILIES if family != "export"])
    options.publish(
        args, text, args.out / "claims.md", table="bench_claims", command=options.command_line(parser, args),
        versions=versions,
    )  # fmt: skip
