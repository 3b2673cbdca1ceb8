"""The renderer: texture of the ground, and light on it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic import noise, render_block
from aeromatch_cli.lab.synthetic.light import Light


def test_texture_fades_out_where_it_cannot_be_sampled() -> None:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-50, 50, (2, 20000)).astype(np.float32)
    fine, coarse = np.full(len(u), 0.02, np.float32), np.full(len(u), 0.5, np.float32)
    assert noise.octaves(u, v, fine, (0.5,), 1, 0).std() == pytest.approx(0.95, abs=0.08)
    assert not noise.octaves(u, v, coarse, (0.5,), 1, 0).any()
    for footprint in (fine, coarse):
        assert noise.stripes(u, 2.0, 0.3, footprint).mean() == pytest.approx(0.15, abs=0.01)
        assert noise.inside(u, footprint).mean() == pytest.approx(0.5, abs=0.02)
    covered, _ = noise.spots(u, v, 1.0, 0.5, 1, fine)
    # Half of the cells hold a disc of radius 0.10 to 0.26 m, uniformly: pi * mean(r^2) / 2.
    assert covered.mean() == pytest.approx(0.5 * np.pi * (0.18**2 + 0.16**2 / 12), abs=0.01)
    assert np.array_equal(
        noise.hash01(np.array([3, -3]), np.array([4, 4]), 5), noise.hash01(np.array([3, -3]), np.array([4, 4]), 5)
    )


def test_light_darkens_reddens_and_turns_with_the_sun() -> None:
    high, low = Light(180.0, 60.0), Light(180.0, 15.0)
    assert high.to_sun == pytest.approx([0.0, -0.5, np.sqrt(0.75)], abs=1e-12)
    assert (low.sun < high.sun).all()
    assert low.sun[2] / low.sun[0] < high.sun[2] / high.sun[0]
    disc = high.disc(200)
    angles = np.rad2deg(np.arccos(np.clip(disc @ high.to_sun, -1.0, 1.0)))
    assert angles.max() < 0.2665
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.2665 / np.sqrt(2.0), rel=0.02)  # even over the disc
    light = np.full((2, 3), 0.1, dtype=np.float32)
    seen = Light(180.0, 60.0, haze_per_km=0.5).through_air(light, np.array([0.0, 2000.0], dtype=np.float32))
    assert seen[0] == pytest.approx(light[0])
    assert seen[1, 2] > seen[1, 0] > 0.2


@pytest.mark.slow
def test_pictures_as_ground_texture(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    checker = (np.indices((200, 300)).sum(axis=0) // 20 % 2 * 200 + 20).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "pictures" / "checker.png"), checker)
    sizes = {"width_px": 96, "height_px": 72, "images": 1, "height_m": 30.0}
    render_block(tmp_path / "plain", "grass", **sizes)
    render_block(tmp_path / "laid", "grass", texture=tmp_path / "pictures", **sizes)
    plain, laid = (cv2.imread(str(tmp_path / k / "images/grass_0001.jpg"), 0).std() for k in ("plain", "laid"))
    assert laid > 2.0 * plain
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="holds no pictures"):
        render_block(tmp_path / "none", "grass", texture=tmp_path / "empty", **sizes)
