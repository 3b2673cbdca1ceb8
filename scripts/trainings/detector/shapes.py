"""Stage 1: simple shapes with exact corners, in any light, with noise and blur.

Polygons, checkerboards, line segments, stars and cubes, after DeTone et al. 2018, "SuperPoint", section 4; ellipses
have no corner. Shapes are painted at SUPER times the size and averaged, so that edges and places are exact.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from trainings.lightglue.homographies import developed

SUPER = 4
_FRACTION_BITS = 4
# A corner between two almost equal grays is none, 0-255.
_LEAST_CONTRAST = 25.0
_VISIBLE = 10
Array = NDArray[np.float64]


class _Canvas:
    """A picture of SUPER times side_px, painted from back to front, and the corners (x, y) still to be seen."""

    def __init__(self, side_px: int, rng: np.random.Generator) -> None:
        self.rng, self.side = rng, side_px * SUPER
        self.pixels = _background(self.side, rng)
        self.corners: Array = np.zeros((0, 2))

    def gray(self) -> float:
        return float(self.rng.uniform(0.0, 255.0))

    def other_gray(self, than: float) -> float:
        """A gray that differs enough to be seen."""
        found = self.gray()
        while abs(found - than) < _LEAST_CONTRAST:
            found = self.gray()
        return found

    def behind(self, points: Array) -> float:
        """Mean gray of what lies under a shape's points."""
        x, y = np.clip(np.rint(points), 0, self.side - 1).astype(int).T
        return float(self.pixels[y, x].mean())

    def fill(self, points: Array, gray: float, *, corners: bool = True) -> None:
        """A polygon (N, 2); what it covers has no corners any more."""
        cv2.fillPoly(self.pixels, [_fixed(points)], gray, lineType=cv2.LINE_AA, shift=_FRACTION_BITS)
        if len(self.corners):
            outline = points.astype(np.float32)
            inside = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) for x, y in self.corners]
            self.corners = self.corners[np.array(inside) < -SUPER]
        if corners:
            self.corners = np.concatenate([self.corners, points])

    def line(self, start: Array, end: Array, width: float, gray: float) -> None:
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
        across = np.array([-along[1], along[0]]) * width / 2.0
        self.fill(np.array([start + across, end + across, end - across, start - across]), gray, corners=False)
        self.corners = np.concatenate([self.corners, [start, end]])


def shape(side_px: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Array]:
    """A picture (side_px, side_px) and its corners (N, 2) in pixels, x and y."""
    canvas = _Canvas(side_px, rng)
    painters: tuple[Callable[[_Canvas], None], ...] = (_polygons, _board, _lines, _star, _cubes, _ellipses)
    painters[int(rng.choice(len(painters), p=(0.3, 0.2, 0.12, 0.12, 0.2, 0.06)))](canvas)
    small = cv2.resize(canvas.pixels, (side_px, side_px), interpolation=cv2.INTER_AREA)
    pixels = developed(np.clip(np.rint(small), 0, 255).astype(np.uint8), rng)
    corners = (canvas.corners + 0.5) / SUPER - 0.5
    corners = corners[((corners > 0.0) & (corners < side_px - 1.0)).all(axis=1)]
    square = np.ones((7, 7), np.uint8)
    columns, rows = np.rint(corners).astype(int).T
    contrast = cv2.dilate(pixels, square)[rows, columns].astype(int) - cv2.erode(pixels, square)[rows, columns]
    return pixels, corners[contrast >= _VISIBLE]  # others were lost to the dark or the light


