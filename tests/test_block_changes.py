"""What is known of the block changes behind finished results: exactly what was made from it is made again."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
from conftest import IMAGES, Site

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.config import load
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import digests, read_json, write_json
from aeromatch_cli.stages import export, extract, match
from aeromatch_cli.stages import filter as filter_stage
from aeromatch_cli.stages.block import block_record
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.pairs import prepare

pytestmark = pytest.mark.slow

PAIRS = IMAGES * (IMAGES - 1) // 2
KINDS = ("camera", "pose", "sigma", "ground")


def context_of(site: Site) -> Context:
    """The context of a command on a finished site."""
    context, *_ = prepare(load(str(site.work / "config.yaml")), Executor("serial"))
    return context


def with_block(context: Context, **changes: Any) -> Context:
    return replace(context, block=replace(context.block, **changes))


def _write_tables(context: Context) -> None:
    """Write block.json, which states the origin, as `prepare` does."""
    workspace = context.workspace
    write_json(workspace.block, block_record(context.block, context.given.block, context.settings))
    report = workspace.stage_report("pairs")
    record = read_json(report)
    write_json(report, {**record, "files": digests(workspace.root, record["files"])})


def test_an_unchanged_block_leaves_all_stages_alone(done_site):
    context = context_of(done_site)
    stages = (extract, match, filter_stage, export)
    assert [stage.run(context).done for stage in stages] == [0, 0, 0, 0]


def test_another_origin_is_exported_anew(done_site):
    context = context_of(done_site)
    east, north, height = context.block.origin_m
    moved = with_block(context, origin_m=(east + 1000.0, north, height))
    _write_tables(moved)
    assert extract.run(moved).done == 0
    assert filter_stage.run(moved).done == 0
    assert export.run(moved).done == 1
    world = json.loads((done_site.work / "export" / "colmap" / "world.json").read_text())
    assert world["origin_m"] == [east + 1000.0, north, height]
    assert export.run(moved).done == 0


@pytest.mark.parametrize("change", ["gsd", "ground"])
def test_another_scale_or_ground_redoes_the_ground_views(done_site, change):
    context = context_of(done_site)
    before = {path.name: path.read_bytes() for path in (done_site.work / "features").iterdir()}
    gsd_m, ground = context.block.gsd_m, context.block.ground
    assert gsd_m is not None
    assert isinstance(ground, ConstantGround)
    changes = {"gsd": {"gsd_m": gsd_m * 1.5}, "ground": {"ground": ConstantGround(ground.z_m - 5.0)}}[change]
    changed = with_block(context, **changes)
    assert extract.run(changed).done == IMAGES
    assert match.run(changed).done == PAIRS
    assert all((done_site.work / "features" / name).read_bytes() != data for name, data in before.items())
    assert extract.run(changed).done == 0


def test_only_strategies_that_read_the_ground_depend_on_its_scale(done_site):
    context = context_of(done_site)
    assert context.block.gsd_m is not None
    finer = with_block(context, gsd_m=context.block.gsd_m * 0.9)
    for image in context.block.images:
        prints = [
            {needs: one.geometry_fingerprint(image.image_id, frozenset({needs})) for needs in KINDS}
            for one in (context, finer)
        ]
        assert {needs for needs in KINDS if prints[0][needs] != prints[1][needs]} == {"ground"}


def test_another_pose_redoes_its_image_and_its_neighbours_views_only(done_site):
    context = context_of(done_site)
    needs = frozenset({"neighbours"})
    first, *others = [image.image_id for image in context.block.images]
    paired = tuple(pair for pair in context.pairs if first not in (pair.image_id0, pair.image_id1))
    apart = replace(
        context, pairs=paired + tuple(p for p in context.pairs if {first, others[0]} == {p.image_id0, p.image_id1})
    )
    pose = apart.block.poses[first]
    moved = with_block(apart, poses={**apart.block.poses, first: replace(pose, center_m=pose.center_m + 1.0)})
    changed = {
        i for i in (first, *others) if apart.geometry_fingerprint(i, needs) != moved.geometry_fingerprint(i, needs)
    }
    assert changed == {others[0]}
    assert [neighbour.pose for neighbour in apart.neighbours(first)] == [apart.block.poses[others[0]]]
    assert len(apart.neighbours(others[0])) == IMAGES - 1
