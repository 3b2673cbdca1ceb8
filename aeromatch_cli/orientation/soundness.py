"""Whether a mapper's models explain the matches that they were made from.

A mapper follows the matches that agree with its solution and drops the others: a model that is wrong has small errors,
too. Of a sound one nearly all verified matches of every pair lie near their epipolar lines and in front of both
cameras; of two parts that do not belong together, hardly any across.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

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
# A position confirms a place up to so many standard deviations.
_CONFIRMED_SIGMAS = 3.0
# Fewer images make no model.
FEWEST_IMAGES = 3


def sound_part(
    model: Model,
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    given: Mapping[str, Pose],
) -> Model | None:
    """The most images of a model that explained pairs hold in their places; None of fewer than three.

    A pair tells the direction from one image to another and not the distance: places hold in triangles that share
    sides, and by two ties to such. Images tied to them otherwise stay where their given positions confirm their places.

    cameras: image_id -> camera, the model's own where it has found it. thresholds_px: by image_id, errors of exact
    matches in stored pixels. given: image_id -> pose whose position was given.
    """
    poses = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    limits_px = {image_id: _SLACK * limit for image_id, limit in thresholds_px.items()}
    inside = [p for p in pairs if {p.image_id0, p.image_id1} <= poses.keys() and len(p.indices) >= MIN_MATCHES]
    good = [p for p in inside if explained_share(p, poses, cameras, limits_px) >= EXPLAINED_SHARE]
    edges = [(p.image_id0, p.image_id1) for p in good]
    rigid = max(rigid_groups(edges), key=lambda group: (len(group), min(group)), default=set())
    sure = rigid | (_confirmed(model, given) if model.kind == "positions" else set())
    groups = connected_groups([edge for edge in edges if sure.issuperset(edge)])
    if not groups or len(groups[0]) < FEWEST_IMAGES:
        return None
    left = sorted(groups[0])
    return replace(
        model,
        rotations={i: model.rotations[i] for i in left},
        centers_m={i: model.centers_m[i] for i in left},
        figures=dict(model.figures) | {"images": len(left)},
    )


def _confirmed(model: Model, given: Mapping[str, Pose]) -> set[str]:
    """Images that a model puts where their positions say."""
    off_m = {i: float(np.linalg.norm(model.centers_m[i] - given[i].center_m)) for i in model.centers_m.keys() & given}
    return {i for i, off in off_m.items() if off <= _CONFIRMED_SIGMAS * given[i].sigma_position_m}


def rigid_groups(edges: Sequence[tuple[str, str]]) -> list[set[str]]:
    """Nodes of the triangles of a graph, together where these share sides one after the other; and further nodes with
    edges to two of such a group.
    """
    around: dict[str, set[str]] = {}
    for one, other in edges:
        around.setdefault(one, set()).add(other)
        around.setdefault(other, set()).add(one)
    return [_grown(group, around) for group in _triangles(edges, around)]


def _grown(group: set[str], around: Mapping[str, set[str]]) -> set[str]:
    grown = set(group)
    while more := {node for node, others in around.items() if node not in grown and len(others & grown) > 1}:
        grown |= more
    return grown


def _triangles(edges: Sequence[tuple[str, str]], around: Mapping[str, set[str]]) -> list[set[str]]:
    sides = {frozenset(edge): set(edge) for edge in edges}
    for one, other in edges:
        for third in around[one] & around[other]:
            three = [frozenset(side) for side in ((one, other), (one, third), (other, third))]
            joined = sides[three[0]] | sides[three[1]] | sides[three[2]]
            members = {id(sides[side]) for side in three}
            if len(members) > 1:
                sides |= {side: joined for side, group in sides.items() if id(group) in members}
    found = {id(group): group for group in sides.values() if len(group) > 2}
    return list(found.values())
