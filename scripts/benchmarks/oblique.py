"""Every table of oblique pairs: a list of runs of the other benchmarks. Hours; a killed run goes on where it was."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.runs import run_all

ON_SOURCE = "SIFT=opencv-sift,ASIFT=opencv-asift,keynet,aliked"
ON_GROUND = "SIFT@ground=opencv-sift@ground,ASIFT@ground=opencv-asift@ground,keynet@ground,aliked@ground"
# SIFT keypoints with this project's descriptor, without context and with it: for GeoDesc and ContextDesc.
STAND_INS = "geodesc*=oblique[extract.detector=sift],contextdesc*=oblique[extract.detector=sift,extract.context=true]"
EVERY = f"{ON_SOURCE},{ON_GROUND},{STAND_INS},fusion,oblique,context=oblique[extract.context=true]"
COMMON = "--flights oblique --condition angles --seed SEED --reference SIFT --tables oblique,angle,scene"
COMMON += " --reference-weights WEIGHTS"
RUNS = (
    f"methods --methods {EVERY} --scenes city,suburb,hills --pairs 12 {COMMON} --docs bench_oblique --out OUT/rendered",
    f"methods --methods {ON_SOURCE},{ON_GROUND},fusion,oblique --scenes grass,desert --pairs 12 {COMMON} "
    "--docs bench_oblique_poor --out OUT/poor",
    # Twice the pairs: only ochota has such that lie above 40 degrees.
    f"methods --methods {EVERY} --scenes '' --data DATA --blocks lewis,ochota --pairs 24 {COMMON} "
    "--docs bench_oblique_real --out OUT/real",
    "blocks thinned --data DATA --blocks lewis,ochota --methods pycolmap-uncut,baseline,fusion,oblique "
    "--docs bench_oblique_blocks --out OUT/blocks",
)


def main(arguments: Sequence[str]) -> int:
    return run_all("oblique", __doc__, RUNS, arguments)
