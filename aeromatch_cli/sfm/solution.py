"""Cameras, poses and terrain of a block: those given as far as the pictures bear them out, else from the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import Block, Camera, FloatArray, Pose
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.components import connected_groups
from aeromatch_cli.results.adjustment import PlacementKind
from aeromatch_cli.results.stages import FocalChange, OrientResult
from aeromatch_cli.sfm.conventions import Recognised, recognised
from aeromatch_cli.sfm.dem import Terrain, ground_points, terrains_of
from aeromatch_cli.sfm.earlier_datum import SAME_SHARE, Before, arranged
from aeromatch_cli.sfm.epipolar_agreement import (
    PairPoints,
    attitude_errors_deg,
    explained_images,
    explained_share,
    position_errors_m,
    triangulated,
)
from aeromatch_cli.sfm.mapping import Group, Model
from aeromatch_cli.sfm.model_validation import FEWEST_IMAGES, SLACK
from aeromatch_cli.sfm.pair_registration import predicted, tied_by_ground, tied_by_pairs
from aeromatch_cli.sfm.pose_prior_check import consistent_images
from aeromatch_cli.sfm.resection import resected

# Given poses stay where they explain the matches of this share of the images: single others are corrected.
_MOST = 0.6
# Standard deviations of poses from the pictures: of each angle, and of the position as a share of the flying height.
_SIGMA_ANGLE_DEG = 0.2
_SIGMA_POSITION_SHARE = 0.005
# Beyond so many standard deviations, and so many degrees, a given position or attitude is wrong and not just inexact.
_WRONG_SIGMAS, _WRONG_DEG = 5.0, 15.0
# A model knows north well enough to judge headings to a few degrees.
_NORTH_KNOWN_DEG = 1.0
# North is unknown.
_UNKNOWN_NORTH_DEG = 180.0
# Nor is one whose difference the frame's own north leaves open by so many of its standard deviations.
_OPEN_SIGMAS = 3.0
# A focal length that differs by more than this share is said.
_FOCAL_SHARE = 0.02
# A pair shows ground where its poses explain this share of its matches.
_SHOWN = 0.5
# Pictures of one place differ by less, in pixels of the stored images.
_STANDING_PX = 2.0
# How given positions miss the pictures, or how they would fit them, and what to do. Positions alone do not tell
# exchanged columns from a wrong sign: either makes a mirror image.
_MISFITS = {
    "exchanged": "the given positions do not fit the pictures, but with latitude and longitude exchanged they do: "
    "exchange these columns of the pose list",
    "mirrored": "the given positions fit the pictures only mirrored: are x and y exchanged, or is the sign of x or y, "
    "or of latitude or longitude, another?",
    "scattered": "the given positions do not fit the pictures: are they those of other images, or of another flight?",
}


@dataclass(frozen=True, eq=False)
class Solution:
    """cameras: camera_id -> Camera. poses: image_id -> Pose. terrains: of flights that lie apart, the largest first.
    groups: images that were oriented together, the largest group first. result: what the stage reports."""

    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    terrains: tuple[Terrain, ...]
    groups: tuple[Group, ...]
    result: OrientResult


@dataclass(frozen=True, eq=False)
class FirstPassMatches:
    """The first pass of a block. pairs: its verified matches. thresholds_px: by image_id, errors of exact matches.

    stated_cameras: camera_id -> Camera as it was given, where the block has another by now. failed: images and rows of
    pairs that the first pass had to leave out.
    """

    block: Block
    pairs: Sequence[PairPoints]
    thresholds_px: Mapping[str, float]
    stated_cameras: Mapping[str, Camera]
    failed: Sequence[str] = ()

    @property
    def cameras(self) -> dict[str, Camera]:
        """Return the cameras by image_id."""
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


def suffices(evidence: FirstPassMatches, good: set[str]) -> bool:
    """Whether the given poses of the images `good` carry the block, so that only others need be found."""
    return len(good) >= _MOST * len(evidence.matched)


def from_given(evidence: FirstPassMatches, good: set[str], *, correct: bool) -> Solution:
    """Return given poses as they are; with `correct`, those that the matches contradict by resection from the `good`
    ones.

    Images without matches keep what was given: nothing speaks against it.
    """
    block, pairs, cameras = evidence.block, evidence.pairs, evidence.cameras
    poses = dict(block.poses)
    known = {i: poses[i] for i in sorted(good)}
    height_m = _flying_height_m(evidence, known) if evidence.matched - good else 1.0
    sigmas = (_SIGMA_POSITION_SHARE * height_m, _SIGMA_ANGLE_DEG)
    found = resected(pairs, known, cameras, evidence.thresholds_px, sigmas)
    if correct:
        by_strip = predicted(block, known | found)
        for image_id in (evidence.matched - good - found.keys()) & poses.keys():
            poses[image_id] = by_strip.get(image_id, replace(poses[image_id], world_rotation=None))
        poses |= found
    # What is wrong with a pose that stays is no reason for a wrong terrain.
    seen = known | found or {i: pose for i, pose in poses.items() if pose.world_rotation is not None}
    groups = connected_groups([(p.image_id0, p.image_id1) for p in pairs if {p.image_id0, p.image_id1} <= seen.keys()])
    terrains, points = _terrains(evidence, seen, groups, cameras)
    result = OrientResult(
        poses_from="given poses",
        frame="world" if block.poses else "own",
        corrected=sorted(found) if correct else [],
        stays=not correct,
        remarks=[],
        focal_lengths=_focal_lengths(evidence.stated_cameras, block.cameras),
        points=points,
        outside=_outside(block, poses),
        **_judged(block.poses, found),
    )
    held = Group("given", tuple(sorted(i for i in poses if poses[i].world_rotation is not None)))
    return Solution(block.cameras, poses, terrains, (held,), result)


def unoriented_remark(evidence: FirstPassMatches) -> str:
    """Say why no image could be oriented from its matches."""
    said = "the first pass could orient no image from the pictures"
    if len(evidence.block.images) < 2:
        return f"{said}: one image has none to be compared with"
    if not evidence.pairs:
        return f"{said}: no two of them have enough matches"
    if len(evidence.matched) < FEWEST_IMAGES:
        return (
            f"{said}: at least {FEWEST_IMAGES} images must have verified matches with others, "
            f"{len(evidence.matched)} have some"
        )
    moved_px = [np.median(np.linalg.norm(p.points0_px - p.points1_px, axis=1)) for p in evidence.pairs]
    if float(np.median(moved_px)) < _STANDING_PX:
        return f"{said}: they show the same from the same place"
    return f"{said}: their matches do not agree on one orientation"


def judged(given: Solution, pictures: Solution) -> Solution:
    """Return given poses as they are, with what the pictures say against them."""
    found = pictures.result
    better = pictures if found.frame == "world" and pictures.terrains else given
    against = {
        "wrong_attitudes": found.wrong_attitudes,
        "wrong_positions": found.wrong_positions,
        "focal_lengths": found.focal_lengths,
        "remarks": [*found.remarks, *_kept_remarks(given, pictures)],
        "points": better.result.points,
    }
    return replace(given, terrains=better.terrains, result=given.result.model_copy(update=against))


def _kept_remarks(given: Solution, pictures: Solution) -> list[str]:
    """Say how far given poses, which stay, are from those of the images."""
    oriented = {i for group in pictures.groups for i in group.images}
    found = {i: pictures.poses[i] for i in sorted(oriented & pictures.poses.keys())}
    off_deg = list(attitude_errors_deg(given.poses, found).values())
    if not off_deg or pictures.result.frame != "world":
        return []
    off_m = list(position_errors_m(given.poses, found).values())
    return [
        "the given poses do not explain the matches, and stay (orient=given): beside those of the pictures they are "
        f"off by {np.median(off_deg):.2f} degrees and {np.median(off_m):.2f} m (medians); orient=global corrects them"
    ]


def from_models(
    evidence: FirstPassMatches,
    models: Sequence[Model],
    before: Before,
    angles: Mapping[str, Angles],
    reading: str = "",
) -> Solution:
    """Return given poses and cameras, replaced by those of the mapper's models, the largest first.

    before: models are moved onto these poses, and where they agree the images keep them and their cameras. angles:
    image_id -> attitude as it was given. reading: how given positions that contradict the pictures fit them all the
    same, as of `_MISFITS`, "" where they do not.
    """
    block = evidence.block
    cameras, found = _of_models(block, models, before)
    beside = set[str]()
    for model in models:
        if model.kind == "level":
            beside.update(model.rotations)
    own = bool(models) and found.keys() <= beside
    # The mapper's own points are few: it leans on the longest tracks.
    lenses = {image.image_id: cameras[image.camera_id] for image in block.images}
    placed = {i: pose for i, pose in found.items() if i not in beside}
    # Images of groups beside are in frames of their own.
    counting = {i: pose for i, pose in block.poses.items() if i not in beside}
    tied = tied_by_pairs(evidence.pairs, placed, counting, lenses, evidence.thresholds_px)
    found |= {i: pose for i, (pose, _) in tied.items()}
    on_ground = _tied_by_ground(evidence, models, found, lenses)
    found |= {i: pose for i, (pose, _) in on_ground.items()}
    beside |= on_ground.keys()
    groups = _groups_with(models, {i: anchor for i, (_, anchor) in (tied | on_ground).items()})
    convention = None if own else _convention(models, angles, block.poses)
    # Given positions are in another frame than one of the pictures' own.
    poses = found if own else {**block.poses, **_loose_poses(evidence, found, convention, angles), **found}
    terrains, points = _terrains(evidence, found, [set(model.rotations) for model in models], lenses)
    judged_poses = {i: pose for i, pose in found.items() if i not in beside}
    result = OrientResult(
        poses_from="pictures",
        stays=False,
        frame="own" if own or not block.poses else "world",
        models=[model.figures for model in models],
        by_one_pair=sorted(tied.keys() | _tied_inside(models, "positions")),
        by_ground=sorted(on_ground.keys() | _tied_inside(models, "level")),
        calibrated=sorted({k for model in models for k in model.cameras}),
        points=points,
        focal_lengths=_focal_lengths(evidence.stated_cameras, cameras),
        outside=_outside(block, found),
        remarks=[*_position_remarks(models, reading), *_convention_remarks(convention)],
        **_judged(block.poses, judged_poses, convention, angles, _north_by_image(models, block.poses)),
    )
    return Solution(cameras, poses, terrains, groups, result)


def _of_models(block: Block, models: Sequence[Model], before: Before) -> tuple[dict[str, Camera], dict[str, Pose]]:
    """Return the block's cameras with those of models in their place, and image_id -> pose of the models' images.

    Where a model agrees with what was found before, poses and cameras found before stay.
    """
    cameras, found = dict(block.cameras), dict[str, Pose]()
    for model, kept in reversed(arranged(models, before)):  # the largest model's cameras count
        height_m = float(np.median([c[2] for c in model.centers_m.values()]) - np.median(model.points_m[:, 2]))
        sigma_m = _SIGMA_POSITION_SHARE * abs(height_m)
        for image_id, rotation in model.rotations.items():
            sigmas = model.tied.get(image_id, (sigma_m, _SIGMA_ANGLE_DEG))
            found[image_id] = Pose(model.centers_m[image_id], rotation, *sigmas)
        found |= kept
        cameras |= model.cameras
        if kept:
            cameras |= {k: old for k, old in before.cameras.items() if _same_lens(model.cameras.get(k), old)}
    return cameras, found


def _tied_inside(models: Sequence[Model], kind: PlacementKind) -> set[str]:
    return {image_id for model in models if model.kind == kind for image_id in model.tied}


def _tied_by_ground(
    evidence: FirstPassMatches, models: Sequence[Model], found: Mapping[str, Pose], lenses: Mapping[str, Camera]
) -> dict[str, tuple[Pose, str]]:
    """Return poses of images that a pair ties to a model in a frame of its own, and the image that each is tied to."""
    tied: dict[str, tuple[Pose, str]] = {}
    for model in models:
        if model.kind != "level":
            continue
        known = {i: found[i] for i in model.rotations}
        elsewhere = (found.keys() | tied.keys()) - known.keys()
        free = [pair for pair in evidence.pairs if elsewhere.isdisjoint((pair.image_id0, pair.image_id1))]
        tied |= tied_by_ground(free, known, lenses, evidence.thresholds_px)
    return tied


def _north_by_image(models: Sequence[Model], given: Mapping[str, Pose]) -> dict[str, float]:
    """Return image_id -> standard deviation of north, degrees, in the model that holds the image."""
    sigmas_deg: dict[str, float] = {}
    for model in models:
        sigmas_deg |= dict.fromkeys(model.rotations, _north_sigma_deg(model, given))
    return sigmas_deg


def _loose_poses(
    evidence: FirstPassMatches, found: Mapping[str, Pose], convention: Recognised | None, angles: Mapping[str, Angles]
) -> dict[str, Pose]:
    """Poses of images that no model holds, as far as they are to be other than given.

    Attitudes by the right reading of what was given, else by the strip: one that nothing confirms in a block where
    others were wrong is not relied on.
    """
    given = evidence.block.poses
    outside = given.keys() - found.keys()
    if convention is not None:
        return {i: replace(given[i], world_rotation=convention.rotation(angles[i])) for i in outside & angles.keys()}
    by_strip = predicted(evidence.block, found)
    return {i: by_strip.get(i, replace(given[i], world_rotation=None)) for i in sorted(outside - evidence.consistent())}


def _groups_with(models: Sequence[Model], anchors: Mapping[str, str]) -> tuple[Group, ...]:
    """Images of every model, and those tied to them. anchors: tied image -> the image that it was tied to, which may
    be a tied one itself, earlier in order."""
    groups = [(model.kind, set(model.rotations)) for model in models]
    for image_id, anchor in anchors.items():
        next(images for _, images in groups if anchor in images).add(image_id)
    return tuple(Group(kind, tuple(sorted(images))) for kind, images in groups)


def _same_lens(found: Camera | None, old: Camera) -> bool:
    """Whether a camera that was found again is the one found before, up to what mapping leaves open."""
    if found is None or (found.model, found.width_px, found.height_px) != (old.model, old.width_px, old.height_px):
        return False
    return abs(focal_px(found) / focal_px(old) - 1.0) <= SAME_SHARE


def _convention(models: Sequence[Model], angles: Mapping[str, Angles], given: Mapping[str, Pose]) -> Recognised | None:
    """Recognise the reading of the angles by the models that positions have placed."""
    placed = [model for model in models if model.kind == "positions"]
    north_deg = [_north_sigma_deg(model, given) for model in placed]
    # Only the models that know north about as well as the best one: a short strip knows little of it.
    known_deg = max(2.0 * min(north_deg, default=0.0), _NORTH_KNOWN_DEG)
    sure = [(model, sigma) for model, sigma in zip(placed, north_deg, strict=True) if sigma <= known_deg]
    rotations = {i: rotation for model, _ in sure for i, rotation in model.rotations.items()}
    return recognised(angles, rotations, max((sigma for _, sigma in sure), default=0.0))


def _north_sigma_deg(model: Model, given: Mapping[str, Pose]) -> float:
    """Standard deviation of a model's turn about the vertical, from the given positions of its images."""
    placed = [i for i in model.centers_m if i in given]
    centers_m = np.array([model.centers_m[i][:2] for i in placed]).reshape(-1, 2)
    spread_m = float(np.sqrt(((centers_m - centers_m.mean(axis=0)) ** 2).sum())) if placed else 0.0
    sigma_m = float(np.median([given[i].sigma_position_m for i in placed])) if placed else 0.0
    return float(np.rad2deg(sigma_m / spread_m)) if spread_m > 0.0 else _UNKNOWN_NORTH_DEG


