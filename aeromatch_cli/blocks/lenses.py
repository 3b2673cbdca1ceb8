"""Lens models of other programs with more terms than OPENCV has: the camera that comes nearest over the picture.

Brown's model with any number of radial terms and a skew (Metashape: k1 to k4, b1, b2; BlocksExchange and Pix4D: three
radial terms; COLMAP: FULL_OPENCV, whose last three terms divide, and OPENCV_FISHEYE).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import from_colmap, parameters, project

# Pixels of rays (N, 2), both of normalised coordinates (N, 2): x right, y down, corner origin.
Forward = Callable[[FloatArray], FloatArray]
# A picture's grid of pixels on which cameras are compared, border included.
_COLUMNS, _ROWS = 25, 19
_STEPS = 100
_SOLVED_PX = 1e-3
# A camera that is off by more (root mean square, as a share of the picture's width) is none.
_LARGEST_MISFIT = 0.003
# A camera that is off by more anywhere is worth a word.
_SAID_PX = 0.5


@dataclass(frozen=True)
class Nearest:
    """camera: OPENCV, None where none comes near. misfit_px: root mean square of its distances over the picture.
    worst_px: the largest.
    """

    camera: Camera | None
    misfit_px: float = 0.0
    worst_px: float = 0.0

    def remark(self, what: str) -> str:
        """For a person, "" where there is nothing to say. what: names the camera."""
        if self.camera is None:
            return f"{what}: no OPENCV camera comes near its lens model: it is not used"
        if self.worst_px > _SAID_PX:
            return (
                f"{what}: its lens model is read as OPENCV's nearest one, {self.misfit_px:.1f} px off over the picture "
                f"and {self.worst_px:.1f} px at most"
            )
        return ""


def brown(
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    middle_px: tuple[float, float],
    radial: Sequence[float],
    tangential: tuple[float, float] = (0.0, 0.0),
    skew_px: float = 0.0,
    dividing: Sequence[float] = (),
) -> Nearest:
    """Brown's model: x = u (1 + k1 r^2 + k2 r^4 + ...) + 2 p1 u v + p2 (r^2 + 2 u^2), and so on, as in OpenCV.

    size_px: width, height. middle_px: corner origin. tangential: OpenCV's p1, p2. skew_px: pixels to the right for each
    unit downwards. dividing: terms of the radial factor's denominator.
    """
    if not any(radial[2:]) and not skew_px and not any(dividing):
        lens = [*radial, 0.0, 0.0][:2]
        return Nearest(from_colmap("OPENCV", *size_px, (*focal_px, *middle_px, *lens, *tangential)))
    p1, p2 = tangential

    def forward(rays: FloatArray) -> FloatArray:
        u, v = rays.T
        r2 = u * u + v * v
        factor = (1.0 + _series(r2, radial)) / (1.0 + _series(r2, dividing))
        x = u * factor + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
        y = v * factor + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
        return np.column_stack([focal_px[0] * x + skew_px * y + middle_px[0], focal_px[1] * y + middle_px[1]])

    return nearest(size_px, (*focal_px, *middle_px, radial[0], 0.0, p1, p2), forward)


def fisheye(
    size_px: tuple[int, int], focal_px: tuple[float, float], middle_px: tuple[float, float], terms: Sequence[float]
) -> Nearest:
    """OpenCV's fisheye model: the angle from the axis, times 1 + k1 angle^2 + ..., is the radius."""

    def forward(rays: FloatArray) -> FloatArray:
        radius = np.linalg.norm(rays, axis=1)
        angle = np.arctan(radius)
        factor = angle * (1.0 + _series(angle**2, terms)) / np.maximum(radius, 1e-12)
        return rays * factor[:, None] * focal_px + middle_px

    return nearest(size_px, (*focal_px, *middle_px, terms[0] - 1.0 / 3.0, 0.0, 0.0, 0.0), forward)


