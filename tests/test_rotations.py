"""Angle conventions: every one by examples worked by hand, then round trips.

A rotation cam_from_world has as rows the camera's right, down and forward directions in the world (east, north, up).
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import (
    angle_between_deg,
    from_omega_phi_kappa,
    from_quaternion,
    from_yaw_pitch_roll,
    rotation_x,
    rotation_y,
    rotation_z,
    tilt_deg,
    to_omega_phi_kappa,
    to_quaternion,
)

EAST, NORTH, UP = np.eye(3)
WEST, SOUTH, DOWN = -EAST, -NORTH, -UP
SIN10, COS10 = np.sin(np.deg2rad(10.0)), np.cos(np.deg2rad(10.0))

unit_quaternions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)
)  # normalised by the function under test


def assert_axes(rotation: FloatArray, right: FloatArray, down: FloatArray, forward: FloatArray) -> None:
    np.testing.assert_allclose(rotation, np.stack([right, down, forward]), atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "right", "down", "forward"),
    [
        ((0, 0, 0), EAST, SOUTH, DOWN),  # nadir, top of the picture north
        ((0, 0, 90), NORTH, EAST, DOWN),  # the camera turned counter-clockwise seen from above: top is west
        ((0, 0, -90), SOUTH, WEST, DOWN),
        ((90, 0, 0), EAST, DOWN, NORTH),  # upright camera that looks north
        ((0, 90, 0), DOWN, SOUTH, WEST),
        ((10, 0, 0), EAST, -COS10 * NORTH - SIN10 * UP, SIN10 * NORTH - COS10 * UP),  # looks a little north
        ((0, 10, 0), COS10 * EAST - SIN10 * UP, SOUTH, -SIN10 * EAST - COS10 * UP),  # looks a little west
    ],
)
def test_omega_phi_kappa_by_hand(
    angles: tuple[float, float, float], right: FloatArray, down: FloatArray, forward: FloatArray
) -> None:
    assert_axes(from_omega_phi_kappa(*angles), right, down, forward)


@pytest.mark.parametrize(
    ("angles", "right", "down", "forward"),
    [
        ((0, -90, 0), EAST, SOUTH, DOWN),  # nadir, top of the picture north
        ((90, -90, 0), SOUTH, WEST, DOWN),  # nadir, top of the picture east
        ((0, 0, 0), EAST, DOWN, NORTH),
        ((90, 0, 0), SOUTH, DOWN, EAST),
        ((180, 0, 0), WEST, DOWN, SOUTH),
        ((0, -80, 0), EAST, -COS10 * NORTH - SIN10 * UP, SIN10 * NORTH - COS10 * UP),
        ((0, 0, 90), DOWN, WEST, NORTH),  # rolled to the right: the picture's right side points to the ground
    ],
)
def test_gimbal_angles_by_hand(
    angles: tuple[float, float, float], right: FloatArray, down: FloatArray, forward: FloatArray
) -> None:
    assert_axes(from_yaw_pitch_roll(*angles, forward=True), right, down, forward)


@pytest.mark.parametrize(
    ("angles", "right", "down", "forward"),
    [
        ((0, 0, 0), EAST, SOUTH, DOWN),
        ((90, 0, 0), SOUTH, WEST, DOWN),
        ((0, 10, 0), EAST, -COS10 * NORTH - SIN10 * UP, SIN10 * NORTH - COS10 * UP),  # nose up: looks ahead
        ((0, 0, 10), COS10 * EAST - SIN10 * UP, SOUTH, -SIN10 * EAST - COS10 * UP),  # right wing down: looks left
    ],
)
def test_nadir_angles_by_hand(
    angles: tuple[float, float, float], right: FloatArray, down: FloatArray, forward: FloatArray
) -> None:
    assert_axes(from_yaw_pitch_roll(*angles, forward=False), right, down, forward)


@given(st.floats(-180, 180), st.floats(-90, 90))
def test_gimbal_and_nadir_pitch_differ_by_ninety_degrees(yaw: float, pitch: float) -> None:
    gimbal = from_yaw_pitch_roll(yaw, pitch - 90.0, 0.0, forward=True)
    np.testing.assert_allclose(gimbal, from_yaw_pitch_roll(yaw, pitch, 0.0, forward=False), atol=1e-12)


@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180))
def test_omega_phi_kappa_is_scipys_intrinsic_xyz(omega: float, phi: float, kappa: float) -> None:
    world_from_photo = Rotation.from_euler("XYZ", [omega, phi, kappa], degrees=True).as_matrix()
    expected = np.diag([1.0, -1.0, -1.0]) @ world_from_photo.T
    np.testing.assert_allclose(from_omega_phi_kappa(omega, phi, kappa), expected, atol=1e-12)


@given(st.floats(-179, 179), st.floats(-89, 89), st.floats(-179, 179))
def test_omega_phi_kappa_round_trip(omega: float, phi: float, kappa: float) -> None:
    angles = to_omega_phi_kappa(from_omega_phi_kappa(omega, phi, kappa))
    np.testing.assert_allclose(angles, (omega, phi, kappa), atol=1e-9)


@given(unit_quaternions)
def test_any_rotation_survives_omega_phi_kappa(q: FloatArray) -> None:
    rotation = from_quaternion(*q)
    np.testing.assert_allclose(from_omega_phi_kappa(*to_omega_phi_kappa(rotation)), rotation, atol=1e-12)


@pytest.mark.parametrize("yaw", [90.0, 270.0])
@pytest.mark.parametrize("roll", [0.0, 33.0, -120.0])
def test_omega_phi_kappa_where_phi_is_ninety(yaw: float, roll: float) -> None:
    # A level view east or west: omega and kappa turn about one axis, only their combination is defined.
    rotation = from_yaw_pitch_roll(yaw, 0.0, roll, forward=True)
    np.testing.assert_allclose(from_omega_phi_kappa(*to_omega_phi_kappa(rotation)), rotation, atol=1e-12)


def test_quaternion_by_hand() -> None:
    half = np.sqrt(0.5)
    np.testing.assert_allclose(from_quaternion(half, 0, 0, half), rotation_z(90.0), atol=1e-15)
    np.testing.assert_allclose(from_quaternion(half, half, 0, 0), rotation_x(90.0), atol=1e-15)
    np.testing.assert_allclose(from_quaternion(2, 0, 2, 0), rotation_y(90.0), atol=1e-15)  # normalised
    np.testing.assert_allclose(to_quaternion(rotation_z(90.0)), (half, 0, 0, half), atol=1e-15)
    # Half turns, where w is zero.
    np.testing.assert_allclose(to_quaternion(np.diag([1.0, -1.0, -1.0])), (0, 1, 0, 0), atol=1e-15)
    np.testing.assert_allclose(to_quaternion(np.diag([-1.0, 1.0, -1.0])), (0, 0, 1, 0), atol=1e-15)
    np.testing.assert_allclose(to_quaternion(np.diag([-1.0, -1.0, 1.0])), (0, 0, 0, 1), atol=1e-15)


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="no rotation"):
        from_quaternion(0.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="no rotation"):
        from_quaternion(float("nan"), 0.0, 0.0, 1.0)


@given(unit_quaternions)
def test_quaternion_round_trip(q: FloatArray) -> None:
    rotation = from_quaternion(*q)
    np.testing.assert_allclose(rotation, Rotation.from_quat(q, scalar_first=True).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    back = np.array(to_quaternion(rotation))
    assert back[0] >= 0
    assert abs(back @ (q / np.linalg.norm(q))) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(from_quaternion(*back), rotation, atol=1e-12)


@given(unit_quaternions, st.floats(0.01, 179.9))
def test_angle_between_is_the_angle_turned(q: FloatArray, angle_deg: float) -> None:
    rotation = from_quaternion(*q)
    assert angle_between_deg(rotation_z(angle_deg) @ rotation, rotation) == pytest.approx(angle_deg, abs=1e-4)


def test_tilt_by_hand() -> None:
    assert tilt_deg(from_omega_phi_kappa(0, 0, 57)) == pytest.approx(0.0, abs=1e-6)
    assert tilt_deg(from_omega_phi_kappa(30, 0, 57)) == pytest.approx(30.0)
    assert tilt_deg(from_yaw_pitch_roll(12, -45, 0, forward=True)) == pytest.approx(45.0)
    assert tilt_deg(from_yaw_pitch_roll(12, 0, 0, forward=True)) == pytest.approx(90.0)
