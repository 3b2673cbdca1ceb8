"""Matches between two pictures of blocks of houses, with exact truth."""

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import Camera, Candidates, Pair, PairGeometry, Pose
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa

CAMERA0 = Camera("RADIAL", 1000, 750, (850.0, 499.5, 374.5, -0.05, 0.01))
CAMERA1 = Camera("PINHOLE", 1000, 750, (800.0, 805.0, 503.0, 371.0))
POSE0 = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(3.0, -2.0, 10.0), 5.0, 3.0)
POSE1 = Pose(np.array([30.0, 8.0, 104.0]), from_omega_phi_kappa(-6.0, 9.0, 40.0), 5.0, 3.0)
GEOMETRY = PairGeometry(Pair("a", "b", 0.7, 15.0, "overlap"), CAMERA0, CAMERA1, POSE0, POSE1, 0.0)
ROOF_M = 12.0


@dataclass(frozen=True, eq=False)
class Scene:
    """candidates: (M,) matches. true: (M,) which are. height_m: (M,) of the surface in image 0."""

    candidates: Candidates
    true: np.ndarray
    height_m: np.ndarray


def houses(count, *, wrong=0.5, noise_px=0.4, seed=0, roof_m=ROOF_M, rough_m=0.0):
    """Streets at height 0 and roofs of 12 x 12 m every 24 m; rough_m: standard deviation of all heights."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-55, -45], [75, 50], (30 * count, 2))
    heights = np.where((np.abs((ground % 24.0) - 12.0) < 6.0).all(axis=1), roof_m, 0.0)
    points_m = np.column_stack([ground, heights + rng.normal(0, rough_m, len(ground))])
    sides = []
    for camera, pose in ((CAMERA0, POSE0), (CAMERA1, POSE1)):
        px = project(camera, pose.world_rotation, pose.center_m, points_m) + rng.normal(0, noise_px, (len(ground), 2))
        px[((px < 0) | (px > [camera.width_px - 1, camera.height_px - 1])).any(axis=1)] = np.nan
        sides.append(px)
    seen = np.flatnonzero(np.isfinite(sides[0] + sides[1]).all(axis=1))[:count]
    assert len(seen) == count
    true = rng.random(count) >= wrong
    points1 = np.where(true[:, None], sides[1][seen], rng.uniform(0, [999, 749], (count, 2)))
    return Scene(Candidates(sides[0][seen], points1), true, heights[seen])


def chance(count, seed):
    """Matches between pictures that share nothing."""
    rng = np.random.default_rng(seed)
    return Candidates(rng.uniform(0, [999, 749], (count, 2)), rng.uniform(0, [999, 749], (count, 2)))
