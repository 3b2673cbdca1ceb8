"""A flat block from straight above, where any focal length goes with some height of the ground: the prior one is taken,
and the ground stays in front of the images."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pycolmap

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.adjusting import _adjuster, _prefer_prior_focal_lengths
from aeromatch_cli.orientation.results import BEHIND_PX, centers_of, image_numbers, points_of

FOCAL_PX, HEIGHT_M, COLUMNS, ROWS = 200.0, 100.0, 6, 5
CENTERS_M = np.array([[24.0 * column, -24.0 * row, HEIGHT_M] for row in range(ROWS) for column in range(COLUMNS)])
DOWN = np.diag([1.0, -1.0, -1.0])


def flat_block(noise_px: float) -> pycolmap.Reconstruction:
    """Images of 160 x 120 pixels, a point every 12 m at height 0."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    params = [FOCAL_PX, FOCAL_PX, 80.0, 60.0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=160, height=120, params=params, camera_id=1)
    )
    grid = np.meshgrid(np.arange(-30.0, 24.0 * COLUMNS, 12.0), np.arange(-24.0 * ROWS, 30.0, 12.0))
    points_m = np.column_stack([axis.ravel() for axis in (*grid, np.zeros_like(grid[0]))])
    seen: dict[int, list[pycolmap.TrackElement]] = {}
    for number, center_m in enumerate(CENTERS_M, start=1):
        near = np.flatnonzero((np.abs(points_m - center_m)[:, :2] < [39.0, 29.0]).all(axis=1))
        local = (points_m[near] - center_m) @ DOWN.T
        places = FOCAL_PX * local[:, :2] / local[:, 2:] + [80.0, 60.0] + rng.normal(0.0, noise_px, (len(near), 2))
        keypoints = [pycolmap.Point2D(place) for place in places]
        image = pycolmap.Image(name=f"{number}", image_id=number, camera_id=1, points2D=keypoints)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([DOWN, -DOWN @ center_m])))
        for keypoint, point in enumerate(near.tolist()):
            seen.setdefault(point, []).append(pycolmap.TrackElement(number, keypoint))
    for point, elements in seen.items():
        if len(elements) > 1:
            model.add_point3D(points_m[point], pycolmap.Track(elements=elements))
    return model


def with_focal_length(model: pycolmap.Reconstruction, focal_px: float) -> pycolmap.Reconstruction:
    """The same pictures by another focal length: the ground lies as much deeper."""
    found = copy.deepcopy(model)
    found.cameras[1].params = [focal_px, focal_px, 80.0, 60.0]
    for point in found.points3D.values():
        point.xyz = [*point.xyz[:2], HEIGHT_M * (1.0 - focal_px / FOCAL_PX)]
    return found


def heights_m(model: pycolmap.Reconstruction) -> FloatArray:
    return np.asarray(points_of(model)[:, 2])


def test_a_far_prior_is_taken_with_the_ground_in_front_of_the_images() -> None:
    start = flat_block(noise_px=0.05)
    found = with_focal_length(start, 1300.0)
    assert np.median(heights_m(found)) < -500.0
    priors = {"1": {"params": np.array([FOCAL_PX, FOCAL_PX, 80.0, 60.0]), "focal_px": FOCAL_PX, "sigma": 0.03}}
    used, sigmas_m = image_numbers(start), np.full(len(CENTERS_M), 5.0)

    def adjuster(which: Any, fixed_cameras: bool) -> Any:
        fixed = {1} if fixed_cameras else set()
        return _adjuster(pycolmap, which, used, CENTERS_M, sigmas_m, fixed, False, 1e-6)

    drifted = copy.deepcopy(found)  # by a name: an adjuster does not keep its model
    cost = adjuster(drifted, True).solve().ceres_summary.final_cost
    _prefer_prior_focal_lengths(found, start, priors, cost, adjuster)
    found.update_point_3d_errors()
    assert found.cameras[1].params[0] == FOCAL_PX
    assert max(point.error for point in found.points3D.values()) < 1.0 < BEHIND_PX
    assert np.abs(heights_m(found)).max() < 5.0
    assert np.abs(centers_of(found, used) - CENTERS_M).max() < 5.0
