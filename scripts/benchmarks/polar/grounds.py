"""Large pictures of flat ground, and pairs cut out of them of which everything is known.

A ground is a mosaic: of pictures of a real block that share next to nothing, or of rendered pictures of as many seeds,
joined over a soft border. Where there are too few they come again mirrored, which no turn makes the same; real ones are
enlarged, if need be.
Both pictures of a pair are cut out by a similarity, with cubic interpolation; then gain, offset and noise are drawn
for each, and gray values rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.opening import open_truth
from benchmarks.scenes import render_once

RENDERED, REAL = ("grass", "desert", "farmland"), ("seneca", "caliterra")
_TILE = (3000, 2250)
_MOST_RENDERED = 18
_TWICE = 0.02  # of a picture, that another of the same mosaic shows too
_SOFT = 0.06  # of a tile's side, where it is joined with the next
_LEAST_OVERLAP = 0.3
_SCALES = (0.8, 1.25)


@dataclass(frozen=True, eq=False)
class KnownPair:
    """Two gray pictures (H, W) uint8, the (3, 3) similarity px1 from px0, and the share of picture 0 that is shared."""

    first: NDArray[np.uint8]
    second: NDArray[np.uint8]
    truth: FloatArray
    overlap: float


def ground(kind: str, size: tuple[int, int], seed: int, data: Path | None, out: Path) -> NDArray[np.uint8]:
    """(H, W) of about `size` (W, H), from the cache in `out` where it is there."""
    path = out / f"{kind}-{size[0]}x{size[1]}-{seed}.png"
    if not path.is_file():
        out.mkdir(parents=True, exist_ok=True)
        tiles = _rendered(kind, size, seed, out) if kind in RENDERED else _real(block(kind, data), size, seed)
        cv2.imwrite(str(path), _joined(tiles, size))
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def block(kind: str, data: Path | None) -> Path:
    if data is None:
        raise SystemExit(f"{kind} is a real block: it needs --data")
    return data / kind


def _rendered(kind: str, size: tuple[int, int], seed: int, out: Path) -> list[list[NDArray[np.uint8]]]:
    rows, columns = _count(size[1], _TILE[1]), _count(size[0], _TILE[0])
    pictures = []
    for index in range(min(_MOST_RENDERED, rows * columns)):
        number = 10_000 + 1000 * seed + index
        folder = render_once(out, kind, seed=number, width_px=_TILE[0], height_px=_TILE[1], images=1)
        pictures.append(read_pixels(next((folder / "images").iterdir()), colour=False))
    return _laid(pictures, rows, columns)


def _real(folder: Path, size: tuple[int, int], seed: int) -> list[list[NDArray[np.uint8]]]:
    pictures = [read_pixels(folder / "images" / name, colour=False) for name in _apart(folder, seed)]
    height, width = pictures[0].shape
    scale = 1.0
    while _count(size[1], int(height * scale)) * _count(size[0], int(width * scale)) > 2 * len(pictures):
        scale *= 1.1
    rows, columns = _count(size[1], int(height * scale)), _count(size[0], int(width * scale))
    wide = int(width * scale), int(height * scale)
    if scale > 1.0:
        pictures = [np.asarray(cv2.resize(p, wide, interpolation=cv2.INTER_CUBIC), np.uint8) for p in pictures]
    return _laid(pictures, rows, columns)


def _apart(folder: Path, seed: int) -> list[str]:
    """Pictures of a block that show next to no ground twice: another place could be right as well else."""
    truth = open_truth(folder)
    names = sorted(truth.cameras)
    kept: list[str] = []
    for number in np.random.default_rng([seed, 3]).permutation(len(names)):
        if all(truth.conditions(*sorted((names[number], other))).overlap <= _TWICE for other in kept):
            kept.append(names[number])
    return kept


def _laid(pictures: Sequence[NDArray[np.uint8]], rows: int, columns: int) -> list[list[NDArray[np.uint8]]]:
    """In rows, from the second round on mirrored."""
    laid = [pictures[i % len(pictures)][:, :: -1 if i >= len(pictures) else 1] for i in range(rows * columns)]
    return [laid[row * columns : (row + 1) * columns] for row in range(rows)]


def _count(length: int, tile: int) -> int:
    """Tiles that cover a length, each giving its soft border to the next."""
    return max(1, int(np.ceil((length / tile - _SOFT) / (1.0 - _SOFT))))


def _joined(tiles: Sequence[Sequence[NDArray[np.uint8]]], size: tuple[int, int]) -> NDArray[np.uint8]:
    height, width = tiles[0][0].shape
    down, across = int(height * (1.0 - _SOFT)), int(width * (1.0 - _SOFT))
    shape = (down * (len(tiles) - 1) + height, across * (len(tiles[0]) - 1) + width)
    values, weights = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    weight = np.minimum.outer(_ramp(height, height - down), _ramp(width, width - across))
    for row, line in enumerate(tiles):
        for column, tile in enumerate(line):
            part = (slice(row * down, row * down + height), slice(column * across, column * across + width))
            values[part] += weight * tile
            weights[part] += weight
    return np.rint(values / weights)[: size[1], : size[0]].astype(np.uint8)


def _ramp(length: int, soft: int) -> NDArray[np.float32]:
    steps = np.minimum(np.arange(length), np.arange(length)[::-1]) + 1.0
    return np.clip(steps / soft, 0.0, 1.0).astype(np.float32)


def known_pair(source: NDArray[np.uint8], size: tuple[int, int], rng: np.random.Generator) -> KnownPair:
    """Any turn, scale 0.8 to 1.25, overlap from 0.3 evenly, gain, offset and noise."""
    wanted = rng.uniform(_LEAST_OVERLAP, 1.0)

    def middles() -> tuple[FloatArray, FloatArray]:
        middle = _extent(source) * rng.uniform(0.3, 0.7, 2)
        way, direction = rng.uniform(0.0, size[0]), rng.uniform(0.0, 2.0 * np.pi)
        return middle, middle + way * np.array([np.cos(direction), np.sin(direction)])

    def good(share: float) -> bool:
        return share >= _LEAST_OVERLAP and abs(share - wanted) < 0.05

    from0, from1, share = _placed(source, size, rng, middles, good)
    first, second = (_shot(source, matrix, size, rng) for matrix in (from0, from1))
    return KnownPair(first, second, np.linalg.inv(from1) @ from0, share)


def apart(
    source: NDArray[np.uint8], size: tuple[int, int], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two pictures of a ground that share nothing, as those of a pair otherwise."""

    def middles() -> tuple[FloatArray, FloatArray]:
        first, second = _extent(source) * rng.uniform(0.2, 0.8, (2, 2))
        return first, second

    from0, from1, _ = _placed(source, size, rng, middles, lambda share: share == 0.0)
    return _shot(source, from0, size, rng), _shot(source, from1, size, rng)


