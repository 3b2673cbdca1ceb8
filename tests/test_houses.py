"""Houses of rendered scenes."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.lab.synthetic.houses import house
from aeromatch_cli.lab.synthetic.solids import Footprint


@pytest.mark.parametrize("length_m", [4.2, 5.0, 12.0])
def test_what_stands_out_of_a_house_stays_near_it(length_m: float) -> None:
    """Also of one that is narrower than the porch that most have."""
    for seed in range(40):
        surfaces = house(np.random.default_rng(seed), Footprint(0.0, 0.0, length_m, 4.0, 0.0))
        corners_m = np.concatenate([surface.triangles_m.reshape(-1, 3) for surface in surfaces])
        assert np.abs(corners_m[:, 0]).max() < 0.5 * length_m + 2.0
        assert corners_m[:, 1].min() > -0.5 * 4.0 - 4.5
