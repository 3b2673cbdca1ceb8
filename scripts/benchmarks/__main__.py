"""`scripts/bench NAME [OPTION ...]`: runs one benchmark; without a name it lists them."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from aeromatch_cli.lab.strategies import add_arms
from benchmarks.launcher import Table, launch

TABLE: Table = {
    "methods": ("benchmarks.methods.command", "presets beside peers on the same pairs, by truth"),
    "presets": ("benchmarks.presets", "presets on whole rendered blocks with inexact poses, beside peers, by truth"),
    "blocks": ("benchmarks.blocks.command", "whole real blocks beside pycolmap: matches, mapping, time"),
    "fusion": ("benchmarks.fusion", "every table of preset fusion: a list of runs of the others"),
    "oblique": ("benchmarks.oblique", "every table of oblique pairs: a list of runs of the others"),
    "claims": ("benchmarks.claims.command", "the papers' claims beside this project, and ablations, by exact truth"),
    "orient": (
        "benchmarks.orient.command",
        "orientation from the pictures where given poses and cameras are wrong",
    ),
    "calibration": (
        "benchmarks.calibration.command",
        "bundle adjustment of simulated tie points with real lenses, beside COLMAP, by exact truth",
    ),
    "quality": (
        "benchmarks.verdicts.command",
        "whether a verdict can be believed: blocks spoilt in known ways, and good ones, by exact truth",
    ),
    "similar": ("benchmarks.similar", "pairs of images without poses by image retrieval, against reference overlaps"),
    "polar": ("benchmarks.polar.command", "registration of texture-poor ground beside SIFT"),
    "keypoints": ("benchmarks.keypoints.command", "detectors, angles and descriptors of one place, by exact truth"),
    "lightglue": ("benchmarks.lightglue.command", "the network beside the ratio test, and its seconds"),
    "probability": ("benchmarks.probability", "how far the probability that a match is right can be relied on"),
    "evidence": ("benchmarks.evidence", "how many matches a step of auto is expected to bring, and how many it brings"),
    "filters": ("benchmarks.filters", "filters on the same matches, by exact truth"),
    "rectification": ("benchmarks.rectification", "scale and rotation that remain between views of oblique pairs"),
    "shadow": ("benchmarks.shadow", "masks of `enhance=shadow` against rendered truth and hand labels"),
    "scenes": ("benchmarks.contact_sheet", "one picture of every rendered scene: .assets/scenes.jpg"),
    "picture": ("benchmarks.picture", "the README's picture: one hard pair, SIFT beside a preset, by exact truth"),
    "growth": ("benchmarks.growth", "seconds and memory of every stage against the number of images"),
    "memory": ("benchmarks.memory", "peak memory of whole runs against --memory, on large images"),
    "device": ("benchmarks.device", "images and pairs a second of the networks on a CUDA device, beside its limit"),
    "pages": ("benchmarks.pages", "brings the first lines of docs/results up to date with the tables' stamps"),
    "same": ("benchmarks.same", "whether two workspaces hold the same verified matches, array by array"),
}


def main(arguments: Sequence[str]) -> int:
    """The exit code of the benchmark that the first argument names."""
    return launch("scripts/bench", TABLE, arguments)


if __name__ == "__main__":
    add_arms()  # which settings of benchmarks may name
    sys.exit(main(sys.argv[1:]))
