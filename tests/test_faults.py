"""Programs of others that stop on a fault: the run goes on without them, says so, and tries again next time."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from conftest import IMAGES, Site

from aeromatch_cli.errors import InputError
from aeromatch_cli.sfm import process
from aeromatch_cli.stages import adjust, models

FAULT = "stopped with exit code -11: segmentation fault"


def stops(*_: object, **__: object) -> None:
    raise InputError(FAULT)


@pytest.mark.slow
def test_a_mapper_that_stops_is_a_failure_and_tried_again(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as faulty:
        faulty.setattr(models, "map_block", stops)
        outcome = site("orient", "--poses", "none")
    assert outcome.code == 1
    assert site.failures() == [("orient", "mapping")]
    assert FAULT in (site.work / "failures.csv").read_text()
    assert "matches do not agree" not in outcome.stdout
    again = site("orient", "--poses", "none")
    assert (again.code, again.counts("orient")) == (0, (IMAGES, 0, 0))
    assert len(again.facts["stages"]["orient"]["result"]["outside"]) < IMAGES
    assert site("orient", "--poses", "none").counts("orient") == (0, IMAGES, 0)


@pytest.mark.slow
def test_after_a_failed_adjustment_matches_are_judged_again(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = ("--set", "consistency.min_probability=0.5")
    assert done_site("adjust", *judged).code == 0
    dropped = (done_site.work / "orientation" / "dropped.npz").read_bytes()
    with monkeypatch.context() as faulty:
        faulty.setattr(adjust, "adjust_block", stops)
        assert done_site("adjust", *judged, "--overwrite").code == 1
    assert (done_site.work / "orientation" / "dropped.npz").read_bytes() != dropped
    assert done_site("adjust", *judged).code == 0
    assert (done_site.work / "orientation" / "dropped.npz").read_bytes() == dropped


@pytest.mark.parametrize(
    ("code", "said", "words"),
    [
        (-15, "", "the adjustment was ended by signal 15 (Terminated)"),
        (
            -11,
            "a stack\nsegmentation fault",
            "the adjustment was ended by signal 11 (Segmentation fault): segmentation fault",
        ),
        (3, "no such file", "the adjustment stopped with exit code 3: no such file"),
        (3, "", "the adjustment stopped with exit code 3"),
    ],
)
def test_how_a_process_has_ended_is_said_whether_or_not_it_said_why(
    code: int, said: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = subprocess.CompletedProcess([], code, "", said)
    monkeypatch.setattr(process.subprocess, "run", lambda *_, **__: ended)
    with pytest.raises(InputError) as fault:
        process.run_process("nothing", tmp_path, "result", "the adjustment")
    assert str(fault.value) == words


def test_a_process_has_one_thread_whatever_ran_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict[str, str]] = []

    def run(command: list[str], *, env: dict[str, str], **_: object) -> subprocess.CompletedProcess[str]:
        seen.append(env)
        (tmp_path / "result").touch()
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(process.subprocess, "run", run)
    for threads in ("1", "8"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        process.run_process("mapping_process", tmp_path, "result", "mapping")
    assert [env["OMP_NUM_THREADS"] for env in seen] == ["1", "1"]
    assert seen[0]["PATH"] == os.environ["PATH"]
