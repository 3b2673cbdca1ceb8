"""Models of a first pass take in images that points of two images tie to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from test_orientation import CAMERA, flight, limits, matches
from test_soundness import model_of

from aeromatch_cli.data import Pose
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_extension import grown
from aeromatch_cli.sfm.model_validation import sound_part

TRUTH = flight()
STRIP = {i: pose for i, pose in TRUTH.items() if i[1] == "2"}
REST = {i: pose for i, pose in TRUTH.items() if i not in STRIP}


def turned(poses: dict[str, Pose]) -> dict[str, Pose]:
    """The same images turned about their first by 30 degrees and smaller: another frame."""
    first = next(iter(poses.values())).center_m
    turn = Rotation.from_euler("x", 30.0, degrees=True).as_matrix()
    return {
        i: replace(p, center_m=first + 0.8 * turn @ (p.center_m - first), world_rotation=p.world_rotation @ turn.T)
        for i, p in poses.items()
    }


def found_of(models: list[Model], pairs: list[PairPoints]) -> tuple[Model, ...]:
    _, thresholds_px = limits(TRUTH)
    return grown(models, pairs, dict.fromkeys(TRUTH, "a"), {"a": CAMERA}, thresholds_px, {})


def same(model: Model) -> bool:
    return all(
        angle_between_deg(model.rotations[i], TRUTH[i].world_rotation) < 0.5
        and np.linalg.norm(model.centers_m[i] - TRUTH[i].center_m) < 1.0
        for i in model.rotations
    )


def test_images_of_no_model_are_resected() -> None:
    pairs, _ = matches(TRUTH)
    (found,) = found_of([model_of(REST)], pairs)
    assert found.rotations.keys() == TRUTH.keys()
    assert same(found)


def test_models_without_matches_across_stay_as_they_are() -> None:
    pairs, _ = matches(TRUTH)
    inside = [p for p in pairs if (p.image_id0 in STRIP) == (p.image_id1 in STRIP)]
    models = [model_of(REST), model_of(turned(STRIP))]
    found = found_of(models, inside)
    assert [model.rotations.keys() for model in found] == [REST.keys(), STRIP.keys()]
    for model, before in zip(found, models, strict=True):
        for image_id, center_m in before.centers_m.items():
            np.testing.assert_array_equal(model.centers_m[image_id], center_m)


def test_an_image_that_most_of_its_matches_contradict_leaves_the_model() -> None:
    """Even where one of its pairs is explained by its wrong attitude, and its position confirms its place."""
    pairs, _ = matches(TRUTH)
    askew = Rotation.from_euler("xyz", [10.0, -8.0, 12.0], degrees=True).as_matrix() @ TRUTH["i00"].world_rotation
    poses = TRUTH | {"i00": replace(TRUTH["i00"], world_rotation=askew)}
    given = {i: replace(pose, sigma_position_m=5.0) for i, pose in TRUTH.items()}
    by_chance = next(p for p in matches(poses)[0] if "i00" in (p.image_id0, p.image_id1))
    ends = {by_chance.image_id0, by_chance.image_id1}
    others = [p for p in pairs if {p.image_id0, p.image_id1} != ends]
    assert sum("i00" in (p.image_id0, p.image_id1) for p in others) >= 2
    part = sound_part(model_of(poses, "positions"), [by_chance, *others], *limits(TRUTH), given)
    assert part is not None
    assert part.rotations.keys() == TRUTH.keys() - {"i00"}
