"""Stored pictures as polar reads them: depth kept, masks applied, TIFFs by parts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from make_ground import ground
from make_images import write_jpeg_2000

from aeromatch_cli.config import load
from aeromatch_cli.executor import Executor
from aeromatch_cli.images import gdal
from aeromatch_cli.images import stored as sources
from aeromatch_cli.images.stored import StoredRaster
from aeromatch_cli.stages import enhance, pairs

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
WIDTH, HEIGHT = 700, 500
PICTURE = np.clip(ground(3, (WIDTH, HEIGHT)), 1.0, 254.0).astype(np.float64)


def write_tiff(path: Path, bands: np.ndarray, **more: object) -> None:
    size = {"height": bands.shape[1], "width": bands.shape[2], "count": bands.shape[0]}
    with rasterio.open(path, "w", driver="GTiff", dtype=bands.dtype, tiled=True, blockxsize=128, blockysize=128,
                       **size, **more) as out:  # fmt: skip
        out.write(bands)


def raster(tmp_path: Path, *settings: str) -> StoredRaster:
    """Of the one picture in tmp_path/images."""
    block = {"images": str(tmp_path / "images")}
    context, *_ = pairs.prepare(
        load("polar", ["orient=none", "pairs=exhaustive", *settings], block, workspace=str(tmp_path / "work")),
        Executor("serial", 1),
    )
    return StoredRaster(enhance.source_of(context, context.block.images[0]))


@pytest.fixture
def images(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "z.jpg"), np.rint(PICTURE).astype(np.uint8))
    return tmp_path / "images"


def same_but_for_gain(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference after the best gain, of the wanted range."""
    gain = float((found * wanted).sum() / (found * found).sum())
    return float(np.abs(gain * found - wanted).max() / np.ptp(wanted))


@pytest.mark.parametrize(
    ("dtype", "scale", "bands"),
    [("uint8", 1.0, 1), ("uint8", 1.0, 3), ("uint16", 256.0, 1), ("uint16", 16.0, 4), ("float32", 1e-4, 1)],
)
def test_every_depth_and_number_of_bands_is_the_same_picture(tmp_path, images, dtype, scale, bands):
    stored = np.repeat((PICTURE * scale)[None], bands, axis=0)
    if bands == 4:
        stored[3] = 65535 - stored[3]  # infrared, not to be looked at
    stored = (np.rint(stored) if dtype != "float32" else stored).astype(dtype)
    write_tiff(images / "a.tif", stored, photometric="minisblack" if bands != 3 else "rgb")
    found = raster(tmp_path)
    values, valid = found.reduced(0.25)
    wanted = cv2.resize(stored[0].astype(np.float32), (WIDTH // 4, HEIGHT // 4), interpolation=cv2.INTER_AREA)
    assert valid is None
    assert values.dtype == np.float32
    assert same_but_for_gain(values, wanted) < 1e-3
    values, valid = found.window(130, 90, 60, 40)
    assert valid is None
    assert same_but_for_gain(values, stored[0, 90:130, 130:190].astype(np.float32)) < (5e-3 if bands > 1 else 1e-5)


def test_sixteen_bits_keep_what_eight_would_round_away(tmp_path, images):
    faint = np.rint(20_000.0 + PICTURE / 4.0).astype(np.uint16)  # 64 steps in 65536: one in 8 bits
    write_tiff(images / "a.tif", faint[None])
    values, _ = raster(tmp_path).window(0, 0, WIDTH, HEIGHT)
    assert len(np.unique(values)) > 40


@pytest.mark.slow
def test_jpeg_2000_is_the_same_picture_whole_and_by_windows(tmp_path, images):
    stored = np.repeat(np.rint(PICTURE * 16.0)[None], 4, axis=0).astype(np.uint16)
    stored[3] = 4095 - stored[3]
    write_jpeg_2000(images / "a.jp2", stored)
    whole, valid = gdal.read_bands(images / "a.jp2")
    assert valid is None
    np.testing.assert_array_equal(whole, np.moveaxis(stored[:3], 0, 2))
    found = raster(tmp_path)
    values, _ = found.window(130, 90, 60, 40)
    assert same_but_for_gain(values, stored[0, 90:130, 130:190].astype(np.float32)) < 5e-3


@pytest.mark.parametrize(("name", "write"), [("a.tif", write_tiff), ("a.jp2", write_jpeg_2000)])
def test_a_picture_of_windows_is_never_decoded_whole(tmp_path, images, monkeypatch, name, write):
    write(images / name, np.rint(PICTURE).astype(np.uint8)[None])
    found = raster(tmp_path)
    parts = []
    read = gdal.read_bands

    def watched(path, part=None):
        parts.append(part)
        return read(path, part)

    monkeypatch.setattr(gdal, "read_bands", watched)
    monkeypatch.setattr("aeromatch_cli.images.scaling._STRIP_PX", 60 * WIDTH)
    sources._units.clear()
    found.reduced(0.125)
    found.window(100, 200, 64, 48)
    assert None not in parts
    assert max(width * height for _, _, width, height in parts) <= 64 * WIDTH
    assert parts[-1] == (100, 200, 64, 48)


def test_nodata_a_frame_and_a_mask_are_known_at_every_scale(tmp_path, images):
    stored = PICTURE.astype(np.float32) + 1.0
    stored[100:200, 300:420] = -1.0
    write_tiff(images / "a.tif", stored[None], nodata=-1.0)
    values, valid = raster(tmp_path).window(250, 90, 100, 60)
    assert valid is not None
    assert np.array_equal(valid, stored[90:150, 250:350] != -1.0)
    assert (values[~valid] == 0.0).all()
    _, small = raster(tmp_path).reduced(0.25)
    assert small is not None
    assert not small[25:50, 75:105].any()
    assert small.mean() == pytest.approx(1.0 - 100 * 120 / (WIDTH * HEIGHT), abs=0.005)

    framed = np.rint(PICTURE).astype(np.uint8) + 1
    framed[:60] = 0
    write_tiff(images / "a.tif", framed[None])
    _, valid = raster(tmp_path).window(0, 40, 50, 40)
    assert valid is not None
    assert not valid[:20].any()
    assert valid[20:].all()


def test_infrared_without_a_name_is_no_mask_over_water(tmp_path, images):
    stored = np.repeat(np.rint(PICTURE * 100.0)[None], 4, axis=0).astype(np.uint16)
    stored[3, :250] = 0
    write_tiff(images / "a.tif", stored, photometric="minisblack")
    _, valid = raster(tmp_path).window(0, 0, 200, 200)
    assert valid is None


def test_a_smaller_working_size_is_the_finest_scale(tmp_path, images):
    cv2.imwrite(str(images / "a.png"), np.rint(PICTURE).astype(np.uint8))
    found = raster(tmp_path, "block.max_size_px=350")
    assert found.finest == 0.5
    values, _ = found.reduced(0.5)
    wanted = cv2.resize(np.rint(PICTURE).astype(np.float32), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    assert values.shape == wanted.shape
    assert np.abs(values - wanted).max() <= 0.5 + 1e-3  # rounded where it is shrunk first
