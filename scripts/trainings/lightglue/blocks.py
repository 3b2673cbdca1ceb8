"""Stage 2: pairs of rendered blocks, with parallax, occlusion, oblique views and two suns, truth by ray casting.

Each block is looked at twice: as the preset `baseline` does (north-up ground views from noisy poses, upright), and in
the stored pictures (descriptors along their gradients).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import FloatArray
from aeromatch_cli.executor import Executor
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.lab.synthetic import Truth, load_truth
from aeromatch_cli.stages import extract, pairs
from aeromatch_cli.stages.context import Context
from trainings.lightglue.sides import Partners, Seen, partners, seen

# By the features: ground views and stored pictures.
RECIPES = {
    "sift": ((), ("simulate=none", "extract.orientation=gradient")),
    "learned": (("extract=learned",), ("extract=learned", "simulate=none")),
}
KEYPOINTS = 1500
LEAST_PARTNERS = 16


@dataclass(frozen=True, eq=False)
class Pair:
    """Two sides, their truth, and whether two suns shone on them."""

    side0: Seen
    side1: Seen
    truth: Partners
    two_suns: bool


def block_pairs(folder: Path, keypoints: int = KEYPOINTS, features: str = "sift") -> list[Pair]:
    """Every pair of a rendered block with partners enough, of each recipe."""
    truth, suns = load_truth(folder), _suns(folder)
    found = []
    for recipe in RECIPES[features]:
        signed = features == "learned"
        sides = {name: side for name, side, _ in extracted(folder, recipe, keypoints, signed=signed)}
        for name0, name1, mates in partnered(truth, sides, LEAST_PARTNERS):
            found.append(Pair(sides[name0], sides[name1], mates, suns[name0] != suns[name1]))
    return found


def extracted(
    folder: Path, recipe: tuple[str, ...], keypoints: int, *, signed: bool = False
) -> Iterator[tuple[str, Seen, extract.ExtractTask]]:
    """Every picture of a rendered block that has keypoints: its name, what is seen in it, and what made that."""
    with tempfile.TemporaryDirectory() as scratch:
        # The recipe comes first: `extract=` resets what was set of it.
        context = prepared(folder, scratch, (*recipe, f"extract.keypoints={keypoints}", "pairs=exhaustive"))
        for image in context.block.images:
            task = extract.task_of(context, image.image_id)
            extract.run_task(task)
            features = read_features(task.path)
            if len(features.descriptors):
                yield image.name, seen(features, signed=signed), task


def partnered(truth: Truth, sides: Mapping[str, Seen], least: int) -> Iterator[tuple[str, str, Partners]]:
    """Pairs of pictures by name, those with `least` partners or more, and who is whose."""
    for name0, name1 in combinations(sorted(sides), 2):
        side0, side1 = sides[name0], sides[name1]
        there0, hidden0 = truth.transfer(name0, side0.places_px, name1)
        there1, hidden1 = truth.transfer(name1, side1.places_px, name0)
        there0[hidden0], there1[hidden1] = np.nan, np.nan
        mates = partners(side0, side1, there0, there1)
        if mates.count >= least:
            yield name0, name1, mates


def prepared(folder: Path, workspace: str, changes: Sequence[str]) -> Context:
    """A rendered block as preset `baseline` with these settings reads it, with noisy poses."""
    block = {"images": str(folder / "images"), "poses": str(folder / "poses_noisy.csv")}
    block["cameras"] = str(folder / "block.json")
    return _prepared(block, workspace, changes)


def prepared_reference(
    folder: Path, workspace: str, changes: Sequence[str], size_px: int
) -> tuple[Context, FloatArray]:
    """A real block, pictures of at most this size, with the poses of its reference, and the points (P, 3) of that."""
    reference = folder / "reference"
    block = {"images": str(folder / "images"), "poses": str(reference / "poses.csv"), "max_size_px": size_px}
    context = _prepared(block | {"cameras": str(reference / "block.json")}, workspace, changes)
    with np.load(reference / "points.npz") as archive:
        return context, archive["xyz"] - np.asarray(context.block.origin_m)


def _prepared(block: Mapping[str, Any], workspace: str, changes: Sequence[str]) -> Context:
    top = {"workspace": workspace, "run": {"executor": "serial", "jobs": 1}}
    settings = load("baseline", ["orient=none", *changes], block, **top)
    return pairs.prepare(settings, Executor("serial", 1))[0]


def _suns(folder: Path) -> dict[str, int]:
    """The sortie of every picture; each has a sun of its own."""
    facts = json.loads((folder / "synth.json").read_text(encoding="utf-8"))
    return {image["name"]: int(image["sortie"]) for image in facts["images"]}
