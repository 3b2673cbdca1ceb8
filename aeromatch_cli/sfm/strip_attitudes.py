"""Attitudes of images that could not be oriented, as their strip predicts them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Block, Pose
from aeromatch_cli.geometry.rotations import angle_between_deg

# An image between two oriented ones of its strip is as they are; where these differ by more, the flight turned there.
_TURN_DEG = 30.0
# An aircraft's attitude changes by so much from one image to the next.
_LEAST_SIGMA_DEG = 5.0


def predicted(block: Block, found: Mapping[str, Pose]) -> dict[str, Pose]:
    """Return poses of images outside `found` that have a position, from the nearest images before and after in their
    strip.

    A strip is the images of one camera in the order of capture time, or of name where times are missing. The attitude
    is that between both neighbours, its standard deviation the angle between them; no attitude where the flight turns
    or there is no neighbour on either side.
    """
    from scipy.spatial.transform import Rotation

    poses = {}
    cameras = {image.camera_id for image in block.images}
    for camera_id in sorted(cameras):
        strip = [image for image in block.images if image.camera_id == camera_id]
        timed = all(image.time for image in strip)
        strip.sort(key=lambda image: ((image.time or "") if timed else "", image.name))
        known = [row for row, image in enumerate(strip) if image.image_id in found]
        for row, image in enumerate(strip):
            given = block.poses.get(image.image_id)
            at = bisect_left(known, row)
            before, after = known[max(0, at - 1) : at], known[at : at + 1]  # of an image that is not known itself
            if image.image_id in found or given is None or not before or not after:
                continue
            ends = [found[strip[k].image_id].world_rotation for k in (*before, *after)]
            if ends[0] is None or ends[1] is None:
                continue
            apart_deg = angle_between_deg(ends[0], ends[1])
            if apart_deg <= _TURN_DEG:
                middle = Rotation.from_matrix(np.array(ends)).mean().as_matrix()
                sigma_deg = max(_LEAST_SIGMA_DEG, apart_deg)
                poses[image.image_id] = replace(given, world_rotation=middle, sigma_angle_deg=sigma_deg)
    return poses
