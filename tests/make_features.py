"""Features of the right shapes and types, for tests that store or match them."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import Features


def random_features(count: int, *, seed: int = 0, side_px: int = 5472) -> Features:
    """Features with `count` keypoints, one descriptor each, spread over a large image."""
    rng = np.random.default_rng(seed)
    points = (rng.random((count, 2)) * side_px).astype(np.float32)
    sizes = rng.uniform(2, 40, count).astype(np.float32)
    return Features(
        keypoints_px=points,
        sizes_px=sizes,
        responses=rng.random(count).astype(np.float32),
        descriptors=rng.integers(0, 256, (count, 128), dtype=np.uint8),
        descriptor_keypoint_idx=np.arange(count, dtype=np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=points.copy(),
        view_size_px=sizes.copy(),
        view_orientation_deg=rng.uniform(-180, 180, count).astype(np.float32),
        view_sizes_px=np.array([[side_px, side_px]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )


def described(points_px: np.ndarray, descriptors: np.ndarray, size_px: float = 8.0) -> Features:
    """Features of one view of 1000 x 750 pixels, one descriptor per keypoint, all of a size."""
    count = len(points_px)
    return Features(
        keypoints_px=points_px.astype(np.float32),
        sizes_px=np.full(count, size_px, np.float32),
        responses=np.ones(count, np.float32),
        descriptors=descriptors,
        descriptor_keypoint_idx=np.arange(count, dtype=np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=points_px.astype(np.float32),
        view_size_px=np.full(count, size_px, np.float32),
        view_orientation_deg=np.zeros(count, np.float32),
        view_sizes_px=np.array([[1000, 750]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )
