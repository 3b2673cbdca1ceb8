"""Cameras, poses and terrain of a block: those given as far as the pictures bear them out, else from the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aeromatch_cli.data import Block, Camera, FloatArray, Pose
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.orientation.consistency import consistent_images
from aeromatch_cli.orientation.conventions import Recognised, recognised
from aeromatch_cli.orientation.dem import Terrain, terrain_of
from aeromatch_cli.orientation.judgement import (
    PairPoints,
    attitude_errors_deg,
    explained_images,
    position_errors_m,
    triangulated,
)
from aeromatch_cli.orientation.mapping import Model
from aeromatch_cli.orientation.placing import similarity
from aeromatch_cli.orientation.resection import resected
from aeromatch_cli.orientation.strips import predicted

# Given poses stay where they explain the matches of this share of the images: single others are corrected.
_MOST = 0.6
# Standard deviations of poses from the pictures: of each angle, and of the position as a share of the flying height.
_SIGMA_ANGLE_DEG = 0.2
_SIGMA_POSITION_SHARE = 0.005
# Beyond this a given attitude is wrong and not just inexact; and a position beyond so many standard deviations.
_WRONG_DEG = 30.0
_WRONG_SIGMAS = 5.0
# Fewer images make no model.
_FEWEST_IMAGES = 3
# Pictures of one place differ by less, in pixels of the stored images.
_STANDING_PX = 2.0
# A model of a grown block is moved onto the poses that it had before, where these agree to a share of its extent.
_SAME_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Solution:
    """cameras: camera_id -> Camera. poses: image_id -> Pose. facts: JSON-ready, see orientation.json in `formats`."""

    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    terrain: Terrain | None
    facts: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Evidence:
    """The first pass of a block. pairs: its verified matches. thresholds_px: by image_id, errors of exact matches."""

    block: Block
    pairs: Sequence[PairPoints]
    thresholds_px: Mapping[str, float]

    @property
    def cameras(self) -> dict[str, Camera]:
        """By image_id."""
        return {image.image_id: self.block.camera(image) for image in self.block.images}

    @property
    def matched(self) -> set[str]:
        return {i for pair in self.pairs for i in (pair.image_id0, pair.image_id1)}

    def explained(self) -> set[str]:
        """Images whose given poses explain their matches."""
        return explained_images(self.pairs, self.block.poses, self.cameras, self.thresholds_px)

    def consistent(self) -> set[str]:
        """Images whose given poses agree with their matches within their standard deviations."""
        return consistent_images(self.pairs, self.block.poses, self.cameras, self.thresholds_px)


def suffices(evidence: Evidence, good: set[str]) -> bool:
    """Whether the given poses of the images `good` carry the block, so that only others need be found."""
    return len(good) >= _MOST * len(evidence.matched)


def from_given(evidence: Evidence, good: set[str], *, correct: bool) -> Solution:
    """Given poses as they are; with `correct`, those that the matches contradict by resection from the `good` ones.

    Images without matches keep what was given: nothing speaks against it.
    """
    block, pairs, cameras = evidence.block, evidence.pairs, evidence.cameras
    poses, found = dict(block.poses), dict[str, Pose]()
    if correct:
        known = {i: poses[i] for i in sorted(good)}
        height_m = _flying_height_m(evidence, known) if evidence.matched - good else 1.0
        sigmas = (_SIGMA_POSITION_SHARE * height_m, _SIGMA_ANGLE_DEG)
        found = resected(pairs, known, cameras, evidence.thresholds_px, sigmas)
        for image_id in evidence.matched - good - found.keys():
            if image_id in poses:
                poses[image_id] = replace(poses[image_id], world_rotation=None)
        poses |= found
    points = _finite(triangulated(pairs, poses, cameras))
    facts = {
        "method": "given",
        "frame": "world",
        "corrected": sorted(found),
        "remarks": [],
        "groups": [{"kind": "given", "images": sorted(i for i in poses if poses[i].world_rotation is not None)}],
        "points": len(points),
        **_judged(block.poses, found),
        "outside": _outside(block, poses),
    }
    return Solution(block.cameras, poses, terrain_of(points, _area(poses)), facts)


def unoriented_remark(evidence: Evidence) -> str:
    """Why no image could be oriented from its matches."""
    said = "no image could be oriented from the pictures"
    if len(evidence.matched) < _FEWEST_IMAGES:
        return f"{said}: at least {_FEWEST_IMAGES} images must show the same ground, {len(evidence.matched)} do"
    moved_px = [np.median(np.linalg.norm(p.points0_px - p.points1_px, axis=1)) for p in evidence.pairs]
    if float(np.median(moved_px)) < _STANDING_PX:
        return f"{said}: they show the same from the same place"
    return f"{said}: their matches do not agree on one orientation"


def judged(given: Solution, pictures: Solution) -> Solution:
    """Given poses as they are, with what the pictures say against them."""
    against = {key: pictures.facts[key] for key in ("wrong_attitudes", "wrong_positions", "remarks")}
    return replace(given, facts={**given.facts, **against})


def from_models(
    evidence: Evidence, models: Sequence[Model], before: Mapping[str, Pose], angles: Mapping[str, Angles]
) -> Solution:
    """Given poses and cameras, replaced by those of the mapper's models, the largest first.

    before: poses that an earlier run found for images that have not changed; models are moved onto them, and where
    they agree the images keep them. angles: image_id -> attitude as it was given.
    """
    block = evidence.block
    poses, cameras = dict(block.poses), dict(block.cameras)
    found: dict[str, Pose] = {}
    offset_m = 0.0
    for model in reversed(models):  # the largest model's cameras count
        model, kept = _anchored(model, before)
        if model.kind == "level" and not kept:
            # Groups that nothing ties to the world or to each other lie side by side.
            east = np.array([center[0] for center in model.centers_m.values()])
            model = _moved(model, 1.0, np.eye(3), np.array([offset_m - east.min(), 0.0, 0.0]))
            offset_m += 2.0 * float(np.ptp(east)) + 1000.0
        height_m = float(np.median([c[2] for c in model.centers_m.values()]) - np.median(model.points_m[:, 2]))
        sigma_m = _SIGMA_POSITION_SHARE * abs(height_m)
        for image_id, rotation in model.rotations.items():
            found[image_id] = Pose(model.centers_m[image_id], rotation, sigma_m, _SIGMA_ANGLE_DEG)
        found |= kept
        cameras |= model.cameras
    level = bool(models) and models[0].kind == "level"
    convention = None if level else _convention(models, angles)
    given = dict(block.poses)
    for image_id, one in angles.items():
        if convention is not None and image_id in given:
            given[image_id] = replace(given[image_id], world_rotation=convention.rotation(one))
    by_strip = {} if level or convention else predicted(block, found)
    inexact = set() if level else evidence.consistent()
    for image_id in block.poses.keys() - found.keys() - inexact:
        # An attitude that nothing confirms in a block where others were wrong is not relied on.
        unknown = by_strip.get(image_id, replace(poses[image_id], world_rotation=None))
        poses[image_id] = given[image_id] if convention else unknown
        if level:
            del poses[image_id]  # its position is in another frame than the others'
    poses |= found
    # The mapper's own points are few: it leans on the longest tracks.
    lenses = {image.image_id: cameras[image.camera_id] for image in block.images}
    points = _finite(triangulated(evidence.pairs, found, lenses))
    facts = {
        "method": "pictures",
        "frame": "own" if level else "world",
        "models": [dict(model.figures) | {"kind": model.kind} for model in models],
        "groups": [{"kind": model.kind, "images": sorted(model.rotations)} for model in models],
        "calibrated": sorted({k for model in models for k in model.cameras}),
        "points": len(points),
        **_judged(given, found),
        "outside": _outside(block, found),
        "remarks": [*_position_remarks(models), *_convention_remarks(convention)],
    }
    if level:
        facts["wrong_positions"] = facts["wrong_attitudes"] = {}
    return Solution(cameras, poses, terrain_of(points, _area(poses)), facts)


def _convention(models: Sequence[Model], angles: Mapping[str, Angles]) -> Recognised | None:
    placed = [model.rotations for model in models if model.kind == "positions"]
    return recognised(angles, {i: rotation for one in placed for i, rotation in one.items()})


def _convention_remarks(convention: Recognised | None) -> list[str]:
    if convention is None:
        return []
    return [f"the given angles do not fit the pictures: {convention.words}"]


def _position_remarks(models: Sequence[Model]) -> list[str]:
    contradiction = models[0].figures.get("contradiction") if models else ""
    if contradiction == "mirrored":
        return [
            "the given positions fit the pictures only mirrored: are x and y, or latitude and longitude, exchanged? "
            "Without them the result is in a frame of its own"
        ]
    if contradiction:
        return [
            "the given positions do not fit the pictures: are they those of other images, or of another flight? "
            "Without them the result is in a frame of its own"
        ]
    return []


def _anchored(model: Model, before: Mapping[str, Pose]) -> tuple[Model, dict[str, Pose]]:
    """The model moved onto poses found before, and those of its images that keep theirs; as it is where they differ."""
    common = sorted(model.centers_m.keys() & before.keys())
    if len(common) < 3:
        return model, {}
    old_m = np.array([before[i].center_m for i in common])
    now = np.array([model.centers_m[i] for i in common])
    moved = _moved(model, *similarity(now, old_m))
    errors_m = np.linalg.norm(np.array([moved.centers_m[i] for i in common]) - old_m, axis=1)
    if errors_m.max() > _SAME_SHARE * np.linalg.norm(np.ptp(old_m, axis=0)):
        return model, {}
    return moved, {i: before[i] for i in common}


def _moved(model: Model, scale: float, rotation: FloatArray, shift_m: FloatArray) -> Model:
    return replace(
        model,
        rotations={i: one @ rotation.T for i, one in model.rotations.items()},
        centers_m={i: scale * rotation @ center + shift_m for i, center in model.centers_m.items()},
        points_m=scale * model.points_m @ rotation.T + shift_m,
    )


def _judged(given: Mapping[str, Pose], found: Mapping[str, Pose]) -> dict[str, Any]:
    """Given attitudes and positions that those found contradict: image_id -> degrees, image_id -> metres."""
    angles = {i: round(error, 1) for i, error in attitude_errors_deg(given, found).items()}
    shifts = {i: round(error, 2) for i, error in position_errors_m(given, found).items()}
    limits = {i: _WRONG_SIGMAS * (given[i].sigma_position_m + found[i].sigma_position_m) for i in shifts}
    return {
        "wrong_attitudes": {i: error for i, error in sorted(angles.items()) if error > _WRONG_DEG},
        "wrong_positions": {i: error for i, error in sorted(shifts.items()) if error > limits[i]},
    }


def _flying_height_m(evidence: Evidence, poses: Mapping[str, Pose]) -> float:
    """Median height of the cameras above the points of posed pairs, 1 where there are none."""
    points = _finite(triangulated(evidence.pairs, poses, evidence.cameras))
    if not len(points):
        return 1.0
    return abs(float(np.median([pose.center_m[2] for pose in poses.values()]) - np.median(points[:, 2])))


def _finite(parts: Sequence[FloatArray]) -> FloatArray:
    points = np.concatenate([np.zeros((0, 3)), *parts])
    return points[np.isfinite(points).all(axis=1)]


def _outside(block: Block, poses: Mapping[str, Pose]) -> list[str]:
    known = {i for i, pose in poses.items() if pose.world_rotation is not None}
    return sorted(image.image_id for image in block.images if image.image_id not in known)


def _area(poses: Mapping[str, Pose]) -> FloatArray:
    return np.array([pose.center_m[:2] for pose in poses.values()]).reshape(-1, 2)
