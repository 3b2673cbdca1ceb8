"""Every frame and unit of the project, stated once, and the 3x3 / 4x4 bookkeeping between them.

World   a projected CRS in metres minus a rounded, recorded origin; float64; x east, y north, z up. Without positions a
        frame of the pictures' own: z up, x and y anyhow, and units of arbitrary length (`Block.metric`).
Camera  x right, y down, z forward. Poses are `cam_from_world`: x_cam = R x_world + t, centre C = -R^T t.
Photo   the photogrammetric camera: x right, y up, z back (Kraus; Luhmann et al., Close-Range Photogrammetry).
Pixel   (x, y); (0, 0) is the centre of the top-left pixel of the stored raster. EXIF Orientation changes nothing.
        COLMAP's origin is the corner of that pixel: a COLMAP coordinate is ours + 0.5. Example: the centre of a
        4 px wide image is x = 1.5 here and 2.0 in COLMAP.
Resize  shrinking by s maps x to (x + 0.5) s - 0.5, never x s.

Names carry the frame so that they cancel: `a_from_c = a_from_b @ b_from_c`.
"""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray

COLMAP_OFFSET_PX = 0.5

# Photogrammetric axes (x right, y up, z back) to computer-vision axes (x right, y down, z forward), and back.
CAM_FROM_PHOTO = np.diag([1.0, -1.0, -1.0])


def length_words(length: float, digits: int = 1, *, metric: bool) -> str:
    """A length with its unit: metres, but in a frame of arbitrary scale units of that."""
    return f"{length:,.{digits}f} {'m' if metric else 'units'}"


def resize_matrix(scale: float) -> FloatArray:
    """(3, 3) homography small_from_large of a shrink by `scale` in the pixel-centre convention."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])


def apply_homography(homography: FloatArray, points_px: FloatArray) -> FloatArray:
    """Points (N, 2) through a (3, 3) homography; points on or behind the horizon line become NaN.

    The sign is judged by the third homogeneous coordinate, so `homography` must be scaled such that visible points
    have it positive (all homographies made in this package are).
    """
    points = np.asarray(points_px, dtype=np.float64)
    homogeneous = points @ homography[:, :2].T + homography[:, 2]
    w = homogeneous[:, 2]
    safe = np.where(w > 1e-12, w, np.nan)
    return homogeneous[:, :2] / safe[:, None]


def homography_jacobians(homography: FloatArray, points_px: FloatArray, there_px: FloatArray) -> FloatArray:
    """(N, 2, 2): how the images there_px (N, 2) of points (N, 2) under a (3, 3) homography move with the points."""
    depth = points_px @ homography[2, :2] + homography[2, 2]
    return np.asarray((homography[:2, :2] - there_px[:, :, None] * homography[2, :2]) / depth[:, None, None])


def closest_similarity(points0: FloatArray, points1: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """(3, 3) similarity that takes points (N, 2), two different ones at least, to others by least squares.

    weights: (N,), by default equal. Source: Umeyama, IEEE TPAMI 13(4), 1991, in the plane without mirroring.
    """
    middles = [np.average(points, axis=0, weights=weights) for points in (points0, points1)]
    first, second = ((points - m) @ np.array([1.0, 1j]) for points, m in zip((points0, points1), middles, strict=True))
    own = first if weights is None else first * weights
    factor = complex(np.vdot(own, second) / np.vdot(own, first))
    linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    shift = middles[1] - linear @ middles[0]
    return np.vstack([np.column_stack([linear, shift]), [0.0, 0.0, 1.0]])
