"""Where tracks come from: rendered blocks by exact truth, homographies of real pictures, reference reconstructions."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.geometry.frames import apply_homography, homography_jacobians
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.lab.synthetic.truth import Truth
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.pyramid import SUPPORT
from trainings.lightglue import homographies
from trainings.lightglue.blocks import prepared, prepared_reference
from trainings.patches.sights import Picture, Sight, sights_of
from trainings.patches.tracks import MARGIN, STORED_PX, Look, Spots, Tracks, assembled, part, tracks_of

SMALLEST_PX, LARGEST_PX = 3.2, 40.0
KEYPOINTS = 700  # asked for in a picture of a rendered block, of either detector
TRACKS = 2800  # of a block and kind of picture
# What is described in use are the network's keypoints; SIFT's are elsewhere, and of other sizes.
DETECTORS: tuple[Literal["sift", "network"], ...] = ("sift", "network")
VIEWS, PER_VIEW = 3, 120  # of a homography group
REAL_SIZE_PX, REAL_TRACKS = 1600, 3500
# Patches of a reference point that correlate less with the one that is most like the others do not show it.
LEAST_NCC = 0.4
_BENT = 0.35
_CAMERA = Camera("PINHOLE", *homographies.SIZE_PX, (500.0, 500.0, 239.5, 199.5))  # of homography views; nobody asks


def rendered(folder: Path) -> dict[str, Tracks]:
    """Tracks between the ground views and between the source pictures of a rendered block."""
    truth = load_truth(folder)
    rng = np.random.default_rng([truth.scene.seed, 31])
    with tempfile.TemporaryDirectory() as scratch:
        context = prepared(folder, scratch, ("simulate.keep_source=true", "pairs=exhaustive"))
        sights = sights_of(context, truth.cameras, truth.poses, truth.sorties)

    def visible(sight: Sight, points_m: FloatArray) -> BoolArray:
        return truth.in_open_view(sight.image, points_m)

    found = {}
    for name, upright in (("ground", True), ("source", False)):
        of_kind = [sight for sight in sights if sight.upright is upright]
        asked = [(index, by) for by in DETECTORS for index in range(len(of_kind))]
        parts = [_met(truth, of_kind[index], *of_kind[index].keypoints(KEYPOINTS, by=by)) for index, by in asked]
        origins = np.repeat([index for index, _ in asked], [len(part.sizes_px) for part in parts])
        spots = Spots(*(np.concatenate([getattr(p, key) for p in parts]) for key in vars(parts[0])))
        kept = _spread(spots.sizes_px, TRACKS, rng)
        found[name] = tracks_of(of_kind, spots.take(kept), origins[kept], visible, rng)
    return found


def _met(truth: Truth, sight: Sight, points_px: FloatArray, sizes_px: FloatArray) -> Spots:
    """What keypoints of a sight show, tangents by differences over a quarter of their diameter; without very small and
    large ones, and those where the surface is bent or broken there."""
    fit = (sizes_px >= SMALLEST_PX) & (sizes_px <= LARGEST_PX)
    points_px, sizes_px = points_px[fit], sizes_px[fit]
    step = 0.25 * sizes_px[:, None]
    offsets = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
    asked = np.concatenate([points_px + step * np.array(offset) for offset in offsets])
    middle, right, left, below, above = truth.surface_points(sight.image, sight.source_px(asked)).reshape(5, -1, 3)
    tangents = np.stack([right - left, below - above], axis=2) / (2.0 * step[:, :, None])
    bends = [np.linalg.norm(a + b - 2.0 * middle, axis=1) for a, b in ((right, left), (below, above))]
    spans = [np.linalg.norm(a - b, axis=1) for a, b in ((right, left), (below, above))]
    with np.errstate(invalid="ignore"):
        flat = np.logical_and(*(bend < _BENT * span for bend, span in zip(bends, spans, strict=True)))
    return Spots(middle, tangents, sizes_px).take(flat)


def _spread(sizes_px: FloatArray, count: int, rng: np.random.Generator) -> Any:
    """Rows of about `count` keypoints, large ones favoured: SIFT finds ten small ones for a large one."""
    weights = sizes_px / sizes_px.mean()
    chance = np.minimum(1.0, 1.4 * count * weights / weights.sum())
    return np.flatnonzero(rng.random(len(sizes_px)) < chance)


def reference(folder: Path, name: str) -> dict[str, Tracks]:
    """Tracks of the sparse points of a real block's reference reconstruction, where its pictures agree.

    No detector and no occlusion: sizes are drawn, the surface is taken for level, and a patch stays only where it
    correlates with the others of its point.
    """
    rng = np.random.default_rng([len(name), *name.encode(), 32])
    with tempfile.TemporaryDirectory() as scratch:
        changes = ("simulate.keep_source=true", "pairs=exhaustive")
        context, points_m = prepared_reference(folder, scratch, changes, REAL_SIZE_PX)
        sights = sights_of(context, None, None, {})
    points_m = points_m[rng.permutation(len(points_m))[:REAL_TRACKS]]
    gsd_m = context.block.gsd_m
    assert gsd_m is not None
    level = np.tile(gsd_m * np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 0.0]]), (len(points_m), 1, 1))
    sizes = np.exp(rng.uniform(np.log(3.5), np.log(20.0), len(points_m)))
    found = {}
    for kind, upright in (("ground", True), ("source", False)):
        of_kind = [sight for sight in sights if sight.upright is upright]
        spots = Spots(points_m, level, sizes)
        origins = _first_seen(of_kind, spots, rng)
        tracks = tracks_of(of_kind, spots, origins, lambda _, points: np.ones(len(points), bool), rng)
        found[kind] = _agreeing(tracks)
    return found


def _first_seen(sights: list[Sight], spots: Spots, rng: np.random.Generator) -> Any:
    """(N,) a sight that shows each spot, at random, 0 where none does."""
    priority = rng.random((len(sights), len(spots.sizes_px)))
    for index, sight in enumerate(sights):
        there = sight.places_px(spots.points_m)
        priority[index, ~sight.shows(there, spots.sizes_px)] = -1.0
    return priority.argmax(axis=0)


def _agreeing(tracks: Tracks) -> Tracks:
    """Without patches that do not look like their track's most typical one, and tracks that are left with one."""
    margin = (STORED_PX - round(STORED_PX / MARGIN)) // 2
    inner = tracks.patches[:, margin:-margin, margin:-margin].astype(np.float32)
    blurred = np.stack([cv2.GaussianBlur(patch, (0, 0), 1.5) for patch in inner]).reshape(len(inner), -1)
    blurred -= blurred.mean(axis=1, keepdims=True)
    blurred /= np.maximum(np.linalg.norm(blurred, axis=1, keepdims=True), 1e-6)
    keep = np.zeros(len(inner), bool)
    for start, end in zip(tracks.starts[:-1], tracks.starts[1:], strict=True):
        alike = blurred[start:end] @ blurred[start:end].T
        agrees = alike[np.argmax(alike.sum(axis=1))] >= LEAST_NCC
        keep[start:end] = agrees & (agrees.sum() > 1)
    names = ("patches", "track", "picture", "size_px", "turn_deg", "ray", "sun")
    return assembled([{name: getattr(tracks, name)[keep] for name in names}], tracks.place_m, tracks.reach_m)


