"""Lens models: against COLMAP's own, round trips on realistic lenses, worked numbers."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import (
    MODELS,
    calibration_matrix,
    colmap_params,
    distort,
    focal_px,
    from_colmap,
    has_distortion,
    normalise,
    project,
    resized,
    undistort,
    world_rays,
)
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa

WIDTH_PX, HEIGHT_PX = 4000, 3000

CAMERAS = {
    "SIMPLE_PINHOLE": Camera("SIMPLE_PINHOLE", WIDTH_PX, HEIGHT_PX, (3100.0, 2003.5, 1490.0)),
    "PINHOLE": Camera("PINHOLE", WIDTH_PX, HEIGHT_PX, (3100.0, 3090.0, 2003.5, 1490.0)),
    "SIMPLE_RADIAL": Camera("SIMPLE_RADIAL", WIDTH_PX, HEIGHT_PX, (3100.0, 2003.5, 1490.0, -0.06)),
    "RADIAL": Camera("RADIAL", WIDTH_PX, HEIGHT_PX, (3100.0, 2003.5, 1490.0, -0.11, 0.05)),
    "OPENCV": Camera("OPENCV", WIDTH_PX, HEIGHT_PX, (3100.0, 3090.0, 2003.5, 1490.0, -0.11, 0.05, 1e-3, -7e-4)),
}


def grid_px(camera: Camera, margin_px: float = 0.0) -> FloatArray:
    x = np.linspace(-margin_px - 0.5, camera.width_px - 0.5 + margin_px, 17)
    y = np.linspace(-margin_px - 0.5, camera.height_px - 0.5 + margin_px, 13)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def test_every_model_is_tested() -> None:
    assert set(CAMERAS) == set(MODELS)


@pytest.mark.parametrize("model", MODELS)
def test_same_rays_and_pixels_as_colmap(model: str) -> None:
    zlib.compress(b"")  # pycolmap aborts the process when it is imported before zlib was used
    import pycolmap

    camera = CAMERAS[model]
    theirs = pycolmap.Camera(model=model, width=WIDTH_PX, height=HEIGHT_PX, params=colmap_params(camera))
    points = grid_px(camera)
    rays = normalise(camera, points)
    np.testing.assert_allclose(rays, theirs.cam_from_img(points + 0.5), atol=1e-9)
    points_m = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * 7.0
    np.testing.assert_allclose(
        project(camera, np.eye(3), np.zeros(3), points_m) + 0.5, theirs.img_from_cam(points_m), atol=1e-6
    )


@pytest.mark.parametrize("model", MODELS)
def test_colmap_parameters_round_trip(model: str) -> None:
    camera = CAMERAS[model]
    theirs = colmap_params(camera)
    named = dict(zip(MODELS[model], theirs, strict=True))
    assert (named["cx"], named["cy"]) == (2004.0, 1490.5)
    assert from_colmap(model, WIDTH_PX, HEIGHT_PX, theirs) == camera


def test_a_centred_colmap_camera_has_its_centre_between_the_middle_pixels() -> None:
    camera = from_colmap("SIMPLE_PINHOLE", 4, 2, (10.0, 2.0, 1.0))
    assert camera.params == (10.0, 1.5, 0.5)


def test_unknown_models_and_wrong_counts_are_named() -> None:
    with pytest.raises(ValueError, match="'FISHEYE' is not supported; use one of SIMPLE_PINHOLE"):
        from_colmap("FISHEYE", 10, 10, (1.0,))
    with pytest.raises(ValueError, match="RADIAL has the 5 parameters f, cx, cy, k1, k2, got 4"):
        from_colmap("RADIAL", 10, 10, (1.0, 2.0, 3.0, 4.0))


@pytest.mark.parametrize("model", MODELS)
def test_undistort_and_distort_are_inverse_beyond_the_image(model: str) -> None:
    camera = CAMERAS[model]
    points = grid_px(camera, margin_px=100.0)
    np.testing.assert_allclose(distort(camera, undistort(camera, points)), points, atol=1e-8)


@settings(max_examples=60)
@given(
    k1=st.floats(-0.15, 0.1),
    k2=st.floats(-0.03, 0.1),
    p1=st.floats(-0.003, 0.003),
    p2=st.floats(-0.003, 0.003),
    focal=st.floats(0.75, 2.0),
)
def test_realistic_lenses_round_trip(k1: float, k2: float, p1: float, p2: float, focal: float) -> None:
    f = focal * WIDTH_PX
    camera = Camera("OPENCV", WIDTH_PX, HEIGHT_PX, (f, f * 1.001, 2010.0, 1480.0, k1, k2, p1, p2))
    points = grid_px(camera)
    np.testing.assert_allclose(distort(camera, undistort(camera, points)), points, atol=1e-6)


def test_distortion_by_hand() -> None:
    # u = 0.5, v = 0: r2 = 0.25, radial = 1 + 0.25 k1; k1 = -0.2 gives 0.475.
    camera = Camera("SIMPLE_RADIAL", 200, 200, (100.0, 99.5, 99.5, -0.2))
    np.testing.assert_allclose(distort(camera, np.array([[149.5, 99.5]])), [[147.0, 99.5]], atol=1e-12)
    # Tangential, u = 0, v = 0.5: du = p2 r2 = 0.0025, dv = 3 p1 r2 = 0.015 for p1 = 0.02, p2 = 0.01.
    camera = Camera("OPENCV", 200, 200, (100.0, 100.0, 99.5, 99.5, 0.0, 0.0, 0.02, 0.01))
    np.testing.assert_allclose(distort(camera, np.array([[99.5, 149.5]])), [[99.75, 151.0]], atol=1e-12)


def test_where_the_lens_model_folds_back_there_is_no_pixel() -> None:
    # r (1 - 0.2 r2) is largest at r = sqrt(1 / 0.6) = 1.29, where it is 0.861.
    camera = Camera("SIMPLE_RADIAL", 200, 200, (100.0, 99.5, 99.5, -0.2))
    beyond = np.array([[99.5 + 130.0, 99.5], [99.5 + 128.0, 99.5]])
    assert np.isnan(distort(camera, beyond)[0]).all()
    assert np.isfinite(distort(camera, beyond)[1]).all()
    unreachable = np.array([[99.5 + 87.0, 99.5], [99.5 + 85.0, 99.5]])
    assert np.isnan(undistort(camera, unreachable)[0]).all()
    assert np.isfinite(undistort(camera, unreachable)[1]).all()


def test_focal_length_matrix_and_distortion_flag() -> None:
    assert focal_px(CAMERAS["OPENCV"]) == 3095.0
    np.testing.assert_array_equal(
        calibration_matrix(CAMERAS["PINHOLE"]), [[3100.0, 0, 2003.5], [0, 3090.0, 1490.0], [0, 0, 1]]
    )
    assert [has_distortion(CAMERAS[m]) for m in MODELS] == [False, False, True, True, True]


def test_projection_of_a_nadir_camera_by_hand() -> None:
    # 100 m above ground with f = 1000 px: 10 px per metre; north is up in the picture.
    camera = Camera("SIMPLE_PINHOLE", 1000, 750, (1000.0, 499.5, 374.5))
    rotation = from_omega_phi_kappa(0.0, 0.0, 0.0)
    points_m = np.array([[500.0, 300.0, 20.0], [510.0, 300.0, 20.0], [500.0, 302.0, 20.0], [500.0, 300.0, 130.0]])
    pixels = project(camera, rotation, np.array([500.0, 300.0, 120.0]), points_m)
    np.testing.assert_allclose(pixels[:3], [[499.5, 374.5], [599.5, 374.5], [499.5, 354.5]], atol=1e-9)
    assert np.isnan(pixels[3]).all()  # above the camera


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-180, 180))
def test_rays_go_through_the_points_that_were_projected(omega: float, phi: float, kappa: float) -> None:
    camera, centre_m = CAMERAS["OPENCV"], np.array([1000.0, 2000.0, 150.0])
    rotation = from_omega_phi_kappa(omega, phi, kappa)
    pixels = grid_px(camera)
    rays = world_rays(camera, rotation, pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(project(camera, rotation, centre_m, centre_m + 80.0 * rays), pixels, atol=1e-6)


@pytest.mark.parametrize("scale", [0.5, 0.25, 0.3])
def test_a_resized_camera_sees_the_resized_picture(scale: float) -> None:
    camera = CAMERAS["OPENCV"]
    small = resized(camera, scale, round(WIDTH_PX * scale), round(HEIGHT_PX * scale))
    points = grid_px(camera)
    np.testing.assert_allclose(normalise(small, (points + 0.5) * scale - 0.5), normalise(camera, points), atol=1e-9)
