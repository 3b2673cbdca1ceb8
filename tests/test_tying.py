"""Images tied to a block by one pair and their position: exact geometry with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_orientation import CAMERA, flight, limits, matches

from aeromatch_cli.data import Pose
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.results.stages import OrientResult
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.pair_registration import tied_by_ground, tied_by_pairs
from aeromatch_cli.stages.messages import single_pair_words

LAST = "i23"


def one_pair_each(truth: dict[str, Pose]) -> list[PairPoints]:
    """The pairs of the flight, of which only one leads to LAST."""
    pairs, _ = matches(truth)
    leads = [p for p in pairs if LAST in (p.image_id0, p.image_id1)]
    return [p for p in pairs if p not in leads] + leads[:1]


def placed(truth: dict[str, Pose], off_m: tuple[float, float, float], sigma_m: float) -> dict[str, Pose]:
    """Given positions of all images, that of LAST off."""
    given = {i: replace(pose, world_rotation=None, sigma_position_m=sigma_m) for i, pose in truth.items()}
    return {**given, LAST: replace(given[LAST], center_m=truth[LAST].center_m + np.array(off_m))}


def tied(truth: dict[str, Pose], given: dict[str, Pose], pairs: list[PairPoints]) -> dict[str, tuple[Pose, str]]:
    known = {i: pose for i, pose in truth.items() if i != LAST}
    cameras, thresholds = limits(truth)
    return tied_by_pairs(pairs, known, given, dict.fromkeys(cameras, CAMERA), thresholds)


@pytest.mark.parametrize("turned", [False, True])
def test_attitude_and_direction_come_from_the_pair_and_the_distance_from_the_position(turned: bool) -> None:
    truth = flight()
    pairs = one_pair_each(truth)
    if turned:
        p = pairs[-1]
        pairs[-1] = PairPoints(p.image_id1, p.image_id0, p.points1_px, p.points0_px, p.indices[:, ::-1])
    found = tied(truth, placed(truth, (3.0, -2.0, 4.0), 5.0), pairs)
    pose, anchor = found[LAST]
    assert {anchor, LAST} == {pairs[-1].image_id0, pairs[-1].image_id1}
    assert pose.world_rotation is not None
    assert angle_between_deg(pose.world_rotation, truth[LAST].world_rotation) < 0.5
    off_m = pose.center_m - truth[LAST].center_m
    way = truth[LAST].center_m - truth[anchor].center_m
    along_m = float(off_m @ way / np.linalg.norm(way))
    assert np.linalg.norm(off_m) < 6.0
    assert np.linalg.norm(off_m - along_m * way / np.linalg.norm(way)) < 1.0


def test_a_position_beside_the_direction_ties_nothing() -> None:
    truth = flight()
    pairs = one_pair_each(truth)
    assert tied(truth, placed(truth, (0.0, 0.0, 60.0), 2.0), pairs) == {}
    assert tied(truth, {}, pairs) == {}


def test_few_or_wrong_matches_tie_nothing() -> None:
    truth = flight()
    *others, last = one_pair_each(truth)
    given = placed(truth, (0.0, 0.0, 0.0), 2.0)
    few = PairPoints(last.image_id0, last.image_id1, last.points0_px[:14], last.points1_px[:14], last.indices[:14])
    assert tied(truth, given, [*others, few]) == {}
    mixed = replace(last, points1_px=np.roll(last.points1_px, 5, axis=0))
    assert tied(truth, given, [*others, mixed]) == {}


def test_what_was_tied_ties_the_next() -> None:
    truth = flight()
    chain = [("i00", "i01"), ("i01", "i02"), ("i02", "i03")]
    pairs = [p for p in matches(truth)[0] if (p.image_id0, p.image_id1) in chain]
    known = {"i00": truth["i00"]}
    cameras, thresholds = limits(truth)
    found = tied_by_pairs(pairs, known, placed(truth, (0.0, 0.0, 0.0), 1.0), cameras, thresholds)
    assert {i: anchor for i, (_, anchor) in found.items()} == {"i01": "i00", "i02": "i01", "i03": "i02"}
    for image_id, (pose, _) in found.items():
        assert angle_between_deg(pose.world_rotation, truth[image_id].world_rotation) < 1.0


@pytest.mark.parametrize("turned", [False, True])
def test_without_a_position_the_ground_beside_tells_the_distance(turned: bool) -> None:
    truth = flight()
    pairs = one_pair_each(truth)
    if turned:
        p = pairs[-1]
        pairs[-1] = PairPoints(p.image_id1, p.image_id0, p.points1_px, p.points0_px, p.indices[:, ::-1])
    known = {i: pose for i, pose in truth.items() if i != LAST}
    cameras, thresholds = limits(truth)
    found = tied_by_ground(pairs, known, dict.fromkeys(cameras, CAMERA), thresholds)
    pose, anchor = found[LAST]
    way_m = truth[LAST].center_m - truth[anchor].center_m
    off_m = pose.center_m - truth[LAST].center_m
    assert pose.world_rotation is not None
    assert angle_between_deg(pose.world_rotation, truth[LAST].world_rotation) < 0.5
    assert np.linalg.norm(off_m) < 0.05 * np.linalg.norm(way_m)
    assert np.linalg.norm(off_m) < 3.0 * pose.sigma_position_m


def test_the_ground_ties_nothing_where_no_other_pair_shows_it() -> None:
    truth = flight()
    pairs = one_pair_each(truth)
    known = {i: pose for i, pose in truth.items() if i != LAST}
    cameras, thresholds = limits(truth)
    anchor = next(i for i in (pairs[-1].image_id0, pairs[-1].image_id1) if i != LAST)
    alone = [p for p in pairs[:-1] if anchor not in (p.image_id0, p.image_id1)] + pairs[-1:]
    assert tied_by_ground(alone, known, dict.fromkeys(cameras, CAMERA), thresholds) == {}


def test_positions_tell_the_distance_from_each_other_where_the_model_lies_beside_them() -> None:
    truth = flight()
    pairs = one_pair_each(truth)
    given = placed(truth, (0.0, 0.0, 0.0), 2.0)
    aside = {i: replace(pose, center_m=pose.center_m + np.array([0.0, 40.0, 0.0])) for i, pose in given.items()}
    pose, anchor = tied(truth, aside, pairs)[LAST]
    assert np.linalg.norm(pose.center_m - truth[LAST].center_m) < 3.0
    # Positions of which one alone is wrong tell nothing.
    assert tied(truth, {**given, LAST: aside[LAST]}, pairs) == {}
    assert anchor in (pairs[-1].image_id0, pairs[-1].image_id1)


def test_images_that_hang_on_a_single_pair_are_named() -> None:
    found = OrientResult(
        poses_from="pictures", stays=False, frame="own", points=9, wrong_attitudes={}, wrong_positions={},
        focal_lengths={}, outside=[], remarks=[], by_one_pair=["a"], by_ground=["b", "c"],
    )  # fmt: skip
    by_position, by_ground = single_pair_words(found, {i: f"{i}.jpg" for i in "abc"})
    assert by_position.startswith("1 by a single pair each; the given position tells how far off they lie")
    assert by_ground.startswith("2 by a single pair each; the height of the ground beside tells how far off they lie")
    assert (by_position.endswith(": a.jpg"), by_ground.endswith(": b.jpg, c.jpg")) == (True, True)
    assert single_pair_words(found.model_copy(update={"by_one_pair": [], "by_ground": []}), {}) == []
