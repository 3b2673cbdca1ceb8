"""Models of a first pass grown by resection of images that no model holds.

A mapper leaves an image out that shares few points of three images with the rest. Points of two images place it all the
same, once the others have their places. Blocks that need it: every 2nd image of brighton, every 3rd of seneca.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_validation import SLACK, sound_part
from aeromatch_cli.sfm.resection import resected


def grown(
    models: Sequence[Model],
    pairs: Sequence[PairPoints],
    camera_ids: Mapping[str, str],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    given: Mapping[str, Pose],
) -> tuple[Model, ...]:
    """Return the models with further images, the largest first.

    camera_ids: image_id -> camera_id. cameras: camera_id -> camera, where no model has found it. thresholds_px: by
    image_id, errors of exact matches in stored pixels. given: image_id -> pose whose position was given.
    """
    largest_first = sorted(models, key=lambda model: -len(model.rotations))
    # As the largest model has it that has found it: images are resected with the camera that they keep.
    found_cameras = {k: camera for model in reversed(largest_first) for k, camera in model.cameras.items()}
    done: list[Model] = []
    for number, model in enumerate(largest_first):
        elsewhere = {i for one in (*done, *largest_first[number + 1 :]) for i in one.rotations}
        free = [pair for pair in pairs if not elsewhere.intersection((pair.image_id0, pair.image_id1))]
        known = {**found_cameras, **model.cameras}
        lenses = {i: known.get(k, cameras[k]) for i, k in camera_ids.items()}
        found = _resected(model, free, lenses, thresholds_px)
        if found:
            own = sorted({camera_ids[i] for i in found} & known.keys())
            larger = replace(model.with_images(found), cameras={**model.cameras, **{k: known[k] for k in own}})
            sound = sound_part(larger, free, lenses, thresholds_px, given)
            model = sound if sound is not None and sound.rotations.keys() > model.rotations.keys() else model
        done.append(model)
    return tuple(sorted(done, key=lambda model: -len(model.rotations)))


def _resected(
    model: Model, pairs: Sequence[PairPoints], lenses: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> dict[str, Pose]:
    known = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    limits_px = {i: SLACK * limit for i, limit in thresholds_px.items()}
    return resected(pairs, known, lenses, limits_px, (0.0, 0.0))
