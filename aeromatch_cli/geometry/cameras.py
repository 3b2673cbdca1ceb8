"""Lens models: rays to pixels and back.

Normalised coordinates (u, v) are camera x/z, y/z. *Undistorted pixels* are K (u, v, 1): the image that a
distortion-free camera of the same focal length, principal point and affinity would take. Two-view estimation works on
them.

The block's own model is BROWN, the full model of Brown (1971) that photogrammetric programs calibrate:

    r2 = u^2 + v^2
    xd = u (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 u v + p2 (r2 + 2 u^2)
    yd = v (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 v^2) + 2 p2 u v
    x  = cx + (f + b1) xd + b2 yd
    y  = cy + f yd

p1 and p2 are in OpenCV's and COLMAP's order; b1, b2 are Metashape's affinity and skew in pixels. The other names are
COLMAP's (src/colmap/sensor/models.h; Schoenberger and Frahm, CVPR 2016) and are special cases of BROWN, but for
OPENCV_FISHEYE, where the angle t from the optical axis, times 1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8, is the distance
from the axis (Kannala and Brandt, IEEE TPAMI 28(8), 2006). docs/cameras.md has the parameters of other programs.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX

BROWN = "BROWN"
FISHEYE = "OPENCV_FISHEYE"
# COLMAP's model with k3; its last three terms divide, which no model here does.
FULL_OPENCV = "FULL_OPENCV"
FULL_OPENCV_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Model name -> parameter names, in COLMAP's order where COLMAP has the model.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    BROWN: ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2"),
    FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

_MAX_ITERATIONS = 50
# The inverse of a squared radius beyond everything that a camera sees.
_LEAST_ROOT = 1e-12


def parameters(camera: Camera) -> dict[str, float]:
    """Every parameter by name; fx, fy, skew, cx, cy, k1 to k4, p1, p2 are present whatever the model.

    skew: pixels to the right for each unit of yd (b2 of BROWN). k4 is of OPENCV_FISHEYE alone.
    """
    named = dict(zip(MODELS[camera.model], camera.params, strict=True))
    f = named.pop("f", 0.0)
    named = {"fx": f + named.pop("b1", 0.0), "fy": f, "skew": named.pop("b2", 0.0)} | named
    return dict.fromkeys(_DISTORTION, 0.0) | named


def as_brown(camera: Camera) -> Camera:
    """The same camera as BROWN. Raises ValueError for a fisheye lens, which BROWN does not describe."""
    if is_fisheye(camera):
        raise ValueError(f"{FISHEYE} is no special case of {BROWN}")
    return brown_camera((camera.width_px, camera.height_px), parameters(camera))


def brown_camera(size_px: tuple[int, int], values: Mapping[str, float]) -> Camera:
    """BROWN of fx, fy, cx, cy and, where they are not zero, skew, k1 to k3, p1, p2. size_px: width, height."""
    f = values["fy"]
    named = {**values, "f": f, "b1": values["fx"] - f, "b2": values.get("skew", 0.0)}
    return Camera(BROWN, *size_px, tuple(named.get(name, 0.0) for name in MODELS[BROWN]))


def is_fisheye(camera: Camera) -> bool:
    return camera.model == FISHEYE


def focal_px(camera: Camera) -> float:
    """Mean focal length in pixels: the scale at which thresholds in px become angles."""
    p = parameters(camera)
    return (p["fx"] + p["fy"]) / 2.0


def calibration_matrix(camera: Camera) -> FloatArray:
    """(3, 3) K: undistorted pixel ~ K (u, v, 1)."""
    p = parameters(camera)
    return np.array([[p["fx"], p["skew"], p["cx"]], [0.0, p["fy"], p["cy"]], [0.0, 0.0, 1.0]])


def has_distortion(camera: Camera) -> bool:
    p = parameters(camera)
    return is_fisheye(camera) or any(p[key] != 0.0 for key in _DISTORTION)


def _normalised(p: dict[str, float], points_px: FloatArray) -> FloatArray:
    """(xd, yd) (N, 2) of pixels (N, 2): through the inverse of K."""
    v = (points_px[:, 1] - p["cy"]) / p["fy"]
    return np.stack([(points_px[:, 0] - p["cx"] - p["skew"] * v) / p["fx"], v], axis=1)


def _pixels(p: dict[str, float], uv: FloatArray) -> FloatArray:
    """Pixels (N, 2) of (xd, yd) (N, 2): through K."""
    u, v = uv[:, 0], uv[:, 1]
    return np.stack([p["fx"] * u + p["skew"] * v + p["cx"], p["fy"] * v + p["cy"]], axis=1)


def _distort_normalised(p: dict[str, float], uv: FloatArray) -> FloatArray:
    u, v = uv[:, 0], uv[:, 1]
    r2 = u * u + v * v
    radial = 1.0 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * p["k3"]))
    du = 2.0 * p["p1"] * u * v + p["p2"] * (r2 + 2.0 * u * u)
    dv = p["p1"] * (r2 + 2.0 * v * v) + 2.0 * p["p2"] * u * v
    return np.stack([u * radial + du, v * radial + dv], axis=1)


# A block has few lenses, and asks for each again and again.
@lru_cache(maxsize=4096)
def _smallest_root(coefficients: tuple[float, ...]) -> float:
    """The smallest s > 0 where 1 + c1 s + c2 s^2 + ... is zero, inf where there is none.

    As one over the largest root of s^n + c1 s^(n-1) + ..., whose leading coefficient is never near zero.
    """
    roots = np.roots([1.0, *coefficients])
    largest = float(roots.real[np.abs(roots.imag) <= 1e-9 * np.abs(roots.real)].max(initial=0.0))
    return 1.0 / largest if largest > _LEAST_ROOT else float("inf")


def _largest_radius(p: dict[str, float]) -> float:
    """Normalised radius up to which the radial model is one-to-one: the first root of d(r (1 + k1 r2 + ...))/dr."""
    return float(np.sqrt(_smallest_root((3.0 * p["k1"], 5.0 * p["k2"], 7.0 * p["k3"]))))


def _fisheye_radius(p: dict[str, float], angle: FloatArray) -> FloatArray:
    square = angle * angle
    terms = (p["k4"], p["k3"], p["k2"], p["k1"])
    factor = np.zeros_like(square)
    for term in terms:
        factor = (factor + term) * square
    return angle * (1.0 + factor)


def _fisheye_slope(p: dict[str, float], angle: FloatArray) -> FloatArray:
    square = angle * angle
    return 1.0 + square * (3.0 * p["k1"] + square * (5.0 * p["k2"] + square * (7.0 * p["k3"] + square * 9.0 * p["k4"])))


def _largest_angle(p: dict[str, float]) -> float:
    """The angle from the axis up to which a fisheye model is one-to-one, at most a right angle."""
    first = _smallest_root((3.0 * p["k1"], 5.0 * p["k2"], 7.0 * p["k3"], 9.0 * p["k4"]))
    return min(float(np.sqrt(first)), np.pi / 2.0)


def _scaled_to(uv: FloatArray, radius: FloatArray, wanted: FloatArray) -> FloatArray:
    """uv (N, 2), whose distances from the axis are radius (N,), moved along their directions to those wanted."""
    return np.asarray(uv * np.where(radius > 0.0, wanted / np.where(radius > 0.0, radius, 1.0), 1.0)[:, None])


def distort(camera: Camera, undistorted_px: FloatArray) -> FloatArray:
    """Stored pixels (N, 2) of undistorted pixels (N, 2); NaN where the lens model folds back on itself."""
    points = np.asarray(undistorted_px, dtype=np.float64)
    if not has_distortion(camera):
        return points.copy()
    p = parameters(camera)
    uv = _normalised(p, points)
    radius = np.hypot(uv[:, 0], uv[:, 1])
    if is_fisheye(camera):
        angle = np.arctan(radius)
        distorted = _pixels(p, _scaled_to(uv, radius, _fisheye_radius(p, angle)))
        distorted[angle > _largest_angle(p)] = np.nan
        return distorted
    distorted = _pixels(p, _distort_normalised(p, uv))
    distorted[radius > _largest_radius(p)] = np.nan
    return distorted


def undistort(camera: Camera, points_px: FloatArray) -> FloatArray:
    """Undistorted pixels (N, 2) of stored pixels (N, 2), by Newton's method; NaN where no ray has that pixel.

    Accurate to 1e-9 px on the image and a margin around it (tested by round trip). A fisheye's rays at a right angle
    from the axis and beyond have no undistorted pixel.
    """
    points = np.asarray(points_px, dtype=np.float64)
    if not has_distortion(camera):
        return points.copy()
    p = parameters(camera)
    target = _normalised(p, points)
    return _pixels(p, _from_fisheye(p, target) if is_fisheye(camera) else _from_brown(p, target))


def _from_brown(p: dict[str, float], target: FloatArray) -> FloatArray:
    uv = target.copy()
    for _ in range(_MAX_ITERATIONS):
        residual = _distort_normalised(p, uv) - target
        step = _solve_2x2(_distortion_jacobian(p, uv), residual)
        uv = uv - step
        if not np.fmax.reduce(np.abs(step), axis=None, initial=0.0) > 1e-13:
            break
    bad = (np.abs(_distort_normalised(p, uv) - target) > 1e-9).any(axis=1)
    bad |= np.hypot(uv[:, 0], uv[:, 1]) > _largest_radius(p)
    uv[bad] = np.nan
    return uv


def _from_fisheye(p: dict[str, float], target: FloatArray) -> FloatArray:
    radius = np.hypot(target[:, 0], target[:, 1])
    most = _largest_angle(p)
    low, high = np.zeros_like(radius), np.full_like(radius, most)
    angle = np.minimum(radius, most)
    for _ in range(_MAX_ITERATIONS):
        off = _fisheye_radius(p, angle) - radius
        low, high = np.where(off < 0.0, angle, low), np.where(off > 0.0, angle, high)
        newton = angle - off / np.maximum(_fisheye_slope(p, angle), 1e-6)
        # A step that leaves the interval which holds the angle halves it instead.
        best = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        step, angle = best - angle, best
        if not np.fmax.reduce(np.abs(step), initial=0.0) > 1e-13:
            break
    bad = ~(np.abs(_fisheye_radius(p, angle) - radius) < 1e-9) | (angle >= np.pi / 2.0 - 1e-6)
    uv = _scaled_to(target, radius, np.tan(np.where(bad, 0.0, angle)))
    uv[bad] = np.nan
    return uv


def _distortion_jacobian(p: dict[str, float], uv: FloatArray) -> FloatArray:
    u, v = uv[:, 0], uv[:, 1]
    r2 = u * u + v * v
    radial = 1.0 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * p["k3"]))
    slope = 2.0 * (p["k1"] + r2 * (2.0 * p["k2"] + 3.0 * r2 * p["k3"]))
    jacobian = np.empty((len(uv), 2, 2))
    jacobian[:, 0, 0] = radial + slope * u * u + 2.0 * p["p1"] * v + 6.0 * p["p2"] * u
    jacobian[:, 0, 1] = slope * u * v + 2.0 * p["p1"] * u + 2.0 * p["p2"] * v
    jacobian[:, 1, 0] = jacobian[:, 0, 1]
    jacobian[:, 1, 1] = radial + slope * v * v + 6.0 * p["p1"] * v + 2.0 * p["p2"] * u
    return jacobian


def _solve_2x2(a: FloatArray, b: FloatArray) -> FloatArray:
    determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    determinant = np.where(np.abs(determinant) > 1e-12, determinant, np.nan)
    x = (a[:, 1, 1] * b[:, 0] - a[:, 0, 1] * b[:, 1]) / determinant
    y = (a[:, 0, 0] * b[:, 1] - a[:, 1, 0] * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def normalise(camera: Camera, points_px: FloatArray) -> FloatArray:
    """Normalised coordinates (N, 2) of stored pixels (N, 2)."""
    return _normalised(parameters(camera), undistort(camera, points_px))


def pixels_of_rays(camera: Camera, rays: FloatArray) -> FloatArray:
    """Stored pixels (N, 2) of normalised coordinates (N, 2) by the formula alone, beyond where it folds back too."""
    p = parameters(camera)
    if is_fisheye(camera):
        radius = np.hypot(rays[:, 0], rays[:, 1])
        return _pixels(p, _scaled_to(rays, radius, _fisheye_radius(p, np.arctan(radius))))
    return _pixels(p, _distort_normalised(p, rays))


def project(camera: Camera, world_rotation: FloatArray, center_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Stored pixels (N, 2) of world points (N, 3); NaN behind the camera or outside the lens model."""
    return distort(camera, undistorted_places(camera, world_rotation, center_m, points_m)[0])


