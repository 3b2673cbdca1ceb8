"""Image points of a network beside those of geometry.cameras, and their derivatives beside differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_networks import HEIGHT_PX, WIDTH_PX, disturbed, lens, simulated, strips
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry import cameras
from aeromatch_cli.sfm.bundle.network import LENS, READOUT, Network, Unknowns
from aeromatch_cli.sfm.bundle.projection import project, project_with_derivatives

BROWN = lens(f=980.0, cx=610.0, cy=430.0, k1=-0.1, k2=0.06, k3=-0.02, p1=0.002, p2=-0.001, b1=3.0, b2=-2.0)
FISHEYE = lens(f=700.0, cx=590.0, cy=460.0, k1=0.04, k2=-0.02, k3=0.01, p1=-0.003, b1=-4.0)
READ_OUT_S = 0.04
LENSES = pytest.mark.parametrize(("values", "fisheye"), [(BROWN, False), (FISHEYE, True)], ids=["brown", "fisheye"])


def seen(values: FloatArray, fisheye: bool) -> tuple[Network, Unknowns]:
    """Images with tilts of 15 degrees, so that all derivatives are far from zero."""
    return simulated(strips(2, 3), points=60, true_lens=values, fisheye=fisheye, tilt_deg=15.0)


def camera_of(values: FloatArray, fisheye: bool) -> Camera:
    if not fisheye:
        return Camera(cameras.BROWN, WIDTH_PX, HEIGHT_PX, tuple(values[:10].tolist()))
    f, cx, cy, k1, k2, k3, k4, _, b1 = values[:9].tolist()
    return Camera(cameras.FISHEYE, WIDTH_PX, HEIGHT_PX, (f + b1, f, cx, cy, k1, k2, k3, k4))


@LENSES
def test_points_are_where_the_cameras_have_them(values: FloatArray, fisheye: bool) -> None:
    network, state = seen(values, fisheye)
    camera, found = camera_of(values, fisheye), project(network, state)
    assert len(found) > 100
    for image in range(network.images):
        own = network.image == image
        points_m = state.points_m[network.point[own]]
        expected = cameras.project(camera, state.rotations[image], state.centers_m[image], points_m)
        np.testing.assert_allclose(found[own], expected, atol=1e-9)
    np.testing.assert_array_equal(project_with_derivatives(network, state).xy_px, found)


@LENSES
def test_derivatives_are_those_of_differences(values: FloatArray, fisheye: bool) -> None:
    network, state = seen(values, fisheye)
    state = disturbed(network, state, np.random.default_rng(3))
    state.lens[:, READOUT] = READ_OUT_S
    found = project_with_derivatives(network, state)

    for k, name in enumerate(LENS):
        step = 1e-2 if name in ("f", "cx", "cy", "b1", "b2") else 1e-5
        by = [replace(state, lens=state.lens + sign * step * np.eye(12)[k]) for sign in (1.0, -1.0)]
        close(found.by_lens[:, :, k], by, network, step)
    for axis in range(3):
        step = 1e-5
        turns = [Rotation.from_rotvec(sign * step * np.eye(3)[axis]).as_matrix() for sign in (1.0, -1.0)]
        close(found.by_turn[:, :, axis], [replace(state, rotations=t @ state.rotations) for t in turns], network, step)
        shifts = [sign * 1e-3 * np.eye(3)[axis] for sign in (1.0, -1.0)]
        by_point = [replace(state, points_m=state.points_m + shift) for shift in shifts]
        close(found.by_point[:, :, axis], by_point, network, 1e-3)
        by_center = [replace(state, centers_m=state.centers_m + shift) for shift in shifts]
        close(-found.by_point[:, :, axis], by_center, network, 1e-3)


def close(derivatives: FloatArray, ends: list[Unknowns], network: Network, step: float) -> None:
    differences = (project(network, ends[0]) - project(network, ends[1])) / (2.0 * step)
    largest = max(float(np.abs(differences).max()), 1e-3)
    np.testing.assert_allclose(derivatives, differences, atol=1e-6 * largest)


def test_the_first_row_is_exposed_before_the_middle_and_the_last_after_it() -> None:
    """A point seen in row y by a camera 10 m/s fast: its centre is v * readout * (y / 899 - 1/2) farther on."""
    network, state = simulated(strips(1, 3), points=60, true_lens=lens(readout_s=READ_OUT_S))
    still = replace(network, velocities_m_s=np.zeros_like(network.velocities_m_s))
    found, at_once = project(network, state), project(still, state)
    share = network.xy_px[:, 1] / (HEIGHT_PX - 1) - 0.5
    moved_m = network.velocities_m_s[network.image] * READ_OUT_S * share[:, None]
    for row in (int(np.argmin(share)), int(np.argmax(share))):
        image = network.image[row]
        centers_m = state.centers_m.copy()
        centers_m[image] += moved_m[row]
        expected = project(still, replace(state, centers_m=centers_m))[row]
        np.testing.assert_allclose(found[row], expected, atol=1e-9)
        assert np.linalg.norm(found[row] - at_once[row]) > 1.0


def test_a_point_behind_its_camera_has_no_image() -> None:
    network, state = simulated(strips(1, 3), points=40)
    state.points_m[0, 2] = 300.0
    behind = network.point == 0
    assert behind.any()
    assert np.isnan(project(network, state)[behind]).all()
    assert np.isfinite(project(network, state)[~behind]).all()


def test_on_the_axis_a_fisheye_has_its_derivatives() -> None:
    network, state = seen(FISHEYE, True)
    state.points_m[0] = state.centers_m[0] + 90.0 * state.rotations[0, 2]
    network = replace(
        network,
        image=np.append(network.image, 0),
        point=np.append(network.point, 0),
        xy_px=np.vstack([network.xy_px, FISHEYE[1:3]]),
        sigma_px=np.append(network.sigma_px, 0.1),
    )
    found = project_with_derivatives(network, state)
    np.testing.assert_allclose(found.xy_px[-1], FISHEYE[1:3], atol=1e-9)
    np.testing.assert_allclose(found.by_turn[-1], [[0.0, 696.0, 0.0], [-700.0, 0.0, 0.0]], atol=1e-4)
    assert np.abs(found.by_lens[-1, :, 3:READOUT]).max() < 1e-4
