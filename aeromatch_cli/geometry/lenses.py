"""The camera that comes nearest a lens which a model does not describe, by least squares over the picture.

Lenses of other programs may have more terms than BROWN has (Metashape: k4; COLMAP's FULL_OPENCV, whose last three terms
divide), and formats that are written often have fewer. docs/cameras.md has the parameters of all programs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import (
    BROWN,
    FISHEYE,
    FULL_OPENCV,
    MODELS,
    brown_camera,
    focal_px,
    from_colmap,
    is_fisheye,
    normalise,
    parameters,
    pixels_of_rays,
    project,
)
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX

# Stored pixels (N, 2) of normalised coordinates (N, 2).
Forward = Callable[[FloatArray], FloatArray]
# Stored pixels (N, 2) by parameters (P,) of normalised coordinates (N, 2).
Formula = Callable[[FloatArray, FloatArray], FloatArray]
# A picture's grid of pixels on which cameras are compared, border included.
_COLUMNS, _ROWS = 25, 19
_STEPS = 100
_SOLVED_PX = 1e-6
# A camera that is off by more (root mean square, as a share of the picture's width) is none.
_LARGEST_MISFIT = 0.003
# Tie points are measured to this, about: a camera that is off by less anywhere is the same one.
SAME_PX = 0.1
# Of a fisheye lens, what is further from the axis (tangent of 70 degrees) has no place in models for other lenses.
_WIDEST = math.tan(math.radians(70.0))


@dataclass(frozen=True)
class Nearest:
    """camera: None where none comes near. misfit_px: root mean square of its distances over the picture. worst_px: the
    largest.
    """

    camera: Camera | None
    misfit_px: float = 0.0
    worst_px: float = 0.0

    @property
    def differs(self) -> bool:
        """Whether it is another camera than the one wanted, as far as pictures tell."""
        return not self.worst_px <= SAME_PX

    @property
    def misfit(self) -> str:
        """In words."""
        return f"{self.misfit_px:.2f} px off over the picture (root mean square) and {self.worst_px:.2f} px at most"


def brown(
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    middle_px: tuple[float, float],
    radial: Sequence[float],
    tangential: tuple[float, float] = (0.0, 0.0),
    skew_px: float = 0.0,
    dividing: Sequence[float] = (),
) -> Nearest:
    """Brown's model with any number of radial terms: OPENCV where that has all of them, else BROWN, the nearest one
    where there are more than three radial terms or dividing ones.

    size_px: width, height. focal_px: of x and y. middle_px: corner origin. tangential: OpenCV's p1, p2. skew_px: pixels
    to the right for each unit downwards. dividing: terms of the radial factor's denominator.
    """
    (fx, fy), (p1, p2) = focal_px, tangential
    cx, cy = (value - COLMAP_OFFSET_PX for value in middle_px)
    k1, k2, k3, *more = [*radial, 0.0, 0.0, 0.0]
    if not k3 and not skew_px and not any(more) and not any(dividing):
        return Nearest(Camera("OPENCV", *size_px, (fx, fy, cx, cy, k1, k2, p1, p2)))
    values = {"fx": fx, "fy": fy, "skew": skew_px, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    start = brown_camera(size_px, values)
    if not any(more) and not any(dividing):
        return Nearest(start)

    def forward(rays: FloatArray) -> FloatArray:
        u, v = rays.T
        r2 = u * u + v * v
        factor = (1.0 + _series(r2, radial)) / (1.0 + _series(r2, dividing))
        x = u * factor + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
        y = v * factor + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
        return np.column_stack([fx * x + skew_px * y + cx, fy * y + cy])

    return nearest(start, forward)


def fisheye(
    size_px: tuple[int, int],
    focal_px: tuple[float, float],
    middle_px: tuple[float, float],
    terms: Sequence[float],
    tangential: tuple[float, float] = (0.0, 0.0),
    skew_px: float = 0.0,
) -> Nearest:
    """OpenCV's fisheye model: the angle from the axis, times 1 + k1 angle^2 + ..., is the radius.

    Up to four terms are exact. Decentring of that radius (Metashape) and a skew have no place in the model, so that the
    nearest camera stands for them. middle_px: corner origin. tangential: OpenCV's p1, p2.
    """
    (fx, fy), (p1, p2) = focal_px, tangential
    cx, cy = (value - COLMAP_OFFSET_PX for value in middle_px)
    k1, k2, k3, k4 = [*terms, 0.0, 0.0, 0.0, 0.0][:4]
    start = Camera(FISHEYE, *size_px, (fx, fy, cx, cy, k1, k2, k3, k4))
    if not any(terms[4:]) and not p1 and not p2 and not skew_px:
        return Nearest(start)

    def forward(rays: FloatArray) -> FloatArray:
        radius = np.linalg.norm(rays, axis=1)
        angle = np.arctan(radius)
        u, v = (rays * (angle / np.maximum(radius, 1e-12))[:, None]).T
        r2 = angle**2
        factor = 1.0 + _series(r2, terms)
        x = u * factor + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
        y = v * factor + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
        return np.column_stack([fx * x + skew_px * y + cx, fy * y + cy])

    return nearest(start, forward)


def of_colmap(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> Nearest:
    """A camera of COLMAP's models. Raises ValueError for one that is not known here and for a wrong count."""
    if model == FULL_OPENCV and len(params) == 12:
        fx, fy, cx, cy, k1, k2, p1, p2, k3, *dividing = params
        return brown((width_px, height_px), (fx, fy), (cx, cy), (k1, k2, k3), (p1, p2), dividing=dividing)
    return Nearest(from_colmap(model, width_px, height_px, params))


