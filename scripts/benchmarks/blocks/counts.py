"""Verified matches of a COLMAP database, against reference poses."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.evaluate.metrics import GRID_CELLS, thin
from aeromatch_cli.evaluate.reference import load_reference
from aeromatch_cli.evaluate.scores import CORRECT_PX, WITHIN_PX
from benchmarks.peers.base import MIN_INLIERS

MAX_IMAGE_ID = 2147483647  # COLMAP's pair_id = id1 * MAX_IMAGE_ID + id2
NamePair = tuple[str, str]


def count_matches(database: Path, reference: Path, only: Collection[NamePair] | None = None) -> dict[str, Any]:
    """Sums over the pairs with at least 15 verified matches; only: those of these image names, sorted within a pair.

    matches: rows. unique_matches: each pair of places once (COLMAP counts a place with two orientations twice).
    within_3px, within_5px: unique ones by symmetric epipolar distance from the reference poses, on undistorted pixels.
    thinned*: of the unique ones, those left one-to-one at 2 px spacing in both images, as in every other table.
    filled_cells: share of the 16 x 16 cells of all images that hold one within 3 px.
    """
    truth = load_reference(reference)
    sums = dict.fromkeys(
        ("pairs", "matches", "unique_matches", "within_3px", "within_5px", "thinned", "thinned_3px", "thinned_5px"), 0
    )
    filled = {name: np.zeros((GRID_CELLS, GRID_CELLS), bool) for name in truth.cameras}
    with sqlite3.connect(database) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        points_px = {image_id: _stored_px(*rest) for image_id, *rest in connection.execute(_KEYPOINTS)}
        query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows >= ?"
        for pair_id, rows, data in connection.execute(query, (MIN_INLIERS,)):
            id0, id1 = divmod(pair_id, MAX_IMAGE_ID)
            pair = names[id0], names[id1]
            if only is not None and tuple(sorted(pair)) not in only:
                continue
            idx = np.frombuffer(data, np.uint32).reshape(rows, 2)
            sides = points_px[id0][idx[:, 0]], points_px[id1][idx[:, 1]]
            places = np.unique(np.hstack(sides), axis=0)
            errors_px = np.nan_to_num(truth.errors(*pair, places[:, :2], places[:, 2:]), nan=np.inf)
            for name, side in zip(pair, (places[:, :2], places[:, 2:]), strict=True):
                camera = truth.cameras[name]
                cells = (side[errors_px <= CORRECT_PX] + 0.5) / [camera.width_px, camera.height_px] * GRID_CELLS
                filled[name][tuple(np.clip(cells.astype(int), 0, GRID_CELLS - 1).T)] = True
            kept = errors_px[thin(places[:, :2], places[:, 2:], np.zeros(len(places)))]
            found = (1, rows, len(places), *_within(errors_px), len(kept), *_within(kept))
            sums = {key: total + value for (key, total), value in zip(sums.items(), found, strict=True)}
    counts = [len(places_px) for places_px in points_px.values()]
    shares = [filled[name].mean() for name in names.values()]
    return sums | {
        "keypoints_mean": float(np.mean(counts)), "keypoints_max": max(counts), "filled_cells": float(np.mean(shares)),
    }  # fmt: skip


_KEYPOINTS = "SELECT image_id, rows, cols, data FROM keypoints"


def _stored_px(rows: int, columns: int, data: bytes | None) -> FloatArray:
    """Places (K, 2) of COLMAP's keypoints; its origin is the corner."""
    return np.frombuffer(data or b"", np.float32).reshape(rows, columns)[:, :2].astype(np.float64) - 0.5


def _within(errors_px: FloatArray) -> tuple[int, int]:
    return int((errors_px <= CORRECT_PX).sum()), int((errors_px <= WITHIN_PX).sum())