def _convention_remarks(convention: Recognised | None) -> list[str]:
    if convention is None:
        return []
    return [f"the given angles do not fit the pictures: {convention.words}"]


def _position_remarks(models: Sequence[Model], reading: str) -> list[str]:
    contradiction = models[0].figures.contradiction if models else ""
    return [_MISFITS[reading or contradiction]] if contradiction else []


def _judged(
    given: Mapping[str, Pose],
    found: Mapping[str, Pose],
    convention: Recognised | None = None,
    as_given: Mapping[str, Angles] | None = None,
    north_deg: Mapping[str, float] | None = None,
) -> dict[str, dict[str, float]]:
    """Return given attitudes and positions that those found contradict: image_id -> degrees, image_id -> metres.

    convention: how the angles as they were given are to be read, where they are wrong as a whole. north_deg: image_id
    -> standard deviation of north in the frame of what was found, where it is not exact.
    """
    given = dict(given)
    for i, angles in (as_given or {}).items():
        if convention is not None and i in given:
            given[i] = replace(given[i], world_rotation=convention.rotation(angles))
    attitudes, positions = {}, {}
    for i, error_deg in sorted(attitude_errors_deg(given, found).items()):
        open_deg = _OPEN_SIGMAS * (north_deg or {}).get(i, 0.0)
        if round(error_deg, 1) > max(_WRONG_DEG, _WRONG_SIGMAS * given[i].sigma_angle_deg, open_deg):
            attitudes[i] = round(error_deg, 1)
    for i, error_m in sorted(position_errors_m(given, found).items()):
        if round(error_m, 2) > _WRONG_SIGMAS * (given[i].sigma_position_m + found[i].sigma_position_m):
            positions[i] = round(error_m, 2)
    return {"wrong_attitudes": attitudes, "wrong_positions": positions}


