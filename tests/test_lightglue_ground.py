"""LightGlue that knows where keypoints are expected on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from make_lightglue import SIFT, features, seeded_tensors
from safetensors.torch import load_file, save_file
from trainings.lightglue.batches import as_side, expected, unit
from trainings.lightglue.sides import Partners, Seen

from aeromatch_cli.data import Camera, Pair, PairGeometry, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.prediction import ground_places
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.lightglue import LightGlue, Side
from aeromatch_cli.nets.lightglue_batch import match_batch
from aeromatch_cli.nets.lightglue_file import infer_dimensions, load_lightglue
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison
from aeromatch_cli.strategies.matchers.descriptors.search import finished
from aeromatch_cli.strategies.matchers.lightglue import learned
from aeromatch_cli.strategies.matchers.lightglue.inference import NetworkInput, network_input, with_expected_places
from aeromatch_cli.strategies.matchers.lightglue.learned import LearnedLightGlue
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue as SiftLightGlue

KNOWING = replace(SIFT, knows_ground=True)
EVERY_LAYER = {"threshold": 0.0, "depth_confidence": -1.0, "width_confidence": -1.0}
CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 319.5, 239.5))
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def network() -> LightGlue:
    tensors = seeded_tensors(KNOWING)
    # Attention between the pictures that counts.
    tensors = {key: value * (6.0 if "cross_attn" in key else 1.0) for key, value in tensors.items()}
    assert infer_dimensions(tensors) == KNOWING
    found = LightGlue(KNOWING)
    found.load_state_dict({key: value for key, value in tensors.items() if key != "confidence_thresholds"})
    return found.eval()


def side(count: int, seed: int, ground: torch.Tensor | None) -> Side:
    rng = np.random.default_rng(seed)
    places = torch.from_numpy(rng.uniform(-1.0, 1.0, (1, count, 4))).float()
    values = torch.from_numpy(np.random.default_rng(99).normal(size=(1, 80, 128)))[:, :count].float()
    return Side(places, torch.nn.functional.normalize(values, dim=-1), ground)


def grounds(shift: float) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(5)
    return (
        torch.from_numpy(rng.uniform(-1.0, 1.0, (1, 60, 2)) + shift).float(),
        torch.from_numpy(rng.uniform(-1.0, 1.0, (1, 80, 2)) + shift).float(),
    )


def test_only_the_difference_of_both_places_counts(network: LightGlue) -> None:
    answers = []
    for shift in (0.0, 0.25):
        ground0, ground1 = grounds(shift)
        answers.append(network.match(side(60, 1, ground0), side(80, 2, ground1), **EVERY_LAYER))
    assert answers[0][0].tolist() == answers[1][0].tolist()
    torch.testing.assert_close(answers[0][1], answers[1][1], atol=1e-3, rtol=0.0)
    unknown = network.match(side(60, 1, None), side(80, 2, None), **EVERY_LAYER)
    same = network.match(
        side(60, 1, torch.zeros(1, 60, 2)), side(80, 2, torch.zeros(1, 80, 2)), **EVERY_LAYER
    )  # one place for all: nothing is known
    torch.testing.assert_close(unknown[1], same[1])
    fewest = min(len(unknown[1]), len(answers[0][1]))
    assert not torch.allclose(unknown[1][:fewest], answers[0][1][:fewest], atol=1e-2)  # the places do count


def test_a_batch_answers_as_each_pair_alone(network: LightGlue) -> None:
    ground0, ground1 = grounds(0.0)
    sides0 = [side(60, 1, ground0), side(40, 3, ground0[:, :40])]
    sides1 = [side(80, 2, ground1), side(70, 4, ground1[:, :70])]
    together = match_batch(network, sides0, sides1, **EVERY_LAYER)
    for pair, (pairs, scores) in zip(zip(sides0, sides1, strict=True), together, strict=True):
        alone = network.match(*pair, **EVERY_LAYER)
        assert pairs.tolist() == alone[0].tolist()
        torch.testing.assert_close(scores, alone[1], atol=1e-4, rtol=0.0)


def test_rays_meet_the_ground_where_it_is_seen() -> None:
    rng = np.random.default_rng(1)
    pose = Pose(np.array([10.0, -20.0, 130.0]), STRAIGHT_DOWN, sigma_position_m=1.0, sigma_angle_deg=1.0)
    places_m = np.column_stack([rng.uniform(-20, 40, 50), rng.uniform(-50, 10, 50), np.full(50, 30.0)])
    points_px = project(CAMERA, STRAIGHT_DOWN, pose.center_m, places_m)
    assert np.allclose(ground_places(CAMERA, pose, points_px, 30.0), places_m[:, :2], atol=1e-6)


def test_expected_places_are_in_the_frame_of_the_first_view() -> None:
    """The second camera stands 12 m east and 5 m north of the first: the same pixel is as far off on the ground."""
    found = features(40)
    poses = [
        Pose(np.array([east, north, 100.0]), STRAIGHT_DOWN, sigma_position_m=1.0, sigma_angle_deg=1.0)
        for east, north in ((0.0, 0.0), (12.0, 5.0))
    ]
    geometry = PairGeometry(Pair("a", "b", 1.0, 0.0, "overlap"), CAMERA, CAMERA, *poses, ground_z_m=0.0)
    sides = [network_input(found, 0, np.ones(40, bool), 40) for _ in range(2)]
    side0, side1 = with_expected_places(*sides, (found, found), geometry)
    assert side0.ground is not None
    assert side1.ground is not None
    half_m = np.ptp(found.keypoints_px, axis=0).max() / 2.0 / 5.0  # 5 px a metre
    assert np.allclose(side1.ground - side0.ground, np.array([12.0, -5.0]) / half_m, atol=1e-4)
    assert np.abs(side0.ground).max() == pytest.approx(1.0, abs=1e-5)
    # As the picture: right is right, down is down.
    assert np.allclose(np.argsort(side0.ground[:, 1]), np.argsort(found.keypoints_px[:, 1]))
    nowhere = with_expected_places(*sides, (found, found), replace(geometry, ground_z_m=None))
    assert nowhere[0].ground is None


def test_training_expects_partners_at_the_same_place() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0, [640, 480], (50, 2)).astype(np.float32)
    turned = points @ np.array([[0.8, 0.6], [-0.6, 0.8]], np.float32) + np.float32(30.0)
    size = np.array([640.0, 480.0], np.float32)
    both = [Seen(p, np.ones(50), np.zeros(50), np.zeros((50, 128), np.int8), size, p) for p in (points, turned)]
    order = np.arange(50, dtype=np.int32)
    exact = expected(*both, Partners(order, order), 1e-9, rng)
    assert np.allclose(exact[0], exact[1], atol=1e-4)
    noisy = expected(*both, Partners(order, order), 0.1, rng)
    assert 0.02 < np.linalg.norm(noisy[0] - noisy[1], axis=1).mean() < 0.4
    none = np.full(50, -1, np.int32)
    assert not np.any(expected(*both, Partners(none, none), 0.1, rng)[1])


def test_descriptors_with_a_sign_keep_it() -> None:
    values = np.array([[3, -4] + [0] * 126], np.int8)
    one = Seen(np.zeros((1, 2)), np.ones(1), np.zeros(1), values, np.array([2.0, 2.0]), np.zeros((1, 2)))
    assert unit(as_side([one])).descriptors[0, 0, :2].tolist() == pytest.approx([0.6, -0.8])


def test_the_network_that_ships_knows_the_ground() -> None:
    assert load_lightglue(shipped_path("lightglue-learned")).dimensions.knows_ground
    assert not load_lightglue(shipped_path("lightglue")).dimensions.knows_ground


def compared() -> Comparison:
    """Two pictures of one texture from straight above, 12 m apart."""
    found = features(200)
    poses = [Pose(np.array([east, 0.0, 100.0]), STRAIGHT_DOWN, 1.0, 1.0) for east in (0.0, 12.0)]
    geometry = PairGeometry(Pair("a", "b", 1.0, 0.0, "overlap"), CAMERA, CAMERA, *poses, ground_z_m=0.0)
    return Comparison(found, features(200), geometry, np.ones((1, 1), bool))


def test_the_matcher_of_learned_features_guides_every_pair_and_begins_with_the_ratio_from_either_image() -> None:
    matcher = LearnedLightGlue()
    assert matcher.guided
    assert min(matcher.guide_below_matches, matcher.network_below_matches) > matcher.max_keypoints
    assert not SiftLightGlue().guided
    first, expected_first = matcher.scan(compared()), Bidirectional(ratio=0.9).scan(compared())
    assert len(first.rows) == 200
    assert np.array_equal(first.rows, expected_first.rows)
    assert np.array_equal(first.costs, expected_first.costs)


@pytest.mark.parametrize(("with_places", "known", "runs"), [(120, 150, 1), (20, 30, 2), (20, 10, 1)])
def test_places_that_hide_the_matches_are_left_out(
    monkeypatch: pytest.MonkeyPatch, with_places: int, known: int, runs: int
) -> None:
    """Where few matches agree with them, and no more than are known without the network."""
    asked: list[bool] = []

    def answer(inputs: Sequence[tuple[NetworkInput, NetworkInput]]) -> list[tuple[np.ndarray, np.ndarray]]:
        asked.extend(side.ground is not None for side, _ in inputs)
        count = with_places if asked[-1] else 150
        return [(np.repeat(np.arange(count), 2).reshape(-1, 2), np.full(count, 0.9))]

    monkeypatch.setattr(learned, "most_evident", lambda _, sets: max(sets, key=lambda one: len(one.rows)))
    found = finished(LearnedLightGlue().by_network(compared(), None, known), answer)
    assert asked == [True, False][:runs]
    assert len(found.rows) == (with_places if runs == 1 else 150)
    asked.clear()
    finished(LearnedLightGlue(expect_places=False).by_network(compared(), None, known), answer)
    assert asked == [False]


def test_weights_of_other_descriptors_are_refused(tmp_path: Path) -> None:
    """Both networks read 128 numbers a keypoint: what the file says tells them apart."""
    with pytest.raises(ConfigError, match="was trained on GeoDesc descriptors, and match=lightglue compares RootSIFT"):
        SiftLightGlue(weights=str(shipped_path("lightglue-learned"))).check_files(128)
    LearnedLightGlue(weights=str(shipped_path("lightglue-learned"))).check_files(128)
    unsaid = tmp_path / "own.safetensors"
    save_file(load_file(shipped_path("lightglue-learned")), unsaid)
    SiftLightGlue(weights=str(unsaid)).check_files(128)  # nothing says what it knows
