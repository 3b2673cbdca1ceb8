"""A model that starts from a single pair, for blocks in which hardly a point is seen by three images.

Mappers need such points. Where every image hangs on the next by a pair alone, the pair with most matches is a model of
two images, and the others are tied to it one by one, as `pair_registration` ties them to larger ones: by the positions
where these tie as many, else by the ground that both show. Blocks that need it: every 6th image of seneca, with
positions and with nothing (5 images; mappers hold 0 and 3 of them, by 4 points).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.results.stages import MappedModel
from aeromatch_cli.sfm.epipolar_agreement import EXPLAINED_SHARE, PairPoints, explained_share, triangulated
from aeromatch_cli.sfm.georeferencing import Placement, place
from aeromatch_cli.sfm.mapping import Model
from aeromatch_cli.sfm.model_validation import FEWEST_IMAGES, SLACK, contradicted_images
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
    evidence = _Evidence(pairs, given, cameras, thresholds_px, ups)
    starts = [start for pair in ranked[:_MOST_STARTS] if (start := evidence.level_pair(pair))]
    by_ground = max((evidence.by_ground(start) for start in starts), key=_images, default=None)
    by_positions = max((evidence.by_positions(start) for start in starts), key=_images, default=None)
    # Two positions fit any two images, right or wrong: what the ground ties says how many images belong together.
    best = by_positions if _images(by_positions) >= _images(by_ground) else by_ground
    return best if _images(best) >= FEWEST_IMAGES else None


def _images(model: Model | None) -> int:
    return 0 if model is None else len(model.rotations)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """The arguments of `started_from_pair`."""

    pairs: Sequence[PairPoints]
    given: Mapping[str, Pose]
    cameras: Mapping[str, Camera]
    thresholds_px: Mapping[str, float]
    ups: Mapping[str, FloatArray]

    def level_pair(self, pair: PairPoints) -> dict[str, Pose]:
        """The two images of a pair in a level frame of their own; nothing where their matches do not tell it."""
        ends, view = (pair.image_id0, pair.image_id1), relative_orientation(pair, self.cameras, self.thresholds_px)
        if view is None or view.rotation is None:
            return {}
        limits_px = {i: SLACK * self.thresholds_px[i] for i in ends}
        for direction in directions(view.model, view.rotation, np.eye(3)):
            both = {ends[0]: Pose(np.zeros(3), np.eye(3), 0.0, 0.0), ends[1]: Pose(direction, view.rotation, 0.0, 0.0)}
            enough = len(self._points(both)) >= _FEWEST_POINTS
            if enough and explained_share(pair, both, self.cameras, limits_px) >= EXPLAINED_SHARE:
                return _moved(both, self._placement(both, {}))
        return {}

    def by_ground(self, start: Mapping[str, Pose]) -> Model | None:
        """The images that the ground ties to a pair, placed by their positions where nearly all of these agree."""
        tied = tied_by_ground(self.pairs, start, self.cameras, self.thresholds_px)
        poses = self._sound(start, tied)
        placement = self._placement(poses, self.given)
        if placement.kind == "positions" and not (placement.trusted and self._positions(poses) >= FEWEST_IMAGES):
            doubted = "scattered" if self._positions(poses) >= FEWEST_IMAGES else ""
            placement = replace(self._placement(poses, {}), contradiction=doubted)
        return self._model(poses, placement)

    def by_positions(self, start: Mapping[str, Pose]) -> Model | None:
        """The images that their positions tie to a pair, whose own ones place it first and those of all then; None
        where positions are lacking or contradict each other."""
        if self._positions(start) < len(start):
            return None
        poses, placement = dict(start), self._placement(start, self.given)
        for _ in range(2):
            if placement.kind != "positions":
                return None
            placed = _moved({i: poses[i] for i in start}, placement)
            poses = self._sound(placed, tied_by_pairs(self.pairs, placed, self.given, self.cameras, self.thresholds_px))
            if len(poses) < FEWEST_IMAGES or not start.keys() <= poses.keys():
                return None
            placement = self._placement(poses, self.given)
        return None if placement.contradiction else self._model(poses, placement)

    def _positions(self, poses: Mapping[str, Pose]) -> int:
        return len(poses.keys() & self.given.keys())

    def _sound(self, start: Mapping[str, Pose], tied: Mapping[str, tuple[Pose, str]]) -> dict[str, Pose]:
        """The images of both whose places explain most of their matches; errors add up from tie to tie."""
        poses = dict(start)
        for image_id, (pose, anchor) in tied.items():
            poses[image_id] = _with_errors_of(pose, poses[anchor])
        wrong = contradicted_images(poses, self.pairs, self.cameras, self.thresholds_px)
        return {image_id: pose for image_id, pose in poses.items() if image_id not in wrong}

    def _points(self, poses: Mapping[str, Pose]) -> FloatArray:
        """(P, 3) points of the pairs between posed images whose rays meet at a fair angle."""
        inside = [pair for pair in self.pairs if {pair.image_id0, pair.image_id1} <= poses.keys()]
        points = np.concatenate(triangulated(inside, poses, self.cameras))
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def _placement(self, poses: Mapping[str, Pose], given: Mapping[str, Pose]) -> Placement:
        nowhere = np.full(3, np.nan)
        rotations = np.array([pose.world_rotation for pose in poses.values()])
        return place(
            np.array([pose.center_m for pose in poses.values()]),
            self._points(poses),
            np.array([given[i].center_m if i in given else nowhere for i in poses]),
            np.array([given[i].sigma_position_m if i in given else np.nan for i in poses]),
            np.einsum("nji,nj->ni", rotations, np.array([self.ups.get(i, nowhere) for i in poses])),
        )

    def _model(self, poses: Mapping[str, Pose], placement: Placement) -> Model:
        moved, points = _moved(poses, placement), placement.points(self._points(poses))
        figures = MappedModel(
            kind=placement.kind, images=len(poses), points=len(points), track_length=2.0, reprojection_error_px=None,
            contradiction=placement.contradiction, turned_back=[],
        )  # fmt: skip
        return Model(
            {i: np.asarray(pose.world_rotation) for i, pose in moved.items()},
            {i: pose.center_m for i, pose in moved.items()},
            {},
            points,
            figures,
            {i: (pose.sigma_position_m, pose.sigma_angle_deg) for i, pose in moved.items() if pose.sigma_angle_deg},
        )


def _moved(poses: Mapping[str, Pose], placement: Placement) -> dict[str, Pose]:
    rotations = placement.rotations(np.array([pose.world_rotation for pose in poses.values()]))
    centers_m = placement.points(np.array([pose.center_m for pose in poses.values()]))
    return {
        i: Pose(center_m, rotation, placement.scale * pose.sigma_position_m, pose.sigma_angle_deg)
        for (i, pose), rotation, center_m in zip(poses.items(), rotations, centers_m, strict=True)
    }


def _with_errors_of(pose: Pose, anchor: Pose) -> Pose:
    """The pose of an image with the errors of the one that it is tied to added to its own."""
    return replace(
        pose,
        sigma_position_m=float(np.hypot(pose.sigma_position_m, anchor.sigma_position_m)),
        sigma_angle_deg=float(np.hypot(pose.sigma_angle_deg, anchor.sigma_angle_deg)),
    )