def _focal_lengths(given: Mapping[str, Camera], found: Mapping[str, Camera]) -> dict[str, FocalChange]:
    """camera_id -> focal lengths given and found, pixels, where they differ."""
    both = {k: (focal_px(camera), focal_px(found[k])) for k, camera in sorted(given.items())}
    changed = {k: sizes for k, sizes in both.items() if abs(sizes[1] / sizes[0] - 1.0) > _FOCAL_SHARE}
    return {k: FocalChange(round(old, 1), round(new, 1)) for k, (old, new) in changed.items()}


def _flying_height_m(evidence: FirstPassMatches, poses: Mapping[str, Pose]) -> float:
    """Median height of the cameras above the points of posed pairs, 1 where there are none."""
    points = _finite(triangulated(evidence.pairs, poses, evidence.cameras))
    if not len(points):
        return 1.0
    return abs(float(np.median([pose.center_m[2] for pose in poses.values()]) - np.median(points[:, 2])))


def _terrains(
    evidence: FirstPassMatches, poses: Mapping[str, Pose], groups: Sequence[set[str]], cameras: Mapping[str, Camera]
) -> tuple[tuple[Terrain, ...], int]:
    """Terrains of groups of posed images, and how many points they come from. cameras: by image_id.

    Pairs whose matches the poses contradict show no ground, nor do single matches that they contradict.
    """
    limits_px = {i: SLACK * limit for i, limit in evidence.thresholds_px.items()}
    parts = []
    for group in groups:
        inside = [pair for pair in evidence.pairs if {pair.image_id0, pair.image_id1} <= group]
        own = [pair for pair in inside if explained_share(pair, poses, cameras, limits_px) >= _SHOWN]
        centers_m = np.array([poses[i].center_m for i in sorted(group)])
        parts.append((ground_points(own, poses, cameras, limits_px), centers_m))
    return terrains_of(parts), sum(len(points) for points, _ in parts)


def _finite(parts: Sequence[FloatArray]) -> FloatArray:
    points = np.concatenate([np.zeros((0, 3)), *parts])
    return points[np.isfinite(points).all(axis=1)]


def _outside(block: Block, poses: Mapping[str, Pose]) -> list[str]:
    known = {i for i, pose in poses.items() if pose.world_rotation is not None}
    return sorted(image.image_id for image in block.images if image.image_id not in known)