def _background(side: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Smooth blotches around a mean gray."""
    cells = int(rng.integers(2, 9))
    blotches = rng.normal(0.0, rng.uniform(0.0, 25.0), (cells, cells)).astype(np.float32)
    smooth = cv2.resize(blotches, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(np.clip(smooth + rng.uniform(20.0, 235.0), 0.0, 255.0))


def _fixed(points: Array) -> NDArray[np.int32]:
    return np.rint(points * 2**_FRACTION_BITS).astype(np.int32)


def _ring(canvas: _Canvas, corners: int, radius: float) -> Array:
    """Corners of a star-shaped polygon around a random middle, no two at nearly the same angle."""
    steps = canvas.rng.uniform(0.5, 1.5, corners)
    angles = canvas.rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(steps) / steps.sum() * 2.0 * np.pi
    reach = radius * canvas.rng.uniform(0.5, 1.0, corners)
    middle = canvas.rng.uniform(0.1, 0.9, 2) * canvas.side
    return np.asarray(middle + np.column_stack([np.cos(angles), np.sin(angles)]) * reach[:, None])


def _polygons(canvas: _Canvas) -> None:
    for _ in range(int(canvas.rng.integers(1, 9))):
        radius = canvas.side * canvas.rng.uniform(0.08, 0.35)
        points = _ring(canvas, int(canvas.rng.integers(3, 7)), radius)
        canvas.fill(points, canvas.other_gray(canvas.behind(points)))


def _board(canvas: _Canvas) -> None:
    rows, columns = (int(n) for n in canvas.rng.integers(3, 9, 2))
    side = canvas.side
    source = np.float32([[0, 0], [columns, 0], [columns, rows], [0, rows]])
    target = np.float32([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]) + canvas.rng.uniform(-0.12, 0.12, (4, 2))
    matrix = cv2.getPerspectiveTransform(source, (target * side).astype(np.float32))
    nodes = np.stack(np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0)), axis=-1)
    places = cv2.perspectiveTransform(nodes.reshape(1, -1, 2), matrix).reshape(rows + 1, columns + 1, 2)
    dark = canvas.gray()
    light = canvas.other_gray(dark)
    for row in range(rows):
        for column in range(columns):
            quad = places[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
            gray = (dark, light)[(row + column) % 2] + canvas.rng.normal(0.0, 5.0)
            cv2.fillPoly(canvas.pixels, [_fixed(quad)], gray, lineType=cv2.LINE_AA, shift=_FRACTION_BITS)
    canvas.corners = places[1:-1, 1:-1].reshape(-1, 2)


def _lines(canvas: _Canvas) -> None:
    for _ in range(int(canvas.rng.integers(2, 9))):
        ends = canvas.rng.uniform(0.05, 0.95, (2, 2)) * canvas.side
        canvas.line(ends[0], ends[1], SUPER * canvas.rng.uniform(1.0, 5.0), canvas.other_gray(canvas.behind(ends)))


def _star(canvas: _Canvas) -> None:
    ends = _ring(canvas, int(canvas.rng.integers(3, 8)), canvas.side * canvas.rng.uniform(0.2, 0.45))
    middle, width = ends.mean(axis=0), SUPER * canvas.rng.uniform(1.0, 4.0)
    gray = canvas.other_gray(canvas.behind(ends))
    for end in ends:
        canvas.line(middle, end, width, gray)
    canvas.corners = np.concatenate([ends, middle[None]])


def _cubes(canvas: _Canvas) -> None:
    for _ in range(int(canvas.rng.integers(1, 5))):
        middle = canvas.rng.uniform(0.15, 0.85, 2) * canvas.side
        turn = canvas.rng.uniform(0.0, 2.0 * np.pi)
        angles = turn + np.array([0.0, 2.1, 4.2]) + canvas.rng.uniform(-0.4, 0.4, 3)
        edges = np.column_stack([np.cos(angles), np.sin(angles)]) * canvas.side * canvas.rng.uniform(0.08, 0.25, (3, 1))
        behind = canvas.behind(middle + np.concatenate([edges, edges + np.roll(edges, 1, axis=0)]))
        grays = [canvas.other_gray(behind)]
        while len(grays) < 3:
            gray = canvas.other_gray(behind)
            if all(abs(gray - known) >= _LEAST_CONTRAST for known in grays):
                grays.append(gray)
        for k in range(3):
            face = np.array([middle, middle + edges[k], middle + edges[k] + edges[k - 1], middle + edges[k - 1]])
            canvas.fill(face, grays[k], corners=False)
        outline = np.concatenate([edges, edges + np.roll(edges, 1, axis=0), np.zeros((1, 2))])
        canvas.corners = np.concatenate([canvas.corners, middle + outline])


def _ellipses(canvas: _Canvas) -> None:
    for _ in range(int(canvas.rng.integers(1, 6))):
        middle = canvas.rng.uniform(0.0, 1.0, 2) * canvas.side
        axes = canvas.rng.uniform(0.05, 0.25, 2) * canvas.side
        box = (tuple(middle), tuple(2.0 * axes), float(canvas.rng.uniform(0.0, 180.0)))
        cv2.ellipse(canvas.pixels, box, canvas.other_gray(canvas.behind(middle[None])), -1, cv2.LINE_AA)
