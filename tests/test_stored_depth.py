"""Pictures of 16 bits that polar reads whole have the gray values of those that it reads by parts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from make_ground import ground
from make_images import write_jpeg_2000
from test_sources import raster, write_tiff

from aeromatch_cli.strategies.matchers.polar.affine import Windows, adjusted
from aeromatch_cli.strategies.matchers.polar.level import level_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
WIDTH, HEIGHT = 700, 500
# A sensor of 12 bits.
DEEP = np.rint(np.clip(ground(3, (WIDTH, HEIGHT)), 1.0, 254.0) * 16.0).astype(np.uint16)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """One for a picture read by parts, one for what is read whole; each has a JPEG beside."""
    found = tmp_path / "parts", tmp_path / "whole"
    for folder in found:
        (folder / "images").mkdir(parents=True)
        cv2.imwrite(str(folder / "images" / "z.jpg"), (DEEP >> 4).astype(np.uint8))
    write_tiff(found[0] / "images" / "a.tif", DEEP[None])
    return found


@pytest.mark.parametrize("kind", ["mask", "frame", "png", "reduced", "jpeg 2000"])
def test_a_picture_read_whole_has_the_values_of_one_read_by_parts(folders: tuple[Path, Path], kind: str) -> None:
    parts, whole = folders
    stored, settings = DEEP.copy(), []
    if kind == "frame":
        stored[:40] = 0
    if kind in ("png", "reduced"):
        cv2.imwrite(str(whole / "images" / "a.png"), stored)
    elif kind == "jpeg 2000":
        write_jpeg_2000(whole / "images" / "a.jp2", stored[None])
    else:
        write_tiff(whole / "images" / "a.tif", stored[None])
    if kind in ("mask", "jpeg 2000"):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:40] = 0
        cv2.imwrite(str(whole / "mask.png"), mask)
        settings = [f"block.masks={whole / 'mask.png'}"]
    if kind == "reduced":
        settings = ["block.max_size_px=350"]
    first, second = raster(parts), raster(whole, *settings)
    wanted, _ = first.reduced(0.25)
    found, _ = second.reduced(0.25)
    rows = slice(12, None)
    assert found.dtype == np.float32
    ratio = float((found[rows] * wanted[rows]).sum() / (wanted[rows] ** 2).sum())
    assert ratio == pytest.approx(1.0, abs=0.02)
    assert 200.0 < found.max() < 300.0
    if kind != "reduced":
        window = (100, 90, 60, 40)
        assert second.window(*window)[0].mean() == pytest.approx(first.window(*window)[0].mean(), rel=0.02)


def test_least_squares_finds_windows_of_a_masked_picture_in_one_without_mask(folders: tuple[Path, Path]) -> None:
    parts, whole = folders
    write_tiff(whole / "images" / "a.tif", DEEP[None])
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:40] = 0
    cv2.imwrite(str(whole / "mask.png"), mask)
    rasters = raster(parts), raster(whole, f"block.masks={whole / 'mask.png'}")
    levels = [level_of(*item.window(0, 0, WIDTH, HEIGHT), 1.0, even=False) for item in rasters]
    places = np.stack(np.meshgrid(np.arange(60.0, 640.0, 40.0), np.arange(90.0, 440.0, 40.0)), axis=-1).reshape(-1, 2)
    start = Windows.start(places, places + np.array([0.8, -0.6]), np.repeat(np.eye(2)[None], len(places), axis=0))
    for level0, level1 in (levels, levels[::-1]):
        found = adjusted(level0, level1, start, 10)
        assert found.matched.mean() > 0.95
        assert np.abs(found.places1_px - places)[found.matched].max() < 0.02