def nearest(start: Camera, forward: Forward) -> Nearest:
    """The camera of start's model whose pixels come nearest those of `forward`; start: where to begin."""
    wanted = _grid(start)
    known = _rays(wanted, normalise(start, wanted), forward)
    if known is None:
        return Nearest(None, math.inf, math.inf)
    inside = np.isfinite(known).all(axis=1)
    rays, wanted = known[inside], wanted[inside]
    found = _fitted(start, MODELS[start.model], rays, wanted)
    camera = found.camera
    if camera is None or not found.misfit_px < _LARGEST_MISFIT * start.width_px or not focal_px(camera) > 0.0:
        return replace(found, camera=None)
    points = np.column_stack([rays, np.ones(len(rays))])
    folds = np.isnan(project(camera, np.eye(3), np.zeros(3), points)).any()
    return replace(found, camera=None if folds else camera)


def nearest_of(camera: Camera, free: Collection[str]) -> Nearest:
    """The camera of BROWN that comes nearest `camera` with only the parameters `free`; never without camera.

    free: names of BROWN's parameters that are found; the others are zero, and the principal point the middle of the
    picture. An exact one is not fitted. Of a fisheye lens, what lies further than 70 degrees from its axis is left out.
    """
    middle = (camera.width_px - 1) / 2.0, (camera.height_px - 1) / 2.0
    p = parameters(camera)
    if is_fisheye(camera):
        p |= {"k1": p["k1"] - 1.0 / 3.0, "k2": 0.0, "k3": 0.0}  # the tangent's series begins angle + angle^3 / 3
    own = dict(zip(MODELS[BROWN], brown_camera((camera.width_px, camera.height_px), p).params, strict=True))
    others = dict.fromkeys(own, 0.0) | dict(zip(("cx", "cy"), middle, strict=True))
    params = tuple(value if name in free else others[name] for name, value in own.items())
    start = Camera(BROWN, camera.width_px, camera.height_px, params)
    if not is_fisheye(camera) and params == tuple(own.values()):
        return Nearest(start)
    return _fitted(start, [name for name in MODELS[BROWN] if name in free], *_seen(camera))


def in_colmap(camera: Camera) -> Nearest:
    """The camera that COLMAP can hold: itself, or the nearest one without b2."""
    if not parameters(camera)["skew"]:
        return Nearest(camera)
    return nearest_of(camera, [name for name in MODELS[BROWN] if name != "b2"])


