"""A model that starts from a single pair, for blocks in which hardly a point is seen by three images.

Mappers need such points. Where every image hangs on the next by a pair alone, the pair with most matches is a model of
two images, and the others are tied to it one by one, as `pair_registration` ties them to larger ones. Blocks that need
it: every 6th image of seneca, with positions and with nothing (5 images; pycolmap's mappers hold 0 and 3, by 4 points).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.results.stages import MappedModel
from aeromatch_cli.sfm.epipolar_agreement import EXPLAINED_SHARE, PairPoints, explained_share, triangulated
from aeromatch_cli.sfm.georeferencing import place
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_validation import FEWEST_IMAGES, SLACK
from aeromatch_cli.sfm.pair_registration import directions, relative_orientation, tied_by_ground, tied_by_pairs

# A pair of fewer points, of rays that meet at a fair angle, says too little of the ground to start from.
_FEWEST_POINTS = 50
# So many pairs are tried.
_MOST_STARTS = 5


def started_from_pair(
    pairs: Sequence[PairPoints],
    given: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    ups: Mapping[str, FloatArray],
) -> Model | None:
    """Return the largest of the models that start from the pairs with most matches; None of fewer than three images.

    given: image_id -> pose whose position was given. cameras: image_id -> camera. thresholds_px: by image_id, errors of
    exact matches in stored pixels. ups: image_id -> (3,) unit vector upwards in the camera by its measured tilt.
    """
    ranked = sorted(pairs, key=lambda pair: (-len(pair.indices), pair.image_id0, pair.image_id1))
    starts = (_of_pair(pair, given, cameras, thresholds_px, ups) for pair in ranked[:_MOST_STARTS])
    models = [_extended(start, pairs, given, cameras, thresholds_px) for start in starts if start is not None]
    best = max(models, key=lambda model: len(model.rotations), default=None)
    return best if best is not None and len(best.rotations) >= FEWEST_IMAGES else None


def _of_pair(
    pair: PairPoints,
    given: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    ups: Mapping[str, FloatArray],
) -> Model | None:
    """The two images of a pair, placed by their positions, else level."""
    ends, view = (pair.image_id0, pair.image_id1), relative_orientation(pair, cameras, thresholds_px)
    if view is None or view.rotation is None:
        return None
    limits_px = {i: SLACK * thresholds_px[i] for i in ends}
    for direction in directions(view.model, view.rotation, np.eye(3)):
        both = {ends[0]: Pose(np.zeros(3), np.eye(3), 0.0, 0.0), ends[1]: Pose(direction, view.rotation, 0.0, 0.0)}
        points = triangulated([pair], both, cameras)[0]
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) >= _FEWEST_POINTS and explained_share(pair, both, cameras, limits_px) >= EXPLAINED_SHARE:
            return _placed(both, points, given, ups)
    return None


def _placed(
    both: Mapping[str, Pose], points: FloatArray, given: Mapping[str, Pose], ups: Mapping[str, FloatArray]
) -> Model:
    nowhere = np.full(3, np.nan)
    rotations = np.array([pose.world_rotation for pose in both.values()])
    centers = np.array([pose.center_m for pose in both.values()])
    placement = place(
        centers,
        points,
        np.array([given[i].center_m if i in given else nowhere for i in both]),
        np.array([given[i].sigma_position_m if i in given else np.nan for i in both]),
        np.einsum("nji,nj->ni", rotations, np.array([ups.get(i, nowhere) for i in both])),
    )
    figures = MappedModel(
        kind=placement.kind, images=2, points=len(points), track_length=2.0, reprojection_error_px=None,
        contradiction=placement.contradiction, turned_back=[],
    )  # fmt: skip
    turned, moved_m = placement.rotations(rotations), placement.points(centers)
    return Model(
        dict(zip(both, turned, strict=True)),
        dict(zip(both, moved_m, strict=True)),
        {},
        placement.points(points),
        figures,
    )


def _extended(
    model: Model,
    pairs: Sequence[PairPoints],
    given: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> Model:
    """The model with the images that a pair each ties to it."""
    known = {i: Pose(model.centers_m[i], rotation, 0.0, 0.0) for i, rotation in model.rotations.items()}
    if model.kind == "positions":
        tied = tied_by_pairs(pairs, known, given, cameras, thresholds_px)
    else:
        tied = tied_by_ground(pairs, known, cameras, thresholds_px)
    return replace(model.with_images({i: pose for i, (pose, _) in tied.items()}), tied=frozenset(tied))
