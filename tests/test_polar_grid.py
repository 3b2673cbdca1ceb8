"""The dynamic polar grid: equal areas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.strategies.matchers.polar.fit import polar_grid


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


def test_a_radius_without_rings_is_refused():
    with pytest.raises(ValueError, match="holds no ring"):
        polar_grid(0.5, 1.0)
