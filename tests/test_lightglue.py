"""The matcher around LightGlue: what the network is given, and what becomes of its answers. Untrained weights."""

from __future__ import annotations

import dataclasses
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from make_lightglue import SIFT, Answers, features, seeded_tensors, stand_in, write
from pydantic import ValidationError
from safetensors.torch import save_file

from aeromatch_cli.data import Camera, Features, FloatArray, Matches, Pair, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.lightglue import Side
from aeromatch_cli.nets.lightglue_file import CALIBRATION_KEY, read_calibration
from aeromatch_cli.strategies.matchers.descriptors.comparison import Found, joined
from aeromatch_cli.strategies.matchers.lightglue.inference import wrapped_rad
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (600.0, 319.5, 239.5))
GEOMETRY = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, None, None, None)
OF_VIEWS = {"view_sizes_px", "view_angles_deg", "view_directions", "view_gsd_m", "view_enhanced"}


class NetworkAlone(LightGlue):
    """Without the ratio test's matches."""

    def scan(self, *_: object) -> Found:
        return joined([])


def recipe(weights: str, **settings: Any) -> LightGlue:
    """The network alone in full precision, so that tests can compare to the last digits."""
    return NetworkAlone(weights=weights, **{"precision": "float32", **settings})


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write(tmp_path_factory.mktemp("weights") / "sift.pth", seeded_tensors(SIFT)))


def permuted(original: Features, order: np.ndarray) -> Features:
    """The same keypoints listed in another order: new row n is old row order[n]."""
    rows = {field.name: getattr(original, field.name) for field in dataclasses.fields(original)}
    for name in rows.keys() - {*OF_VIEWS, "descriptor_keypoint_idx", "colours"}:
        rows[name] = rows[name][order]
    return Features(**rows)


def noisy(original: Features, shift_px: float) -> Features:
    moved = np.clip(original.view_keypoints_px + np.float32(shift_px), 0, [639, 479]).astype(np.float32)
    return dataclasses.replace(original, keypoints_px=moved, view_keypoints_px=moved)


def two_views(view0: Features, view1: Features) -> Features:
    """One image whose keypoint n is row n of both views."""
    rows = {field.name: getattr(view0, field.name) for field in dataclasses.fields(view0)}
    for name in rows.keys() - {"keypoints_px", "sizes_px", "responses", "colours"}:
        rows[name] = np.concatenate([rows[name], getattr(view1, name)])
    return Features(**rows | {"view_idx": np.repeat(np.arange(2, dtype=np.int32), len(view0.keypoints_px))})


def as_dict(matches: Matches) -> dict[tuple[int, int], float]:
    return {(int(i), int(j)): float(s) for (i, j), s in zip(matches.indices, matches.scores, strict=True)}


def test_nothing_is_downloaded(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    assert len(recipe(weights, threshold=0.05)(features(40), features(40), GEOMETRY).indices) > 0


def test_equal_pictures_match_point_by_point(weights: str) -> None:
    first, second = features(200), noisy(features(200), 2.0)
    matches = recipe(weights)(first, second, GEOMETRY)
    assert (matches.indices.dtype, matches.scores.dtype, matches.view_pairs.dtype) == (np.int32, np.float32, np.int16)
    assert len(matches.indices) > 150
    assert (matches.indices[:, 0] == matches.indices[:, 1]).mean() > 0.95
    assert (np.diff(matches.indices[:, 0]) > 0).all()
    assert len(np.unique(matches.indices[:, 1])) == len(matches.indices)
    assert matches.scores.min() > 0.1
    assert matches.scores.max() <= 1.0
    assert (matches.view_pairs == 0).all()
    assert matches.points0_px is None


def test_the_order_of_keypoints_only_renames_matches(weights: str) -> None:
    first, second = features(150), noisy(features(150), 2.0)
    order = np.random.default_rng(2).permutation(150)
    plain = as_dict(recipe(weights)(first, second, GEOMETRY))
    shuffled = as_dict(recipe(weights)(first, permuted(second, order), GEOMETRY))
    renamed = {(i, int(order[j])): score for (i, j), score in shuffled.items()}
    assert renamed.keys() == plain.keys()
    np.testing.assert_allclose([renamed[key] for key in plain], list(plain.values()), atol=1e-4)


def test_swapping_the_images_swaps_the_matches(weights: str) -> None:
    first, second = features(150), noisy(features(170), 2.0)
    forth = as_dict(recipe(weights)(first, second, GEOMETRY))
    back = as_dict(recipe(weights)(second, first, GEOMETRY))
    assert {(j, i) for i, j in back} == forth.keys()


def test_the_same_call_gives_the_same_bits(weights: str) -> None:
    first, second = features(150), noisy(features(150), 2.0)
    runs = [recipe(weights)(first, second, GEOMETRY) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].indices, runs[1].indices)
    np.testing.assert_array_equal(runs[0].scores, runs[1].scores)


