"""Keypoints of a picture where the detector's heat is largest, level by level.

The paper of method 3 (J. Geo-inf. Sci. 2021(10), 1823-1837) searches Gaussian heat maps for scale-space maxima and
refines them below the pixel; here the maps are those of `nets.detector` on levels an octave apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.strategies.extractors.pyramid import Level, levels_of
from aeromatch_cli.strategies.extractors.tiles import tiles

# Diameter of a keypoint in pixels of its level: its patch is then 48 of them (pyramid.SUPPORT). 32 give 3 % more
# correct matches on renders and 4 to 14 % fewer on photographs, whose finest detail is the camera's own.
SIZE_PX = 7.5
# Pixels of a level that the network is given at once: bounds its memory. On a CPU it cuts them into pieces itself.
TILE_AREA_PX = 4_000_000
_TILE_MARGIN_PX = 64
# Closer to a level's edge the zeros that the layers put around it make maxima of their own.
BORDER_PX = 4
# Of 5 x 5 pixels, in gray levels: with less there is nothing but rounding.
_LEAST_CONTRAST = 3
# Of two keypoints this close, in picture pixels, the weaker one shows nothing new, whatever their sizes.
_APART_PX = 3.0
# Log odds are smoothed by so many pixels of a level: tops become rounder, and places a third more exact.
_SMOOTH_PX = 0.7
# Candidates per keypoint: thinning nearly always leaves as many keypoints as are needed.
_SPARE = 4
# Log odds that half an octave costs: larger keypoints are found again less exactly. Validation pairs, and correct
# matches in six rendered blocks: 48,004 with 0.3, 48,451 with 0.6 (`auto`), 32,702 and 33,147 (`oblique`).
_FINER = 0.6
# Levels half an octave apart would take half as many seconds more for no more matches: ground views of one scale need
# no finer steps (correct ones of `auto` in six rendered blocks, while levels suppressed each other: 37,048 and 37,389).
_PER_OCTAVE = 1
Logits = NDArray[np.float32]


def heat_keypoints(
    gray: NDArray[np.uint8], most: int, valid: BoolArray | None = None, network: Any = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The surest keypoints of a picture (H, W), the surest first: points_px (N, 2) x and y, sizes_px (N,) the
    diameters SIZE_PX / scale of their levels, confidences (N,) 0-1; all float64, N at most `most`.

    Confidence is the heat, lowered where a level is coarse: what fine and coarse keypoints are compared by.

    valid: (H, W) where the picture shows something; keypoints closer to its edge than their size are left out.
    network: a Detector, by default the shipped one. The result does not depend on tiles.
    """
    from aeromatch_cli.nets.detector import load_detector

    network = network or load_detector()
    levels = levels_of(gray, per_octave=_PER_OCTAVE)
    seen = None if valid is None or bool(valid.all()) else valid.astype(np.float32)
    maps = [heat(level.gray, network, shown=_shown(level, seen)) for level in levels]
    points, sizes, logits = maxima(levels, maps)
    inside = inside_shown(valid, points, sizes)
    points, sizes, logits = points[inside], sizes[inside], logits[inside]
    ranks = logits - _FINER * 2.0 * np.log2(sizes / SIZE_PX)
    order = np.lexsort((points[:, 0], points[:, 1], sizes, -ranks))
    first = _apart(points[order[: _SPARE * most]], most)
    order = order[first if len(first) == most else _apart(points[order], most)]
    return points[order], sizes[order], 1.0 / (1.0 + np.exp(-ranks[order]))


def heat(
    gray: NDArray[np.uint8], network: Any = None, tile_area_px: int = TILE_AREA_PX, shown: BoolArray | None = None
) -> Logits:
    """Log odds (H, W) of the heat of a gray picture (H, W), computed in tiles, then smoothed.

    shown: (H, W) where they are wanted; a few pixels off its edge they may be lower than they are.
    """
    import cv2
    import torch

    from aeromatch_cli.nets.detector import CELL_PX, load_detector

    network = network or load_detector()
    device = network.first.weight.device
    height, width = gray.shape
    out = np.empty((height, width), np.float32)
    with torch.inference_mode():
        for tile in tiles(width, height, tile_area_px, _TILE_MARGIN_PX):
            assert tile.x0 % CELL_PX == 0
            assert tile.y0 % CELL_PX == 0
            window = slice(tile.y0, tile.y1), slice(tile.x0, tile.x1)
            piece = torch.from_numpy(np.ascontiguousarray(gray[window])).to(device).float()[None, None] / 255.0
            known = () if shown is None else (torch.from_numpy(np.ascontiguousarray(shown[window])),)
            found = network(piece, *known)[0, 0].cpu().numpy()
            left, top, right, bottom = tile.core
            x0, x1 = int(np.ceil(max(left, tile.x0))), int(np.ceil(min(right, tile.x1)))
            y0, y1 = int(np.ceil(max(top, tile.y0))), int(np.ceil(min(bottom, tile.y1)))
            out[y0:y1, x0:x1] = found[y0 - tile.y0 : y1 - tile.y0, x0 - tile.x0 : x1 - tile.x0]
    return np.asarray(cv2.GaussianBlur(out, (0, 0), _SMOOTH_PX), np.float32)


