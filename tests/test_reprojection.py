"""Reprojection errors of blocks whose cameras look straight down from 100 m, worked out by hand."""

from __future__ import annotations

import math

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, FloatArray, PoseResidual
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.reprojection import errors_in_image, with_errors, with_points

CAMERA = Camera("SIMPLE_PINHOLE", 1000, 800, (1000.0, 499.5, 399.5))
DOWN = np.diag([1.0, -1.0, -1.0])
POINTS_M = np.array([[0.0, 0.0, 0.0], [5.0, 2.0, 0.0]])


def pose(x_m: float) -> AdjustedPose:
    unknown = np.zeros(3)
    return AdjustedPose(np.array([x_m, 0.0, 100.0]), DOWN, unknown, unknown, unknown)


POSES = {"a": pose(0.0), "b": pose(10.0), "c": pose(20.0)}
# Keypoint 0 of every image is of point 1, keypoint 1 of point 0; each lies so many pixels to the right of its place.
OFF_PX = {"a": (0.0, 1.0), "b": (2.0, 3.0), "c": (7.0, 0.0)}
TRACKS = {
    "a": np.array([[0, 1], [1, 0]], np.int32),
    "b": np.array([[0, 1], [1, 0]], np.int32),
    "c": np.array([[0, 1]], np.int32),
}
BLOCK = AdjustedBlock({"1": CAMERA}, POSES, POINTS_M, np.array([9.0, 9.0]), TRACKS)


def keypoints_px(image_id: str) -> FloatArray:
    seen = project(CAMERA, DOWN, POSES[image_id].center_m, POINTS_M[::-1])
    return seen + np.array([[off, 0.0] for off in OFF_PX[image_id]])


def test_errors_are_distances_of_keypoints_from_where_points_are_seen() -> None:
    np.testing.assert_allclose(errors_in_image(BLOCK, "b", CAMERA, keypoints_px), [2.0, 3.0], atol=1e-9)


def test_a_points_error_is_the_mean_of_the_images_that_see_it() -> None:
    found = with_errors(BLOCK, dict.fromkeys(POSES, CAMERA), keypoints_px)
    np.testing.assert_allclose(found.errors_px, [(1.0 + 3.0) / 2.0, (0.0 + 2.0 + 7.0) / 3.0], atol=1e-9)
    # A camera with a focal length that is 1 % longer sees point 1, 5 m and 2 m off, at 50.5 and 20.2 px, not 50 and 20.
    longer = Camera("SIMPLE_PINHOLE", 1000, 800, (1010.0, 499.5, 399.5))
    alone = AdjustedBlock({"1": longer}, POSES, POINTS_M, np.zeros(2), {"a": TRACKS["a"][:1]})
    found = with_errors(alone, {"a": longer}, keypoints_px)
    np.testing.assert_allclose(found.errors_px, [0.0, math.hypot(0.5, 0.2)], atol=1e-9)


def test_residuals_of_an_image_are_of_the_points_that_are_left() -> None:
    given = PoseResidual(np.ones(3), np.ones(3), np.ones(3), np.ones(3), 5.0, 40, 3.5)
    seen = np.array([2, 3])
    found = with_points(given, BLOCK, "b", CAMERA, keypoints_px, seen)
    assert (found.error_px, found.points, found.images_per_point) == (2.5, 2, 2.5)
    assert found.position_m is given.position_m
    left = AdjustedBlock({"1": CAMERA}, POSES, POINTS_M, np.zeros(2), {"a": TRACKS["a"]})
    none = with_points(given, left, "b", CAMERA, keypoints_px, seen)
    assert none.points == 0
    assert math.isnan(none.error_px)
    assert math.isnan(none.images_per_point)
