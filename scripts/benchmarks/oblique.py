"""Every table of oblique pairs: a list of runs of the other benchmarks. Hours; a killed run goes on where it was."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks import options
from benchmarks.runs import Run, run_all

ON_SOURCE = ("SIFT=opencv-sift", "ASIFT=opencv-asift", "keynet", "aliked")
ON_GROUND = ("SIFT@ground=opencv-sift@ground", "ASIFT@ground=opencv-asift@ground", "keynet@ground", "aliked@ground")
# SIFT keypoints with this project's descriptor, without context and with it: for GeoDesc and ContextDesc.
STAND_INS = (
    "geodesc*=oblique[extract.detector=sift]",
    "contextdesc*=oblique[extract.detector=sift,extract.context=true]",
)
OURS, CONTEXT = ("fusion", "oblique"), "context=oblique[extract.context=true]"
EVERY = (*ON_SOURCE, *ON_GROUND, *STAND_INS, *OURS, CONTEXT)


def runs(data: str, weights: str, out: str, seed: str, docs: Sequence[str]) -> list[Run]:
    """docs: ("--docs",), or nothing to leave docs/results as it is."""

    def methods(table: str, asked: Sequence[str], *more: str, pairs: str = "12") -> Run:
        common = (
            "--flights",
            "oblique",
            "--condition",
            "angles",
            "--pairs",
            pairs,
            "--seed",
            seed,
            "--reference",
            "SIFT",
        )
        common += ("--tables", "oblique,angle,scene", "--reference-weights", weights)
        written = (*(docs and ("--docs", table)), "--out", f"{out}/{table}")
        return ("methods", "--methods", ",".join(asked), *more, *common, *written)

    both = ("--data", data, "--blocks", "lewis,ochota")
    return [
        methods("bench_oblique", EVERY, "--scenes", "city,suburb,hills"),
        methods("bench_oblique_poor", (*ON_SOURCE, *ON_GROUND, *OURS), "--scenes", "grass,desert"),
        # Twice the pairs: only ochota has such that lie above 40 degrees.
        methods("bench_oblique_real", EVERY, "--scenes", "", *both, pairs="24"),
        (
            "blocks", "thinned", *both, "--methods", "pycolmap-uncut,baseline,fusion,oblique",
            *(docs and ("--docs", "bench_oblique_blocks")), "--out", f"{out}/blocks",
        ),
    ]  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    parser = options.make_parser("oblique", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of real blocks")
    add("--reference-weights", type=Path, required=True, metavar="DIR", help="weights of the peers")
    options.add_runs(parser)
    args = options.parse(parser, arguments)
    places = (str(path.resolve()) for path in (args.data, args.reference_weights, args.out))
    return run_all(runs(*places, str(args.seed), ("--docs",) if args.docs else ()), listed=args.list)
