"""Patches around keypoints, and how keypoints of one image are measured by patches of others; the work of `refine`."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray, PairGeometry
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.archives import load_arrays, save_arrays
from aeromatch_cli.formats.reading import say_damaged
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.geometry.level import level_affinities
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.stages.enhance import check_unchanged
from aeromatch_cli.strategies.refiners.least_squares import PATCH_HALF_PX, REACH_PX, LeastSquares, Patches

_PATCHES = "patches"


@dataclass(frozen=True, eq=False)
class CutTask:
    """An image, the stored pixels (N, 2) around which patches are wanted, and the file that gets them."""

    source: Source
    points_px: FloatArray
    path: Path


@dataclass(frozen=True, eq=False)
class ByImage:
    """Keypoints of one image that are measured by those of another: patches (N,) of either, their places (N, 2), and
    what is known of both images, the other one first."""

    image_id: str
    patches: IntArray
    own_patches: IntArray
    places_px: FloatArray
    own_places_px: FloatArray
    geometry: PairGeometry


@dataclass(frozen=True, eq=False)
class MeasureTask:
    """Asks for the measurement of all keypoints of one image that others measure. path, fingerprint: of the file that
    keeps what was found, and what it must carry; "" where none keeps it."""

    image_id: str
    by: tuple[ByImage, ...]
    recipe: LeastSquares
    folder: Path
    scales: Mapping[str, float]
    path: Path
    fingerprint: str

    @property
    def rows(self) -> IntArray:
        """(N,) which of the image's matched keypoints they are, in the order of the measurements."""
        return np.concatenate([one.own_patches for one in self.by])

    def with_patches(self) -> MeasureTask:
        """Return the task without the other images that have no patches, whose pictures could not be read."""
        own = patches_of(self.folder, self.image_id).is_file()
        by = tuple(one for one in self.by if own and patches_of(self.folder, one.image_id).is_file())
        return self if len(by) == len(self.by) else replace(self, by=by, fingerprint="")


@dataclass(frozen=True, eq=False)
class Measured:
    """Holds the measurements of keypoints (N,): shifts (N, 2), whether they hold, and pixels from those of the other
    image (N, 2, 2)."""

    shifts_px: FloatArray
    held: BoolArray
    matrices: FloatArray

    @classmethod
    def nothing(cls, count: int) -> Measured:
        matrices = np.zeros((count, 2, 2), np.float32)
        return cls(np.zeros((count, 2), np.float32), np.zeros(count, dtype=bool), matrices)

    def set(self, rows: IntArray, values: Measured) -> None:
        self.shifts_px[rows], self.held[rows], self.matrices[rows] = values.shifts_px, values.held, values.matrices


def cut_patches(task: CutTask) -> int:
    """Write the patches of an image; how many there are. Those near its edge, or near what a mask hides, are empty:
    nothing is measured there."""
    pixels, valid = read_source(task.source, colour=False)
    check_unchanged(task.source)
    places = in_working_frame(task.points_px.astype(np.float64), task.source.scale)
    side = 2 * PATCH_HALF_PX + 1
    padded = np.pad(pixels, PATCH_HALF_PX, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    middles = np.clip(np.rint(places).astype(np.int64), 0, np.array(pixels.shape[1::-1]) - 1)
    patches = windows[middles[:, 1], middles[:, 0]]
    patches[~_far_inside(pixels.shape, valid, middles)] = 0
    write_atomically(task.path, lambda stream: np.save(stream, patches))
    return len(patches)


def _far_inside(shape: tuple[int, ...], valid: BoolArray | None, places: IntArray) -> BoolArray:
    """Return which places (N, 2), x and y, have nothing invalid within the reach of a window."""
    import cv2

    inside = (places >= REACH_PX) & (places < np.array(shape[1::-1]) - REACH_PX)
    if valid is None:
        return np.asarray(inside.all(axis=1))
    whole = cv2.erode(valid.astype(np.uint8), np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8))
    return np.asarray(inside.all(axis=1) & (whole[places[:, 1], places[:, 0]] > 0))


def in_working_frame(points_px: FloatArray, scale: float) -> FloatArray:
    """Return stored pixels (N, 2) in the raster that is worked on, half-pixel correct."""
    return points_px if scale >= 1.0 else apply_homography(resize_matrix(scale), points_px)


def measure(task: MeasureTask) -> Measured:
    """Measure the keypoints of one image, in the order of the task; the result is kept for later runs."""
    own: NDArray[np.uint8] = np.load(patches_of(task.folder, task.image_id), mmap_mode="r")
    parts = []
    for one in task.by:
        other = np.load(patches_of(task.folder, one.image_id), mmap_mode="r")
        scale, own_scale = task.scales[one.image_id], task.scales[task.image_id]
        places, own_places = one.places_px.astype(np.float64), one.own_places_px.astype(np.float64)
        matrices = level_affinities(one.geometry, places, own_places)
        first = _with_places(other[one.patches], in_working_frame(places, scale))
        second = _with_places(own[one.own_patches], in_working_frame(own_places, own_scale))
        shifts, held = task.recipe(first, second, matrices * (own_scale / scale))
        parts.append((shifts / own_scale, held, matrices))
    shifts, held, matrices = (np.concatenate(values) for values in zip(*parts, strict=True))
    found = Measured(shifts.astype(np.float32), held, np.nan_to_num(matrices).astype(np.float32))
    if task.fingerprint:
        write_atomically(task.path, partial(_save, found, task.fingerprint))
    return found


def _save(found: Measured, made_of: str, stream: BinaryIO) -> None:
    arrays = {"shifts_px": found.shifts_px, "held": found.held, "matrices": found.matrices}
    save_arrays(stream, fingerprint=np.array(made_of), **arrays)


def kept_measurements(task: MeasureTask) -> Measured | None:
    """Read what an earlier run has kept, where it is of the same measurements; None, with a warning, where the file is
    broken."""
    try:
        found = load_arrays(task.path, ("fingerprint", "shifts_px", "held", "matrices"))
    except BrokenFileError as error:
        say_damaged(task.path, error)
        return None
    if str(found["fingerprint"]) != task.fingerprint:
        return None
    return Measured(found["shifts_px"], found["held"], found["matrices"])


def measurement_fingerprint(
    recipe: LeastSquares, versions: object, by: Sequence[ByImage], sources: Sequence[str]
) -> str:
    """Return the fingerprint of everything that measurements of one image depend on. sources: fingerprints of its
    picture and of those of the others, in their order."""
    places = [hashlib.sha256(one.places_px.tobytes() + one.own_places_px.tobytes()).hexdigest() for one in by]
    return fingerprint(versions, recipe, sources, [(one.image_id, one.geometry) for one in by], places)


def _with_places(pixels: NDArray[np.uint8], places_px: FloatArray) -> Patches:
    return Patches(pixels, places_px - np.rint(places_px))


def patches_of(folder: Path, image_id: str) -> Path:
    return folder / f"{image_id}.{_PATCHES}.npy"
