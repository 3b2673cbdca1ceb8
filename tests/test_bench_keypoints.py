"""What scripts/bench keypoints is made of: truth of keypoints, and figures by hand."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.keypoints import correspondence, descriptors, detectors, figures, orientations, tables
from benchmarks.peers import base

from aeromatch_cli.data import BoolArray, Camera, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.rendered import RenderedTruth

pytestmark = pytest.mark.slow


def names_of(block: Path) -> list[str]:
    return sorted(open_truth(block).cameras)[:2]


def pictures_of(block: Path, work: Path) -> Any:
    files = block / "images", block / "poses.csv", block / "block.json"
    scene = base.Scene("suburb", *files, open_truth(block).cameras, ())
    return correspondence.Pictures(scene, work)


def both(block: Path, work: Path, frame: str) -> Any:
    pictures = pictures_of(block, work)
    return tuple(pictures(name, frame) for name in names_of(block))


def test_the_smallest_error_goes_first_and_every_keypoint_once() -> None:
    pairs = np.array([[0, 0], [0, 1], [1, 0], [2, 2]])
    chosen = correspondence.one_to_one(pairs, np.array([1.0, 0.5, 2.0, 0.1]))
    assert sorted(map(tuple, pairs[chosen].tolist())) == [(0, 1), (1, 0), (2, 2)]


def test_true_places_are_partners_and_shifted_ones_as_far_off_as_they_were_shifted(rendered: Path) -> None:
    truth = open_truth(rendered)
    assert isinstance(truth, RenderedTruth)
    name0, name1 = names_of(rendered)
    x, y = np.meshgrid(np.arange(10.0, 310.0, 23.0), np.arange(10.0, 230.0, 19.0))
    points = np.column_stack([x.ravel(), y.ravel()])
    there, hidden = truth.truth.transfer(name0, points, name1)
    points, there = points[~hidden], there[~hidden]
    assert len(points) > 40
    order = np.random.default_rng(0).permutation(len(points))
    found = correspondence.partners(truth, name0, points, name1, there[order])
    assert (order[found.rows1] == found.rows0).all()
    assert len(found.rows0) > 0.9 * len(points)
    assert np.median(found.errors_px) < 0.05
    shifted = correspondence.partners(truth, name0, points, name1, there + np.array([0.0, 2.0]))
    assert np.median(shifted.errors_px) == pytest.approx(2.0, abs=0.3)
    assert len(correspondence.partners(truth, name0, points, name1, there[:0]).rows0) == 0


def test_places_go_to_stored_pixels_and_back(rendered: Path, tmp_path: Path) -> None:
    ground, _ = both(rendered, tmp_path, correspondence.GROUND)
    assert ground.view is not None
    height, width = ground.seen.shape
    points = np.array([[0.5 * width, 0.5 * height], [0.4 * width, 0.6 * height]])
    stored = ground.stored_px(points)
    assert np.abs(stored - points).max() > 0.5
    np.testing.assert_allclose(ground.from_stored(stored), points, atol=1e-6)
    assert ground.shows(stored).all()
    assert not ground.shows(np.array([[-5.0, 3.0], [np.nan, np.nan]])).any()


def flat_truth(matrix: FloatArray, camera: Camera) -> tuple[Any, Any]:
    """Two stored pictures of a plane that a matrix (2, 2) takes into one another, and who knows."""

    def transfer(_name: str, points_px: FloatArray, _other: str) -> tuple[FloatArray, BoolArray]:
        there = points_px @ matrix.T + 100.0
        return there, np.zeros(len(there), bool)

    blank = np.zeros((10, 10), np.uint8)
    picture = correspondence.Picture("a", camera, None, blank, blank, blank == 0)
    return SimpleNamespace(truth=SimpleNamespace(transfer=transfer)), picture


@pytest.mark.parametrize("turn_deg", [-120.0, 0.0, 35.0])
def test_turn_and_scale_are_those_of_the_nearest_rotation(rendered: Path, turn_deg: float) -> None:
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    truth, picture = flat_truth(rotation @ np.diag([2.0, 0.5]), next(iter(open_truth(rendered).cameras.values())))
    found = correspondence.local_change(truth, picture, np.array([[5.0, 6.0]]), picture)
    assert found.known.all()
    assert found.turn_deg[0] == pytest.approx(turn_deg)
    assert found.scale[0] == pytest.approx(1.0)
    mirrored, _ = flat_truth(np.diag([1.0, -1.0]), picture.camera)
    flat, _ = flat_truth(np.diag([4.0, 0.4]), picture.camera)
    for other in (mirrored, flat):
        assert not correspondence.local_change(other, picture, np.array([[5.0, 6.0]]), picture).known.any()


def test_angles_of_one_place_disagree_by_what_the_turn_leaves() -> None:
    angles0 = np.array([[10.0, np.nan], [350.0, 90.0], [0.0, np.nan]])
    angles1 = np.array([[45.0, np.nan], [10.0, np.nan], [200.0, 5.0]])
    apart = orientations.disagreement_deg(angles0, angles1, np.array([30.0, 15.0, 0.0]))
    np.testing.assert_allclose(apart, [5.0, 5.0, 5.0])
    row = orientations.orientation_row(np.array([-3.0, 8.0, -30.0, 100.0]))
    assert [row[f"within_{limit}_deg"] for limit in (5, 10, 20, 45)] == [1, 2, 2, 3]
    assert row["median_error_deg"] == 19.0
    assert orientations.orientation_row(np.zeros(0))["median_error_deg"] is None


@pytest.mark.parametrize("frame", ["source", "ground"])
def test_sift_is_found_again_and_its_angles_agree(rendered: Path, tmp_path: Path, frame: str) -> None:
    truth, pictures = open_truth(rendered), both(rendered, tmp_path, frame)
    detector = detectors.Sift(None)
    sides = tuple(detector(picture, 5000) for picture in pictures)
    for side in sides:
        assert len(np.unique(side.points_px, axis=0)) == len(side.points_px)
    row = detectors.detector_row(truth, sides, pictures, 150)
    assert (row["keypoints0"], row["keypoints1"]) == (150, 150)
    assert 0.3 < row["repeated_3px"] / 150 <= 1.0
    assert 0.2 < row["repeated_1px"] / row["repeated_3px"] < 1.0
    assert 0.05 < row["error_px"] < 1.5
    turned = orientations.turned_keypoints(truth, pictures, 5000, 300)
    assert len(turned.turn_deg) > 30
    angles = [
        orientations.OfSift(None)(picture, side) for picture, side in zip(pictures, turned.keypoints, strict=True)
    ]
    errors = orientations.disagreement_deg(*angles, turned.turn_deg)
    assert np.median(np.abs(errors)) < 10.0


def test_figures_of_descriptors_worked_by_hand() -> None:
    same, other = np.arange(1.0, 21.0), np.array([5.0, 18.9, 19.0, 19.1, 30.0])
    assert descriptors.false_positive_rate(same, other) == pytest.approx(3 / 5)  # 19 of 20 accepted at 19
    assert math.isnan(descriptors.false_positive_rate(same[:0], other))
    scores, correct = np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, False, True, False])
    assert descriptors.average_precision(scores, correct, 4) == pytest.approx((1 / 1 + 2 / 3) / 4)
    assert descriptors.average_precision(np.ones(4), correct, 2) == pytest.approx(0.5)  # ties come at once
    assert math.isnan(descriptors.average_precision(scores, correct, 0))
    first, second = np.random.default_rng(0).normal(size=(2, 30, 8)).astype(np.float32)
    wanted = np.linalg.norm(first[:, None] - second[None], axis=2)
    np.testing.assert_allclose(descriptors.distances(first, second), wanted, atol=1e-4)


def test_nearest_neighbours_are_right_within_three_pixels_of_the_partner() -> None:
    places = np.array([[0.0, 0.0], [2.0, 0.0], [50.0, 0.0]])
    # Partner itself; another keypoint of its place; elsewhere; without partner; not asked.
    apart = np.array([[1, 5, 9], [3, 9, 9], [9, 9, 1], [2, 3, 9], [1, 9, 9]], np.float32)
    partner, asked = np.array([0, 1, 0, -1, 0]), np.array([True, True, True, True, False])
    found = descriptors.nearest_neighbours(apart, partner, places, asked)
    assert found.right == pytest.approx(2 / 3)
    # By ratio: wrong 1/9, right 1/5, right 3/9, without partner 2/3.
    assert found.by_ratio == pytest.approx((1 / 2 + 2 / 3) / 3)
    # By distance: the two at 1 together, then the one without partner, then the last.
    assert found.by_distance == pytest.approx((1 / 2 + 2 / 4) / 3)


def test_sift_tells_places_apart_and_noise_does_not(rendered: Path, tmp_path: Path) -> None:
    truth = open_truth(rendered)
    task = descriptors.make_task(truth, both(rendered, tmp_path, "ground"), 300, np.random.default_rng(0), upright=True)
    assert (task.partner >= 0).sum() > 30
    for side in task.sides:
        assert side.patches.shape == (len(side.own), 32, 32)
    row = descriptors.descriptor_row(descriptors.Sift(None, root=True), task)
    rng = np.random.default_rng(1)
    noise = descriptors.descriptor_row(lambda side: rng.normal(size=(len(side.own), 128)).astype(np.float32), task)
    assert row["corresponding"] == noise["corresponding"]
    assert row["map_by_ratio"] > 0.5 > 0.1 > noise["map_by_ratio"]
    assert row["fpr95"] < 0.2 < noise["fpr95"]
    assert row["right"] > 0.5


def test_names_may_have_labels_and_weights(tmp_path: Path) -> None:
    found = figures.named("sift, mine=ours, new=ours:a/b=c.safetensors", {"sift": None, "ours": None})
    assert [(one.label, one.name) for one in found] == [("sift", "sift"), ("mine", "ours"), ("new", "ours")]
    assert found[2].weights == Path("a/b=c.safetensors")
    assert figures.without_paths("sift,new=ours:a/b.safetensors,tfeat") == "sift,new=ours:FILE,tfeat"
    for wrong, said in (("surf", "none of"), ("ours,ours:x", "two methods")):
        with pytest.raises(ConfigError, match=said):
            figures.named(wrong, {"sift": None, "ours": None})
    with pytest.raises(ConfigError, match="not found"):
        figures.make({"ours": lambda _options, weights: weights}, found[2], None)


def test_figures_are_made_once_for_what_they_depend_on(tmp_path: Path) -> None:
    judged = SimpleNamespace(key="k", scene=SimpleNamespace(name="city"))
    pair = SimpleNamespace(images=("a", "b"), conditions=SimpleNamespace(view_angle_deg=41.0, overlap=0.5))
    made = []

    def make() -> dict[str, Any]:
        made.append(1)
        return {"figure": len(made)}

    def row(settings: int, method: str) -> Any:
        one = figures.Named(method, method, None)
        return figures.Store(tmp_path, settings).row(judged, pair, "detector", "ground", one, make)

    first = row(1, "sift")
    assert (first["figure"], first["pair"], first["view_angle_deg"]) == (1, "a b", 41.0)
    assert row(1, "sift") == first
    assert [row(2, "sift")["figure"], row(1, "ours")["figure"]] == [2, 3]


def test_tables_sum_pairs_and_put_large_angles_together() -> None:
    common = {"section": "detectors", "method": "sift", "frame": "ground", "keypoints0": 100, "keypoints1": 80}
    rows = [
        common | {"view_angle_deg": angle, "repeated_3px": repeated, "repeated_1px": 4, "error_px": error}
        for angle, repeated, error in ((45.0, 40, 1.0), (70.0, 20, 2.0))
    ]
    text = tables.detector_table(rows)
    assert "| 40-60 | ground | `sift` | 1 | 90 | 50.0 % | 5.0 % | 1.00 |" in text
    assert "| >40 | ground | `sift` | 2 | 90 | 37.5 % | 5.0 % | 1.50 |" in text
    figures = {"corresponding": 10, "fpr95": 0.1, "map_by_ratio": None, "map_by_distance": 0.5, "right": 0.6}
    line = {"section": "descriptors", "method": "ours", "suns": "two", "view_angle_deg": 50.0, **figures}
    assert "| >40 | two | `ours` | 1 | 10 | 10.00 % | - | 50.0 % | 60.0 % |" in tables.descriptor_table([line])
