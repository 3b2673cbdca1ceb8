"""What a file marks as empty is masked and black: alpha, nodata values, masks and NaN, alone and in the stages."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Picture

from aeromatch_cli.data import BoolArray, Camera, Features, View
from aeromatch_cli.images.files import read_pixels, read_raster
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.enhancers import ENHANCERS
from aeromatch_cli.strategies.enhancers.shadow_mask import make_overview
from aeromatch_cli.strategies.enhancers.tone import tone_of, white_of
from aeromatch_cli.strategies.extractors.sift import Sift

EVERY = {**ENHANCERS, **ARMS["enhance"]}

HEIGHT, WIDTH, FRAME = 240, 320, 80


def framed() -> BoolArray:
    """(H, W) False in a frame on the left and at the top."""
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[: FRAME // 2], valid[:, :FRAME] = False, False
    return valid


def texture(seed: int = 0) -> NDArray[np.uint8]:
    """(H, W, 3) of 20-220, structure at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT, WIDTH))
    for scale in (2, 4, 8, 16):
        coarse = rng.standard_normal((HEIGHT // scale + 2, WIDTH // scale + 2))
        total += scale**0.5 * cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    gray = np.clip(120 + 25 * total, 20, 220)
    return np.stack([gray, 0.8 * gray, 0.6 * gray], axis=2).astype(np.uint8)


def filled(pixels: NDArray[Any], value: float) -> NDArray[Any]:
    """The picture with a value in its frame."""
    pixels = pixels.copy()
    pixels[~framed()] = value
    return pixels


def write_tiff(path: Path, pixels: NDArray[Any], *, mask: BoolArray | None = None, **profile: Any) -> Path:
    """A GeoTIFF of (H, W) or (H, W, B), and with `mask` one inside it."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    bands = np.moveaxis(np.atleast_3d(pixels), 2, 0)
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        size = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
        with rasterio.open(path, "w", driver="GTiff", dtype=bands.dtype, **size, **profile) as sink:
            sink.write(bands)
            if mask is not None:
                sink.write_mask(mask)
    return path


def write_png(path: Path, pixels: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> Path:
    Picture.fromarray(np.dstack([pixels, alpha])).save(path)
    return path


def assert_frame_is_out(path: Path, inside: NDArray[Any] | None = None) -> None:
    """Of the file: the frame is invalid and 0, in colour and in gray, the rest valid and, if given, as it was."""
    for colour in (True, False):
        pixels, valid = read_raster(path, colour=colour)
        assert valid is not None
        np.testing.assert_array_equal(valid, framed())
        assert not pixels[~valid].any()
        if colour and inside is not None:
            np.testing.assert_array_equal(pixels[valid], inside[valid])


# --- what the file says ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("opaque", [1, 128, 255])
def test_transparent_pixels_of_a_png(tmp_path: Path, opaque: int) -> None:
    alpha = np.where(framed(), opaque, 0).astype(np.uint8)
    assert_frame_is_out(write_png(tmp_path / "a.png", filled(texture(), 255), alpha), texture())
    gray = np.dstack([filled(texture(), 255)[..., 0], alpha])
    Picture.fromarray(gray, "LA").save(tmp_path / "b.png")
    assert_frame_is_out(tmp_path / "b.png")


@pytest.mark.parametrize("alpha", [0, 255])
def test_alpha_that_is_the_same_everywhere_says_nothing(tmp_path: Path, alpha: int) -> None:
    path = write_png(tmp_path / "a.png", texture(), np.full((HEIGHT, WIDTH), alpha, np.uint8))
    for written in (path, write_tiff(tmp_path / "a.tif", np.dstack([texture(), np.full((HEIGHT, WIDTH), alpha)]))):
        pixels, valid = read_raster(written, colour=True)
        assert valid is None
        np.testing.assert_array_equal(pixels, texture())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("bands", [1, 3])
def test_transparent_pixels_of_a_tiff(tmp_path: Path, dtype: type, bands: int) -> None:
    """With the band named as alpha, and without."""
    pixels = filled(texture()[..., :bands].astype(dtype), 255)
    alpha = np.where(framed(), np.iinfo(dtype).max, 0).astype(dtype)
    inside = texture()[..., 0] if bands == 1 else texture()
    colours = "minisblack" if bands == 1 else "rgb"
    for name, named in (("a", "yes"), ("b", "no")):
        path = tmp_path / f"{name}.tif"
        write_tiff(path, np.dstack([pixels, alpha]), photometric=colours, alpha=named)
        assert_frame_is_out(path, inside)


def test_a_fourth_band_of_measured_values_is_no_alpha(tmp_path: Path) -> None:
    infrared = np.where(framed(), texture(1)[..., 0], 0).astype(np.uint8)
    path = write_tiff(tmp_path / "a.tif", np.dstack([texture(), infrared]), photometric="rgb", alpha="no")
    pixels, valid = read_raster(path, colour=True)
    assert valid is None
    np.testing.assert_array_equal(pixels, texture())


def test_the_nodata_value_counts_where_all_bands_have_it(tmp_path: Path) -> None:
    deep = filled(texture().astype(np.uint16) * 50, 65535)
    deep[200, 200, 0] = 65535  # a red light
    path = write_tiff(tmp_path / "a.tif", deep, nodata=65535, photometric="rgb")
    assert_frame_is_out(path, deep)
    # It does not count in the stretch: the picture has its contrast, where all of it was dark before.
    gray = read_pixels(path, colour=False)[framed()]
    assert gray.std() > 40
    assert_frame_is_out(write_tiff(tmp_path / "b.tif", filled(texture()[..., 0], 7), nodata=7))


@pytest.mark.parametrize("nodata", [-9999.0, 0.5, 256.0, float("nan")])
def test_nodata_values_that_the_type_cannot_hold_are_passed_over(nodata: float) -> None:
    from aeromatch_cli.images.gdal import _has_values

    assert _has_values(np.zeros((1, 4, 4), np.uint8), [nodata]) is None
    assert _has_values(np.zeros((2, 4, 4), np.uint8), [None, 0.0]) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, -10000.0, -3.4028234663852886e38])
@pytest.mark.parametrize("bands", [1, 3])
def test_nodata_of_float_pictures(tmp_path: Path, value: float, bands: int) -> None:
    pixels = filled(texture()[..., :bands].astype(np.float32) / 255, value)
    tag = {} if value == np.inf else {"nodata": value}
    path = write_tiff(tmp_path / "a.tif", pixels, **tag)
    assert_frame_is_out(path)
    found = read_pixels(path, colour=True)[framed()].astype(float)
    expected = texture()[framed()][:, :bands].reshape(found.shape) / np.percentile(texture()[framed()][:, :bands], 99.9)
    assert np.abs(found - np.minimum(expected, 1.0) * 65535).max() < 2


def test_nodata_of_negative_values_is_neither_counted_nor_gray(tmp_path: Path) -> None:
    """Hundredths of a degree from -10 to 30, frame -32768."""
    celsius = ((texture()[..., 0].astype(float) - 20.0) * 20.0 - 1000.0).astype(np.int16)
    path = write_tiff(tmp_path / "a.tif", filled(celsius, -32768), nodata=-32768)
    assert_frame_is_out(path)
    found = read_pixels(path, colour=True)[framed()].astype(float)
    expected = (celsius[framed()] + 1000.0) * 65535 / 4000.0
    assert np.abs(found - expected).max() < 500


def test_the_mask_inside_a_tiff(tmp_path: Path) -> None:
    assert_frame_is_out(write_tiff(tmp_path / "a.tif", filled(texture(), 200), mask=framed()), texture())


def test_ordinary_pictures_have_no_mask(tmp_path: Path) -> None:
    Picture.fromarray(texture()).save(tmp_path / "a.jpg")
    Picture.fromarray(filled(texture(), 255)).save(tmp_path / "a.png")
    write_tiff(tmp_path / "a.tif", filled(texture(), 255))
    for name in ("a.jpg", "a.png", "a.tif"):
        assert read_raster(tmp_path / name, colour=True)[1] is None
        assert read_raster(tmp_path / name, colour=False)[1] is None


# --- what the stages make of it -------------------------------------------------------------------------------------


def loaded(path: Path, mask: Path | None = None, *, colour: bool = True) -> tuple[NDArray[Any], BoolArray | None]:
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (400.0, 400.0, 159.5, 119.5))
    return read_source(Source(path, mask, camera, None, 1.0, ""), colour=colour)


def features(pixels: NDArray[Any], valid: BoolArray | None) -> Features:
    view = View("source", WIDTH, HEIGHT, np.eye(3), is_source=True, angle_deg=0.0)
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (400.0, 400.0, 159.5, 119.5))
    return Sift(keypoints=2000)(camera, (ViewPixels(view, pixels, valid),))


def test_the_mask_of_the_user_and_of_the_file_both_count(tmp_path: Path) -> None:
    alpha = np.where(framed(), 255, 0).astype(np.uint8)
    path = write_png(tmp_path / "a.png", filled(texture(), 255), alpha)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[-30:] = 0
    Picture.fromarray(mask).save(tmp_path / "m.png")
    _, valid = loaded(path, tmp_path / "m.png")
    np.testing.assert_array_equal(valid, framed() & (mask > 0))


def test_features_keep_as_far_from_any_frame_as_from_a_black_one(tmp_path: Path) -> None:
    alpha = np.where(framed(), 255, 0).astype(np.uint8)
    Picture.fromarray(filled(texture(), 0)).save(tmp_path / "black.png")
    paths = [
        write_png(tmp_path / "white.png", filled(texture(), 255), alpha),
        write_tiff(tmp_path / "tag.tif", filled(texture(), 255), nodata=255),
        write_tiff(tmp_path / "alpha.tif", np.dstack([filled(texture(), 140), alpha])),
    ]
    black = features(*loaded(tmp_path / "black.png", colour=False))
    assert len(black.keypoints_px) > 300
    for path in paths:
        found = features(*loaded(path, colour=False))
        np.testing.assert_array_equal(found.keypoints_px, black.keypoints_px)
        np.testing.assert_array_equal(found.descriptors, black.descriptors)
        inside = (found.keypoints_px - (FRAME, FRAME // 2)).min(axis=1)
        assert (inside > 0.9 * found.sizes_px).all()


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)])
def test_white_is_that_of_the_valid_pixels(shape: tuple[int, ...]) -> None:
    deep = np.random.default_rng(0).integers(1000, 9000, shape).astype(np.uint16)
    white = float(np.percentile(deep[framed()], 99.8))
    for value in (0, 60000):
        assert white_of(filled(deep, value), framed()) == white
        tone = tone_of(deep, filled(deep, value), framed())
        assert (tone.white, tone.linear) == (white, len(shape) == 2)
        assert make_overview(filled(deep, value), framed(), WIDTH).tone == tone
    assert white_of(deep, None) == float(np.percentile(deep, 99.8))
    assert white_of(deep, np.zeros(shape[:2], bool)) == white_of(deep, None)
    assert white_of(deep.astype(np.uint8), framed()) == 255.0


@pytest.mark.parametrize("name", sorted(EVERY))
@pytest.mark.parametrize("deep", [False, True])
def test_a_mask_that_masks_nothing_changes_nothing(name: str, deep: bool) -> None:
    pixels = texture().astype(np.uint16) * 200 if deep else texture()
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    found = EVERY[name]()(pixels, everywhere).pixels
    expected = EVERY[name]()(pixels, None).pixels
    assert np.abs(found.astype(int) - expected).max() <= (1 if name == "wallis" else 0)