def _placed(
    source: NDArray[np.uint8],
    size: tuple[int, int],
    rng: np.random.Generator,
    middles: Callable[[], tuple[FloatArray, FloatArray]],
    good: Callable[[float], bool],
) -> tuple[FloatArray, FloatArray, float]:
    """(3, 3) ground px from px of both pictures, and the share of picture 0 that is shared: drawn until it is good."""
    for _ in range(20_000):
        turns, scale = rng.uniform(-np.pi, np.pi, 2), float(np.exp(rng.uniform(*np.log(_SCALES))))
        at0, at1 = middles()
        from0, from1 = _cut(turns[0], 1.0, at0, size), _cut(turns[1], 1.0 / scale, at1, size)
        if _inside(from0, size, source) and _inside(from1, size, source):
            share = overlap(np.linalg.inv(from1) @ from0, size)
            if good(share):
                return from0, from1, share
    wide, high = source.shape[::-1]
    raise SystemExit(f"a ground of {wide}x{high} is too small for such pairs of {size[0]}x{size[1]}")


def _extent(source: NDArray[np.uint8]) -> FloatArray:
    """Width and height."""
    return np.array(source.shape[::-1], np.float64)


def _cut(turn: float, scale: float, middle: FloatArray, size: tuple[int, int]) -> FloatArray:
    """(3, 3) ground px from picture px."""
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    own = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    return np.vstack([np.column_stack([linear, middle - linear @ own]), [0.0, 0.0, 1.0]])


def _inside(matrix: FloatArray, size: tuple[int, int], source: NDArray[np.uint8]) -> bool:
    width, height = size
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1.0]])
    places = corners @ matrix[:2].T
    return bool((places >= 0.0).all() and (places <= np.array(source.shape[::-1]) - 1.0).all())


def overlap(truth: FloatArray, size: tuple[int, int]) -> float:
    """Share of picture 0 that picture 1, of the same size, shows."""
    return float(shared_places(truth, size)[1].mean())


def shared_places(truth: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Places (N, 2) of picture 0 on an even grid, and which of them picture 1 shows."""
    xs, ys = np.linspace(0, size[0] - 1, 64), np.linspace(0, size[1] - 1, 48)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    there = places @ truth[:2, :2].T + truth[:2, 2]
    return places, ((there >= 0.0) & (there <= np.array(size) - 1.0)).all(axis=1)


def _shot(
    source: NDArray[np.uint8], matrix: FloatArray, size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.uint8]:
    scale = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    # A picture that shows the ground smaller has seen it through a wider lens.
    soft = cv2.GaussianBlur(source, (0, 0), 0.5 * max(1.0, scale))
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(soft, matrix[:2], size, flags=flags).astype(np.float32)
    gain, offset, noise = float(np.exp(rng.uniform(-0.3, 0.3))), rng.uniform(-20.0, 20.0), rng.uniform(1.0, 5.0)
    values = gain * (values - 128.0) + 128.0 + offset + noise * rng.standard_normal(values.shape, np.float32)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def errors(found: FloatArray, truth: FloatArray, size: tuple[int, int]) -> tuple[float, float, float]:
    """Displacement at the overlap's middle (px of picture 1), turn (degrees), scale (relative)."""
    places, shared = shared_places(truth, size)
    return differences(found, truth, places[shared].mean(axis=0))


def differences(found: FloatArray, other: FloatArray, place: FloatArray) -> tuple[float, float, float]:
    """Of two similarities (3, 3): how far apart they take a place (2,), px, turn (degrees), scale (relative)."""
    turns = [turn_deg(matrix) for matrix in (found, other)]
    scales = [np.hypot(matrix[0, 0], matrix[1, 0]) for matrix in (found, other)]
    return (
        float(np.linalg.norm((found - other)[:2] @ np.append(place, 1.0))),
        float(abs((turns[0] - turns[1] + 180.0) % 360.0 - 180.0)),
        float(abs(scales[0] / scales[1] - 1.0)),
    )


def turn_deg(matrix: FloatArray) -> float:
    """Of a similarity (3, 3), -180 to 180."""
    return float(np.rad2deg(np.arctan2(matrix[1, 0], matrix[0, 0])))
