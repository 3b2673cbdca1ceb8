"""Lens models: against COLMAP's own, round trips on realistic lenses, worked numbers."""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import (
    BROWN,
    FISHEYE,
    FULL_OPENCV,
    MODELS,
    as_brown,
    calibration_matrix,
    colmap_camera,
    corner_params,
    distort,
    focal_px,
    from_colmap,
    has_distortion,
    normalise,
    parameters,
    pixels_of_rays,
    poselib_camera,
    project,
    resized,
    undistort,
    without_skew,
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
    BROWN: Camera(BROWN, WIDTH_PX, HEIGHT_PX, (3090.0, 2003.5, 1490.0, -0.11, 0.05, -0.02, 1e-3, -7e-4, 10.0, -4.0)),
    FISHEYE: Camera(FISHEYE, WIDTH_PX, HEIGHT_PX, (1900.0, 1890.0, 2003.5, 1490.0, -0.02, 0.006, -0.003, 5e-4)),
}
# COLMAP has all of them but BROWN's b2.
IN_COLMAP = CAMERAS | {BROWN: dataclasses.replace(CAMERAS[BROWN], params=(*CAMERAS[BROWN].params[:-1], 0.0))}


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

    camera = IN_COLMAP[model]
    name, params = colmap_camera(camera)
    assert name == (FULL_OPENCV if model == BROWN else model)
    theirs = pycolmap.Camera(model=name, width=WIDTH_PX, height=HEIGHT_PX, params=params)
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
    theirs = corner_params(camera)
    named = dict(zip(MODELS[model], theirs, strict=True))
    assert (named["cx"], named["cy"]) == (2004.0, 1490.5)
    assert from_colmap(model, WIDTH_PX, HEIGHT_PX, theirs) == camera


@pytest.mark.parametrize("model", MODELS)
def test_cameras_survive_colmap(model: str) -> None:
    camera = IN_COLMAP[model]
    name, params = colmap_camera(camera)
    assert from_colmap(name, WIDTH_PX, HEIGHT_PX, params) == camera


def test_full_opencv_is_brown_without_its_dividing_terms() -> None:
    # f = fy, b1 = fx - fy; the order of the parameters is COLMAP's: k1 k2 p1 p2 k3.
    params = (3100.0, 3090.0, 2004.0, 1490.5, -0.1, 0.05, 1e-3, -7e-4, 0.02, 0.0, 0.0, 0.0)
    camera = from_colmap(FULL_OPENCV, WIDTH_PX, HEIGHT_PX, params)
    assert camera.params == (3090.0, 2003.5, 1490.0, -0.1, 0.05, 0.02, 1e-3, -7e-4, 10.0, 0.0)
    assert colmap_camera(camera) == (FULL_OPENCV, params)
    flat = dataclasses.replace(camera, params=(*camera.params[:5], 0.0, *camera.params[6:]))
    assert colmap_camera(flat) == ("OPENCV", params[:8])
    with pytest.raises(ValueError, match="no place for the terms k4, k5, k6"):
        from_colmap(FULL_OPENCV, WIDTH_PX, HEIGHT_PX, (*params[:-1], 0.1))


@pytest.mark.parametrize("model", [model for model in MODELS if model != FISHEYE])
def test_every_other_model_is_a_special_case_of_brown(model: str) -> None:
    camera, points = CAMERAS[model], grid_px(CAMERAS[model])
    np.testing.assert_allclose(normalise(as_brown(camera), points), normalise(camera, points), atol=1e-13)
    with pytest.raises(ValueError, match="no special case"):
        as_brown(CAMERAS[FISHEYE])


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
    k3=st.floats(-0.02, 0.05),
    p1=st.floats(-0.003, 0.003),
    p2=st.floats(-0.003, 0.003),
    b1=st.floats(-0.01, 0.01),
    b2=st.floats(-0.01, 0.01),
    focal=st.floats(0.75, 2.0),
)
def test_realistic_brown_lenses_round_trip(
    k1: float, k2: float, k3: float, p1: float, p2: float, b1: float, b2: float, focal: float
) -> None:
    f = focal * WIDTH_PX
    params = (f, 2010.0, 1480.0, k1, k2, k3, p1, p2, b1 * f, b2 * f)
    camera = Camera(BROWN, WIDTH_PX, HEIGHT_PX, params)
    points = grid_px(camera)
    np.testing.assert_allclose(distort(camera, undistort(camera, points)), points, atol=1e-6)


