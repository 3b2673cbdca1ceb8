"""Ground views where a wrong terrain reaches up to a camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround, DemGround
from aeromatch_cli.blocks.plausibility import warnings_of
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Image, Pose
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import write_json
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.stages import simulate
from aeromatch_cli.stages.context import Context, Given
from aeromatch_cli.strategies.simulators import GroundView
from aeromatch_cli.workspace import Workspace

CAMERA = from_colmap("PINHOLE", 800, 600, (700.0, 700.0, 400.0, 300.0))
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
FLYING_M = 120.0
# That of the image that the spike is below.
LOST = "i22"


def flown(spike_m: float, *, low_m: float = FLYING_M) -> Block:
    """Sixteen images 30 m apart over ground at 0 m with a spike below one of them, which is flown at low_m."""
    names = [f"i{row}{column}" for row in range(4) for column in range(4)]
    poses = {
        name: Pose(np.array([30.0 * int(name[2]), 30.0 * int(name[1]), FLYING_M]), STRAIGHT_DOWN, 0.1, 0.1)
        for name in names
    }
    poses[LOST] = replace(poses[LOST], center_m=np.array([60.0, 60.0, low_m]))
    heights_m = np.zeros((60, 60))
    heights_m[25:36, 25:36] = spike_m
    ground = DemGround(heights_m, -87.5, 207.5, (5.0, 5.0), 0.0)
    images = tuple(Image(name, f"{name}.jpg", 800, 600, "c") for name in names)
    return Block(images, {"c": CAMERA}, poses, "local", (0.0, 0.0, 500.0), ground, "terrain", FLYING_M / 700.0)


@pytest.mark.parametrize("spike_m", [95.0, 106.0, 119.0, 150.0])
def test_a_spike_below_one_image_makes_no_view(spike_m: float) -> None:
    """The plane of the images around it does: 800 x 600 px, less the rounding, not 94 x 70 px of 14 m below it."""
    block = flown(spike_m)
    footprint = block_footprints(block)[LOST]
    assert footprint.ground_z_m == 0.0
    assert footprint.degenerate is not None
    assert footprint.degenerate.ground_z_m == pytest.approx(spike_m)
    assert footprint.degenerate.width_px == pytest.approx(800 * max(0.0, FLYING_M - spike_m) / FLYING_M, abs=1.0)
    *_, view = GroundView()(CAMERA, block.poses[LOST], footprint.ground_z_m, block.gsd_m)
    assert (view.width_px, view.height_px) == pytest.approx((800, 600), abs=2)
    assert [i for i, one in block_footprints(block).items() if one.degenerate is not None] == [LOST]
    (warning,) = [one for one in warnings_of(block) if "degenerate" in one]
    assert f"1 image ({LOST}.jpg) with a degenerate ground view (" in warning
    assert f"the terrain there, {500 + spike_m:.0f} m, is nearly as high as the camera" in warning
    assert not [one for one in warnings_of(block) if "below the ground" in one]


def test_hills_and_low_flights_are_looked_at_as_they_are() -> None:
    for block in (flown(60.0), flown(0.0, low_m=20.0)):
        assert all(one.degenerate is None for one in block_footprints(block).values())
    assert block_footprints(flown(60.0))[LOST].ground_z_m == pytest.approx(60.0)
    assert block_footprints(flown(0.0, low_m=20.0))[LOST].gsd_m == pytest.approx(20.0 / 700.0)


def test_an_image_below_all_ground_sees_none() -> None:
    block = replace(flown(0.0, low_m=-10.0), ground=ConstantGround(0.0))
    assert LOST not in block_footprints(block)


def context_of(block: Block, root: Path) -> Context:
    return Context(Settings(), Workspace(root), Executor("serial"), Given(block, {}), block)


def test_the_views_and_their_file_say_why(tmp_path: Path) -> None:
    context = context_of(flown(106.0), tmp_path)
    assert context.ground_z_m(LOST) == 0.0
    assert context.ground_z_m("i00") == 0.0
    assert context.ground_remark("i00") == ""
    words = context.ground_remark(LOST)
    assert words == "degenerate ground view (93x70 px: the terrain there, 606 m, is nearly as high as the camera)"


def view(width_px: int, height_px: int) -> dict[str, Any]:
    return {"name": "ground", "width_px": width_px, "height_px": height_px}


@pytest.mark.parametrize(
    ("scale", "remark", "views", "said"),
    [
        (1.0, "", [(120, 90)], "degenerate ground view (120x90 px of an image of 800x600 px)"),
        (1.0, "stated", [(800, 600)], "stated"),
        (1.0, "", [(120, 90), (800, 600)], ""),
        (0.25, "", [(120, 90)], ""),
    ],
)
def test_small_views_are_a_reason_of_their_own(
    tmp_path: Path, scale: float, remark: str, views: list[tuple[int, int]], said: str
) -> None:
    workspace, image = Workspace(tmp_path), Image("a", "a.jpg", 800, 600, "c")
    assert simulate.degenerate_view(workspace, image) == ""
    record = {"fingerprint": "", "scale": scale, "remark": remark, "views": [view(*size) for size in views]}
    write_json(workspace.views("a"), record)
    assert simulate.degenerate_view(workspace, image) == said
