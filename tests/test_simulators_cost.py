"""What the stage reports say of the cost of views."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import Camera
from aeromatch_cli.images.views import render_view
from aeromatch_cli.lab.strategies.tilts import Tilts
from aeromatch_cli.results.stages import ExtractResult
from aeromatch_cli.stages.simulate import ViewCost, views_result
from aeromatch_cli.strategies import ViewPixels


def test_cost_is_counted_over_views() -> None:

    camera = Camera("PINHOLE", 400, 300, (380.0, 380.0, 199.5, 149.5))
    views = Tilts(levels=0, rotations=4)(camera, None, None, None)
    gray = np.zeros((300, 400), np.uint8)
    cost = ViewCost.of([ViewPixels(view, *render_view(gray, None, camera, view)) for view in views])
    assert cost == ViewCost(4, 0.48)


def test_views_add_up_over_the_passes_of_a_command() -> None:
    first = views_result([ViewCost(1, 2.0), ViewCost(3, 4.0)])
    assert (first.images, first.views, first.view_megapixels) == (2, 4, 6.0)
    assert (first.views_per_image, first.megapixels_per_image) == (2.0, 3.0)
    second = views_result([ViewCost(5, 9.0)])
    both = ExtractResult(keypoints=77, **first.as_json()).plus(ExtractResult(keypoints=3, **second.as_json()))
    assert (both.images, both.views, both.view_megapixels, both.keypoints) == (3, 9, 15.0, 80)
    assert (both.views_per_image, both.megapixels_per_image) == (3.0, 5.0)
