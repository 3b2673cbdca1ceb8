"""The terrain below a block: a constant height, a digital elevation model, or what adjacent images tell.

All heights of a ground are world heights: those of the block's CRS minus the world origin.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aeromatch_cli.blocks.crs import LOCAL, across_unit_m, converted_heights, heights_of, heights_words, parsed_crs
from aeromatch_cli.blocks.units import metres_of
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import check_given
from aeromatch_cli.geometry.footprints import MAX_DISTANCE_FACTOR
from aeromatch_cli.words import listed

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# A block's window of a DEM is read with at most this many cells per side; a finer DEM is averaged.
_MAX_CELLS = 4096
_MARGIN_M = (100.0, 20_000.0)
# A height beyond these is none on land: -9999, -32768, 3.4e38 stand for no data, declared or not. So does 0 where all
# other heights are higher than a cliff.
_LOWEST_M, _HIGHEST_M, _ABOVE_ZERO_M = -500.0, 9000.0, 100.0
# Where all others are higher than this, 0 may be the sea or no data.
_SAID_ABOVE_ZERO_M = 5.0
# Of these also where one unit is so small that they could be heights.
_CODES = (-9999.0, -32767.0, -32768.0)
# A number and a word behind it.
_HEIGHT = re.compile(r"[-+]?(?:\d[\d.,]*)?\d\s*(?:[^\W\d]+[\s-]?){0,3}")
# The geoid is asked for at no more places a side.
_SHIFT_PLACES = 33
# So many cells more than asked for, half of them for interpolation.
_BESIDE = 8


@dataclass(frozen=True)
class ConstantGround:
    """A horizontal plane. z_m: its world height."""

    z_m: float

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) below world points (N, 2)."""
        return np.full(len(xy_m), self.z_m)


@dataclass(frozen=True, eq=False)
class DemGround:
    """A raster of world heights, interpolated bilinearly between the centres of its cells.

    heights_m: (H, W) float64, rows from north to south, no gaps. west_m, north_m: world position of the centre of the
    first cell. cell_m: (east-west, north-south) spacing. outside_m: height of points beyond the raster.
    """

    heights_m: FloatArray
    west_m: float
    north_m: float
    cell_m: tuple[float, float]
    outside_m: float

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) below world points (N, 2)."""
        points = np.asarray(xy_m, dtype=np.float64)
        rows, columns = self.heights_m.shape
        x = (points[:, 0] - self.west_m) / self.cell_m[0]
        y = (self.north_m - points[:, 1]) / self.cell_m[1]
        # The outer half of the border cells has their own height.
        outside = ~((x >= -0.5) & (x <= columns - 0.5) & (y >= -0.5) & (y <= rows - 0.5))
        x, y = np.clip(np.where(outside, 0.0, x), 0, columns - 1), np.clip(np.where(outside, 0.0, y), 0, rows - 1)
        x0, y0 = np.minimum(x.astype(int), max(columns - 2, 0)), np.minimum(y.astype(int), max(rows - 2, 0))
        x1, y1 = np.minimum(x0 + 1, columns - 1), np.minimum(y0 + 1, rows - 1)
        fx, fy = x - x0, y - y0
        top = self.heights_m[y0, x0] * (1 - fx) + self.heights_m[y0, x1] * fx
        bottom = self.heights_m[y1, x0] * (1 - fx) + self.heights_m[y1, x1] * fx
        return np.where(outside, self.outside_m, top * (1 - fy) + bottom * fy)

    def shifted(self, up_m: float) -> DemGround:
        """The same ground, so many metres higher."""
        return replace(self, heights_m=self.heights_m + up_m, outside_m=self.outside_m + up_m)

    def distance_m(self, xy_m: FloatArray) -> FloatArray:
        """How far (N,) world points (N, 2) lie from the raster, 0 inside."""
        rows, columns = self.heights_m.shape
        middle = np.array([self.west_m, self.north_m]) + 0.5 * np.array(self.cell_m) * [columns - 1, 1 - rows]
        beyond = np.abs(np.asarray(xy_m) - middle) - 0.5 * np.array(self.cell_m) * [columns, rows]
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1))


@dataclass(frozen=True, eq=False)
class SeveralGrounds:
    """Rasters of flights that lie apart: of each point the first one that holds it counts, else the nearest."""

    parts: tuple[DemGround, ...]

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) below world points (N, 2)."""
        points = np.asarray(xy_m, dtype=np.float64)
        nearest = np.argmin([part.distance_m(points) for part in self.parts], axis=0)
        heights = np.array([part.height_m(points) for part in self.parts])
        return np.asarray(heights[nearest, np.arange(len(points))])


