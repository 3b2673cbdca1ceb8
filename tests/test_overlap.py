"""Which keypoints go to a dear matcher: what the other image shows, by matches or by poses."""

import numpy as np
import pytest
from make_features import described

from aeromatch_cli.data import Pair, PairGeometry, Pose
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.strategies.matchers.descriptors import comparison as comparing
from aeromatch_cli.strategies.matchers.descriptors import search
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.matchers.descriptors.overlap import in_overlap

CAMERA = from_colmap("SIMPLE_PINHOLE", 1000, 750, (900.0, 500.0, 375.0))
DOWN = np.diag([1.0, -1.0, -1.0])
# Image 1, taken from three times as high, shows the ground of image 0 here.
FIRST_PX, LAST_PX = np.array([400.0, 300.0]), np.array([733.0, 550.0])


LOOKS = np.zeros((500, 128), np.uint8)  # nobody looks


def nadir(x_m: float, height_m: float) -> Pose:
    return Pose(np.array([x_m, 0.0, height_m]), DOWN, 0.1, 0.05)


def compared(rng: np.random.Generator, pose0: Pose | None = None, pose1: Pose | None = None) -> Comparison:
    """500 keypoints all over either image; the first 60 of both show the same places."""
    points0, points1 = (rng.uniform(2, [998, 748], (500, 2)) for _ in "01")
    points1[:60] = FIRST_PX + points0[:60] / 3.0 + rng.normal(0.0, 2.0, (60, 2))
    geometry = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, pose0, pose1, 0.0 if pose0 else None)
    return Comparison(described(points0, LOOKS), described(points1, LOOKS), geometry, np.ones((1, 1), bool))


def found(rng: np.random.Generator, right: int, wrong: int) -> Found:
    columns = np.concatenate([np.arange(right), rng.integers(60, 500, wrong)])
    rows = np.concatenate([np.arange(right), rng.integers(60, 500, wrong)])
    return Found(rows, columns, np.full(right + wrong, 0.5))


@pytest.mark.parametrize("seed", range(3))
def test_matches_tell_what_the_higher_image_shows_of_the_lower(seed: int) -> None:
    rng = np.random.default_rng(seed)
    comparison = compared(rng)
    shown0, shown1 = in_overlap(comparison, found(rng, 60, 40), Nearest().windows)
    points1 = comparison.features1.keypoints_px
    beyond = np.maximum(FIRST_PX - points1, points1 - LAST_PX).max(axis=1)
    assert shown0.mean() > 0.99
    assert shown1[beyond < 0.0].all()
    assert not shown1[beyond > 80.0].any()


def test_few_matches_leave_it_to_the_poses_and_no_poses_to_everything() -> None:
    rng = np.random.default_rng(1)
    few = found(rng, 6, 60)
    for shown in in_overlap(compared(rng), few, Nearest().windows):
        assert shown.all()
    # From 100 m a picture shows 111 m of ground along x; these share a half.
    comparison = compared(rng, nadir(0.0, 100.0), nadir(55.0, 100.0))
    shown0, shown1 = in_overlap(comparison, few, Nearest().windows)
    x0, x1 = comparison.features0.keypoints_px[:, 0], comparison.features1.keypoints_px[:, 0]
    assert shown0[x0 > 510].all()
    assert not shown0[x0 < 250].any()
    assert shown1[x1 < 490].all()
    assert not shown1[x1 > 750].any()


def test_chance_tells_nothing() -> None:
    rng = np.random.default_rng(2)
    for shown in in_overlap(compared(rng), found(rng, 0, 100), Nearest().windows):
        assert shown.all()


def test_images_without_keypoints_show_nothing() -> None:
    rng = np.random.default_rng(3)
    whole = compared(rng, nadir(0.0, 100.0), nadir(55.0, 100.0))
    empty = described(np.zeros((0, 2)), LOOKS[:0])
    comparison = Comparison(empty, whole.features1, whole.geometry, whole.comparable)
    shown0, shown1 = in_overlap(comparison, found(rng, 0, 0), Nearest().windows)
    assert (len(shown0), shown1.any()) == (0, False)


def test_of_many_keypoints_only_what_both_images_show_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """4,500 keypoints: image 0 shows a ninth of image 1, the same 600 places with descriptors off by noise."""
    rng = np.random.default_rng(4)
    looks = [rng.integers(0, 200, (4500, 128)).astype(np.uint8) for _ in "01"]
    looks[1][:600] = np.clip(looks[0][:600] + rng.normal(0.0, 6.0, (600, 128)), 0, 255)
    points0, points1 = (rng.uniform(2, [998, 748], (4500, 2)) for _ in "01")
    points1[:600] = FIRST_PX + points0[:600] / 3.0 + rng.normal(0.0, 0.5, (600, 2))
    sides = described(points0, looks[0]), described(points1, looks[1])
    geometry = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, None, None, None)
    compared_descriptors, scan = [], comparing.mutual_nearest

    def counted(descriptors0: np.ndarray, descriptors1: np.ndarray, *others: object, **named: object) -> object:
        compared_descriptors.append((len(descriptors0), len(descriptors1)))
        return scan(descriptors0, descriptors1, *others, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(comparing, "mutual_nearest", counted)
    quick = Nearest()(*sides, geometry)
    scouts, both = compared_descriptors
    assert scouts == (2000, 2000)
    assert both[0] == 4500
    assert 600 <= both[1] < 2200  # the ninth, 600 places beside, and a margin
    monkeypatch.setattr(search, "_SCOUTS_OF", 10**9)
    np.testing.assert_array_equal(quick.indices, Nearest()(*sides, geometry).indices)
    assert len(quick.indices) >= 595  # two that lie together in both images are one
    assert (quick.indices[:, 0] == quick.indices[:, 1]).all()
