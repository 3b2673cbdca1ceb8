"""Rotations from every angle convention that a pose list may use. Angles in degrees, matrices (3, 3) float64."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO

# Body axes (x forward, y right, z down) of an aircraft, to a camera that looks along body x (a gimbal's zero).
CAM_FROM_BODY_FORWARD = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
# The same to a camera that looks along body z (down at zero angles), image top towards body x.
CAM_FROM_BODY_DOWN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# North-east-down to east-north-up.
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def rotation_x(angle_deg: float) -> FloatArray:
    c, s = _cos_sin(angle_deg)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_deg: float) -> FloatArray:
    c, s = _cos_sin(angle_deg)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_deg: float) -> FloatArray:
    c, s = _cos_sin(angle_deg)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _cos_sin(angle_deg: float) -> tuple[float, float]:
    angle = np.deg2rad(angle_deg)
    return float(np.cos(angle)), float(np.sin(angle))


def from_omega_phi_kappa(omega_deg: float, phi_deg: float, kappa_deg: float) -> FloatArray:
    """cam_from_world from photogrammetric angles: world_from_photo = Rx(omega) Ry(phi) Rz(kappa)."""
    world_from_photo = rotation_x(omega_deg) @ rotation_y(phi_deg) @ rotation_z(kappa_deg)
    return CAM_FROM_PHOTO @ world_from_photo.T


def to_omega_phi_kappa(world_rotation: FloatArray) -> tuple[float, float, float]:
    """Inverse of `from_omega_phi_kappa`; degrees, phi in [-90, 90]."""
    m = (CAM_FROM_PHOTO @ world_rotation).T
    phi = np.arctan2(m[0, 2], np.hypot(m[0, 0], m[0, 1]))
    omega = np.arctan2(-m[1, 2], m[2, 2])
    # From what omega leaves over: at phi = +-90 noise picks omega, and only kappa combined with it is defined.
    row = np.cos(omega) * m[1] + np.sin(omega) * m[2]
    kappa = np.arctan2(row[0], row[1])
    return float(np.rad2deg(omega)), float(np.rad2deg(phi)), float(np.rad2deg(kappa))


def from_yaw_pitch_roll(yaw_deg: float, pitch_deg: float, roll_deg: float, *, forward: bool) -> FloatArray:
    """cam_from_world from R_ned_from_body = Rz(yaw) Ry(pitch) Rx(roll), yaw clockwise from grid north.

    forward: True where the optical axis is body x (gimbal angles: pitch -90 is nadir), False where it points down at
    zero angles.
    """
    ned_from_body = rotation_z(yaw_deg) @ rotation_y(pitch_deg) @ rotation_x(roll_deg)
    cam_from_body = CAM_FROM_BODY_FORWARD if forward else CAM_FROM_BODY_DOWN
    return cam_from_body @ ned_from_body.T @ NED_FROM_ENU


def to_yaw_pitch_roll(world_rotation: FloatArray, *, forward: bool) -> tuple[float, float, float]:
    """Inverse of `from_yaw_pitch_roll`; degrees, yaw in [0, 360), pitch in [-90, 90]."""
    cam_from_body = CAM_FROM_BODY_FORWARD if forward else CAM_FROM_BODY_DOWN
    m = NED_FROM_ENU @ world_rotation.T @ cam_from_body
    yaw = np.arctan2(m[1, 0], m[0, 0])
    pitch = np.arctan2(-m[2, 0], np.hypot(m[0, 0], m[1, 0]))
    # From what yaw leaves over, as kappa of `to_omega_phi_kappa`.
    side = np.cos(yaw) * m[1] - np.sin(yaw) * m[0]
    roll = np.arctan2(-side[2], side[1])
    return float(np.rad2deg(yaw)) % 360.0, float(np.rad2deg(pitch)), float(np.rad2deg(roll))


def from_quaternion(qw: float, qx: float, qy: float, qz: float) -> FloatArray:
    """(3, 3) from a Hamilton quaternion, scalar first, normalised here. Raises ValueError on a zero quaternion."""
    q = np.array([qw, qx, qy, qz], dtype=np.float64)
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError("a quaternion of length zero is no rotation")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Hamilton quaternion (w, x, y, z), w >= 0, of a rotation matrix (Shepperd 1978: the largest term first)."""
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    rows = [
        [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]],
    ]
    q = np.array(rows[int(np.argmax(squares))])
    q = q / np.linalg.norm(q)
    w, x, y, z = (q if q[0] >= 0 else -q).tolist()
    return w, x, y, z


def angle_between_deg(rotation0: FloatArray, rotation1: FloatArray) -> float:
    """Angle of the rotation that takes one (3, 3) rotation into the other, degrees in [0, 180]."""
    cosine = (np.trace(rotation0 @ rotation1.T) - 1.0) / 2.0
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def tilt_deg(world_rotation: FloatArray) -> float:
    """Angle between the optical axis and straight down, degrees."""
    return float(np.rad2deg(np.arccos(np.clip(-world_rotation[2, 2], -1.0, 1.0))))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices [v]x of vectors (N, 3): [v]x w = v x w."""
    x, y, z = np.asarray(vectors).T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