@settings(max_examples=60)
@given(
    k1=st.floats(-0.1, 0.1),
    k2=st.floats(-0.02, 0.02),
    k3=st.floats(-0.01, 0.01),
    k4=st.floats(-0.002, 0.002),
    focal=st.floats(0.45, 2.0),
)
def test_fisheye_lenses_round_trip_where_they_have_rays(
    k1: float, k2: float, k3: float, k4: float, focal: float
) -> None:
    f = focal * WIDTH_PX
    camera = Camera(FISHEYE, WIDTH_PX, HEIGHT_PX, (f, 1.001 * f, 2010.0, 1480.0, k1, k2, k3, k4))
    # By angle: the first pixel that no ray has lies where the radius is largest, or at a right angle.
    angle = np.linspace(0.0, np.pi / 2.0 - 1e-3, 2000)
    radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    falls = np.flatnonzero(np.diff(radius) <= 0.0)
    reached = radius[falls[0]] if len(falls) else radius[-1]
    points = grid_px(camera)
    far = np.hypot((points[:, 0] - 2010.0) / f, (points[:, 1] - 1480.0) / (1.001 * f))
    undistorted = undistort(camera, points)
    assert np.isfinite(undistorted[far < 0.999 * reached]).all()
    assert np.isnan(undistorted[far > 1.01 * max(reached, radius[-1])]).all()
    seen = np.isfinite(undistorted).all(axis=1)
    # Near a right angle the undistorted pixel lies so far away that 64 bits tell less.
    np.testing.assert_allclose(distort(camera, undistorted[seen]), points[seen], atol=1e-4)


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


def test_browns_model_by_hand() -> None:
    """u = 0.4, v = 0.2: r2 = 0.2, radial = 1 - 0.1 * 0.2 + 0.05 * 0.04 + 0.5 * 0.008 = 0.986.

    xd = 0.4 * 0.986 + 2 * 0.01 * 0.08 + 0.02 * (0.2 + 0.32) = 0.4064
    yd = 0.2 * 0.986 + 0.01 * (0.2 + 0.08) + 2 * 0.02 * 0.08 = 0.2032
    x = 500 + (1000 + 8) * 0.4064 + 5 * 0.2032 = 910.6672, y = 400 + 1000 * 0.2032 = 603.2
    """
    camera = Camera(BROWN, 1000, 800, (1000.0, 500.0, 400.0, -0.1, 0.05, 0.5, 0.01, 0.02, 8.0, 5.0))
    point_m = np.array([[2.0, 1.0, 5.0]])
    expected = [[910.6672, 603.2]]
    np.testing.assert_allclose(project(camera, np.eye(3), np.zeros(3), point_m), expected, atol=1e-10)
    np.testing.assert_allclose(pixels_of_rays(camera, np.array([[0.4, 0.2]])), expected, atol=1e-10)
    np.testing.assert_allclose(normalise(camera, np.array(expected)), [[0.4, 0.2]], atol=1e-12)
    # K alone: 500 + 1008 * 0.4 + 5 * 0.2 = 904.2, 400 + 1000 * 0.2 = 600.
    np.testing.assert_allclose(undistort(camera, np.array(expected)), [[904.2, 600.0]], atol=1e-9)


def test_the_fisheye_model_by_hand() -> None:
    """At 45 degrees, to the lower right by 3 : 4: the angle is 0.785398, its square 0.616850, so that the radius is
    0.785398 * (1 - 0.1 * 0.616850 + 0.02 * 0.380504 - 0.01 * 0.234714 + 0.001 * 0.144783) = 0.741199.
    """
    camera = Camera(FISHEYE, 1000, 800, (500.0, 400.0, 499.5, 399.5, -0.1, 0.02, -0.01, 0.001))
    pixel = project(camera, np.eye(3), np.zeros(3), np.array([[3.0, 4.0, 5.0]]))
    np.testing.assert_allclose(pixel, [[499.5 + 500 * 0.6 * 0.741199, 399.5 + 400 * 0.8 * 0.741199]], atol=3e-4)