@pytest.mark.parametrize(("count0", "count1"), [(0, 0), (0, 30), (30, 0), (1, 1), (1, 30), (2, 1)])
def test_few_keypoints_are_no_error(weights: str, count0: int, count1: int) -> None:
    matches = recipe(weights, threshold=0.0)(features(count0), features(count1, seed=1), GEOMETRY)
    assert matches.indices.shape == (len(matches.scores), 2)
    assert matches.view_pairs.shape == matches.indices.shape
    assert len(matches.indices) <= min(count0, count1)


def test_images_without_views_match_nothing(weights: str) -> None:
    nothing = dataclasses.replace(
        features(0),
        view_sizes_px=np.zeros((0, 2), np.int32),
        view_angles_deg=np.zeros(0, np.float32),
        view_directions=np.zeros((0, 3), np.float32),
        view_gsd_m=np.zeros(0, np.float32),
        view_enhanced=np.zeros(0, bool),
    )
    assert recipe(weights)(nothing, features(20), GEOMETRY).indices.shape == (0, 2)


def test_points_over_the_border_are_clipped(weights: str) -> None:
    original = features(60)
    moved = original.view_keypoints_px.copy()
    moved[:3] = [[-0.8, 5.0], [639.9, 479.9], [10.0, -3.0]]
    outside = dataclasses.replace(original, view_keypoints_px=moved)
    assert len(recipe(weights)(outside, outside, GEOMETRY).indices) > 40


def test_several_views_are_merged_one_to_one(weights: str) -> None:
    pictures0 = [features(60), features(60, seed=9)]
    pictures1 = [features(60, seed=8), features(60, seed=7)]
    matcher = recipe(weights, threshold=0.01)
    # By hand: the matches of all four view pairs, best first, each keypoint once.
    found = [
        (score, key, (v0, v1))
        for v0 in range(2)
        for v1 in range(2)
        for key, score in as_dict(matcher(pictures0[v0], pictures1[v1], GEOMETRY)).items()
    ]
    expected: dict[tuple[int, int], tuple[float, tuple[int, int]]] = {}
    for score, key, views in sorted(found, reverse=True):
        if all(key[0] != i and key[1] != j for i, j in expected):
            expected[key] = (score, views)
    matches = matcher(two_views(*pictures0), two_views(*pictures1), GEOMETRY)
    assert as_dict(matches) == {key: score for key, (score, _) in expected.items()}
    assert [tuple(v) for v in matches.view_pairs.tolist()] == [expected[key][1] for key in sorted(expected)]
    assert len({views for _, views in expected.values()}) > 1


def test_the_budget_keeps_the_strongest(weights: str) -> None:
    first = features(100)
    matches = recipe(weights, max_keypoints=30)(first, first, GEOMETRY)
    strongest = np.argsort(-first.responses)[:30]
    assert len(matches.indices) > 15
    assert set(matches.indices.ravel().tolist()) <= set(strongest.tolist())


def test_scale_and_orientation_reach_the_network(weights: str) -> None:
    first, second = features(100), noisy(features(100), 2.0)
    plain = as_dict(recipe(weights, threshold=0.0)(first, second, GEOMETRY))
    turned_by_360 = dataclasses.replace(second, view_orientation_deg=second.view_orientation_deg - np.float32(360.0))
    np.testing.assert_allclose(
        list(as_dict(recipe(weights, threshold=0.0)(first, turned_by_360, GEOMETRY)).values()),
        list(plain.values()),
        atol=1e-3,
    )
    for change in (
        {"view_orientation_deg": second.view_orientation_deg + 90},
        {"view_size_px": second.view_size_px * 4},
    ):
        changed = recipe(weights, threshold=0.0)(first, dataclasses.replace(second, **change), GEOMETRY)
        shared = plain.keys() & as_dict(changed).keys()
        assert max(abs(as_dict(changed)[key] - plain[key]) for key in shared) > 1e-3


