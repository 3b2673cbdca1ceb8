"""Strategy `shadow` against scenes whose shadow is known."""

import json

import numpy as np
import pytest

from aeromatch_cli.lab.synthetic import render_block
from aeromatch_cli.nets.shadow import network_weights, shadow_logits
from aeromatch_cli.strategies.enhancers.relight import relit
from aeromatch_cli.strategies.enhancers.shadow import (
    MAX_LISTED_REGIONS,
    ShadowEnhancement,
    find_regions,
    gain_field,
    region_table,
)
from aeromatch_cli.strategies.enhancers.shadow_mask import SoftMask, make_overview, shadow_share, soft_mask
from aeromatch_cli.strategies.enhancers.tone import Tone

SKY_SHARE = np.array([0.21, 0.25, 0.33])  # of sun and sky together: shadow is bluer
HEIGHT, WIDTH = 240, 320


def stored(light: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear light."""
    light = np.clip(light, 0.0, 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * level).astype(np.uint8)


def ground() -> np.ndarray:
    """(H, W, 3) albedo: textured pavement with a lawn."""
    import cv2

    rng = np.random.default_rng(5)
    fine = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)).astype(np.float32), (0, 0), 1.2)
    coarse = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)).astype(np.float32), (0, 0), 9.0)
    texture = 1.0 + 2.0 * (fine - 0.5) + 4.0 * (coarse - 0.5)
    albedo = texture[..., None] * np.array([0.36, 0.35, 0.33])
    albedo[150:, :120] = texture[150:, :120, None] * np.array([0.20, 0.26, 0.10])
    return np.clip(albedo, 0.02, 0.9)


def cast() -> np.ndarray:
    """(H, W) bool: where a tall house, its long side across, throws its shadow."""
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[60:130, 90:260] = True
    mask[130:190, 200:260] = True
    return mask


def sunny() -> np.ndarray:
    return stored(ground())


def shaded() -> np.ndarray:
    light = ground()
    light[cast()] *= SKY_SHARE
    return stored(light)


def true_soft(mask: np.ndarray) -> SoftMask:
    share = mask.astype(np.float32)
    return SoftMask(np.zeros_like(share), share, share)


def test_weights_are_of_the_architecture():
    weights = network_weights()
    assert len(weights) == 30
    assert weights["down0.0.weight"].shape[0] == 9 * 12
    assert weights["out.weight"].shape[1] == 4
    assert all(np.isfinite(array).all() for array in weights.values())


def test_the_network_is_torchs_convolutions():
    import torch

    weights = network_weights()
    inputs = np.random.default_rng(1).normal(size=(64, 96, 3)).astype(np.float32)
    named = {name: torch.from_numpy(array) for name, array in weights.items()}

    def layer(x, name):
        kernel = named[f"{name}.weight"].reshape(3, 3, x.shape[1], -1).permute(3, 2, 0, 1)
        return torch.relu(torch.nn.functional.conv2d(x, kernel, named[f"{name}.bias"], padding=1))

    x = torch.nn.functional.pixel_unshuffle(torch.from_numpy(inputs).permute(2, 0, 1)[None], 2)
    skipped = []
    for scale in range(5):
        x = torch.nn.functional.max_pool2d(x, 2) if scale else x
        x = layer(layer(x, f"down{scale}.0"), f"down{scale}.1")
        skipped.append(x)
    for scale in (3, 2, 1, 0):
        coarse = torch.nn.functional.interpolate(x, scale_factor=2, mode="nearest")
        x = layer(torch.cat([skipped[scale], coarse], dim=1), f"up{scale}")
    x = torch.einsum("bchw,cd->bdhw", x, named["out.weight"]) + named["out.bias"][None, :, None, None]
    expected = torch.nn.functional.pixel_shuffle(x, 2)[0, 0].numpy()
    assert np.allclose(shadow_logits(inputs, weights), expected, atol=1e-3)


def test_sides_that_do_not_divide_are_refused():
    with pytest.raises(ValueError, match="multiples of 32"):
        shadow_logits(np.zeros((40, 64, 3), np.float32), network_weights())


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> tuple[np.ndarray, np.ndarray]:
    """One rendered picture of a town from above, and its shadow."""
    import cv2

    folder = tmp_path_factory.mktemp("town")
    render_block(folder, "city", seed=31, width_px=480, height_px=360, images=1)
    pixels = cv2.cvtColor(cv2.imread(str(folder / "images" / "city_0001.jpg")), cv2.COLOR_BGR2RGB)
    return pixels, cv2.imread(str(folder / "truth" / "city_0001.sun.png"), cv2.IMREAD_UNCHANGED) < 128


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


@pytest.mark.slow
def test_shadow_of_a_town_is_found_and_lifted(town):
    pixels, true = town
    enhanced = ShadowEnhancement()(pixels, None)
    assert true.mean() > 0.1
    assert overlap(enhanced.mask > 0, true) > 0.65
    lit, before, after = pixels[~true].mean(), pixels[true].mean(), enhanced.pixels[true].mean()
    assert before < 0.6 * lit
    assert 0.65 * lit < after < 1.2 * lit
    import cv2

    gray_before, gray_after = (cv2.cvtColor(some, cv2.COLOR_RGB2GRAY).astype(int) for some in (pixels, enhanced.pixels))
    assert (gray_after >= gray_before - 1).all()
    # Skylight is bluer than the sun's: more than half of that goes.
    blue = [float(some[..., 2].mean() / some.mean()) for some in (pixels[~true], pixels[true], enhanced.pixels[true])]
    assert blue[1] > blue[0] + 0.05
    assert abs(blue[2] - blue[0]) < 0.5 * (blue[1] - blue[0])


def test_facts_are_bounded_and_json_ready(town):
    enhanced = ShadowEnhancement()(town[0], None)
    facts = json.loads(json.dumps(enhanced.info, allow_nan=False))
    assert facts["shadow_share"] == pytest.approx(np.mean(enhanced.mask > 0), abs=1e-5)
    assert 2.0 < facts["start_gain"] < 8.0
    assert 1 <= len(facts["regions"]) <= min(MAX_LISTED_REGIONS, facts["region_count"])
    assert all(region["gain"] >= 1.0 for region in facts["regions"])


def test_a_picture_without_shadow_passes_unchanged():
    enhanced = ShadowEnhancement()(sunny(), None)
    assert np.array_equal(enhanced.pixels, sunny())
    assert not enhanced.mask.any()
    assert enhanced.info["regions"] == []


def test_invalid_pixels_are_neither_shadow_nor_changed(town):
    pixels, _ = town
    valid = np.ones(pixels.shape[:2], dtype=bool)
    valid[:, 240:] = False
    enhanced = ShadowEnhancement()(pixels, valid)
    assert enhanced.mask[:, :240].any()
    assert not enhanced.mask[:, 240:].any()
    assert np.array_equal(enhanced.pixels[:, 240:], pixels[:, 240:])


def test_equal_calls_give_equal_bytes(town):
    first, second = (ShadowEnhancement()(town[0], None) for _ in range(2))
    assert np.array_equal(first.pixels, second.pixels)
    assert np.array_equal(first.mask, second.mask)


@pytest.mark.parametrize("kind", ["gray", "deep", "linear gray"])
def test_other_kinds_of_pictures_are_lifted_too(town, kind):
    colour, true = town
    light = Tone(255.0, linear=False).light(colour / np.float32(255.0))
    pixels = {
        "gray": lambda: np.rint(colour.mean(axis=2)).astype(np.uint8),
        "deep": lambda: colour.astype(np.uint16) * 60,
        "linear gray": lambda: np.rint(light.mean(axis=2) * 20000.0).astype(np.uint16),
    }[kind]()
    enhanced = ShadowEnhancement()(pixels, None)
    assert enhanced.pixels.dtype == pixels.dtype
    assert overlap(enhanced.mask > 0, true) > 0.5
    assert enhanced.pixels[true].mean() > 1.25 * pixels[true].mean()


def regions_of(pixels: np.ndarray, mask: np.ndarray, *, exponent: float = 0.5):
    overview = make_overview(pixels, None, max(pixels.shape))
    share = mask.astype(np.float32)
    return overview, find_regions(overview, share, exponent=exponent, max_gain=16.0, min_area_px=4)


def test_the_start_factor_is_the_ratio_of_light_on_the_same_ground():
    _, regions = regions_of(shaded(), cast())
    lit = ground()[cast()].mean()
    dark = (ground() * SKY_SHARE)[cast()].mean()
    assert regions.start == pytest.approx(lit / dark, rel=0.1)


def test_a_deeper_shadow_gets_more_light():
    light = ground()
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[30:90, 30:120] = mask[30:90, 180:270] = True
    light[30:90, 30:120] *= 0.3
    light[30:90, 180:270] *= 0.15
    _, regions = regions_of(stored(light), mask)
    gain = np.exp(regions.log_gain)
    shallow, deep = int(regions.labels[60, 70]), int(regions.labels[60, 220])
    assert gain[deep] / gain[shallow] == pytest.approx(2.0**0.5, rel=0.1)
    field = gain_field(regions)
    assert field[60, 220] == pytest.approx(regions.log_gain[deep])
    rows = region_table(regions, 2.0)
    assert [row["area_px"] for row in rows] == [4 * 60 * 90] * 2
    assert {tuple(row["box_px"]) for row in rows} == {(60, 60, 180, 120), (360, 60, 180, 120)}
    assert regions_of(stored(light), mask, exponent=0.0)[1].log_gain[1] == pytest.approx(np.log(regions.start))


def test_light_is_restored_exactly_under_the_true_mask_and_hue_stays():
    log_gain = np.full((HEIGHT, WIDTH), np.log(1.0 / 0.25), dtype=np.float32)
    light = ground()
    light[cast()] *= 0.25
    lifted, mask = relit(
        stored(light), None, true_soft(cast()), cast(), log_gain, Tone(255.0, linear=False), np.zeros(2)
    )
    inner = np.s_[66:124, 96:254]
    assert np.abs(lifted[inner].astype(float) - sunny()[inner]).mean() < 3.0
    assert (mask > 0)[inner].all()
    before, after = (picture[inner].reshape(-1, 3).astype(float) for picture in (stored(light), lifted))
    # One factor for all bands: what each is of the brightest stays, up to rounding.
    shift = after / after.max(axis=1, keepdims=True) - before / before.max(axis=1, keepdims=True)
    assert np.abs(shift).max() < 0.02


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("gain", [1.5, 4.0, 12.0])
def test_gains_are_monotone_and_keep_highlights(linear, gain):
    tone = Tone(255.0, linear=linear)
    levels = np.linspace(0.0, 1.0, 512, dtype=np.float32)[None]
    raised = levels * tone.factor(levels, np.full_like(levels, np.log(gain)))
    assert (np.diff(raised) > -1e-6).all()
    assert (raised >= levels - 1e-6).all()
    assert raised.max() <= 1.0 + 1e-5
    small = np.float32(0.05)
    factor = tone.factor(np.array([[small]]), np.array([[np.log(gain)]], dtype=np.float32))[0, 0]
    assert tone.light(small * factor) / tone.light(small) == pytest.approx(gain, rel=0.12)


def test_large_pictures_follow_edges_finer_than_the_overview(town):
    import cv2

    pixels, true = town
    fine = cv2.resize(pixels, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    found = ShadowEnhancement(detection_px=480)(fine, None).mask > 0
    assert found.shape == fine.shape[:2]
    assert overlap(found[1::3, 1::3], true) > 0.6


def test_the_share_is_bounded_and_follows_the_valid_area():
    valid = np.zeros((HEIGHT, WIDTH), dtype=bool)
    valid[:, :160] = True
    overview = make_overview(shaded(), valid, 160)
    share = shadow_share(overview)
    assert share.shape == (120, 160)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert not share[:, 81:].any()
    assert soft_mask(overview, share).share.shape == share.shape
