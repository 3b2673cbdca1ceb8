"""The grid: even, where there is texture, from the image alone."""

import numpy as np
import pytest
from make_ground import ground

from aeromatch_cli.data import Camera
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.grid import Grid
from aeromatch_cli.strategies.simulators.none import source_view

CAMERA = Camera("PINHOLE", 900, 600, (800.0, 800.0, 449.5, 299.5))


def found(gray, valid=None, points=600):
    return Grid(points=points)(CAMERA, [ViewPixels(source_view(CAMERA), gray, valid)])


def picture(seed=0):
    return np.clip(ground(seed, (900, 600)), 0, 255).astype(np.uint8)


def test_one_point_in_every_cell():
    features = found(picture())
    assert len(features.keypoints_px) == pytest.approx(600, abs=30)
    side = np.sqrt(900 * 600 / 600)
    cells = {tuple(cell) for cell in (features.keypoints_px // side).astype(int)}
    assert len(cells) > 0.97 * len(features.keypoints_px)
    assert np.array_equal(features.keypoints_px, np.rint(features.keypoints_px))
    assert len(features.descriptors) == 0


def test_flat_and_masked_ground_is_left_out():
    gray = picture()
    gray[:, :300] = 200
    valid = np.ones(gray.shape, bool)
    valid[400:] = False
    points = found(gray, valid).keypoints_px
    assert points[:, 0].min() > 290  # windows reach over the edge
    assert points[:, 1].max() < 400
    assert len(points) > 200


def test_a_picture_without_texture_has_no_points():
    features = found(np.full((600, 900), 255, np.uint8))
    assert features.keypoints_px.shape == (0, 2)


def test_a_large_picture_is_judged_reduced_and_its_points_lie_in_stored_pixels():
    gray = np.clip(ground(2, (4000, 800)), 0, 255).astype(np.uint8)
    camera = Camera("PINHOLE", 4000, 800, (3000.0, 3000.0, 1999.5, 399.5))
    features = Grid(points=500)(camera, [ViewPixels(source_view(camera), gray, None)])
    assert features.keypoints_px[:, 0].max() > 3900
    assert len(features.keypoints_px) == pytest.approx(500, abs=25)


def test_more_cells_than_pixels_are_as_many_as_fit():
    features = found(picture(), points=3_000_000)
    assert 20_000 < len(features.keypoints_px) <= 300 * 200