@pytest.mark.parametrize(
    ("degrees", "radians"),
    [
        (0, 0.0),
        (90, np.pi / 2),
        (180, np.pi),
        (-180, np.pi),
        (181, -179 * np.pi / 180),
        (359, -np.pi / 180),
        (540, np.pi),
    ],
)
def test_orientations_are_wrapped_half_open(degrees: float, radians: float) -> None:
    wrapped: FloatArray = wrapped_rad(np.array([degrees], np.float32))
    np.testing.assert_allclose(wrapped, [radians], atol=1e-6)


def by_hand() -> Features:
    """Three keypoints; two lie in view 0 (640 x 480), the third in view 1 (200 x 100)."""
    descriptors = np.zeros((3, 128), np.uint8)
    descriptors[0, :2], descriptors[1, 5], descriptors[2, 7] = (30, 40), 200, 9
    places = np.array([[10.0, 20.25], [-0.7, 480.0], [150.0, 60.0]], np.float32)
    return Features(
        keypoints_px=np.array([[400.0, 300.0], [1.0, 2.0], [3.0, 4.0]], np.float32),  # in the source: not what is sent
        sizes_px=np.array([90.0, 91.0, 92.0], np.float32),
        responses=np.ones(3, np.float32),
        descriptors=descriptors,
        descriptor_keypoint_idx=np.array([0, 1, 2], np.int32),
        view_idx=np.array([0, 0, 1], np.int32),
        view_keypoints_px=places,
        view_size_px=np.array([3.0, 8.0, 5.0], np.float32),
        view_orientation_deg=np.array([270.0, 180.0, 45.0], np.float32),
        view_sizes_px=np.array([[640, 480], [200, 100]], np.int32),
        view_angles_deg=np.zeros(2, np.float32),
        view_directions=np.full((2, 3), np.nan, np.float32),
        view_gsd_m=np.full(2, np.nan, np.float32),
        view_enhanced=np.zeros(2, bool),
    )


def given_to(network: Answers, weights: str, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Side, Side]]:
    stand_in(monkeypatch, network)
    recipe(weights)(by_hand(), by_hand(), GEOMETRY)
    return [(side0, side1) for side0, side1, _ in network.given]


