"""Groups of images that matches tie become one: similarities between their points."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.sfm.group_merging import Part, common_similarity, joined

POINTS = 200


def part(kind: str, first: int, points: FloatArray) -> Part:
    """Two images 100 m above the points that both see, keypoint k the k-th."""
    images = (first, first + 1)
    centers = {i: np.array([10.0 * i, 0.0, 100.0]) for i in images}
    rotations = {i: from_omega_phi_kappa(1.0 * i, 2.0, 10.0 * i) for i in images}
    return Part(kind, rotations, centers, dict.fromkeys(images, points))


def places(seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform([-50, -50, 0], [50, 50, 20], (POINTS, 3))


def elsewhere(one: Part) -> Part:
    return one.moved((0.7, from_omega_phi_kappa(5.0, -4.0, 60.0), np.array([30.0, -80.0, 12.0])))


MATCHES = {(2, 3): np.column_stack([np.arange(POINTS)] * 2)}


@pytest.mark.parametrize("wrong", [0, 80])
def test_a_part_in_another_frame_is_brought_back(wrong: int) -> None:
    """Up to 40 % of the matches join other points."""
    truth = [part("positions", 1, places()), part("level", 3, places())]
    indices = MATCHES[2, 3].copy()
    indices[:wrong, 1] = np.roll(indices[:wrong, 1], 7)
    (found,) = joined([truth[0], elsewhere(truth[1])], {(2, 3): indices})
    assert found.kind == "positions"
    assert sorted(found.rotations) == [1, 2, 3, 4]
    for image in (3, 4):
        np.testing.assert_allclose(found.centers_m[image], truth[1].centers_m[image], atol=1e-6)
        assert angle_between_deg(found.rotations[image], truth[1].rotations[image]) < 1e-4


def test_parts_that_share_no_place_stay_apart() -> None:
    """Other points, too few of the same, and surveyed poses."""
    first = part("positions", 1, places())
    other = elsewhere(part("positions", 3, places(1)))
    assert len(joined([first, other], MATCHES)) == 2
    few = {(2, 3): MATCHES[2, 3][:20]}
    same = elsewhere(part("positions", 3, places()))
    assert len(joined([first, same], few)) == 2
    assert len(joined([first, same], MATCHES)) == 1
    given = elsewhere(part("given", 3, places()))
    assert len(joined([first, given], MATCHES)) == 2


def test_a_small_part_that_ties_two_others_ties_them_all() -> None:
    """The largest part and the second share nothing; the third shares points with both."""
    parts = [part("positions", 1, places()), part("positions", 3, places(1)), part("level", 5, places())]
    bridge = np.concatenate([places()[:100], places(1)[:100]])
    parts[2] = elsewhere(part("level", 5, bridge))
    matches = {(1, 5): MATCHES[2, 3][:100], (3, 6): MATCHES[2, 3][100:] - [100, 0]}
    (found,) = joined(parts, matches)
    assert sorted(found.rotations) == [1, 2, 3, 4, 5, 6]


def test_keypoints_without_a_point_do_not_count() -> None:
    points = places()
    points[40:] = np.nan
    assert len(joined([part("positions", 1, points), elsewhere(part("level", 3, points))], MATCHES)) == 1
    points[20:] = np.nan
    assert len(joined([part("positions", 1, points), elsewhere(part("level", 3, points))], MATCHES)) == 2


def test_noise_within_the_tolerance_is_no_difference() -> None:
    points = places()
    noisy = points + np.random.default_rng(3).normal(0.0, 0.2, points.shape)
    found = common_similarity(points, 2.0 * noisy, 2.0)
    assert found is not None
    assert found[0] == pytest.approx(2.0, rel=0.01)
    assert common_similarity(points, np.random.default_rng(4).permutation(points), 2.0) is None
