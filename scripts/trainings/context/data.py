"""Views of rendered blocks with learned keypoints, their plain descriptors and coarse pictures, and true partners.

Every block is looked at twice: in north-up ground views from noisy poses, upright, and in the stored pictures, turned
by the orientation network.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.stages import simulate
from aeromatch_cli.strategies.extractors.context import coarse_of
from trainings.lightglue.blocks import extracted, partnered
from trainings.lightglue.data import save_arrays
from trainings.lightglue.sides import Partners, Seen

_LEARNED = ("extract=learned", "extract.context=false")
RECIPES = (_LEARNED, (*_LEARNED, "simulate=none"))
KEYPOINTS, LEAST_PARTNERS = 1200, 32
Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class ViewSeen:
    """seen: keypoints and descriptor bytes. coarse: (h, w) uint8, the view REDUCED times smaller."""

    seen: Seen
    coarse: Array


@dataclass(frozen=True, eq=False)
class ContextPair:
    """Two views and who is whose partner. angle_deg: between both lines of sight."""

    view0: ViewSeen
    view1: ViewSeen
    truth: Partners
    angle_deg: float


def block_pairs(folder: Path, path: Path, weights: Path | None = None) -> list[ContextPair]:
    """Pairs of a rendered block with partners enough, from the file `path` where it is there.

    weights: folder of detector, orientation network and GeoDesc; what it lacks, or None, are those that ship.
    """
    if not path.is_file():
        _write(folder, path, weights)
    with np.load(path) as archive:
        arrays = dict(archive)
    views = [_view(arrays, number) for number in range(int(arrays["views"]))]
    found = []
    for number in range(int(arrays["pairs"])):
        first, second = arrays[f"pair.{number}"]
        truth = Partners(arrays[f"pair.{number}.of0"], arrays[f"pair.{number}.of1"])
        found.append(ContextPair(views[first], views[second], truth, float(arrays[f"pair.{number}.angle"])))
    return found


def _view(arrays: dict[str, Array], number: int) -> ViewSeen:
    fields = {name: arrays[f"view.{number}.{name}"] for name in Seen.__dataclass_fields__}
    return ViewSeen(Seen(**fields), arrays[f"view.{number}.coarse"])


def _write(folder: Path, path: Path, weights: Path | None) -> None:
    truth, judge = load_truth(folder), open_truth(folder)
    arrays: dict[str, Any] = {}
    views = pairs = 0
    own = () if weights is None else (f"extract.weights={weights.resolve()}",)
    for recipe in RECIPES:
        numbers: dict[str, int] = {}
        known: dict[str, Seen] = {}
        for name, side, task in extracted(folder, (*recipe, *own), KEYPOINTS):
            numbers[name], known[name] = views, side
            arrays[f"view.{views}.coarse"] = coarse_of(simulate.render(task.views)[0][0].gray)
            arrays |= {f"view.{views}.{key}": value for key, value in side.arrays().items()}
            views += 1
        for name0, name1, mates in partnered(truth, known, LEAST_PARTNERS):
            arrays[f"pair.{pairs}"] = np.array([numbers[name0], numbers[name1]])
            arrays[f"pair.{pairs}.angle"] = np.array(judge.conditions(name0, name1).view_angle_deg)
            arrays |= {f"pair.{pairs}.of0": mates.of0, f"pair.{pairs}.of1": mates.of1}
            pairs += 1
    save_arrays(path, arrays | {"views": np.array(views), "pairs": np.array(pairs)})
