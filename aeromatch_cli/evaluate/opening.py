"""What every truth of a block can say, and the one of reference poses, opened from its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from aeromatch_cli.data import BoolArray, Camera, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate.reference import ReferenceTruth, load_reference
from aeromatch_cli.evaluate.scores import Conditions, PairScore

_REFERENCE_FILES = ("poses.csv", "block.json")


class BlockTruth(Protocol):
    """Who judges the pairs of a block. Images go by name; points are stored pixels."""

    @property
    def kind(self) -> str:
        """ "rendered" or "reference"."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]: ...

    @property
    def images_folder(self) -> Path | None: ...

    def near(self, name: str, others: Sequence[str]) -> BoolArray: ...

    def overlap_at_most(self, name0: str, name1: str) -> float: ...

    def conditions(self, name0: str, name1: str) -> Conditions: ...

    def judge(
        self,
        name0: str,
        name1: str,
        keypoints0_px: FloatArray,
        keypoints1_px: FloatArray,
        points0_px: FloatArray,
        points1_px: FloatArray,
        scores: FloatArray,
    ) -> PairScore: ...


def open_reference(folder: Path) -> ReferenceTruth:
    """The reference poses in a folder: poses.csv and block.json, there or in its subfolder reference.

    Raises ConfigError where it holds none, InputError where they cannot be used.
    """
    for place in (folder, folder / "reference"):
        if all((place / name).is_file() for name in _REFERENCE_FILES):
            return load_reference(place, existing(folder / "images") or existing(place.parent / "images"))
    raise ConfigError(
        f"{folder} holds no truth: give the folder that synth wrote (truth.json), or one with reference poses "
        f"({' and '.join(_REFERENCE_FILES)})"
    )


def existing(folder: Path) -> Path | None:
    """The folder where it exists, else None."""
    return folder if folder.is_dir() else None