def in_colmaps_mappers(camera: Camera) -> Nearest:
    """The camera that COLMAP's mappers can refine: itself, or the nearest one of OPENCV.

    The only model of COLMAP that holds k3, FULL_OPENCV, has terms that divide: mappers free them with the others, where
    blocks of some images do not determine them, and lose the block.
    """
    if is_fisheye(camera) or not (parameters(camera)["skew"] or parameters(camera)["k3"]):
        return Nearest(camera)
    return nearest_of(camera, [name for name in MODELS[BROWN] if name not in ("k3", "b2")])


def fitted(formula: Formula, start: FloatArray, scale: FloatArray, camera: Camera) -> tuple[FloatArray, float, float]:
    """Parameters (P,) by which a formula's pixels come nearest a camera's, and the root mean square and the largest of
    their distances in pixels. scale: (P,) what makes the parameters of one order."""
    return _least(formula, start, scale, *_seen(camera))


def _seen(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Normalised coordinates and stored pixels (N, 2 each) over the picture that other models may have."""
    wanted = _grid(camera)
    rays = normalise(camera, wanted)
    inside = np.hypot(rays[:, 0], rays[:, 1]) < (_WIDEST if is_fisheye(camera) else math.inf)
    return rays[inside], wanted[inside]


def _fitted(start: Camera, free: Sequence[str], rays: FloatArray, wanted: FloatArray) -> Nearest:
    places = [MODELS[start.model].index(name) for name in free]
    whole = np.array(start.params)

    def with_values(values: FloatArray) -> Camera:
        params = whole.copy()
        params[places] = values
        return replace(start, params=tuple(float(value) for value in params))

    longer = float(max(start.width_px, start.height_px))
    # Pixels of unit size, so that all parameters are of one order.
    scale = np.array([longer if name in ("f", "fx", "fy", "cx", "cy", "b1", "b2") else 1.0 for name in free])
    values, whole_px, worst_px = _least(
        lambda found, seen: pixels_of_rays(with_values(found), seen), whole[places], scale, rays, wanted
    )
    return Nearest(with_values(values), whole_px, worst_px)


def _least(
    formula: Formula, start: FloatArray, scale: FloatArray, rays: FloatArray, wanted: FloatArray
) -> tuple[FloatArray, float, float]:
    from scipy.optimize import least_squares

    def misfit(scaled: FloatArray) -> FloatArray:
        return (formula(scaled * scale, rays) - wanted).ravel()

    # Three-point differences: with two-point ones the exact camera of an exact start is found to 1e-4 px only.
    found = least_squares(misfit, start / scale, jac="3-point", x_scale="jac", ftol=1e-14, xtol=1e-14).x * scale
    off = np.linalg.norm(formula(found, rays) - wanted, axis=1)
    return found, float(np.sqrt(np.mean(off**2))), float(off.max())


def _grid(camera: Camera) -> FloatArray:
    """Stored pixels (N, 2) over the picture."""
    x = np.linspace(0.0, camera.width_px, _COLUMNS) - COLMAP_OFFSET_PX
    y = np.linspace(0.0, camera.height_px, _ROWS) - COLMAP_OFFSET_PX
    return np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])


def _rays(wanted: FloatArray, start: FloatArray, forward: Forward) -> FloatArray | None:
    """Normalised coordinates (N, 2) of pixels (N, 2), by Newton's method with slopes from differences.

    start: where to begin, NaN for pixels that no ray has.
    """
    inside = np.isfinite(start).all(axis=1)
    rays = start.copy()
    step = 1e-6
    for _ in range(_STEPS):
        off = forward(rays) - wanted
        if not np.abs(off[inside]).max(initial=0.0) > _SOLVED_PX:
            return rays
        columns = [(forward(rays + step * axis) - wanted - off) / step for axis in np.eye(2)]
        slope = np.stack(columns, axis=2)[inside]
        if not np.isfinite(slope).all() or (np.abs(np.linalg.det(slope)) < 1e-9).any():
            return None
        rays[inside] -= np.linalg.solve(slope, off[inside][:, :, None])[:, :, 0]
    return None


def _series(square: FloatArray, terms: Sequence[float]) -> FloatArray:
    total = np.zeros_like(square)
    for term in reversed(terms):
        total = (total + term) * square
    return total
