"""Every table of preset `fusion`: a list of runs of the other benchmarks. Hours; a killed run goes on where it was."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.runs import run_all

PEERS = "SIFT=opencv-sift,opencv-asift,pycolmap,pycolmap-guided"
PLAIN = "plain=fusion[enhance=none,simulate=none]"
PLAIN_UNGUIDED = "plain-unguided=fusion[enhance=none,simulate=none,match.guided=false]"
UNGUIDED = "fusion-unguided=fusion[match.guided=false]"
# The network is run where nearest neighbours leave few matches; without it, and always.
NEAREST = "nearest=fusion[match.name=nearest,match.guided=true]"
NEAREST_UNGUIDED = "nearest-unguided=fusion[match.name=nearest]"
NETWORK = "network=fusion[match.network_below_matches=100000,match.guide_below_matches=100000]"
SINGLE = (
    "shadow=fusion[simulate=none],clahe=fusion[enhance=clahe,simulate=none],wallis=fusion[enhance=wallis,simulate=none],"
    "north-up=fusion[enhance=none,simulate=ground],views=fusion[enhance=none],tilts=fusion[simulate=tilts],"
    "clahe-beside=fusion[enhance=clahe,enhance.keep_source=true]"
)
# fusion has the budget in either picture, of which a pair uses one; these have it in all, in one picture or in both.
STRICT = "lifted-only=fusion[enhance.keep_source=false],half-budget=fusion[extract.keypoints=1024]"
FILTERS = "direct=fusion[filter=homography],magsac=fusion[filter=magsac],poselib=fusion[filter=poselib]"
OTHERS = f"{NEAREST},{NETWORK},{PLAIN_UNGUIDED},{UNGUIDED},{NEAREST_UNGUIDED}"
MATCHERS = f"fusion,{NEAREST},{UNGUIDED},{NEAREST_UNGUIDED}"
COMPARED = "--seed SEED --reference SIFT --unprocessed plain"
RUNS = (
    f"methods --methods {PEERS},{PLAIN},{SINGLE},fusion,{STRICT},{FILTERS},{OTHERS} --pairs 12 {COMPARED} --poses both "
    "--noisy-methods plain,fusion,fusion-unguided --tables goals,shadow,strategies,noise "
    "--docs bench_fusion --out OUT/bench_fusion",
    # ASIFT with a whole budget in each of its views takes half a minute a pair.
    f"methods --methods {PEERS},{PLAIN},fusion,{UNGUIDED} --pairs 4 {COMPARED} --budget view --tables goals,strategies "
    "--docs bench_fusion_per_view --out OUT/bench_fusion_per_view",
    "shadow --data DATA --seed SEED --docs --out OUT",
    "filters --seed SEED --docs --out OUT",
    "filters --seed SEED --flights oblique --ratio 0.9 --docs --out OUT/oblique",
    f"blocks cross --data DATA --methods pycolmap-uncut-guided,pycolmap-guided,{MATCHERS} --docs --out OUT",
    f"blocks thinned --data DATA --methods pycolmap-uncut,baseline,{MATCHERS} --docs --out OUT",
    f"blocks easy --data DATA --methods baseline,fusion,{NEAREST} --docs --out OUT",
)


def main(arguments: Sequence[str]) -> int:
    return run_all("fusion", __doc__, RUNS, arguments)
