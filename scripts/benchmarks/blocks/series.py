"""The two series of a block that was flown twice, and the pairs across them that see common ground."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aeromatch_cli.data import Block
from aeromatch_cli.strategies.pairings import PAIRINGS
from benchmarks.peers.base import prepared
from benchmarks.scenes import MIN_OVERLAP


def two_series(brightness: Mapping[str, float]) -> tuple[set[str], set[str]]:
    """Names of the darker and of the brighter series: cut where brightness rises by the largest factor."""
    names = sorted(brightness, key=lambda name: brightness[name])
    levels = np.maximum([brightness[name] for name in names], 1.0)
    cut = 1 + int(np.argmax(levels[1:] / levels[:-1]))
    return set(names[:cut]), set(names[cut:])


def pairs_across(block: Block, series: tuple[set[str], set[str]]) -> list[tuple[str, str]]:
    """Image names of the pairs across both series whose footprints share a fifth of the smaller one, whatever the angle
    between both views; sorted.
    """
    everything = {"min_overlap": MIN_OVERLAP, "max_view_angle_deg": 180.0, "max_neighbours": max(1, len(block.images))}
    names = {image.image_id: image.name for image in block.images}
    found = []
    for pair in PAIRINGS["overlap"](**everything)(block):
        first, second = sorted((names[pair.image_id0], names[pair.image_id1]))
        if pair.overlap >= MIN_OVERLAP and (first in series[0]) != (second in series[0]):
            found.append((first, second))
    return sorted(found)


def read_block(images: Path, reference: Path) -> Block:
    """A block with its reference poses, cameras and ground height."""
    with tempfile.TemporaryDirectory() as scratch:
        places = images, reference / "poses.csv", reference / "block.json", Path(scratch)
        return prepared("baseline", ["pairs=exhaustive"], *places, dry=True).block