def test_a_camera_without_skew_has_the_same_rays() -> None:
    camera, points = CAMERAS[BROWN], grid_px(CAMERAS[BROWN])
    flat = undistort(camera, points)
    fx, fy, cx, cy = poselib_camera(camera)["params"]
    np.testing.assert_allclose(
        (without_skew(camera, flat) - [cx, cy]) / [fx, fy], normalise(camera, points), atol=1e-12
    )
    other = CAMERAS["OPENCV"]
    assert without_skew(other, points) is points


def test_where_the_lens_model_folds_back_there_is_no_pixel() -> None:
    # r (1 - 0.2 r2) is largest at r = sqrt(1 / 0.6) = 1.29, where it is 0.861.
    camera = Camera("SIMPLE_RADIAL", 200, 200, (100.0, 99.5, 99.5, -0.2))
    beyond = np.array([[99.5 + 130.0, 99.5], [99.5 + 128.0, 99.5]])
    assert np.isnan(distort(camera, beyond)[0]).all()
    assert np.isfinite(distort(camera, beyond)[1]).all()
    unreachable = np.array([[99.5 + 87.0, 99.5], [99.5 + 85.0, 99.5]])
    assert np.isnan(undistort(camera, unreachable)[0]).all()
    assert np.isfinite(undistort(camera, unreachable)[1]).all()
    # r (1 - 0.1 r6) is largest where 0.7 r6 = 1, at r = 1.0612, where it is 0.9096; no k1 or k2 announces it.
    camera = Camera(BROWN, 200, 200, (100.0, 99.5, 99.5, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 0.0))
    places = np.array([[99.5 + 106.2, 99.5], [99.5 + 106.0, 99.5]])
    assert np.isnan(distort(camera, places)).all(axis=1).tolist() == [True, False]
    places = np.array([[99.5 + 91.1, 99.5], [99.5 + 90.9, 99.5]])
    assert np.isnan(undistort(camera, places)).all(axis=1).tolist() == [True, False]
    # Terms so small that they mean nothing are none.
    camera = Camera(BROWN, 200, 200, (100.0, 99.5, 99.5, -5e-324, 0.0, -5e-324, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(distort(camera, np.array([[199.5, 99.5]])), [[199.5, 99.5]])


@pytest.mark.parametrize("model", MODELS)
def test_a_place_without_value_does_not_touch_the_others(model: str) -> None:
    camera, points = CAMERAS[model], grid_px(CAMERAS[model])
    mixed = np.concatenate([[[np.nan, 0.0]], points])
    assert np.isnan(undistort(camera, mixed)[0]).any()
    np.testing.assert_allclose(undistort(camera, mixed)[1:], undistort(camera, points), atol=1e-9)


def test_focal_length_matrix_and_distortion_flag() -> None:
    assert focal_px(CAMERAS["OPENCV"]) == 3095.0
    np.testing.assert_array_equal(
        calibration_matrix(CAMERAS["PINHOLE"]), [[3100.0, 0, 2003.5], [0, 3090.0, 1490.0], [0, 0, 1]]
    )
    assert {m for m in MODELS if not has_distortion(CAMERAS[m])} == {"SIMPLE_PINHOLE", "PINHOLE"}
    np.testing.assert_array_equal(
        calibration_matrix(CAMERAS[BROWN]), [[3100.0, -4.0, 2003.5], [0, 3090.0, 1490.0], [0, 0, 1]]
    )
    assert parameters(CAMERAS["SIMPLE_PINHOLE"]) == {
        "fx": 3100.0, "fy": 3100.0, "skew": 0.0, "cx": 2003.5, "cy": 1490.0, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0,
        "p1": 0.0, "p2": 0.0,
    }  # fmt: skip


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


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scale", [0.5, 0.25, 0.3])
def test_a_resized_camera_sees_the_resized_picture(scale: float, model: str) -> None:
    camera = CAMERAS[model]
    small = resized(camera, scale, round(WIDTH_PX * scale), round(HEIGHT_PX * scale))
    points = grid_px(camera)
    np.testing.assert_allclose(normalise(small, (points + 0.5) * scale - 0.5), normalise(camera, points), atol=1e-9)
