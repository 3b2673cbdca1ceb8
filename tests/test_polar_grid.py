"""The dynamic polar grid: equal areas, turns as shifts, and back to a picture."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.geometry.polar import as_picture, bilinear, polar_grid, resampled, shifted

CENTER = np.array([60.3, 49.6])


def picture(x, y):
    """Something smooth without symmetry, of places."""
    return 100 + 30 * np.sin(x / 9.0) * np.cos(y / 11.0) + 0.4 * x - 0.2 * y


PIXELS = picture(*np.meshgrid(np.arange(121.0), np.arange(101.0)))


@settings(max_examples=25, deadline=None)
@given(st.floats(3.0, 300.0), st.floats(0.3, 3.0))
def test_every_sample_stands_for_the_same_area(radius_px, step_px):
    grid = polar_grid(radius_px, step_px)
    outer = (np.arange(len(grid.counts)) + 1) * step_px
    areas = np.pi * (outer**2 - (outer - step_px) ** 2) / grid.counts
    # Whole numbers of samples: rings of a dozen are off by a few per cent.
    assert np.allclose(areas[2:], step_px**2, rtol=0.05)
    assert np.allclose(areas[10:], step_px**2, rtol=0.01)
    assert np.allclose(np.hypot(*grid.offsets_px.T), grid.radii_px[grid.ring_idx])
    assert len(grid.offsets_px) == grid.counts.sum()


def test_the_figures_of_the_docstring():
    grid = polar_grid(100.0)
    assert len(grid.offsets_px) == pytest.approx(31_416, abs=30)
    assert grid.counts[[10, 50, 99]].tolist() == [66, 317, 625]  # rings at 10.5, 50.5 and 99.5 px


@settings(max_examples=25, deadline=None)
@given(st.floats(-7.0, 7.0))
def test_a_turn_of_the_grid_is_a_shift_along_its_rings(turn_rad):
    grid = polar_grid(40.0, 0.5)
    turned = resampled(PIXELS, grid, CENTER, turn_rad)
    assert np.abs(turned - shifted(resampled(PIXELS, grid, CENTER), grid, turn_rad)).max() < 0.3  # of 60 gray values


def test_scale_and_turn_move_the_samples_as_a_similarity_does():
    grid = polar_grid(20.0)
    angle = np.deg2rad(30.0)
    x, y = grid.offsets_px.T
    places = CENTER + 1.2 * np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], 1)
    assert np.allclose(resampled(PIXELS, grid, CENTER, angle, 1.2), bilinear(PIXELS, places))
    assert np.abs(bilinear(PIXELS, places) - picture(*places.T)).max() < 0.2


def test_back_to_a_picture():
    again = as_picture(resampled(PIXELS, polar_grid(45.0, 0.5), CENTER), polar_grid(45.0, 0.5), (121, 101), CENTER)
    known = np.isfinite(again)
    y, x = np.nonzero(known)
    radii = np.hypot(x - CENTER[0], y - CENTER[1])
    assert known.sum() == pytest.approx(np.pi * 44.75**2, rel=0.01)
    assert radii.max() <= 44.75
    assert np.abs(again - PIXELS)[known].max() < 0.5


def test_outside_of_the_picture_nothing_is_known():
    values = resampled(PIXELS, polar_grid(30.0), np.array([0.0, 50.0]))
    assert np.isnan(values).mean() == pytest.approx(0.5, abs=0.02)
    assert np.isnan(bilinear(PIXELS, np.array([[120.01, 5.0], [5.0, -0.01]]))).all()
    assert np.array_equal(bilinear(PIXELS, np.array([[120.0, 100.0], [0.0, 0.0]])), PIXELS[[100, 0], [120, 0]])


def test_a_radius_without_rings_is_refused():
    with pytest.raises(ValueError, match="holds no ring"):
        polar_grid(0.5, 1.0)
