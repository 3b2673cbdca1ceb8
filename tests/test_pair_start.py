"""Blocks in which no point is seen by three images: exact geometry with noise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from test_orientation import CAMERA, flight, limits, matches
from test_tying import placed

from aeromatch_cli.data import Pose
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.pair_start import started_from_pair

IMAGES = ("i00", "i01", "i02", "i03")


def chain(truth: dict[str, Pose]) -> list[PairPoints]:
    """Every image with the next alone."""
    return [p for p in matches(truth)[0] if (p.image_id0, p.image_id1) in set(pairwise(IMAGES))]


def started(truth: dict[str, Pose], pairs: list[PairPoints], given: dict[str, Pose]) -> Model | None:
    cameras, thresholds = limits(truth)
    return started_from_pair(pairs, given, dict.fromkeys(cameras, CAMERA), thresholds, {})


@pytest.mark.parametrize("positions", [True, False])
def test_a_chain_of_pairs_is_oriented(positions: bool) -> None:
    truth = flight()
    pairs = chain(truth)
    assert len(pairs) == len(IMAGES) - 1
    model = started(truth, pairs, placed(truth, (0.0, 0.0, 0.0), 1.0) if positions else {})
    assert model is not None
    assert model.kind == ("positions" if positions else "level")
    assert sorted(model.rotations) == list(IMAGES)
    assert (len(model.tied), model.figures.images) == (2, 4)
    for first, second in pairwise(IMAGES):
        turn = model.rotations[second] @ model.rotations[first].T
        true = np.asarray(truth[second].world_rotation) @ np.asarray(truth[first].world_rotation).T
        assert angle_between_deg(turn, true) < 0.5
    steps = [np.linalg.norm(model.centers_m[b] - model.centers_m[a]) for a, b in pairwise(IMAGES)]
    true_steps_m = [np.linalg.norm(truth[b].center_m - truth[a].center_m) for a, b in pairwise(IMAGES)]
    scales = np.divide(steps, true_steps_m)
    np.testing.assert_allclose(scales, scales.mean(), rtol=0.1)
    if positions:
        np.testing.assert_allclose(scales, 1.0, rtol=0.1)


def test_two_images_are_no_block() -> None:
    truth = flight()
    assert started(truth, chain(truth)[:1], {}) is None
    assert started(truth, [], {}) is None
