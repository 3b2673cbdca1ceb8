"""The context network: what it must not depend on, and where it begins."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from trainings.context import command as train_context
from trainings.context import data
from trainings.context.validation import compared

from aeromatch_cli.nets.context import NEIGHBOURS, Context, evened, layout_of, load_context
from aeromatch_cli.nets.descriptor_bytes import as_bytes, from_bytes
from aeromatch_cli.strategies.extractors.context import context_inputs
from aeromatch_cli.strategies.extractors.detection import Raw


def raw_of(points: np.ndarray, sizes: np.ndarray) -> Raw:
    nothing = np.zeros(len(points), np.float32)
    return Raw(points, sizes, points, sizes, nothing, nothing, nothing.astype(np.int32), nothing.astype(np.int32))


def unit(count: int, rng: np.random.Generator) -> np.ndarray:
    values = rng.standard_normal((count, 128)).astype(np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def test_untrained_context_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 99, (40, 2)).astype(np.float32)
    picture = rng.integers(0, 255, (100, 100), np.uint8)
    descriptors = unit(40, rng)
    out = Context()(*context_inputs(descriptors, raw_of(points, np.full(40, 5.0, np.float32)), picture))
    np.testing.assert_allclose(out.detach().numpy(), descriptors, atol=1e-6)


def test_only_keypoints_near_a_change_of_the_picture_notice_it() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1999, (300, 2)).astype(np.float32)
    points[:, 1] *= 0.5  # not as high as wide: x and y are told apart
    picture = cv2.GaussianBlur(rng.integers(0, 255, (1000, 2000), np.uint8), (0, 0), 8)
    marked = picture.copy()
    marked[:200, 1800:] = rng.integers(0, 255, (200, 200), np.uint8)
    raw, descriptors, network = raw_of(points, np.full(300, 8.0, np.float32)), unit(300, rng), load_context()
    with torch.inference_mode():
        before, after = (network(*context_inputs(descriptors, raw, gray)).numpy() for gray in (picture, marked))
    moved = np.linalg.norm(after - before, axis=1)
    # 4 view pixels are one of the coarse picture, of which a value sees 28 to every side; light is made even over 31.
    far = np.abs(points - [1900, 100]).max(axis=1) > 100 + 4 * (28 + 15 + 4 + 1)
    inside = (points[:, 0] > 1820) & (points[:, 1] < 180)
    assert inside.sum() >= 3
    assert moved[inside].min() > 0.01
    assert moved[far].max() < 1e-5


def test_visual_context_is_taken_where_the_keypoint_lies() -> None:
    """Of a coarse picture with one bright pixel, untrained layers answer most at its own place, whatever its size."""
    network = Context()
    for layer in network.visual.layers[::2]:
        torch.nn.init.constant_(layer.weight, 0.1)
        torch.nn.init.zeros_(layer.bias)
    for height, width in ((160, 200), (161, 203)):
        x, y = torch.meshgrid(torch.arange(0.0, width), torch.arange(0.0, height), indexing="xy")
        places = torch.stack([x.ravel(), y.ravel()], dim=1)
        for column, row in ((100, 80), (60, 100)):
            spot = torch.zeros(1, 1, height, width)
            spot[0, 0, row, column] = 1.0
            with mock.patch("aeromatch_cli.nets.context.evened", lambda picture: picture), torch.inference_mode():
                answer = network.seen(spot, places)[:, 0]
            centre = (answer[:, None] * places).sum(dim=0) / answer.sum()
            np.testing.assert_allclose(centre.numpy(), [column, row], atol=0.3)


@pytest.mark.slow
def test_the_shipped_weights_are_as_good_as_their_card_says(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data, "RECIPES", data.RECIPES[:1])
    monkeypatch.setattr(data, "KEYPOINTS", 300)
    pairs = data.block_pairs(rendered, tmp_path / "block.npz")
    network = load_context()
    with torch.inference_mode():
        found = compared(pairs, lambda view: network(*train_context.inputs(view, None)[0]).numpy())
    plain = compared(pairs, lambda view: train_context.inputs(view, None)[0][0].numpy())
    # The card's figures: on today's keypoints there is nothing left to gain, and it is off by default.
    for angle, without, corrected in (("0-20", 0.984, 0.977), ("20-40", 0.948, 0.947)):
        assert plain[angle]["rank1"] == pytest.approx(without, abs=0.005)
        assert found[angle]["rank1"] == pytest.approx(corrected, abs=0.005)


@pytest.mark.parametrize("count", [1, 2, NEIGHBOURS, NEIGHBOURS + 1, 60])
def test_few_keypoints_have_neighbours_too(count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.uniform(0, 63, (count, 2)).astype(np.float32)
    inputs = context_inputs(
        unit(count, rng), raw_of(points, np.full(count, 5.0, np.float32)), np.zeros((64, 64), np.uint8)
    )
    assert inputs[3].shape == (count, NEIGHBOURS)
    assert bool(torch.isfinite(inputs[2]).all())
    assert Context()(*inputs).shape == (count, 128)


@given(turn=st.floats(-3.1, 3.1), scale=st.floats(0.3, 3.0))
@settings(max_examples=25, deadline=None)
def test_layout_turns_and_grows_with_the_keypoints(turn: float, scale: float) -> None:
    rng = np.random.default_rng(1)
    points, sizes, angles = rng.uniform(0, 100, (30, 2)), rng.uniform(4, 9, 30), rng.uniform(-3, 3, 30)
    near = torch.from_numpy(rng.integers(0, 30, (30, 5)))
    matrix = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    before, after = (
        layout_of(torch.from_numpy(p), torch.from_numpy(s), torch.from_numpy(a), near)
        for p, s, a in ((points, sizes, angles), (points @ matrix.T, sizes * scale, angles + turn))
    )
    np.testing.assert_allclose(before.numpy(), after.numpy(), atol=1e-9)


def test_picture_is_free_of_brightness_and_contrast() -> None:
    """Brightness to the digit; contrast but for what keeps noise of flat pictures small: 0.02 of a spread of 0.29."""
    picture = torch.rand(1, 1, 80, 90, generator=torch.Generator().manual_seed(0))
    plain = evened(picture)
    torch.testing.assert_close(evened(picture + 0.3), plain, atol=1e-4, rtol=0.0)
    faint, clear = evened(0.5 * picture), plain.abs() > 0.1
    ratio = (faint / plain)[clear]
    assert 0.91 < float(ratio.min()) <= float(ratio.max()) < 0.96


def test_bytes_keep_distances_to_a_hundredth() -> None:
    values = unit(300, np.random.default_rng(2))
    apart = np.linalg.norm(values[:150] - values[150:], axis=1)
    stored = as_bytes(values).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(stored[:150] - stored[150:], axis=1) / 256.0, apart, rtol=0.01)
    np.testing.assert_allclose(from_bytes(as_bytes(values)), values, atol=0.5 / 256.0 + 1e-6)
