"""What an exporter gets and what it returns, and the folder that appears whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import AdjustedBlock, Block, FloatArray, IntArray, Pair, Pose, PoseResidual
from aeromatch_cli.errors import WorkspaceError

Colours = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PairContents:
    """One matched pair.

    matches: (M, 2) int32 keypoint indices before any filter. verified: (V, 2) int32, those that the filters kept,
    empty where the pair was not verified. model_kind, model: as in `data.Verdict`.
    """

    pair: Pair
    matches: IntArray
    verified: IntArray
    model_kind: str
    model: FloatArray


@dataclass(frozen=True, eq=False)
class ExportContents:
    """Everything that leaves the workspace. Arrays are read when they are needed, never all at once.

    keypoints_px: image_id -> (K, 2) float32 in stored pixels, the array that match indices point into; (0, 2) for an
    image without features. pairs: each pair at most once, in the order of pairs.csv; only iterated once.
    guessed_cameras: camera_ids whose focal length is a guess and not a value from the user or from EXIF.
    positions: image_id -> position as it was given, with its standard deviation; None: those of the block. adjusted:
    the block after bundle adjustment, or None. geographic: world (N, 3) -> WGS84 latitude, longitude in degrees and
    height (N, 3); None in a local frame. residuals: of the adjusted images, by image_id. colours: image_id -> RGB
    (K, 3) of its picture at the keypoints, for which it is decoded; None where that fails.
    """

    block: Block
    keypoints_px: Callable[[str], FloatArray]
    pairs: Iterable[PairContents]
    guessed_cameras: frozenset[str] = frozenset()
    positions: Mapping[str, Pose] | None = None
    adjusted: AdjustedBlock | None = None
    geographic: Callable[[FloatArray], FloatArray] | None = None
    residuals: Mapping[str, PoseResidual] = field(default_factory=dict)
    colours: Callable[[str], Colours | None] = lambda image_id: None


@dataclass(frozen=True)
class ExportSummary:
    """Counts of what was written. files: absolute or relative as the folder was given, sorted. remarks: for a person,
    on what the format does not hold."""

    files: tuple[Path, ...]
    images: int
    posed_images: int
    keypoints: int
    matched_pairs: int
    matches: int
    verified_pairs: int
    verified_matches: int
    remarks: tuple[str, ...] = ()


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A scratch folder beside `folder` that takes its place when the block ends, and vanishes if it raises.

    A reader never sees half an export; leftovers of a killed run are removed first. The scratch names are fixed, so
    that only one export of a folder may run at a time.

    Raises WorkspaceError where the folder cannot be written.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    previous = folder.with_name(f".{folder.name}.previous")
    try:
        if previous.exists() and not folder.exists():
            previous.rename(folder)
        for leftover in (partial, previous):
            _remove(leftover)
        partial.mkdir(parents=True)
        yield partial
        if folder.is_symlink():
            folder.unlink()
        if folder.exists():
            folder.rename(previous)
        partial.rename(folder)
        _remove(previous)
    except OSError as error:
        raise WorkspaceError(
            f"export folder {folder} cannot be written: {error}; check free space and permissions, then run again"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _remove(folder: Path) -> None:
    """A folder, or what else has its name: a file, or a link, of which only the link goes."""
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder)
    else:
        folder.unlink(missing_ok=True)
