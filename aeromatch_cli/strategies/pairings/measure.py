"""Overlap share and view angle of image pairs from their footprints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Block, FloatArray, IntArray, Pair
from aeromatch_cli.geometry.footprints import Footprint, view_angles_deg

# Pairs intersected at once: bounds the memory of a large block.
_CHUNK = 100_000


def footprint_polygons(footprints: Mapping[str, Footprint]) -> NDArray[Any]:
    """Valid shapely polygons (N,) of footprints, in their order.

    A lens can bend the border so that the polygon crosses itself; the crossing is resolved, no area is lost.
    """
    import shapely

    rings = [shapely.polygons(footprint.polygon_m) for footprint in footprints.values()]
    polygons = np.array(rings, dtype=object)
    invalid = ~shapely.is_valid(polygons)
    polygons[invalid] = shapely.make_valid(polygons[invalid])
    return polygons


def measure_overlaps(
    polygons: NDArray[Any], centers_m: FloatArray, ground_z_m: FloatArray, pairs_idx: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Overlap shares (P,) and view angles in degrees (P,) of pairs (P, 2) of footprints.

    polygons (N,): shapely polygons; centers_m (N, 3): projection centres; ground_z_m (N,): height of each footprint.
    Share: common area over the smaller footprint. Angle: between both rays to the centroid of the common area at the
    mean height of both planes; NaN where nothing is shared.
    """
    import shapely

    areas = shapely.area(polygons)
    shares, angles = np.zeros(len(pairs_idx)), np.full(len(pairs_idx), np.nan)
    for start in range(0, len(pairs_idx), _CHUNK):
        first, second = pairs_idx[start : start + _CHUNK].T
        common = shapely.intersection(polygons[first], polygons[second])
        common_areas = shapely.area(common)
        shares[start : start + _CHUNK] = common_areas / np.maximum(np.minimum(areas[first], areas[second]), 1e-12)
        hit = np.flatnonzero(common_areas > 0.0)
        middles = shapely.centroid(common[hit])
        heights = 0.5 * (ground_z_m[first[hit]] + ground_z_m[second[hit]])
        points = np.stack([shapely.get_x(middles), shapely.get_y(middles), heights], axis=1)
        angles[start + hit] = view_angles_deg(centers_m[first[hit]], centers_m[second[hit]], points)
    return np.minimum(shares, 1.0), angles


def measured_pairs(
    block: Block, reasons: Mapping[tuple[str, str], str], footprints: Mapping[str, Footprint]
) -> list[Pair]:
    """Pairs, sorted, of a mapping (image_id0, image_id1) -> reason, measured where both images have a footprint."""
    row = {image_id: idx for idx, image_id in enumerate(footprints)}
    keys = sorted(reasons)
    known = [key for key in keys if key[0] in row and key[1] in row]
    values: dict[tuple[str, str], tuple[float, float]] = {}
    if known:
        centers = np.array([block.poses[image_id].center_m for image_id in footprints])
        heights = np.array([footprint.ground_z_m for footprint in footprints.values()])
        pairs_idx = np.array([(row[id0], row[id1]) for id0, id1 in known], dtype=np.int64)
        shares, angles = measure_overlaps(footprint_polygons(footprints), centers, heights, pairs_idx)
        values = dict(zip(known, zip(shares.tolist(), angles.tolist(), strict=True), strict=True))
    return [Pair(*key, *values.get(key, (float("nan"), float("nan"))), reasons[key]) for key in keys]


def ordered(image_id0: str, image_id1: str) -> tuple[str, str]:
    """Both ids in the order that pairs are stored in."""
    return (image_id0, image_id1) if image_id0 < image_id1 else (image_id1, image_id0)
