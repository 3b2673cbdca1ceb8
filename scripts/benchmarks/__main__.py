"""`scripts/bench NAME [OPTION ...]`: runs one benchmark; without a name it lists them."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from aeromatch_cli.lab.strategies import add_arms
from benchmarks.launcher import Table, launch

TABLE: Table = {
    "results": ("benchmarks.results", "makes the tables of docs/results by running the standing benchmarks"),
    "auto": ("benchmarks.auto.command", "auto beside presets and peers, strategy by strategy, and on real blocks"),
    "peers": ("benchmarks.peers.command", "presets beside other programs on the same pairs, by truth"),
    "anchors": (
        "benchmarks.anchors.command",
        "pairs of photographs whose truth others have measured, without any pose",
    ),
    "calibration": (
        "benchmarks.calibration.command",
        "bundle adjustment of simulated tie points with real lenses, beside COLMAP, by exact truth",
    ),
    "orientation": (
        "benchmarks.orientation.command",
        "orientation from the pictures where given poses and cameras are wrong",
    ),
    "claims": (
        "benchmarks.claims.command",
        "the papers' claims beside their baselines, and ablations, by truth",
    ),
    "growth": ("benchmarks.growth", "seconds and memory of every stage against the number of images"),
    "speed": ("benchmarks.speed", "seconds and memory of whole runs beside pycolmap, by stage"),
    "robustness": (
        "benchmarks.robustness.command",
        "whether a verdict can be believed: blocks spoilt in known ways, and good ones, by exact truth",
    ),
    "picture": ("benchmarks.picture", "the README's picture: one hard pair, SIFT beside a preset, by exact truth"),
    "same": ("benchmarks.same", "whether two workspaces hold the same verified matches, array by array"),
}


def main(arguments: Sequence[str]) -> int:
    """The exit code of the benchmark that the first argument names."""
    return launch("scripts/bench", TABLE, arguments)


if __name__ == "__main__":
    add_arms()  # which settings of benchmarks may name
    sys.exit(main(sys.argv[1:]))