def undistorted_places(
    camera: Camera, world_rotation: FloatArray, center_m: FloatArray, points_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Undistorted pixels (N, 2) of world points (N, 3), metres, and their depths (N,) along the axis, metres.

    world_rotation: (3, 3), world to camera. Pixels are NaN where the depth is not positive.
    """
    rays = (np.asarray(points_m, dtype=np.float64) - center_m) @ np.asarray(world_rotation).T
    depth = np.where(rays[:, 2] > 1e-9, rays[:, 2], np.nan)
    return _pixels(parameters(camera), rays[:, :2] / depth[:, None]), rays[:, 2]


def world_rays(camera: Camera, world_rotation: FloatArray, points_px: FloatArray) -> FloatArray:
    """Unit directions (N, 3) in the world of stored pixels (N, 2)."""
    uv = normalise(camera, points_px)
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.asarray(world_rotation)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def from_colmap(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> Camera:
    """Camera of COLMAP parameters (corner origin), FULL_OPENCV without dividing terms as BROWN.

    Raises ValueError on an unknown model, a wrong count, and FULL_OPENCV with k4, k5 or k6 (see lenses.of_colmap).
    """
    names = FULL_OPENCV_NAMES if model == FULL_OPENCV else MODELS.get(model)
    if names is None:
        known = ", ".join((*MODELS, FULL_OPENCV))
        raise ValueError(f"camera model {model!r} is not supported; use one of {known}")
    if len(params) != len(names):
        raise ValueError(f"camera model {model} has the {len(names)} parameters {', '.join(names)}, got {len(params)}")
    shifted = tuple(v - COLMAP_OFFSET_PX if n in ("cx", "cy") else v for n, v in zip(names, params, strict=True))
    if model != FULL_OPENCV:
        return Camera(model, width_px, height_px, shifted)
    if any(params[9:]):
        raise ValueError(f"{BROWN} has no place for the terms k4, k5, k6 of {FULL_OPENCV}, which divide")
    return brown_camera((width_px, height_px), dict(zip(names, shifted, strict=True)))


def corner_params(camera: Camera) -> tuple[float, ...]:
    """Parameters of the camera's own model with the corner of the first pixel as origin: of a camera file."""
    names = MODELS[camera.model]
    return tuple(v + COLMAP_OFFSET_PX if n in ("cx", "cy") else v for n, v in zip(names, camera.params, strict=True))


def colmap_camera(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model and parameters (corner origin). BROWN becomes OPENCV, or FULL_OPENCV where it has k3.

    COLMAP has no place for b2, which is left out: lenses.nearest_of finds the camera without it that comes nearest.
    """
    if camera.model != BROWN:
        return camera.model, corner_params(camera)
    named = parameters(camera) | {"k4": 0.0, "k5": 0.0, "k6": 0.0}
    named |= {"cx": named["cx"] + COLMAP_OFFSET_PX, "cy": named["cy"] + COLMAP_OFFSET_PX}
    model, names = (FULL_OPENCV, FULL_OPENCV_NAMES) if named["k3"] else ("OPENCV", MODELS["OPENCV"])
    return model, tuple(named[name] for name in names)


def poselib_camera(camera: Camera) -> dict[str, Any]:
    """The camera of undistorted pixels in PoseLib's words, which know no skew: of pixels by without_skew."""
    p = parameters(camera)
    size = {"width": camera.width_px, "height": camera.height_px}
    return {"model": "PINHOLE", "params": [p["fx"], p["fy"], p["cx"], p["cy"]], **size}


def without_skew(camera: Camera, undistorted_px: FloatArray) -> FloatArray:
    """Undistorted pixels (N, 2) as a camera without skew would have them, all else the same."""
    p = parameters(camera)
    if p["skew"] == 0.0:
        return undistorted_px
    points = np.array(undistorted_px, dtype=np.float64)
    points[:, 0] -= p["skew"] * (points[:, 1] - p["cy"]) / p["fy"]
    return points


def resized(camera: Camera, scale: float, width_px: int, height_px: int) -> Camera:
    """The camera of the same image shrunk by `scale` to the given size, half-pixel correct."""
    values = []
    for name, value in zip(MODELS[camera.model], camera.params, strict=True):
        if name in ("f", "fx", "fy", "b1", "b2"):
            values.append(value * scale)
        elif name in ("cx", "cy"):
            values.append((value + 0.5) * scale - 0.5)
        else:
            values.append(value)
    return Camera(camera.model, width_px, height_px, tuple(values))
