"""Pixel frames: the half-pixel bookkeeping by worked numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO, apply_homography, closest_similarity, resize_matrix


def test_halving_keeps_centre_and_corners() -> None:
    # Four pixels 0..3 become two pixels 0..1: centre 1.5 -> 0.5, outer edges -0.5 -> -0.5 and 3.5 -> 1.5.
    points = np.array([[1.5, 1.5], [-0.5, -0.5], [3.5, 3.5], [0.5, 2.5]])
    halved = apply_homography(resize_matrix(0.5), points)
    np.testing.assert_allclose(halved, [[0.5, 0.5], [-0.5, -0.5], [1.5, 1.5], [0.0, 1.0]], atol=1e-15)


@given(st.floats(0.05, 20.0), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_resizing_back_returns_the_point(scale: float, x: float, y: float) -> None:
    point = np.array([[x, y]])
    there = apply_homography(resize_matrix(scale), point)
    np.testing.assert_allclose(apply_homography(resize_matrix(1.0 / scale), there), point, atol=1e-8)


def test_a_projective_map_divides_by_its_third_coordinate() -> None:
    # w = 1 + x / 4; (4, 2) -> (8, 6) / 2.
    homography = np.array([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.25, 0.0, 1.0]])
    np.testing.assert_allclose(apply_homography(homography, np.array([[4.0, 2.0], [0.0, 1.0]])), [[4, 3], [0, 3]])


def test_points_on_and_behind_the_horizon_are_nan() -> None:
    homography = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    mapped = apply_homography(homography, np.array([[-1.0, 5.0], [-2.0, 5.0], [1.0, 5.0]]))
    assert np.isnan(mapped[:2]).all()
    np.testing.assert_allclose(mapped[2], [0.5, 2.5])


def test_no_points_stay_no_points() -> None:
    assert apply_homography(np.eye(3), np.zeros((0, 2))).shape == (0, 2)


def test_photo_axes_turn_into_camera_axes() -> None:
    # Photo: x right, y up, z back. Camera: x right, y down, z forward.
    up_in_photo, back_in_photo = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert (CAM_FROM_PHOTO @ up_in_photo == [0, -1, 0]).all()
    assert (CAM_FROM_PHOTO @ back_in_photo == [0, 0, -1]).all()
    assert np.linalg.det(CAM_FROM_PHOTO) == pytest.approx(1.0)


@given(st.floats(-3.1, 3.1), st.floats(0.2, 5.0), st.integers(0, 1000))
def test_the_closest_similarity_of_moved_points_is_their_motion(turn: float, scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    motion = np.array([[cosine, -sine, 40.0], [sine, cosine, -7.0], [0.0, 0.0, 1.0]])
    points = rng.uniform(0.0, 1000.0, (6, 2))
    assert np.allclose(closest_similarity(points, apply_homography(motion, points)), motion, atol=1e-6)