def looks_like_height(text: str) -> bool:
    """Whether a ground is a number, with a unit or without, and no name of a file."""
    return metres_of(text) is not None or bool(_HEIGHT.fullmatch(text.strip()))


def stated_height_m(text: str) -> float | None:
    """A height with its unit, metres without one; None of what names a file. Raises ConfigError for a number that is
    neither."""
    if not looks_like_height(text):
        return None
    found = metres_of(text) if "," not in text else None
    if found is None:
        raise ConfigError(
            f"--ground {text!r} is no height: give metres with a decimal point, such as 34.5, or with a unit, such as "
            "'112 ft'; or a DEM, or auto"
        )
    return found


def open_dem(
    path: Path, crs: str, origin_m: tuple[float, float, float], positions_m: FloatArray, zero: str = ""
) -> tuple[DemGround, tuple[str, ...]]:
    """The DEM under a block, resampled bilinearly into the block's CRS, and what the user should know about it.

    path: any single-band raster of heights that GDAL reads (the first band counts), in the unit that the band or the
    vertical axis of its CRS states, else in metres. crs: authority code of
    the world frame or "local"; origin_m: the world origin in it; positions_m: (N, 3) projection centres in the world
    frame. Only the block's extent, 5 flying heights around the cameras, is read. Cells without data get the median.
    zero: what heights of the world count from, as of `crs.heights_of`: those of a DEM that states another zero are
    brought to it. Raises ConfigError where the file cannot be read, its CRS cannot be brought to the block's, or it
    does not cover the block.
    """
    import rasterio
    from rasterio.errors import RasterioError

    if len(positions_m) == 0:
        raise ConfigError(f"the DEM {path} needs image positions to find the block on it; give poses or a constant")
    try:
        check_given(path)
        with rasterio.open(path) as dataset:
            source_crs, notes = _source_crs(dataset, path, crs)
            unit_m, of_unit = _unit_m(dataset, path)
            notes += of_unit
            absolute = np.asarray(positions_m, dtype=np.float64) + np.asarray(origin_m)
            low, high = absolute[:, :2].min(axis=0), absolute[:, :2].max(axis=0)
            frames = (source_crs, source_crs if crs == "local" else rasterio.CRS.from_user_input(crs))
            coarse, _, _ = _read_extent(dataset, frames, low - _MARGIN_M[0], high + _MARGIN_M[0], 512, unit_m)
            if not np.isfinite(coarse).any():
                raise ConfigError(f"the DEM {path} does not cover the block {_extent_text(low, high, crs)}")
            reach = MAX_DISTANCE_FACTOR * float(absolute[:, 2].max() - np.nanmin(coarse))
            margin = float(np.clip(reach, *_MARGIN_M))
            heights, transform, codes = _read_extent(dataset, frames, low - margin, high + margin, _MAX_CELLS, unit_m)
    except (RasterioError, OSError) as error:
        said = getattr(error, "strerror", None) or str(error).rstrip(".")
        raise ConfigError(f"cannot read the DEM {path}: {said}; give a GeoTIFF of heights or a constant") from error
    if codes:
        named = listed(f"{code:g}" for code in codes)
        notes = (
            *notes,
            f"the DEM {path} has cells of {named} that it does not declare as no data: they count as such",
        )
    known = np.isfinite(heights)
    median = float(np.median(heights[known]))
    notes += _of_zeros(heights[known], path)
    if not known.all():
        share = 100.0 * float(1.0 - known.mean())
        missing = f"{share:.0f}" if share < 99.0 else "more than 99"
        notes = (
            *notes,
            f"the DEM {path} has no data in {missing} % of the block's surroundings: {median:.1f} m there",
        )
        heights = np.where(known, heights, median)
    shifts_m, said = _shifts_m(source_crs, crs, zero, transform, heights.shape, median, path)
    heights, median = heights + shifts_m, median + float(np.median(shifts_m))
    notes = (*notes, *said)
    ground = DemGround(
        heights - origin_m[2],
        transform.c + 0.5 * transform.a - origin_m[0],
        transform.f + 0.5 * transform.e - origin_m[1],
        (transform.a, -transform.e),
        median - origin_m[2],
    )
    return ground, notes


