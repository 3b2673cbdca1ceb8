"""Enhancers keep shape, dtype and their input; the simple ones do what their formulas say."""

import colorsys
import json

import numpy as np
import pytest

from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.strategies import Enhanced
from aeromatch_cli.strategies.enhancers import ENHANCERS

EVERY = {**ENHANCERS, **ARMS["enhance"]}


def enhance(name: str, pixels: np.ndarray, valid: np.ndarray | None = None, **settings: object) -> Enhanced:
    return EVERY[name](**settings)(pixels, valid)


def textured(shape: tuple[int, ...], dtype: type, *, top: int) -> np.ndarray:
    """Smooth random texture of values 0 to top."""
    import cv2

    rng = np.random.default_rng(3)
    values = cv2.GaussianBlur(rng.random(shape).astype(np.float32), (0, 0), 3.0)
    values = (values - values.min()) / (values.max() - values.min())
    return (values * top).astype(dtype)


@pytest.mark.parametrize("name", sorted(EVERY))
@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3), (1, 1), (2, 300), (33, 31, 3), (40, 60, 2)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_shape_dtype_and_input_stay(name, shape, dtype):
    pixels = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    before = pixels.copy()
    enhanced = enhance(name, pixels)
    assert enhanced.pixels.shape == shape
    assert enhanced.pixels.dtype == dtype
    assert np.array_equal(pixels, before)
    assert enhanced.mask is None or (enhanced.mask.shape == shape[:2] and enhanced.mask.dtype == np.uint8)
    json.dumps(enhanced.info, allow_nan=False)


@pytest.mark.parametrize("name", sorted(EVERY))
@pytest.mark.parametrize("level", [0, 90, 255])
def test_a_flat_picture_and_one_without_valid_pixels_pass(name, level):
    pixels = np.full((64, 80, 3), level, dtype=np.uint8)
    assert np.ptp(enhance(name, pixels).pixels) == 0
    enhanced = enhance(name, pixels, np.zeros((64, 80), dtype=bool))
    assert enhanced.pixels.shape == pixels.shape
    assert enhanced.mask is None or not enhanced.mask.any()


def test_none_changes_nothing():
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    enhanced = enhance("none", pixels, np.ones((3, 4), dtype=bool))
    assert np.array_equal(enhanced.pixels, pixels)
    assert enhanced.mask is None
    assert enhanced.info == {}


@pytest.mark.parametrize("name", ["clahe", "wallis"])
@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 60), (np.uint16, 9000)])
def test_local_contrast_grows(name, dtype, top):
    pixels = textured((128, 160), dtype, top=top)
    pixels[:4] = 4 * top  # the picture's white
    after = enhance(name, pixels, **({"window_share": 0.3} if name == "wallis" else {})).pixels
    assert after[5:].std() > 1.2 * pixels[5:].std()


@pytest.mark.parametrize("name", ["clahe", "wallis"])
def test_hue_stays(name):
    gray = textured((96, 96), np.uint8, top=90) + 20
    pixels = np.stack([gray, gray // 2, gray // 4], axis=2)
    after = enhance(name, pixels, **({"mean": 0.3, "standard_deviation": 0.1} if name == "wallis" else {})).pixels
    unclipped = after.max(axis=2) < 250
    hues = [colorsys.rgb_to_hsv(*pixel)[0] * 360.0 for pixel in after[unclipped][::97].astype(float)]
    wanted = [colorsys.rgb_to_hsv(*pixel)[0] * 360.0 for pixel in pixels[unclipped][::97].astype(float)]
    assert unclipped.mean() > 0.9
    assert np.abs(np.subtract(hues, wanted)).max() < 3.0


def test_wallis_brings_halves_of_different_light_to_the_same_mean_and_spread():
    texture = textured((200, 400), np.uint8, top=200).astype(np.float64)
    texture[:, :200] *= 0.2
    after = enhance("wallis", texture.astype(np.uint8), window_share=0.2).pixels.astype(float)
    dark, bright = after[:, 20:140], after[:, 260:380]
    assert abs(dark.mean() - bright.mean()) < 25.0
    assert dark.std() / bright.std() > 0.4  # 0.2 before


def test_wallis_is_the_same_wherever_its_strips_end(monkeypatch):
    from aeromatch_cli.lab.strategies import wallis

    pixels = textured((150, 90), np.uint8, top=255)
    whole = enhance("wallis", pixels).pixels
    monkeypatch.setattr(wallis, "_STRIP_ROWS", 17)
    assert np.abs(enhance("wallis", pixels).pixels.astype(int) - whole).max() <= 1


def test_wallis_leaves_nodata_out_of_its_neighbourhoods():
    whole = np.random.default_rng(0).integers(60, 120, (200, 300)).astype(np.uint8)
    valid = np.ones(whole.shape, dtype=bool)
    valid[:, :100] = False
    framed = np.where(valid, whole, 0).astype(np.uint8)
    beside = np.s_[:, 101:106]
    expected = enhance("wallis", whole).pixels[beside].astype(int)
    found = enhance("wallis", framed, valid).pixels[beside].astype(int)
    taken_in = enhance("wallis", framed).pixels[beside].astype(int)
    assert np.abs(found - expected).mean() < 3.0 < 15.0 < np.abs(taken_in - expected).mean()
