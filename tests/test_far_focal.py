"""A flat block from straight above, where any focal length goes with some height of the ground: it stays at its prior,
and the ground in front of the images."""

from __future__ import annotations

import copy

import numpy as np
import pycolmap
import pytest
from make_networks import given_positions

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.bundle.of_model import image_numbers
from aeromatch_cli.sfm.calibration import freed, lens_prior
from aeromatch_cli.sfm.model_adjustment import Work, adjusted, state_errors
from aeromatch_cli.sfm.model_arrays import BEHIND_PX, centers_of, points_of

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


def work(sigma: float, *, final: bool = False) -> Work:
    """sigma: standard deviation of the focal length, as a share; the rest of the lens is as `calibration` frees it."""
    prior = lens_prior(Camera("SIMPLE_PINHOLE", 160, 120, (FOCAL_PX, 79.5, 59.5)), sigma)
    sigmas = freed(prior, "auto", {}, len(CENTERS_M)) if final else np.where(np.arange(12) == 0, prior.sigmas, 0.0)
    return Work(pycolmap, {1: prior.lens}, {1: sigmas}, frozenset(), Options(1e-6, final=final))


GIVEN = given_positions(CENTERS_M, np.full(len(CENTERS_M), 5.0))


def test_a_far_focal_length_goes_back_to_its_prior_with_the_ground_in_front_of_the_images() -> None:
    found = with_focal_length(flat_block(noise_px=0.05), 1300.0)
    assert np.median(heights_m(found)) < -500.0
    own = work(0.03)
    own.start(found)
    adjusted(own, found, GIVEN)
    state_errors(own, found, GIVEN)
    assert found.cameras[1].params[0] == pytest.approx(FOCAL_PX, rel=0.01)
    assert max(point.error for point in found.points3D.values()) < 1.0 < BEHIND_PX
    assert np.abs(heights_m(found)).max() < 5.0
    assert np.abs(centers_of(found, image_numbers(found)) - CENTERS_M).max() < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("start_px", [FOCAL_PX, 230.0])
def test_what_a_block_says_nothing_of_stays_near_its_prior(start_px: float) -> None:
    """All of the lens is free; a tenth of the prior's standard deviation is as far as noise may move the focal length,
    and its stated one is that of the prior."""
    found = with_focal_length(flat_block(noise_px=0.05), start_px)
    own = work(0.03, final=True)
    own.start(found)
    outcome = adjusted(own, found, GIVEN)
    assert outcome.result.found is not None
    assert found.cameras[1].params[0] == pytest.approx(FOCAL_PX, abs=0.1 * 0.03 * FOCAL_PX)
    assert outcome.result.found.lens_sigmas[0, 0] == pytest.approx(0.03 * FOCAL_PX, rel=0.1)
    assert np.abs(heights_m(found)).max() < 5.0


@pytest.mark.slow
def test_what_nobody_knows_of_a_focal_length_is_said() -> None:
    """With a prior ten times as wide, heights are as uncertain as it: 30 % of the flying height."""
    found = flat_block(noise_px=0.05)
    own = work(0.3, final=True)
    own.start(found)
    outcome = adjusted(own, found, GIVEN)
    assert outcome.result.found is not None
    sigmas_m = np.sqrt(np.diag(outcome.result.found.of_points(np.arange(10))))[2::3]
    assert (sigmas_m > 0.2 * HEIGHT_M).all()