def _shifts_m(
    source_crs: Any, crs: str, zero: str, transform: Any, shape: tuple[int, int], height_m: float, path: Path
) -> tuple[FloatArray, tuple[str, ...]]:
    """What brings heights (H, W) of a DEM in its own CRS to those of the world, and what was done; zeros where either
    side does not state its heights. height_m: of the DEM, about. The geoid is smooth: a few places tell it."""
    own = heights_of(source_crs.to_wkt()) if zero and crs != LOCAL else ""
    if not own or own == zero:
        return np.zeros(shape), ()
    rows, columns = (np.linspace(0.5, count - 0.5, min(count, _SHIFT_PLACES)) for count in shape)
    x, y = np.meshgrid(transform.c + transform.a * columns, transform.f + transform.e * rows)
    places_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)])
    heights_m, why_not = converted_heights(crs, own, zero, places_m)
    if why_not:
        return np.zeros(shape), (f"the DEM {path}: {why_not}",)
    coarse = DemGround(
        (heights_m - height_m).reshape(x.shape),
        float(columns[0]),
        -float(rows[0]),
        tuple(float(v[1] - v[0]) if len(v) > 1 else 1.0 for v in (columns, rows)),  # type: ignore[arg-type]
        0.0,
    )
    cells = np.stack(np.meshgrid(np.arange(shape[1]) + 0.5, -(np.arange(shape[0]) + 0.5)), axis=-1)
    shifts_m = coarse.height_m(cells.reshape(-1, 2)).reshape(shape)
    words = f"from {heights_words(own)} to {heights_words(zero)}: {float(np.median(shifts_m)):+.2f} m (median)"
    return shifts_m, (f"the heights of the DEM {path} are transformed {words}",)


def _source_crs(dataset: DatasetReader, path: Path, crs: str) -> tuple[Any, tuple[str, ...]]:
    """The CRS to read a DEM in, and a note where it had to be assumed."""
    import rasterio

    if crs == "local":
        if dataset.crs is not None:
            raise ConfigError(
                f"the DEM {path} is in {dataset.crs}, the poses in a local frame; give --crs or a local DEM"
            )
        # Both sides in one arbitrary frame: nothing is transformed.
        return rasterio.CRS.from_epsg(3857), ()
    if dataset.crs is None:
        return rasterio.CRS.from_user_input(crs), (f"the DEM {path} names no CRS; the block's, {crs}, is assumed",)
    return dataset.crs, ()


def _unit_m(dataset: DatasetReader, path: Path) -> tuple[float, tuple[str, ...]]:
    """Metres of one unit of heights, as the band or the vertical axis of the CRS states it, and a note where that is
    not metres, or is not stated in a CRS that counts in feet."""
    text = (dataset.units[0] or "").strip()
    crs = parsed_crs(dataset.crs.to_wkt()) if dataset.crs is not None else None
    vertical = next((axis for axis in crs.axis_info if axis.direction.lower() == "up"), None) if crs else None
    unit_m = metres_of(f"1 {text}") if text else None
    if unit_m is None and vertical is not None:
        text, unit_m = vertical.unit_name, float(vertical.unit_conversion_factor)
    if unit_m is not None:
        stated = unit_m != 1.0
        return unit_m, (f"the DEM {path} states heights in {text}: they are converted to metres",) if stated else ()
    if text:
        return 1.0, (
            f"the DEM {path} states heights in {text[:30]!r}, which is no unit that is known: metres are assumed",
        )
    if crs is not None and across_unit_m(crs) != 1.0:
        name = crs.axis_info[0].unit_name
        return 1.0, (f"the CRS of the DEM {path} counts in {name}, and nothing states the unit of its heights: metres "
                     "are assumed; where they are not, give the DEM a compound CRS",)  # fmt: skip
    return 1.0, ()


def _of_zeros(heights_m: FloatArray, path: Path) -> tuple[str, ...]:
    """A note on heights of exactly 0 that are far below all others."""
    rest = heights_m[heights_m != 0.0]
    if rest.size in (0, heights_m.size) or rest.min() <= _SAID_ABOVE_ZERO_M:
        return ()
    share = 100.0 * (1.0 - rest.size / heights_m.size)
    return (
        f"the DEM {path} has cells of 0 ({share:.0f} % around the block), and all others are {rest.min():.0f} m or "
        f"higher: if they stand for no data and not for the sea, declare them as such (gdal_edit.py -a_nodata 0)",
    )


