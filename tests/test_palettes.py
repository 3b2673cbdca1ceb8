"""TIFFs whose numbers stand for colours of a table."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from aeromatch_cli.fingerprints import image_fingerprint, picture_fingerprint
from aeromatch_cli.images import gdal
from aeromatch_cli.images.files import read_raster

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
# Neighbouring numbers stand for colours far apart, as in any table that was made for a picture.
TABLE = np.random.default_rng(5).integers(1, 256, (256, 3)).astype(np.uint8)
NUMBERS = np.random.default_rng(6).integers(0, 256, (60, 80)).astype(np.uint8)


def write(path: Path, *, nodata: int | None = None, height: int = 60) -> Path:
    numbers = np.resize(NUMBERS, (height, 80))
    size = {"width": 80, "height": height, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", photometric="palette", nodata=nodata, blockysize=4, **size) as out:
        out.write_colormap(1, {k: (*map(int, colour), 255) for k, colour in enumerate(TABLE)})
        out.write(numbers[None])
    return path


@pytest.mark.parametrize("strip_px", [4_000_000, 640])
def test_a_palette_is_looked_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strip_px: int) -> None:
    monkeypatch.setattr(gdal, "STRIP_PIXELS", strip_px)
    path = write(tmp_path / "a.tif")
    pixels, valid = read_raster(path, colour=True)
    assert valid is None
    np.testing.assert_array_equal(pixels, TABLE[NUMBERS])
    gray, _ = read_raster(path, colour=False)
    np.testing.assert_array_equal(gray, cv2.cvtColor(TABLE[NUMBERS], cv2.COLOR_RGB2GRAY))
    part, _ = gdal.read_bands(path, (10, 20, 30, 15))
    np.testing.assert_array_equal(part, TABLE[NUMBERS[20:35, 10:40]])


def test_a_number_without_value_is_masked_whatever_its_colour(tmp_path: Path) -> None:
    pixels, valid = read_raster(write(tmp_path / "a.tif", nodata=7), colour=True)
    assert valid is not None
    np.testing.assert_array_equal(valid, NUMBERS != 7)
    assert (pixels[NUMBERS == 7] == 0).all()
    np.testing.assert_array_equal(pixels[valid], TABLE[NUMBERS[valid]])


def test_only_a_palette_has_another_fingerprint(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif")
    assert picture_fingerprint(path) != image_fingerprint(path)
