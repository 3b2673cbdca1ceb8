"""Models of a first pass grown by resection: images that no model holds, and smaller models that a larger one ties.

A mapper leaves an image out that shares few points of three images with the rest, and makes a model of its own of what
hangs on it. Points of two images place them all the same, once the others have their places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_validation import SLACK, sound_part
from aeromatch_cli.sfm.resection import resected

# A smaller model becomes part of a larger one by so large a share of its images.
_MOST = 0.6


def grown(
    models: Sequence[Model],
    pairs: Sequence[PairPoints],
    camera_ids: Mapping[str, str],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    given: Mapping[str, Pose],
) -> tuple[Model, ...]:
    """Return the models with further images, the largest first; smaller ones that became part of a larger one are gone.

    camera_ids: image_id -> camera_id. cameras: camera_id -> camera, where no model has found it. thresholds_px: by
    image_id, errors of exact matches in stored pixels. given: image_id -> pose whose position was given.
    """
    left = sorted(models, key=lambda model: -len(model.rotations))
    done: list[Model] = []
    while left:
        model, *left = left
        taken = {i for one in done for i in one.rotations}
        free = [pair for pair in pairs if not taken.intersection((pair.image_id0, pair.image_id1))]
        # As the largest model has it that has found it: images are resected with the camera that they keep.
        known = {k: camera for one in reversed([model, *left]) for k, camera in one.cameras.items()}
        lenses = {i: known.get(k, cameras[k]) for i, k in camera_ids.items()}
        found = _resected(model, free, lenses, thresholds_px)
        if not found:
            done.append(model)
            continue
        larger, parts = _extended(model, left, found, camera_ids, known)
        others = [one for one in left if one not in parts]
        sound = sound_part(larger, free, lenses, thresholds_px, given)
        if sound is not None and sound.rotations.keys() > model.rotations.keys():
            done.append(sound)
            left = others
        else:
            done.append(model)
            left = sorted([*parts, *others], key=lambda one: -len(one.rotations))
    return tuple(sorted(done, key=lambda model: -len(model.rotations)))


def _extended(
    model: Model,
    others: Sequence[Model],
    found: Mapping[str, Pose],
    camera_ids: Mapping[str, str],
    known: Mapping[str, Camera],
) -> tuple[Model, list[Model]]:
    """Return the model with the images found that no other one keeps, and those others that become part of it.

    camera_ids: image_id -> camera_id. known: camera_id -> camera as a model has found it.
    """
    parts = [one for one in others if len(found.keys() & one.rotations.keys()) >= _MOST * len(one.rotations)]
    elsewhere = {i for one in others if one not in parts for i in one.rotations}
    taken_in = {i: pose for i, pose in found.items() if i not in elsewhere}
    own = {camera_ids[i] for i in taken_in} & known.keys()
    return _with(model, taken_in, {k: known[k] for k in sorted(own)}), parts


def _resected(
    model: Model, pairs: Sequence[PairPoints], lenses: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> dict[str, Pose]:
    known = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    limits_px = {i: SLACK * limit for i, limit in thresholds_px.items()}
    return resected(pairs, known, lenses, limits_px, (0.0, 0.0))


def _with(model: Model, found: Mapping[str, Pose], cameras: Mapping[str, Camera]) -> Model:
    """The model with the poses found. cameras: of their images, where a model has found them."""
    rotations, centers_m = dict(model.rotations), dict(model.centers_m)
    for image_id, pose in found.items():
        assert pose.world_rotation is not None
        rotations[image_id], centers_m[image_id] = pose.world_rotation, pose.center_m
    figures = model.figures.model_copy(update={"images": len(rotations)})
    return replace(
        model, rotations=rotations, centers_m=centers_m, cameras={**model.cameras, **cameras}, figures=figures
    )
