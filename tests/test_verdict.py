"""Exit codes by the verdict on a block, and where a workspace says it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import Site, invoke

from aeromatch_cli.cli.output import guarded
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.formats.adjusted import write_dropped
from aeromatch_cli.formats.rows import read_verified_row
from aeromatch_cli.stages.command_result import Result
from aeromatch_cli.workspace import Workspace


def exit_code(*, strict: bool, **result: Any) -> int:
    import typer

    try:
        guarded(
            lambda: Result((), {}, **result),
            "run",
            quiet=True,
            as_json=False,
            log_file=None,
            context=None,
            strict=strict,
        )
    except typer.Exit as stop:
        return stop.exit_code
    return 0


@pytest.mark.parametrize(
    ("verdict", "strict", "code"),
    [
        ("good", True, 0), ("doubtful", False, 0), ("doubtful", True, 4), ("bad", False, 1), ("bad", True, 1),
        (None, True, 0),
    ],
)  # fmt: skip
def test_a_bad_result_is_a_failure_and_a_doubtful_one_where_it_is_asked_for(
    verdict: Any, strict: bool, code: int
) -> None:
    assert exit_code(strict=strict, verdict=verdict) == code


def test_failures_go_before_doubt() -> None:
    assert exit_code(strict=True, verdict="doubtful", failures=(("extract", "a", "broken"),)) == 1


def test_strict_is_for_commands_with_a_verdict(site: Site) -> None:
    assert site("pairs", "--strict").code == 2


@pytest.mark.slow
def test_run_show_and_page_agree(done_site: Site) -> None:
    told = site_quality(done_site)
    assert told["verdict"] in ("good", "doubtful")
    shown = invoke("show", done_site.work, "--json").facts["quality"]
    assert shown == told
    assert invoke("report", "--workspace", done_site.work, "--quiet").code == 0
    page = (done_site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert f"<h2>Result: {told['verdict']}</h2>" in page
    assert f"<b>{told['verdict']}</b>result: " in page


@pytest.mark.slow
def test_a_pair_tells_what_every_stage_dropped_and_what_it_left(done_site: Site) -> None:
    workspace, names = Workspace(done_site.work), done_site.names()[:2]
    first, second = (name.replace(".", "_") for name in names)
    entry = read_verified_row(workspace.verified(first))[second]
    assert entry.verdict.rejected["poselib"] > 0
    with workspace.dropped.open("wb") as stream:
        write_dropped(stream, {(first, second): (entry.fingerprint, np.arange(3, dtype=np.int32))}, 15)
    path = workspace.stage_report("consistency")
    record = read_json(path)
    write_json(path, record | {"result": record["result"] | {"doubtful": [second]}})
    lines = invoke("show", done_site.work, *names).stdout.splitlines()
    assert f"dropped     {entry.verdict.rejected['poselib']} by poselib of the stage filter" in lines
    assert "dropped     3 by the stage consistency" in lines
    (off,) = [line for line in lines if line.startswith("adjusted    median ")]
    assert float(off.split()[2]) < 1.0
    (doubt,) = [line for line in lines if line.startswith("consistency ")]
    assert doubt.startswith(f"consistency most matches of {names[1]} contradict its adjusted pose")


def site_quality(site: Site) -> dict[str, Any]:
    outcome = site("run")
    assert outcome.code == 0
    quality: dict[str, Any] = outcome.facts["quality"]
    return quality
