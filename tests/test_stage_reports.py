"""Reports of stages: what later ones supersede, and what the present settings no longer name."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from conftest import UNORIENTED, Site, invoke

from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.stages.stage_report import StageReport, gather_failures
from aeromatch_cli.workspace import Workspace


def test_a_whole_run_supersedes_the_failure_of_an_earlier_shard(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    workspace.create()
    StageReport("extract", items=3, done=3).write(workspace)
    os.utime(workspace.stage_report("extract"), (1e9, 1e9))
    failed = StageReport("extract", items=1, failures=[("a", "gone for a while")])
    failed.write(workspace, Shard.parse("1/2") if Shard.parse("1/2").owns("a") else Shard.parse("2/2"))
    assert [item for _, item, _ in gather_failures(workspace)] == ["a"]
    StageReport("extract", items=3, skipped=3).write(workspace)
    assert gather_failures(workspace) == []


@pytest.mark.slow
def test_exports_that_the_settings_no_longer_name_are_said_to_be_old(done_site: Site) -> None:
    assert done_site("export", "--set", "export=colmap+tracks").code == 0
    told = done_site("export")
    assert told.code == 0
    assert "is of earlier" not in told.stdout  # it is of the present matches, only not asked for
    assert done_site("export", "--set", "export=tracks").code == 0
    assert done_site("run", "--set", "consistency.epipolar_px=2").code == 0
    told = done_site("export", "--set", "consistency.epipolar_px=2")
    assert f"export    {done_site.work / 'export' / 'tracks'} is of earlier results" in told.stdout
    assert "colmap is of earlier" not in told.stdout


@pytest.mark.slow
def test_an_export_of_an_earlier_adjustment_is_said_to_be_old(done_site: Site) -> None:
    held = "--set", "adjust.calibration=given"
    folder = done_site.work / "export" / "colmap"
    old = f"export    {folder} is of an earlier adjustment: `aeromatch export` makes it anew"
    assert "of an earlier adjustment" not in done_site("adjust").stdout
    for _ in range(2):  # also where the adjustment is up to date
        assert old in done_site("adjust", *held).stdout
    assert "colmap, of an earlier adjustment: run aeromatch export" in invoke("show", done_site.work).stdout
    assert done_site("export", *held).done() == {"export": 1}
    for command in ("adjust", "report"):
        assert "of an earlier adjustment" not in done_site(command, *held).stdout
    # Made again, and the same: the export is up to date.
    done_site("adjust", "--overwrite", *held)
    assert done_site("export", *held).done() == {}
    assert "of an earlier adjustment" not in done_site("adjust", *held).stdout
    assert "of an earlier adjustment" not in invoke("show", done_site.work).stdout


@pytest.mark.slow
def test_pairs_without_results_are_not_vouched_for(site: Site) -> None:
    """Without an adjustment, too: pairs that are verified later are judged then."""
    judged = (*UNORIENTED, "--set", "refine=none", "--set", "consistency.min_probability=0.5")
    last = site.image(-1)
    away = site.root / last.name
    last.rename(away)
    assert site("run", *judged).code == 0
    away.rename(last)
    assert site("match", *judged).code == 0
    report = site.work / "reports" / "consistency.json"
    site("export", *judged)
    before = json.loads(report.read_text())
    assert site("filter", *judged).code == 0
    assert site("export", *judged).code == 0
    after = json.loads(report.read_text())
    assert after["items"] > before["items"]
    assert after["fingerprint"] != before["fingerprint"]
