"""Heights of reference points tell true matches from those that are wrong along the epipolar line."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from benchmarks.peers.heights import Heights
from conftest import IMAGES

from aeromatch_cli.data import FloatArray
from aeromatch_cli.evaluate.reference import load_reference
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses
from aeromatch_cli.lab.synthetic import render_block
from aeromatch_cli.lab.synthetic.truth import Truth, load_truth

# An image: the shared blocks have as many and more.
POINTS = 500
# A wrong match that verification has kept lies on its epipolar line, by so much beside its place.
BESIDE_PX = (6.0, 40.0)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("city") / "block"
    render_block(out, "city", seed=1, images=IMAGES, width_px=400, height_px=300, flight="mixed", jobs=1)
    return out


def random_px(truth: Truth, name: str, count: int, rng: np.random.Generator) -> FloatArray:
    camera = truth.cameras[name]
    return rng.random((count, 2)) * [camera.width_px - 1.0, camera.height_px - 1.0]


def test_true_matches_agree_with_the_heights_around_them_and_shifted_ones_do_not(block: Path) -> None:
    truth, rng = load_truth(block), np.random.default_rng(0)
    seen = np.concatenate(
        [truth.surface_points(name, random_px(truth, name, POINTS, rng)) for name in sorted(truth.cameras)]
    )
    heights = Heights(truth.cameras, truth.poses, seen[np.isfinite(seen).all(axis=1)])
    kept = {"true": np.zeros(2), "shifted": np.zeros(2)}
    for name0, name1 in combinations(sorted(truth.cameras), 2):
        points0 = random_px(truth, name0, 400, rng)
        points1, hidden = truth.transfer(name0, points0, name1)
        points0, points1 = points0[~hidden], points1[~hidden]
        matrix = fundamental_from_poses(
            truth.cameras[name0], truth.poses[name0], truth.cameras[name1], truth.poses[name1]
        )
        lines = np.column_stack([undistort(truth.cameras[name0], points0), np.ones(len(points0))]) @ matrix.T
        along = np.column_stack([-lines[:, 1], lines[:, 0]]) / np.linalg.norm(lines[:, :2], axis=1)[:, None]
        step_px = rng.uniform(*BESIDE_PX, len(points0)) * rng.choice([-1.0, 1.0], len(points0))
        for kind, there in (("true", points1), ("shifted", points1 + step_px[:, None] * along)):
            kept[kind] += heights.agreeing(name0, name1, points0, there).sum(), len(points0)
    assert kept["true"][1] > 800
    assert kept["true"][0] >= 0.93 * kept["true"][1]
    assert kept["shifted"][0] <= 0.12 * kept["shifted"][1]


def test_points_are_read_in_the_frame_of_the_poses(block: Path) -> None:
    """A reference has its frame; the truth that is read from it has moved its origin."""
    truth = load_truth(block)
    name = min(truth.cameras)
    seen = truth.surface_points(name, np.array([[200.0, 150.0]]))
    reference = load_reference(block)
    offset = reference.poses[name].center_m - truth.poses[name].center_m
    np.savez(block / "points.npz", xyz=seen)
    np.testing.assert_allclose(Heights.of(block, reference).points_m, seen + offset, atol=1e-3)
