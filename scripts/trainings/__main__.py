"""`scripts/train NAME [OPTION ...]`: makes again what ships and was fitted; without a name it lists all."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from benchmarks.launcher import Table, launch

TABLE: Table = {
    "shadow": ("trainings.shadow.command", "network of enhance=shadow: cast shadow against dark ground"),
    "lightglue": ("trainings.lightglue.command", "network of match=lightglue"),
    "detector": ("trainings.detector.command", "keypoint detector of extract=learned"),
    "orientation": ("trainings.orientation.command", "orientation network of extract=learned"),
    "descriptor": ("trainings.descriptor.command", "GeoDesc descriptors of extract=learned"),
    "context": ("trainings.context.command", "context network of extract=learned"),
    "evidence": ("trainings.evidence", "weights that say how many matches a step of auto may bring"),
    "probability": ("trainings.probability", "weights of the probability that a match is right"),
}


def main(arguments: Sequence[str]) -> int:
    """The exit code of the training that the first argument names."""
    return launch("scripts/train", TABLE, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
