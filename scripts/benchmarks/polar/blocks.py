"""Pairs of blocks, of which nothing is told, or the poses: real ones with reference poses, rendered ones with relief.

Right or wrong is said by reference poses (epipolar distance), or by the renderer (where every pixel really lands).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, Pair, PairGeometry
from aeromatch_cli.evaluate import BlockTruth
from aeromatch_cli.evaluate.scores import PairScore
from aeromatch_cli.geometry.warps import source_from_view, undistorted_from_ground, view_from_source
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.stages.context import Context
from benchmarks.peers.base import prepared
from benchmarks.polar.grounds import RENDERED, block
from benchmarks.scenes import EXACT_POSES, NOISY_POSES, overlapping, render_once

_LEAST_OVERLAP = 0.3
_NO_SCORES = np.zeros((0, 2))
# Of the longer side: how far most matches may be off the plane of the ground where a registration is called right. The
# ground is no plane, and reference poses are good to some pixels.
_RIGHT = 0.03
Poses = tuple[Path, Path]  # told, and right


@dataclass(frozen=True, eq=False)
class BlockPair:
    """first, second: (H, W) uint8 gray. names: of the images. geometry: with what is known of the poses. overlap: share
    of the larger part. true: the geometry with the poses that say what is right.
    """

    kind: str
    names: tuple[str, str]
    first: NDArray[np.uint8]
    second: NDArray[np.uint8]
    geometry: PairGeometry
    overlap: float
    true: PairGeometry
    truth: BlockTruth

    def judged(self, points0_px: FloatArray, points1_px: FloatArray) -> PairScore:
        """Matches (M, 2) of stored pixels."""
        equal = np.ones(len(points0_px))
        return self.truth.judge(*self.names, _NO_SCORES, _NO_SCORES, points0_px, points1_px, equal)

    def right(self, points0_px: FloatArray, points1_px: FloatArray) -> bool:
        """Whether matches (M, 2) lie about where the plane of the ground puts them."""
        if not len(points0_px):
            return False
        off = np.linalg.norm(points1_px - on_plane(self.true, points0_px), axis=1)
        return bool(np.nanmedian(off) <= _RIGHT * max(self.first.shape))


def block_pairs(
    kind: str, size: tuple[int, int], images: int, count: int, seed: int, data: Path | None, out: Path
) -> Iterator[BlockPair]:
    """Up to `count` pairs, at random, of overlap 0.3 at least. size, images: of rendered blocks."""
    folder, poses = _rendered(kind, size, images, seed, out) if kind in RENDERED else _real(block(kind, data))
    truth = open_truth(folder)
    with tempfile.TemporaryDirectory() as scratch:
        told, right = (_context(folder, path, Path(scratch)) for path in poses)
    usable = list(overlapping(truth, _LEAST_OVERLAP).items())
    for number in sorted(np.random.default_rng([seed, 11]).permutation(len(usable))[:count]):
        names, conditions = usable[number]
        yield _pair(kind, told, right, truth, names, conditions.overlap)


def _rendered(kind: str, size: tuple[int, int], images: int, seed: int, out: Path) -> tuple[Path, Poses]:
    """A block over relief; its poses as a navigation unit gives them, and as they are."""
    width_px, height_px = size
    folder = render_once(out, kind, seed=2_000_000 + seed, width_px=width_px, height_px=height_px, images=images)
    return folder, (folder / NOISY_POSES, folder / EXACT_POSES)


def _real(folder: Path) -> tuple[Path, Poses]:
    return folder, (folder / "reference" / "poses.csv", folder / "reference" / "poses.csv")


def _context(folder: Path, poses: Path, workspace: Path) -> Context:
    cameras = folder / "block.json" if (folder / "block.json").is_file() else folder / "reference" / "block.json"
    return prepared("polar", ["pairs=exhaustive"], folder / "images", poses, cameras, workspace, dry=True)


def _pair(
    kind: str, told: Context, right: Context, truth: BlockTruth, names: tuple[str, str], overlap: float
) -> BlockPair:
    ids = {image.name: image.image_id for image in told.block.images}
    images = [told.image_by_id[ids[name]] for name in names]
    pair = Pair(ids[names[0]], ids[names[1]], overlap, float("nan"), "bench")
    first, second = (read_pixels(told.image_path(image), colour=False) for image in images)
    geometries = told.geometry(pair), right.geometry(pair)
    return BlockPair(kind, names, first, second, geometries[0], overlap, geometries[1], truth)


def on_plane(geometry: PairGeometry, places_px: FloatArray) -> FloatArray:
    """Where the plane of the ground puts stored pixels (N, 2) of image 0 in image 1."""
    camera0, camera1 = geometry.camera0, geometry.camera1
    if geometry.pose0 is None or geometry.pose1 is None or geometry.ground_z_m is None:
        raise ValueError("both poses and the ground must be known")
    seen_from = undistorted_from_ground(camera0, geometry.pose0, geometry.ground_z_m)
    ground = view_from_source(camera0, seen_from, places_px)
    return source_from_view(camera1, undistorted_from_ground(camera1, geometry.pose1, geometry.ground_z_m), ground)