def _read_extent(
    dataset: DatasetReader, frames: tuple[Any, Any], low: FloatArray, high: FloatArray, max_cells: int, unit_m: float
) -> tuple[FloatArray, Any, list[float]]:
    """Heights (H, W) float64, NaN without data, over a box of the second frame's CRS, their affine transform, and what
    stands for no data without being declared.

    frames: CRS of the DEM and of the block. unit_m: metres of one unit of its heights. Cells are as fine as
    the DEM's; within one CRS they are its own.
    """
    import rasterio
    from rasterio.warp import Resampling, reproject, transform_bounds

    left, bottom, right, top = transform_bounds(frames[1], frames[0], *low, *high)
    own = dataset.transform
    cells = np.hypot([own.a, own.b], [own.d, own.e])
    if frames[0] == frames[1] and own.b == own.d == 0.0 and own.e < 0.0:
        west = own.c + np.floor((low[0] - own.c) / own.a) * own.a
        north = own.f + np.ceil((high[1] - own.f) / -own.e) * -own.e
        size = np.array([own.a, -own.e])
    else:
        west, north = low[0], high[1]
        size = (high - low) / np.maximum(np.array([right - left, top - bottom]) / cells, 1.0)
    size = size * np.maximum(np.ceil((high - low) / size / max_cells), 1.0)
    columns, rows = np.ceil((np.array([high[0] - west, north - low[1]])) / size).astype(int) + 1
    transform = rasterio.Affine(size[0], 0.0, west, 0.0, -size[1], north)
    heights = np.full((rows, columns), np.nan)
    stored, stored_transform = _stored_part(dataset, (left, bottom, right, top), max_cells + _BESIDE)
    if stored.size == 0:
        return heights, transform, []
    stored, codes = _without_voids(stored, unit_m)
    reproject(
        stored,
        heights,
        src_transform=stored_transform,
        src_crs=frames[0],
        src_nodata=np.nan,
        dst_transform=transform,
        dst_crs=frames[1],
        dst_nodata=np.nan,
        resampling=Resampling.bilinear,
        tolerance=0.0,
    )
    return heights, transform, codes


def _stored_part(
    dataset: DatasetReader, box: tuple[float, float, float, float], max_cells: int
) -> tuple[FloatArray, Any]:
    """Heights (H, W) float64 of the cells around a box of the DEM's CRS, NaN where it declares no data, and their
    affine transform; every n-th cell where they would be too many."""
    import rasterio
    from rasterio.windows import Window

    left, bottom, right, top = box
    place_from_cell = np.reshape(dataset.transform, (3, 3))
    places = np.array([[x, y, 1.0] for x in (left, right) for y in (bottom, top)])
    corners = (places @ np.linalg.inv(place_from_cell).T)[:, :2]
    first = np.maximum(np.floor(np.min(corners, axis=0)).astype(int) - _BESIDE // 4, 0)
    last = np.minimum(np.ceil(np.max(corners, axis=0)).astype(int) + _BESIDE // 4, [dataset.width, dataset.height])
    if (last <= first).any():
        return np.zeros((0, 0)), dataset.transform
    size = last - first
    step = max(1, int(np.ceil(size.max() / max_cells)))
    shape = np.maximum(size // step, 1)
    part = dataset.read(1, window=Window(*first, *size), out_shape=(int(shape[1]), int(shape[0])), masked=True)
    heights = part.astype(np.float64).filled(np.nan) * dataset.scales[0] + dataset.offsets[0]
    steps = size / shape
    cell_from_part = np.array([[steps[0], 0.0, first[0]], [0.0, steps[1], first[1]], [0.0, 0.0, 1.0]])
    return heights, rasterio.Affine(*(place_from_cell @ cell_from_part)[:2].ravel())


def _without_voids(heights: FloatArray, unit_m: float) -> tuple[FloatArray, list[float]]:
    """Heights in metres with NaN for what can be none, and the values that were taken out, as they are stored."""
    heights_m = unit_m * heights
    with np.errstate(invalid="ignore"):
        void = (heights_m < _LOWEST_M) | (heights_m > _HIGHEST_M) | np.isin(heights, _CODES)
        rest = heights_m[~void & np.isfinite(heights_m) & (heights_m != 0.0)]
        if rest.size and rest.min() > _ABOVE_ZERO_M:
            void |= heights_m == 0.0
    return np.where(void, np.nan, heights_m), np.unique(heights[void]).tolist()


def _extent_text(low: FloatArray, high: FloatArray, crs: str) -> str:
    return f"(x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} in {crs}); check --crs"
