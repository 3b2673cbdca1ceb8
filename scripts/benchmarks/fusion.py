"""Every table of preset `fusion`: a list of runs of the other benchmarks. Hours; a killed run goes on where it was."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks import options
from benchmarks.runs import Run, run_all

PEERS = ("SIFT=opencv-sift", "opencv-asift", "pycolmap", "pycolmap-guided")
PLAIN, PLAIN_UNGUIDED = (
    "plain=fusion[enhance=none,simulate=none]",
    ("plain-unguided=fusion[enhance=none,simulate=none,match.guided=false]"),
)
UNGUIDED = "fusion-unguided=fusion[match.guided=false]"
# The network is run where nearest neighbours leave few matches; without it, and always.
NEAREST = "nearest=fusion[match.name=nearest,match.guided=true]"
NEAREST_UNGUIDED = "nearest-unguided=fusion[match.name=nearest]"
NETWORK = "network=fusion[match.network_below_matches=100000,match.guide_below_matches=100000]"
SINGLE = (
    "shadow=fusion[simulate=none]",
    "clahe=fusion[enhance=clahe,simulate=none]",
    "wallis=fusion[enhance=wallis,simulate=none]",
    "north-up=fusion[enhance=none,simulate=ground]",
    "views=fusion[enhance=none]",
    "tilts=fusion[simulate=tilts]",
    "clahe-beside=fusion[enhance=clahe,enhance.keep_source=true]",
)
# fusion has the budget in either picture, of which a pair uses one; these have it in all, in one picture or in both.
STRICT = ("lifted-only=fusion[enhance.keep_source=false]", "half-budget=fusion[extract.keypoints=1024]")
FILTERS = ("direct=fusion[filter=homography]", "magsac=fusion[filter=magsac]", "poselib=fusion[filter=poselib]")
ALL = (
    *PEERS,
    PLAIN,
    *SINGLE,
    "fusion",
    *STRICT,
    *FILTERS,
    NEAREST,
    NETWORK,
    PLAIN_UNGUIDED,
    UNGUIDED,
    NEAREST_UNGUIDED,
)
MATCHERS = ("fusion", NEAREST, UNGUIDED, NEAREST_UNGUIDED)


def runs(data: str, out: str, seed: str, docs: Sequence[str]) -> list[Run]:
    """docs: ("--docs",), or nothing to leave docs/results as it is."""

    def blocks(section: str, *methods: str) -> Run:
        return ("blocks", section, "--data", data, "--methods", ",".join(methods), *docs, "--out", out)

    def methods(table: str, *asked: str) -> Run:
        compared = ("--reference", "SIFT", "--unprocessed", "plain", "--seed", seed)
        return ("methods", *asked, *compared, *(docs and ("--docs", table)), "--out", f"{out}/{table}")

    rendered = ("--seed", seed, *docs, "--out", out)
    return [
        methods(
            "bench_fusion", "--methods", ",".join(ALL), "--pairs", "12", "--poses", "both",
            "--noisy-methods", "plain,fusion,fusion-unguided", "--tables", "goals,shadow,strategies,noise",
        ),
        # ASIFT with a whole budget in each of its views takes half a minute a pair.
        methods(
            "bench_fusion_per_view", "--methods", ",".join((*PEERS, PLAIN, "fusion", UNGUIDED)), "--pairs", "4",
            "--budget", "view", "--tables", "goals,strategies",
        ),
        ("shadow", "--data", data, *rendered),
        ("filters", *rendered),
        ("filters", "--flights", "oblique", "--ratio", "0.9", "--seed", seed, *docs, "--out", f"{out}/oblique"),
        blocks("cross", "pycolmap-uncut-guided", "pycolmap-guided", *MATCHERS),
        blocks("thinned", "pycolmap-uncut", "baseline", *MATCHERS),
        blocks("easy", "baseline", "fusion", NEAREST),
    ]  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    parser = options.make_parser("fusion", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of real blocks")
    options.add_runs(parser)
    args = options.parse(parser, arguments)
    found = runs(str(args.data.resolve()), str(args.out.resolve()), str(args.seed), ("--docs",) if args.docs else ())
    return run_all(found, listed=args.list)
