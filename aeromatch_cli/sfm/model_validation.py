"""Whether a mapper's models explain the matches that they were made from.

A mapper follows the matches that agree with its solution and drops the others: a model that is wrong has small errors,
too. Of a sound one nearly all verified matches of every pair lie near their epipolar lines and in front of both
cameras; of two parts that do not belong together, hardly any across. A block that needs it: every 2nd image of lewis
without poses, two images of which hang on the others by one pair.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.geometry.components import connected_groups
from aeromatch_cli.sfm.epipolar_agreement import (
    EXPLAINED_SHARE,
    MIN_MATCHES,
    PairPoints,
    explained_share,
)
from aeromatch_cli.sfm.mapping import Model

# Models are less exact than the errors of exact matches, by this factor: found from few tracks, without distortion.
SLACK = 3.0
# Of what an image in its place shares with the others at least this share is explained.
_LEAST_EXPLAINED = 0.5
# A position confirms a place up to so many standard deviations.
_CONFIRMED_SIGMAS = 3.0
# So many keypoints that two pairs of an image share tie their scales to each other.
_SHARED_KEYPOINTS = 8
# Fewer images make no model.
FEWEST_IMAGES = 3


def sound_part(
    model: Model,
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    given: Mapping[str, Pose],
) -> Model | None:
    """Return the most images of a model that explained pairs hold in their places; None of fewer than three.

    A pair tells the direction from one image to another and not the distance. Points that three images see tell it:
    keypoints of an image that two of its pairs share. Images tied otherwise stay where their given positions confirm
    their places.

    cameras: image_id -> camera, the model's own where it has found it. thresholds_px: by image_id, errors of exact
    matches in stored pixels. given: image_id -> pose whose position was given.
    """
    poses = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    inside, shares = _explained(poses, pairs, cameras, thresholds_px)
    wrong = _contradicted(inside, shares)
    explained = [p for p, share in zip(inside, shares, strict=True) if share >= EXPLAINED_SHARE]
    good = [p for p in explained if not wrong & {p.image_id0, p.image_id1}]
    edges = [(p.image_id0, p.image_id1) for p in good]
    sure = max(rigid_groups(good), key=lambda group: (len(group), min(group)), default=set())
    if model.kind == "positions":
        sure = sure | (_confirmed(model, given) - wrong)
    groups = connected_groups([edge for edge in edges if sure.issuperset(edge)])
    if not groups or len(groups[0]) < FEWEST_IMAGES:
        return None
    return only(model, groups[0])


def contradicted_images(
    poses: Mapping[str, Pose],
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> set[str]:
    """Return the images most of whose matches with the others their poses do not explain. cameras and thresholds_px: by
    image_id."""
    return _contradicted(*_explained(poses, pairs, cameras, thresholds_px))


def _explained(
    poses: Mapping[str, Pose],
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> tuple[list[PairPoints], list[float]]:
    """The pairs between posed images, and the share of the matches of each that the poses explain."""
    limits_px = {image_id: SLACK * limit for image_id, limit in thresholds_px.items()}
    inside = [p for p in pairs if {p.image_id0, p.image_id1} <= poses.keys() and len(p.indices) >= MIN_MATCHES]
    return inside, [explained_share(p, poses, cameras, limits_px) for p in inside]


def only(model: Model, image_ids: Collection[str]) -> Model:
    """Return some images of a model."""
    left = sorted(image_ids)
    return replace(
        model,
        rotations={i: model.rotations[i] for i in left},
        centers_m={i: model.centers_m[i] for i in left},
        figures=model.figures.model_copy(update={"images": len(left)}),
    )


def _contradicted(pairs: Sequence[PairPoints], shares: Sequence[float]) -> set[str]:
    """Images in wrong places: most of what they share with the others is not explained. The worst counts first.

    A misplaced image may explain a pair by chance, where its keypoints lie along one line say.
    """
    wrong: set[str] = set()
    while True:
        explained: defaultdict[str, float] = defaultdict(float)
        total: defaultdict[str, float] = defaultdict(float)
        for pair, share in zip(pairs, shares, strict=True):
            ids = pair.image_id0, pair.image_id1
            if not wrong.intersection(ids):
                for image_id in ids:
                    explained[image_id] += share * len(pair.indices)
                    total[image_id] += len(pair.indices)
        worst = min(sorted(total), key=lambda i: explained[i] / total[i], default=None)
        if worst is None or explained[worst] >= _LEAST_EXPLAINED * total[worst]:
            return wrong
        wrong.add(worst)


def _confirmed(model: Model, given: Mapping[str, Pose]) -> set[str]:
    """Images that a model puts where their positions say."""
    off_m = {i: float(np.linalg.norm(model.centers_m[i] - given[i].center_m)) for i in model.centers_m.keys() & given}
    return {i for i, off in off_m.items() if off <= _CONFIRMED_SIGMAS * given[i].sigma_position_m}


def rigid_groups(pairs: Sequence[PairPoints]) -> list[set[str]]:
    """Return images of pairs whose relative scales are known: two pairs of an image that share keypoints there, and so
    on."""
    of_image: dict[str, list[tuple[tuple[str, str], set[int]]]] = {}
    for pair in pairs:
        ids = pair.image_id0, pair.image_id1
        for side, image_id in enumerate(ids):
            of_image.setdefault(image_id, []).append((ids, set(pair.indices[:, side].tolist())))
    tied = [
        (one, other)
        for seen in of_image.values()
        for (one, own), (other, others) in combinations(seen, 2)
        if len(own & others) >= _SHARED_KEYPOINTS
    ]
    return [{image_id for ids in group for image_id in ids} for group in connected_groups(tied)]
