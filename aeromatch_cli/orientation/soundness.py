"""Whether a mapper's models explain the matches that they were made from.

A mapper follows the matches that agree with its solution and drops the others: a model that is wrong has small errors,
too. Of a sound one nearly all verified matches of every pair lie near their epipolar lines and in front of both
cameras; of two parts that do not belong together, hardly any across.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.orientation.judgement import MIN_MATCHES, PairPoints, explained_images
from aeromatch_cli.orientation.mapping import Model

# Models are less exact than the errors of exact matches, by this factor: found from few tracks, without distortion.
_SLACK = 3.0
# Fewer images make no model.
_FEWEST_IMAGES = 3


@dataclass(frozen=True, eq=False)
class Checked:
    """models: without the images whose matches they do not explain. sound, contradicted: how many of both."""

    models: tuple[Model, ...]
    sound: int
    contradicted: int


def checked(
    models: Sequence[Model],
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    camera_of: Mapping[str, str],
    thresholds_px: Mapping[str, float],
) -> Checked:
    """The models as far as they explain the pairs.

    cameras: by camera_id, as given. camera_of: image_id -> camera_id. thresholds_px: by image_id, errors of exact
    matches in stored pixels.
    """
    limits_px = {image_id: _SLACK * limit for image_id, limit in thresholds_px.items()}
    kept, contradicted = [], 0
    for model in models:
        own = {**cameras, **model.cameras}
        wrong = _contradicted(model, pairs, {i: own[k] for i, k in camera_of.items()}, limits_px)
        contradicted += len(wrong)
        if len(model.rotations) - len(wrong) >= _FEWEST_IMAGES:
            kept.append(_without(model, wrong))
    kept.sort(key=lambda model: -len(model.rotations))
    return Checked(tuple(kept), sum(len(model.rotations) for model in kept), contradicted)


def _contradicted(
    model: Model, pairs: Sequence[PairPoints], cameras: Mapping[str, Camera], limits_px: Mapping[str, float]
) -> set[str]:
    """Images of a model whose matches with the others it does not explain."""
    poses = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    inside = [p for p in pairs if {p.image_id0, p.image_id1} <= poses.keys() and len(p.indices) >= MIN_MATCHES]
    judged = {image_id for pair in inside for image_id in (pair.image_id0, pair.image_id1)}
    return judged - explained_images(inside, poses, cameras, limits_px)


def _without(model: Model, wrong: set[str]) -> Model:
    if not wrong:
        return model
    left = [i for i in model.rotations if i not in wrong]
    return replace(
        model,
        rotations={i: model.rotations[i] for i in left},
        centers_m={i: model.centers_m[i] for i in left},
        figures=dict(model.figures) | {"images": len(left)},
    )