def maxima(levels: Sequence[Level], maps: Sequence[Logits]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """All maxima of all levels: picture points (N, 2), sizes (N,), log odds (N,), refined below the pixel.

    A maximum is larger than its eight neighbours. It need not be larger than what lies around it in the next levels,
    as the paper has it: of two images one takes the finer and the other the coarser keypoint where both are nearly as
    sure, and neither is found again (ochota, every 2nd image: 20,439 matches with that rule, 22,164 without it). Only
    within _APART_PX does the surer one stay alone.
    """
    import cv2

    square, wide = np.ones((3, 3), np.uint8), np.ones((5, 5), np.uint8)
    square[1, 1] = 0
    found_points, found_sizes, found_logits = [], [], []
    for level, logits in zip(levels, maps, strict=True):
        peak = logits > cv2.dilate(logits, square)
        peak &= cv2.dilate(level.gray, wide).astype(np.int16) - cv2.erode(level.gray, wide) >= _LEAST_CONTRAST
        peak[:BORDER_PX], peak[-BORDER_PX:], peak[:, :BORDER_PX], peak[:, -BORDER_PX:] = False, False, False, False
        y, x = np.nonzero(peak)
        steps, values = refined(logits, x, y)
        points = level.to_picture(np.column_stack([x, y]) + steps)
        found_points.append(points)
        found_sizes.append(np.full(len(x), SIZE_PX / float(np.sqrt(level.scale.prod()))))
        found_logits.append(values)
    return np.concatenate(found_points), np.concatenate(found_sizes), np.concatenate(found_logits)


def refined(logits: Logits, x: IntArray, y: IntArray) -> tuple[FloatArray, FloatArray]:
    """Steps (N, 2), x and y, at most one pixel, from pixels (N,) to the tops of paraboloids, and log odds there (N,).

    The paraboloid is the least-squares one through 3 x 3 pixels: the log of a Gaussian is one, and so are the log odds
    of a low one. Where it has no top, the step is 0. Log odds are the pixel's own, and what the paraboloid rises by.
    """
    v = [[logits[y + dy, x + dx].astype(np.float64) for dx in (-1, 0, 1)] for dy in (-1, 0, 1)]
    columns, rows = [v[0][k] + v[1][k] + v[2][k] for k in range(3)], [sum(row) for row in v]
    slope_x, slope_y = (columns[2] - columns[0]) / 6.0, (rows[2] - rows[0]) / 6.0
    bend_x, bend_y = ((s[0] - 2.0 * s[1] + s[2]) / 3.0 for s in (columns, rows))
    twist = (v[2][2] - v[2][0] - v[0][2] + v[0][0]) / 4.0
    determinant = bend_x * bend_y - twist**2
    has_top = (bend_x < 0.0) & (determinant > 1e-12)
    safe = np.where(has_top, determinant, 1.0)
    steps = np.column_stack([twist * slope_y - bend_y * slope_x, twist * slope_x - bend_x * slope_y]) / safe[:, None]
    steps[~has_top] = 0.0
    steps = np.clip(steps, -1.0, 1.0)
    return steps, v[1][1] + 0.5 * (steps[:, 0] * slope_x + steps[:, 1] * slope_y)


def _shown(level: Level, seen: NDArray[np.float32] | None) -> BoolArray | None:
    """Which pixels (h, w) of a level lie within 2 of what the picture shows: where `seen` (H, W) is 1, not 0. None for
    all.

    No keypoint that stays depends on others: it lies farther inside than its size of SIZE_PX of its level, half as many
    pixels of the next coarser one, where its neighbours and their smoothing reach 5.
    """
    if seen is None:
        return None
    import cv2

    height, width = level.gray.shape
    touched = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA) > 0.0
    return np.asarray(cv2.dilate(touched.astype(np.uint8), np.ones((5, 5), np.uint8)), bool)


def _nearest(values: NDArray[Any], points_px: FloatArray) -> NDArray[Any]:
    """Values (N,) of a map at the pixels nearest to points (N, 2)."""
    columns, rows = np.rint(points_px).astype(np.int64).T
    return values[np.clip(rows, 0, values.shape[0] - 1), np.clip(columns, 0, values.shape[1] - 1)]


def inside_shown(valid: BoolArray | None, points_px: FloatArray, sizes_px: FloatArray) -> BoolArray:
    """Which keypoints (N,) lie farther than their size inside what the picture shows: a mask's edge is no texture.

    Their patches, of more than three sizes to either side, may reach over it.
    """
    if valid is None or bool(valid.all()):
        return np.ones(len(points_px), bool)
    import cv2

    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(_nearest(distance, points_px) > 1.0 + sizes_px)


def _apart(points_px: FloatArray, most: int) -> IntArray:
    """Rows of the first `most` points (N, 2) without one before them, itself kept, within _APART_PX."""
    from scipy.spatial import cKDTree

    pairs = np.sort(cKDTree(points_px).query_pairs(_APART_PX, output_type="ndarray"), axis=1)
    pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
    keep = np.ones(len(points_px), bool)
    # Of chains, too, what is kept never depends on what was left out.
    undecided = pairs
    while len(undecided):
        first = np.setdiff1d(undecided[:, 0], undecided[:, 1])
        keep[undecided[np.isin(undecided[:, 0], first), 1]] = False
        undecided = undecided[keep[undecided].all(axis=1) & ~np.isin(undecided[:, 0], first)]
    return np.flatnonzero(keep)[:most]
