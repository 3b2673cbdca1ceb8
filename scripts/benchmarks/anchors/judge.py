"""How far a model that matches support is from the truth of a pair."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.frames import apply_homography

_PLANE_PX, _LINES_PX, _CONFIDENCE, _ITERATIONS = 3.0, 1.0, 0.9999, 10_000
_FEWEST = 8


def error_px(
    points0: FloatArray, points1: FloatArray, places0: FloatArray, places1: FloatArray, *, planar: bool
) -> tuple[float, int]:
    """Mean distance of places (N, 2) from where a model of the matches (M, 2) puts them, infinite without a model, and
    the number of matches that it explains."""
    import cv2

    if len(points0) < _FEWEST:
        return float("inf"), 0
    robust = (cv2.USAC_MAGSAC, _PLANE_PX if planar else _LINES_PX)
    try:
        if planar:
            model, mask = cv2.findHomography(points0, points1, *robust, maxIters=_ITERATIONS, confidence=_CONFIDENCE)
        else:
            model, mask = cv2.findFundamentalMat(points0, points1, *robust, _CONFIDENCE, _ITERATIONS)
    except cv2.error:  # OpenCV asserts where no sample gives a model
        return float("inf"), 0
    if model is None or model.shape != (3, 3):
        return float("inf"), 0
    if planar:
        off = np.linalg.norm(apply_homography(model, places0) - places1, axis=1)
    else:
        lines = np.column_stack([places0, np.ones(len(places0))]) @ model.T
        there = np.column_stack([places1, np.ones(len(places1))])
        off = np.abs((lines * there).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    return float(np.mean(off)) if np.isfinite(off).all() else float("inf"), int(mask.sum())