def of_colmap(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> Nearest:
    """A camera of COLMAP's models. Raises ValueError for one that is not known here and for a wrong count."""
    if model == "FULL_OPENCV" and len(params) == 12:
        fx, fy, cx, cy, k1, k2, p1, p2, k3, *dividing = params
        return brown((width_px, height_px), (fx, fy), (cx, cy), (k1, k2, k3), (p1, p2), dividing=dividing)
    if model == "OPENCV_FISHEYE" and len(params) == 8:
        fx, fy, cx, cy, *terms = params
        return fisheye((width_px, height_px), (fx, fy), (cx, cy), terms)
    return Nearest(from_colmap(model, width_px, height_px, params))


def nearest(size_px: tuple[int, int], start: tuple[float, ...], forward: Forward) -> Nearest:
    """The OPENCV camera whose pixels come nearest those of `forward` by least squares over the picture.

    start: OPENCV's parameters to begin with, corner origin.
    """
    from scipy.optimize import least_squares

    width, height = size_px
    grid = np.meshgrid(np.linspace(0.0, width, _COLUMNS), np.linspace(0.0, height, _ROWS))
    wanted = np.column_stack([axis.ravel() for axis in grid])
    rays = _rays(wanted, np.array(start[:2]), np.array(start[2:4]), forward)
    if rays is None:
        return Nearest(None, math.inf, math.inf)
    # Pixels of unit size, so that all parameters are of one order.
    longer = float(max(width, height))
    scale = np.array([longer] * 4 + [1.0] * 4)

    def misfit(scaled: FloatArray) -> FloatArray:
        return (_pixels(size_px, scaled * scale, rays) - wanted).ravel()

    found = least_squares(misfit, np.array(start) / scale, x_scale="jac").x * scale
    off = np.linalg.norm(_pixels(size_px, found, rays) - wanted, axis=1)
    whole, worst = float(np.sqrt(np.mean(off**2))), float(off.max())
    if not whole < _LARGEST_MISFIT * width or found[0] <= 0.0:
        return Nearest(None, whole, worst)
    camera = from_colmap("OPENCV", width, height, tuple(float(value) for value in found))
    points = np.column_stack([rays, np.ones(len(rays))])
    folds = np.isnan(project(camera, np.eye(3), np.zeros(3), points)).any()
    return Nearest(None if folds else camera, whole, worst)


def _rays(wanted: FloatArray, focal: FloatArray, middle: FloatArray, forward: Forward) -> FloatArray | None:
    """Normalised coordinates (N, 2) of pixels (N, 2), by Newton's method with slopes from differences."""
    rays = (wanted - middle) / focal
    step = 1e-6
    for _ in range(_STEPS):
        off = forward(rays) - wanted
        if np.abs(off).max() < _SOLVED_PX:
            return rays
        columns = [(forward(rays + step * axis) - wanted - off) / step for axis in np.eye(2)]
        slope = np.stack(columns, axis=2)
        if not np.isfinite(slope).all() or (np.abs(np.linalg.det(slope)) < 1e-9).any():
            return None
        rays = rays - np.linalg.solve(slope, off[:, :, None])[:, :, 0]
    return None


def _pixels(size_px: tuple[int, int], params: FloatArray, rays: FloatArray) -> FloatArray:
    """Corner-origin pixels (N, 2) of rays (N, 2) by OPENCV's parameters."""
    p = parameters(Camera("OPENCV", *size_px, tuple(float(value) for value in params)))
    u, v = rays.T
    r2 = u * u + v * v
    radial = 1.0 + r2 * (p["k1"] + r2 * p["k2"])
    x = u * radial + 2.0 * p["p1"] * u * v + p["p2"] * (r2 + 2.0 * u * u)
    y = v * radial + p["p1"] * (r2 + 2.0 * v * v) + 2.0 * p["p2"] * u * v
    return np.column_stack([p["fx"] * x + p["cx"], p["fy"] * y + p["cy"]])


def _series(square: FloatArray, terms: Sequence[float]) -> FloatArray:
    total = np.zeros_like(square)
    for term in reversed(terms):
        total = (total + term) * square
    return total
