"""Which attitudes contradict the matches: rotations from matches against the given ones, image by image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aeromatch_cli.data import FloatArray, Pose

# Beyond this angle a pose is no noisy measurement but a mistake (wrong convention, image turned after capture).
LARGEST_DIFFERENCE_DEG = 45.0
# Fewer matches do not accuse anyone: on four real blocks 7 of 87 rotations from 15 to 29 matches were wrong by more
# than 45 degrees, 1 of 926 from more matches.
LEAST_MATCHES = 30


def contradicting_images(
    poses: Mapping[str, Pose], rotations: Sequence[tuple[str, str, FloatArray, int]]
) -> dict[str, float]:
    """image_id -> angle in degrees between its given attitude and the one that its matches imply, where > 45.

    rotations: (id0, id1, cam1_from_cam0 (3, 3), supporting matches) of verified pairs. A pair only tells that one of
    its two attitudes is wrong. So rotations are chained along the strongest pairs (maximum spanning tree, Kruskal) to
    one attitude per image up to a common turn; that turn is the one on which most images agree; the others contradict.
    Pairs of fewer than LEAST_MATCHES matches are left out.
    """
    strong = [r for r in rotations if r[3] >= LEAST_MATCHES]
    usable = [r for r in strong if _attitude(poses, r[0]) is not None and _attitude(poses, r[1]) is not None]
    result: dict[str, float] = {}
    for chained in _chain_components(usable):
        # Row i: the world rotation that takes the chained attitude of image i to its given one.
        ids = sorted(chained)
        turns = np.array([(_known(poses, i).T @ chained[i]).ravel() for i in ids])
        best, votes = _most_agreed(turns)
        if votes * 2 <= len(ids):
            continue  # no majority: the attitudes as a whole cannot be judged
        angles = _angles_deg(turns, turns[best : best + 1])[:, 0]
        for index in np.flatnonzero(angles > LARGEST_DIFFERENCE_DEG):
            result[ids[index]] = round(float(angles[index]), 1)
    return dict(sorted(result.items()))


def _most_agreed(turns: FloatArray) -> tuple[int, int]:
    """Index of the turn (N, 9) that most others agree with, and how many do; by blocks, as N may be 10,000."""
    votes = [
        int(count)
        for start in range(0, len(turns), 512)
        for count in (_angles_deg(turns[start : start + 512], turns) <= LARGEST_DIFFERENCE_DEG).sum(axis=1)
    ]
    best = int(np.argmax(votes))
    return best, votes[best]


def _angles_deg(turns0: FloatArray, turns1: FloatArray) -> FloatArray:
    """Angles (N, M) between rotations given as rows of nine: trace(A B^T) is their dot product."""
    return np.rad2deg(np.arccos(np.clip((turns0 @ turns1.T - 1.0) / 2.0, -1.0, 1.0)))


def _attitude(poses: Mapping[str, Pose], image_id: str) -> FloatArray | None:
    pose = poses.get(image_id)
    return None if pose is None else pose.world_rotation


def _known(poses: Mapping[str, Pose], image_id: str) -> FloatArray:
    attitude = _attitude(poses, image_id)
    if attitude is None:
        raise ValueError(f"image {image_id} has no attitude")
    return attitude


def _chain_components(rotations: Sequence[tuple[str, str, FloatArray, int]]) -> list[dict[str, FloatArray]]:
    """Attitude of every image relative to the first of its component, along the maximum spanning tree."""
    group: dict[str, dict[str, FloatArray]] = {}
    for id0, id1, cam1_from_cam0, _ in sorted(rotations, key=lambda r: (-r[3], r[0], r[1])):
        first = group.setdefault(id0, {id0: np.eye(3)})
        second = group.setdefault(id1, {id1: np.eye(3)})
        if first is second:
            continue
        # Bring the second group into the frame of the first: cam1_from_first = cam1_from_cam0 cam0_from_first.
        first_from_second = (cam1_from_cam0 @ first[id0]).T @ second[id1]
        for image_id, cam_from_second in second.items():
            first[image_id] = cam_from_second @ first_from_second.T
            group[image_id] = first
    unique = {id(members): members for members in group.values()}
    return sorted(unique.values(), key=lambda members: min(members))
