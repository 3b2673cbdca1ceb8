"""Depths other than 8 and 16 bit: what becomes of their values, and what is refused."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from make_images import write_bands
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images import gdal
from aeromatch_cli.images.depth import _stretched, in_16_bits, to_gray8
from aeromatch_cli.images.files import read_pixels, write_png
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.strategies.enhancers import ENHANCERS

EVERY = {**ENHANCERS, **ARMS["enhance"]}


def pattern(height: int = 30, width: int = 40) -> NDArray[np.uint8]:
    """Three bands that differ, values 0-236."""
    y, x = np.mgrid[:height, :width]
    return np.stack([6 * x, 8 * y, 3 * x + 4 * y], axis=2).astype(np.uint8)


def test_stretch_ignores_nodata_and_outliers() -> None:
    values = np.full((100, 100), 1000.0, np.float32)
    values[:, 50:] = 2000.0
    values[0, :40] = 0.0
    values[1, :3] = (np.nan, np.inf, 1e9)
    gray = to_gray8(in_16_bits(values))
    assert (gray[50, 10], gray[50, 90]) == (0, 255)
    assert gray[0, 0] == 0


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.uint32, np.int64, np.float32, np.float64])
def test_every_depth_becomes_gray(dtype: type) -> None:
    for colours in (pattern().astype(dtype), np.full((4, 4), 7, dtype), np.zeros((4, 4), dtype)):
        gray = to_gray8(in_16_bits(colours))
        assert (gray.dtype, gray.shape) == (np.uint8, colours.shape[:2])
    assert gray.max() == 0


def ramp(low: float, high: float) -> FloatArray:
    """10 x 100 values from low to high."""
    return np.linspace(low, high, 1000).reshape(10, 100)


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.uint32, np.uint64])
def test_whole_numbers_that_16_bits_hold_keep_their_values(dtype: type) -> None:
    values = np.rint(ramp(0, 30000)).astype(dtype)
    found = in_16_bits(values)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, values)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint32])
def test_what_16_bits_cannot_hold_is_scaled_and_zero_stays_zero(dtype: type) -> None:
    """Percentile 99.9 of the 999 values that are not 0 lies at 0.999 of the range, but for the rounding of a rank."""
    top = 4e9 if dtype is np.uint32 else 0.8
    found = in_16_bits(ramp(0, top).astype(dtype))
    assert found.dtype == np.uint16
    assert np.abs(found - np.minimum(np.rint(ramp(0, 65535 / 0.999)), 65535)).max() <= 2
    assert (found[0, 0], found[-1, -1]) == (0, 65535)


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_negative_values_keep_their_steps(dtype: type) -> None:
    """Tenths of a degree from -20 to 40: 600 steps of 109.2, but for 0.1 % at either end."""
    tenths = np.rint(ramp(-200, 400))
    found = in_16_bits(tenths.astype(dtype)).astype(float)
    assert np.abs(found - (tenths + 200) * 65535 / 600).max() < 1.5 * 65535 / 600
    assert len(np.unique(found)) > 595


def test_all_bands_are_scaled_alike() -> None:
    colours = np.stack([ramp(0.1, 0.4)] * 3, axis=2) * (1.0, 0.5, 0.25)
    found = in_16_bits(colours.astype(np.float32)).astype(float)
    inside = found[..., 0] < 65535
    np.testing.assert_allclose(found[inside][:, 1:] / found[inside][:, :1], [[0.5, 0.25]] * inside.sum(), atol=1e-3)


@pytest.mark.parametrize(("dtype", "scale"), [("float32", 0.004), ("int16", 30), ("uint32", 30), ("float64", 1e6)])
@pytest.mark.parametrize("colour", [True, False])
def test_tiffs_of_other_depths_show_what_8_bits_show(tmp_path: Path, dtype: str, scale: float, colour: bool) -> None:
    bands = np.moveaxis(pattern(), 2, 0)[: 3 if colour else 1].astype(float)
    found = read_pixels(write_bands(tmp_path / "a.tif", (bands * scale).astype(dtype)), colour=colour)
    assert found.dtype == (np.uint16 if colour else np.uint8)
    plain = read_pixels(write_bands(tmp_path / "b.tif", bands.astype(np.uint8)), colour=colour)
    assert np.corrcoef(found.ravel(), plain.ravel())[0, 1] > 0.999
    assert len(np.unique(found)) > 0.9 * len(np.unique(plain))


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    path = write_bands(tmp_path / "a.tif", np.ones((1, 4, 4), np.complex64))
    with pytest.raises(ItemError, match=r"a\.tif holds complex64 numbers: write their magnitudes"):
        read_pixels(path, colour=True)


@pytest.mark.parametrize("dtype", [bool, np.int8, np.int16, np.float32, np.uint32])
def test_a_png_of_another_depth_is_refused(dtype: type) -> None:
    with pytest.raises(ValueError, match="a PNG holds uint8 or uint16"):
        write_png(io.BytesIO(), np.ones((4, 4), dtype))


@pytest.mark.parametrize("name", sorted(EVERY))
@pytest.mark.parametrize(("dtype", "scale"), [("float32", 1 / 255), ("int16", 50), ("float64", 1e5)])
def test_enhancers_take_every_depth_and_keep_the_picture(tmp_path: Path, name: str, dtype: str, scale: float) -> None:
    """Half the picture in shadow; afterwards there are still hundreds of levels, and the order of the bands holds."""
    rng = np.random.default_rng(0)
    lit = 40.0 + 160.0 * rng.random((1, 96, 128))
    lit[..., 64:] *= 0.25
    bands = np.concatenate([lit, 0.8 * lit, 0.6 * lit]) * scale
    pixels = read_pixels(write_bands(tmp_path / "a.tif", bands.astype(dtype)), colour=True)
    found = EVERY[name]()(pixels, None).pixels
    assert found.dtype == np.uint16
    assert len(np.unique(found)) > 1000
    assert np.mean((found[..., 0] >= found[..., 1]) & (found[..., 1] >= found[..., 2])) == 1.0


@pytest.mark.parametrize("top", [5, 300, 4096, 65536])
def test_the_stretch_is_that_of_numpys_percentiles(top: int) -> None:
    """In tables and strips: the whole picture in floating numbers would take ten times its memory."""
    rng = np.random.default_rng(top)
    for shape in ((1, 1), (7, 3), (90, 61), (40, 30, 3)):
        pixels = rng.integers(0, top, shape).astype(np.uint16)
        seen = pixels[pixels != 0].astype(np.float32) if pixels.any() else np.array([0.0, 1.0], np.float32)
        low, high = np.percentile(seen, (0.5, 99.5)) if pixels.any() else (0.0, 1.0)
        exact = np.clip(np.rint((pixels.astype(np.float64) - low) * (255.0 / max(high - low, 1e-6))), 0, 255)
        np.testing.assert_array_equal(_stretched(pixels, pixels), exact)


@pytest.mark.parametrize("mask_rows", [(), (2,), (2, 70)])
def test_a_tiff_is_the_same_in_strips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mask_rows: tuple[int]) -> None:
    """Whether an unnamed last band is one of transparency is told by all of it: here by its last rows."""
    bands = np.random.default_rng(3).integers(1, 60000, (4, 100, 64)).astype(np.uint16)
    bands[3] = np.where(np.arange(64) < 9, 0, 65535)
    bands[3, list(mask_rows), 20] = 777
    path = tmp_path / "a.tif"
    shape = {"count": 4, "height": 100, "width": 64, "dtype": "uint16"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", tiled=True, blockxsize=16, blockysize=16, **shape) as out:
            out.write(bands)
    whole, valid = gdal.read_bands(path)
    monkeypatch.setattr(gdal, "STRIP_PIXELS", 64 * 32)
    strips, known = gdal.read_bands(path)
    np.testing.assert_array_equal(strips, whole)
    np.testing.assert_array_equal(strips, np.moveaxis(bands[:3], 0, 2))
    if mask_rows:
        assert valid is None
        assert known is None
    else:
        assert valid is not None
        assert known is not None
        np.testing.assert_array_equal(known, valid)
        assert known[:, :9].sum() == 0
        assert known[:, 9:].all()