def test_what_the_network_is_given(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = given_to(Answers(), weights, monkeypatch)
    assert len(given) == 4  # every view with every view
    first, last = given[0][0], given[3][1]
    # From the corner of the picture, clipped to it, middle 0, half the longer side 1.
    points = [[(10.5 - 320) / 320, (20.75 - 240) / 320], [-1.0, 0.75]]
    np.testing.assert_allclose(first.places[0, :, :2].numpy(), points, atol=1e-6)
    np.testing.assert_allclose(last.places[0, :, :2].numpy(), [[0.505, 0.105]], atol=1e-6)
    assert first.places[0, :, 2].tolist() == [1.5, 4.0]
    np.testing.assert_allclose(first.places[0, :, 3].numpy(), [-np.pi / 2, np.pi], atol=1e-6)
    np.testing.assert_allclose(last.places[0, :, 3].numpy(), [np.pi / 4], atol=1e-6)
    np.testing.assert_allclose(first.descriptors[0, 0, :3].numpy(), [0.6, 0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(torch.linalg.norm(first.descriptors, dim=2).numpy(), [[1.0, 1.0]], atol=1e-6)
    assert (first.places.dtype, first.descriptors.dtype) == (torch.float32, torch.float32)


@pytest.mark.parametrize(("count", "runs"), [(400, False), (200, True)])
def test_the_network_runs_where_the_ratio_test_leaves_few(
    weights: str, monkeypatch: pytest.MonkeyPatch, count: int, runs: bool
) -> None:
    recorder = Answers()
    stand_in(monkeypatch, recorder)
    matches = LightGlue(weights=weights)(features(count), noisy(features(count), 2.0), GEOMETRY)
    assert bool(recorder.given) == runs
    # The ratio test's stay where the network finds nothing.
    assert len(matches.indices) == pytest.approx(count, rel=0.05)


def test_networks_without_scale_and_orientation_get_none(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = given_to(Answers(dimensions=dataclasses.replace(SIFT, add_scale_ori=False)), weights, monkeypatch)
    assert given[0][0].places.shape == (1, 2, 2)


def test_other_descriptors_are_refused(weights: str) -> None:
    short = features(20)
    short = dataclasses.replace(short, descriptors=short.descriptors[:, :64])
    with pytest.raises(ConfigError, match="length 128, the extractor makes 64"):
        recipe(weights)(short, short, GEOMETRY)


def test_missing_weights_say_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("aeromatch_cli.nets.files.SHIPPED_FOLDER", tmp_path)
    with pytest.raises(ConfigError, match=r"lightglue.safetensors is missing: install aeromatch again"):
        LightGlue().fingerprint_files()
    with pytest.raises(ConfigError, match=r"no such file.*aeromatch weights add"):
        LightGlue(weights=str(tmp_path / "absent.pth"))(features(3), features(3), GEOMETRY)
    with pytest.raises(ConfigError, match="is a folder"):
        LightGlue(weights=str(tmp_path)).fingerprint_files()


def test_weights_of_a_user_are_found_wanting_before_anything_is_matched(weights: str, tmp_path: Path) -> None:
    recipe(weights).check_files(128)
    LightGlue().check_files(128)
    with pytest.raises(ConfigError, match="length 128, the extractor makes 64"):
        recipe(weights).check_files(64)
    (tmp_path / "other.safetensors").write_bytes(b"not a network")
    with pytest.raises(ConfigError, match=r"other\.safetensors is damaged"):
        recipe(str(tmp_path / "other.safetensors")).check_files(128)


def test_surer_matches_are_only_those_above_the_threshold(weights: str) -> None:
    assert recipe(weights, threshold=0.1)._least_probabilities() == [0.1, 0.3, 0.5, 0.8]
    assert recipe(weights, threshold=0.8)._least_probabilities() == [0.8]


def test_fingerprint_files_and_schema(weights: str) -> None:
    matcher = recipe(weights)
    assert matcher.fingerprint_files() == (weights,)
    assert hash(matcher) == hash(recipe(weights))
    with pytest.raises(ValidationError):
        LightGlue(weight="x")  # type: ignore[call-arg]


def test_a_replaced_file_is_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    matcher = LightGlue(weights=str(write(path, seeded_tensors(SIFT))))
    assert len(matcher(features(50), features(50), GEOMETRY).indices) > 20
    write(path, {"conv1.weight": torch.zeros(3, 3)})
    with pytest.raises(ConfigError, match="does not fit LightGlue"):
        matcher(features(50), features(50), GEOMETRY)


def test_scores_and_threshold_are_those_of_the_calibration(tmp_path: Path) -> None:
    tensors = {name: value.contiguous() for name, value in seeded_tensors(SIFT).items()}
    plain, stretched = tmp_path / "plain.safetensors", tmp_path / "stretched.safetensors"
    save_file(tensors, plain)
    save_file(tensors, stretched, {CALIBRATION_KEY: "2.0 1.0"})
    sides = features(60), noisy(features(60), 2.0)
    before = as_dict(recipe(str(plain), threshold=0.0)(*sides, GEOMETRY))
    after = as_dict(recipe(str(stretched), threshold=0.5)(*sides, GEOMETRY))
    # sigmoid(2 x + 1) >= 0.5 where x >= -0.5.
    expected = {pair: 1 / (1 + np.exp(-2 * np.log(s / (1 - s)) - 1)) for pair, s in before.items()}
    expected = {pair: score for pair, score in expected.items() if score >= 0.5}
    assert 0 < len(expected) < len(before)
    assert after.keys() == expected.keys()
    for pair, score in after.items():
        assert score == pytest.approx(expected[pair], abs=1e-5)


@pytest.mark.parametrize("text", ["", "one two", "1", "0 1", "-1 0", "nan 0", "1 2 3"])
def test_other_calibrations_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "weights.safetensors"
    save_file({name: value.contiguous() for name, value in seeded_tensors(SIFT).items()}, path, {CALIBRATION_KEY: text})
    with pytest.raises(ConfigError, match="calibration"):
        read_calibration(path)
