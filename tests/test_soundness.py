"""Models are taken as far as they explain their matches; several of them lie apart; given poses agree or do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_results import filled
from scipy.spatial.transform import Rotation
from test_orientation import CAMERA, flight, limits, matches

from aeromatch_cli.data import Pose
from aeromatch_cli.results.stages import MappedModel
from aeromatch_cli.sfm.earlier_datum import Before, arranged
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_validation import rigid_groups, sound_part
from aeromatch_cli.sfm.pose_prior_check import consistent_images


def model_of(poses: dict[str, Pose], kind: str = "level") -> Model:
    return Model(
        rotations={i: pose.world_rotation for i, pose in poses.items()},
        centers_m={i: pose.center_m for i, pose in poses.items()},
        cameras={"a": CAMERA},
        points_m=np.zeros((1, 3)),
        figures=filled(MappedModel, kind=kind, images=len(poses)),
    )


def test_a_model_that_explains_its_matches_is_kept_whole() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    part = sound_part(model_of(truth), pairs, *limits(truth), {})
    assert part is not None
    assert part.rotations.keys() == truth.keys()


def test_images_in_wrong_places_leave_the_model() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    moved = dict(truth)
    for image_id in ("i00", "i23"):
        moved[image_id] = replace(truth[image_id], center_m=truth[image_id].center_m + np.array([40.0, -60.0, 90.0]))
    part = sound_part(model_of(moved), pairs, *limits(truth), {})
    assert part is not None
    assert part.rotations.keys() == truth.keys() - {"i00", "i23"}
    assert part.figures.images == len(truth) - 2


def test_of_two_halves_that_do_not_fit_the_larger_stays() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    turn = Rotation.from_euler("z", 25.0, degrees=True).as_matrix()
    away = {i for i in truth if i[2] == "3"}
    bent = {
        i: replace(pose, center_m=1.3 * turn @ pose.center_m, world_rotation=pose.world_rotation @ turn.T)
        if i in away
        else pose
        for i, pose in truth.items()
    }
    part = sound_part(model_of(bent), pairs, *limits(truth), {})
    assert part is not None
    assert part.rotations.keys() == truth.keys() - away


def test_an_image_on_a_single_pair_stays_only_where_its_position_confirms_it() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    ties = [p for p in pairs if "i00" in (p.image_id0, p.image_id1)]
    alone = replace(ties[0], indices=ties[0].indices + 100_000)  # keypoints that no other pair has
    single = [*(p for p in pairs if p not in ties), alone]
    base = truth["i00"].center_m - truth[ties[0].image_id1].center_m
    slid = truth | {"i00": replace(truth["i00"], center_m=truth["i00"].center_m + 3.0 * base)}  # along the pair's line
    given = {i: replace(pose, sigma_position_m=5.0) for i, pose in truth.items()}
    for poses, kind, positions, stays in (
        (slid, "level", {}, False),
        (slid, "positions", given, False),
        (truth, "positions", given, True),
    ):
        part = sound_part(model_of(poses, kind), single, *limits(truth), positions)
        assert part is not None
        assert ("i00" in part.rotations) is stays
        assert part.rotations.keys() >= truth.keys() - {"i00"}


def tie(ids: str, first: int) -> PairPoints:
    """Twenty matches of two images, of keypoints with the same numbers in both from `first` on."""
    indices = np.arange(first, first + 20)
    return PairPoints(ids[0], ids[1], np.zeros((20, 2)), np.zeros((20, 2)), np.column_stack([indices, indices]))


@pytest.mark.parametrize(
    ("ties", "expected"),
    [
        ([("ab", 0), ("bc", 10)], ["abc"]),  # ten keypoints of b in both
        ([("ab", 0), ("bc", 15)], []),  # five
        ([("ab", 0), ("bc", 0), ("cd", 100), ("de", 100)], ["abc", "cde"]),  # two groups that share an image only
        ([("ab", 0), ("bc", 0), ("cd", 10), ("de", 10)], ["abcde"]),
        ([("ab", 0), ("bc", 100), ("ac", 200)], []),  # a triangle without a point that all three see
    ],
)
def test_scales_are_tied_by_keypoints_that_two_pairs_share(ties: list[tuple[str, int]], expected: list[str]) -> None:
    found = rigid_groups([tie(*one) for one in ties])
    assert sorted("".join(sorted(group)) for group in found) == expected


def test_models_without_positions_lie_beside_those_with() -> None:
    truth = flight()
    placed = model_of(truth, "positions")
    beside = model_of({f"x{i}": pose for i, pose in truth.items()})
    more = model_of({f"y{i}": pose for i, pose in truth.items()})
    found = arranged([beside, placed, more], Before())
    east = [np.array([center[0] for center in model.centers_m.values()]) for model, _ in found]
    np.testing.assert_array_equal(east[1], [pose.center_m[0] for pose in truth.values()])
    assert east[0].min() > east[1].max() + 1000.0
    assert east[2].min() > east[0].max() + 1000.0


@pytest.mark.parametrize(("kind", "placed", "stays"), [("positions", False, False), ("positions", True, True),
                                                       ("level", False, True)])  # fmt: skip
def test_a_model_that_positions_place_now_leaves_the_frame_that_it_had_to_itself(
    kind: str, placed: bool, stays: bool
) -> None:
    truth = flight()
    aside = {i: replace(pose, center_m=0.01 * pose.center_m + [5000.0, 0.0, 0.0]) for i, pose in truth.items()}
    before = Before(aside, {}, truth.keys() if placed else ())
    ((model, kept),) = arranged([model_of(truth, kind)], before)
    assert (kept == aside) is stays
    expected = aside if stays else truth
    moved = [np.linalg.norm(model.centers_m[i] - pose.center_m) for i, pose in expected.items()]
    assert max(moved) < 1e-6


def test_inexact_poses_are_consistent_and_wrong_ones_are_not() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    rng = np.random.default_rng(5)

    def disturbed(pose: Pose) -> Pose:
        turn = Rotation.from_rotvec(rng.normal(0.0, 3.0, 3), degrees=True).as_matrix()
        return Pose(pose.center_m + rng.normal(0.0, 4.0, 3), turn @ pose.world_rotation, 5.0, 3.0)

    noisy = {i: disturbed(pose) for i, pose in truth.items()}
    assert consistent_images(pairs, noisy, *limits(truth)) == truth.keys()
    wrong = {"i01", "i12"}
    turned = {
        i: replace(pose, world_rotation=Rotation.from_euler("xyz", [50, 30, 100], degrees=True).as_matrix())
        if i in wrong
        else pose
        for i, pose in noisy.items()
    }
    assert consistent_images(pairs, turned, *limits(truth)) == truth.keys() - wrong
    backwards = {i: replace(p, world_rotation=np.diag([-1.0, -1.0, 1.0]) @ p.world_rotation) for i, p in noisy.items()}
    assert len(consistent_images(pairs, backwards, *limits(truth))) < 0.5 * len(truth)
