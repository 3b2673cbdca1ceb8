"""Virtual cameras: how else the ground of one image can be looked at before features are found.

Call: `strategy(camera, pose, ground_z_m, gsd_m, neighbours) -> tuple[View, ...]`, at least one view. pose, ground_z_m
(world height of the ground under the image's footprint) and gsd_m (the block's common ground sampling distance) are
None where unknown. neighbours: the images it is paired with that have an attitude, in the order of their ids; empty for
a strategy that does not list "neighbours" in its needs. A view is geometry only; its pixels are the source's, resampled
at `geometry.warps.source_from_view`. A view with is_source is the stored raster itself: its pixels ARE the stored
pixels, distortion included, and its undistorted_from_view (identity) is not used.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.simulators.ground import GroundView
from aeromatch_cli.strategies.simulators.neighbours import NeighbourViews
from aeromatch_cli.strategies.simulators.none import SourceOnly
from aeromatch_cli.strategies.simulators.none import source_view as source_view

SIMULATORS: Mapping[str, type[Strategy]] = {
    "none": SourceOnly,
    "ground": GroundView,
    "neighbours": NeighbourViews,
}
