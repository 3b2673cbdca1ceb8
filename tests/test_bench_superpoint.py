"""The peer SuperPoint: places and descriptors against numbers known beforehand, and weights by path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from benchmarks.peers import base, superpoint, table

from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError


def options_of(weights: Path | None, keypoints: int = 200) -> Any:
    return base.Options(keypoints, "image", 1, 0, weights)


def scene_of(folder: Path) -> Any:
    cameras = {name: Camera("PINHOLE", 300, 236, (300.0, 300.0, 150.0, 118.0)) for name in ("a.png", "b.png")}
    pairs = (("a.png", "b.png"),)
    return base.Scene("s", folder, folder, folder, cameras, pairs)


def test_a_score_lies_at_its_pixel_of_its_cell() -> None:
    logits = torch.zeros(65, 4, 5)
    logits[64] = 12.0  # nothing anywhere, but
    for (row, column), channel in {(1, 2): 8 * 3 + 5, (2, 3): 8 * 7 + 0, (0, 1): 8 * 2 + 4}.items():
        logits[64, row, column] = 0.0
        logits[channel, row, column] = 9.0
    places, scores = superpoint.maxima(logits, 40, 32)
    strong = {tuple(place) for place, score in zip(places.tolist(), scores.tolist(), strict=True) if score > 0.9}
    assert strong == {(16 + 5, 8 + 3), (24 + 0, 16 + 7)}  # the third lies within 4 px of the border


def test_of_two_scores_within_four_pixels_the_larger_stays() -> None:
    logits = torch.full((65, 3, 3), -20.0)
    logits[64] = 0.0
    logits[8 * 4 + 3, 1, 1], logits[8 * 4 + 6, 1, 1] = 2.0, 1.0
    places, scores = superpoint.maxima(logits, 24, 24)
    assert [8 + 3, 8 + 4] in places[scores > 0.1].tolist()
    assert [8 + 6, 8 + 4] not in places.tolist()


def test_descriptors_are_read_between_the_centres_of_cells() -> None:
    columns = torch.arange(6.0)
    coarse = torch.stack([columns.expand(4, 6), torch.ones(4, 6)])  # tangent of the direction: the column
    places = torch.tensor([[20, 12], [24, 12], [31, 20]])
    found = superpoint.sampled(coarse, places)
    expected = (places[:, 0].float() + 0.5) / 8.0 - 0.5
    torch.testing.assert_close(found[:, 0] / found[:, 1], expected)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(3))


def test_weights_are_read_by_path_and_what_does_not_fit_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (240, 310), dtype=np.uint8), (0, 0), 1.5)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    # Neither side is a multiple of 8; b shows what a does, 8 pixels further left.
    for name, left in (("a.png", 0), ("b.png", 8)):
        cv2.imwrite(str(tmp_path / name), picture[:236, left : left + 300])
    with pytest.raises(ConfigError, match="not found in"):
        table.method("superpoint")(scene_of(tmp_path), options_of(tmp_path))
    torch.save({"conv1a.weight": torch.zeros(1)}, tmp_path / "superpoint_v1.pth")
    with pytest.raises(ConfigError, match="does not hold SuperPoint"):
        table.method("superpoint")(scene_of(tmp_path), options_of(tmp_path))

    torch.manual_seed(0)
    network = superpoint.Network()
    for layer in network.children():  # as drawn by default every place is described alike
        torch.nn.init.kaiming_normal_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    torch.save(network.state_dict(), tmp_path / "superpoint_v1.pth")
    method = table.method("superpoint")(scene_of(tmp_path), options_of(tmp_path))
    sides = [method.features(name) for name in ("a.png", "b.png")]
    for side in sides:
        assert side.descriptors.shape == (200, 256)
        assert (side.places_px >= 4).all()
        assert (side.places_px <= (295, 231)).all()
    found = method.match("a.png", "b.png", *sides)
    # Whatever the weights: a shift by whole cells changes no score and no descriptor but near the borders.
    inner = (np.abs(found.points0_px - (150, 118)) < (80, 48)).all(axis=1)
    shift = (found.points0_px - found.points1_px)[inner]
    assert len(shift) >= 15
    assert (np.abs(shift - (8.0, 0.0)).max(axis=1) < 0.5).mean() > 0.9
