"""Whether a mapper's models explain the matches that they were made from.

A mapper follows the matches that agree with its solution and drops the others: a model that is wrong has small errors,
too. Of a sound one nearly all verified matches of every pair lie near their epipolar lines and in front of both
cameras; of two parts that do not belong together, hardly any across.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.orientation.judgement import (
    EXPLAINED_SHARE,
    MIN_MATCHES,
    PairPoints,
    connected_groups,
    explained_share,
)
from aeromatch_cli.orientation.mapping import Model

# Models are less exact than the errors of exact matches, by this factor: found from few tracks, without distortion.
_SLACK = 3.0
# Fewer images make no model.
FEWEST_IMAGES = 3


def sound_part(
    model: Model,
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> Model | None:
    """The images of a model that explained pairs connect, as many as there are; None of fewer than three.

    cameras: image_id -> camera, the model's own where it has found it. thresholds_px: by image_id, errors of exact
    matches in stored pixels.
    """
    poses = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    limits_px = {image_id: _SLACK * limit for image_id, limit in thresholds_px.items()}
    inside = [p for p in pairs if {p.image_id0, p.image_id1} <= poses.keys() and len(p.indices) >= MIN_MATCHES]
    good = [p for p in inside if explained_share(p, poses, cameras, limits_px) >= EXPLAINED_SHARE]
    groups = connected_groups([(p.image_id0, p.image_id1) for p in good])
    if not groups or len(groups[0]) < FEWEST_IMAGES:
        return None
    left = sorted(groups[0])
    return replace(
        model,
        rotations={i: model.rotations[i] for i in left},
        centers_m={i: model.centers_m[i] for i in left},
        figures=dict(model.figures) | {"images": len(left)},
    )