def homography(paths: list[Path], seed: int) -> tuple[str, Tracks] | None:
    """Tracks of VIEWS views of one picture, warped and developed anew; None where it shows nothing.

    Half of the groups are `source`: turned at will and cut along the true turn; the others `ground`: turned a little
    and cut upright.
    """
    rng = np.random.default_rng([seed, 33])
    base = homographies.base_of(read_pixels(paths[int(rng.integers(len(paths)))], colour=False), rng)
    free = rng.random() < 0.5
    size = homographies.SIZE_PX
    matrices = [homographies.random_homography(base.shape[::-1], free, rng) for _ in range(VIEWS)]
    pictures = []
    for light, matrix in enumerate(matrices):
        gray = cv2.warpPerspective(base, matrix, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
        seen = cv2.warpPerspective(np.full(base.shape, 255, np.uint8), matrix, size) > 254
        view = View("source", *size, np.eye(3), True, 0.0, north_up=not free)
        pictures.append(Picture(ViewPixels(view, homographies.developed(gray, rng), seen), _CAMERA, light))
    points, sizes = pictures[0].keypoints(4 * PER_VIEW)
    rows = _spread(sizes, PER_VIEW, rng)
    rows = rows[sizes[rows] >= SMALLEST_PX]
    tracks = _warped(pictures, matrices, points[rows], sizes[rows])
    return ("source" if free else "ground", tracks) if len(tracks.place_m) > 1 else None


def _warped(pictures: list[Picture], matrices: list[Any], points_px: FloatArray, sizes_px: FloatArray) -> Tracks:
    """Tracks of places (N, 2) of the first picture; metres are pixels of the base."""
    parts, straight = [], np.tile([0.0, 0.0, -1.0], (len(points_px), 1))
    to_base = np.linalg.inv(matrices[0])
    for index, (picture, matrix) in enumerate(zip(pictures, matrices, strict=True)):
        warp = matrix @ to_base
        there = apply_homography(warp, points_px)
        seen = Look.of(there, homography_jacobians(warp, points_px, there))
        rows = np.flatnonzero(seen.usable(sizes_px) & picture.shows(there, sizes_px * seen.scale))
        parts.append(part(picture, seen, sizes_px, straight, rows, index))
    base_px = apply_homography(to_base, points_px)
    scale = np.sqrt(np.abs(np.linalg.det(homography_jacobians(to_base, points_px, base_px))))
    return assembled(parts, np.column_stack([base_px, np.zeros(len(base_px))]), SUPPORT / 2.0 * sizes_px * scale)
