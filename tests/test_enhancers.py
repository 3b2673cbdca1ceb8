"""Enhancers keep shape and dtype; `none` keeps everything."""

import numpy as np
import pytest

from aeromatch_cli.strategies.enhancers import ENHANCERS


@pytest.mark.parametrize("name", sorted(ENHANCERS))
@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_shape_and_dtype_stay(name, shape, dtype):
    pixels = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    before = pixels.copy()
    enhanced = ENHANCERS[name]()(pixels, None)
    assert enhanced.pixels.shape == shape
    assert enhanced.pixels.dtype == dtype
    assert np.array_equal(pixels, before)


def test_none_changes_nothing():
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    enhanced = ENHANCERS["none"]()(pixels, np.ones((3, 4), dtype=bool))
    assert np.array_equal(enhanced.pixels, pixels)
    assert enhanced.mask is None
    assert enhanced.info == {}
