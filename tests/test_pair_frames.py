"""Images whose poses lie in different frames: the poses of one say nothing of the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Image, Pair, Pose
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.sfm.mapping import Group, own_frames
from aeromatch_cli.stages.context import Context, Given
from aeromatch_cli.workspace import Workspace

CAMERA = from_colmap("PINHOLE", 800, 600, (700.0, 700.0, 400.0, 300.0))
NAMES = ("a", "b", "c", "d", "lost")


@pytest.fixture
def context(tmp_path: Path) -> Context:
    """a and b lie in the world, c and d in a frame of their own, the last one nowhere; every image is in every pair."""
    poses = {
        name: Pose(np.array([10.0 * number, 0.0, 100.0]), np.diag([1.0, -1.0, -1.0]), 0.1, 0.1)
        for number, name in enumerate(NAMES[:4])
    }
    images = tuple(Image(name, f"{name}.jpg", 800, 600, "k") for name in NAMES)
    groups = [Group("positions", ("a", "b")), Group("level", ("c", "d"))]
    block = Block(
        images,
        {"k": CAMERA},
        poses,
        "local",
        (0.0, 0.0, 0.0),
        ConstantGround(0.0),
        "given",
        0.1,
        frames=own_frames(groups),
    )
    pairs = tuple(Pair(one, two, 0.8, 5.0, "file") for n, one in enumerate(NAMES) for two in NAMES[n + 1 :])
    return Context(Settings(), Workspace(tmp_path), Executor("serial", 1), Given(block, {}), block, pairs)


def test_poses_count_where_both_lie_in_one_frame(context: Context) -> None:
    known = {
        (pair.image_id0, pair.image_id1)
        for pair in context.pairs
        if None not in (context.geometry(pair).pose0, context.geometry(pair).pose1)
    }
    assert known == {("a", "b"), ("c", "d")}
    # Of an image without a pose the other's is what there is, as without frames.
    assert context.geometry(Pair("a", "lost", 0.8, 5.0, "file")).pose0 is not None


def test_views_look_where_neighbours_of_the_same_frame_look(context: Context) -> None:
    assert [float(one.pose.center_m[0]) for one in context.neighbours("a")] == [10.0]
    assert [float(one.pose.center_m[0]) for one in context.neighbours("c")] == [30.0]


def test_north_of_another_frame_is_another_north(context: Context) -> None:
    alone = replace(context, pairs=(Pair("a", "b", 0.8, 5.0, "file"),))
    assert not alone.lacks_attitude("a")
    assert replace(context, pairs=(Pair("a", "c", 0.8, 5.0, "file"),)).lacks_attitude("a")


def test_fingerprints_tell_frames_apart(context: Context) -> None:
    needs = frozenset({"pose"})
    plain = replace(context, block=replace(context.block, frames={}))
    assert context.geometry_fingerprint("a", needs) == plain.geometry_fingerprint("a", needs)
    assert context.geometry_fingerprint("c", needs) != plain.geometry_fingerprint("c", needs)
