"""Every stage of a run, as declared: what it makes is made again, the same, where it was damaged or lost, and where the
run was stopped while it wrote."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest
from conftest import PAGE, Site, contents

from aeromatch_cli import graph

pytestmark = pytest.mark.slow

every_stage = pytest.mark.parametrize("stage", graph.RUN)
# One process, so that the test can stop it.
ALONE = ("--executor", "serial", "--jobs", "1", *PAGE)


def files_of(work: Path, stage: str) -> list[Path]:
    """The files that a stage has made, its report among them."""
    files = sorted(path for path in work.rglob("*") if path.is_file())
    return [path for path in files if graph.stage_that_makes(PurePosixPath(path.relative_to(work).as_posix())) == stage]


def damaged(path: Path, how: str) -> None:
    """how: cut | empty | flipped | another file of its kind | lost."""
    data = bytearray(path.read_bytes())
    if how == "lost":
        path.unlink()
    elif how == "another":
        path.write_bytes(b"\x80[1, 2]")
        if path.suffix == ".npz":
            with path.open("wb") as stream:
                np.savez(stream, fingerprint=np.array("x"), image_id1=np.array(["y"]))
    elif how == "flipped" and data:
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    else:
        path.write_bytes(data[: len(data) // 2] if how == "cut" else b"")


@pytest.fixture(scope="module")
def calm(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Site:
    """A finished site, run by one process; tests copy it."""
    folder = tmp_path_factory.mktemp("calm") / "site"
    shutil.copytree(finished, folder)
    site = Site(folder)
    assert site("run", *ALONE).code == 0
    return site


def held(site: Site) -> dict[str, Any]:
    """What the workspace holds, but the settings, which name the folder of the images."""
    return {name: one for name, one in contents(site.work).items() if name != "config.yaml"}


@pytest.fixture
def copied(calm: Site, tmp_path: Path) -> Site:
    shutil.copytree(calm.root, tmp_path / "site")
    return Site(tmp_path / "site")


@pytest.fixture(scope="module")
def expected(calm: Site) -> dict[str, Any]:
    return held(calm)


@every_stage
def test_what_is_damaged_is_made_again(copied: Site, expected: dict[str, Any], stage: str) -> None:
    files = files_of(copied.work, stage)
    assert len(files) > 1
    for number, path in enumerate(files):
        damaged(path, ("cut", "empty", "flipped", "another", "lost")[number % 5])
    outcome = copied("run", *ALONE)
    assert outcome.code == 0, outcome.stderr
    assert held(copied) == expected


def test_steps_of_a_cascade_are_made_again(site: Site) -> None:
    settings = ("--set", "cascade=guided", "--set", "cascade.guided.below_matches=100000", *ALONE)
    assert site("run", *settings).code == 0
    expected = contents(site.work)
    files = [path for stage in ("extract", "match", "filter") for path in files_of(site.work, stage)]
    assert {"first", "guided"} <= {path.parent.name for path in files}
    for number, path in enumerate(files):
        damaged(path, ("cut", "empty", "flipped", "another", "lost")[number % 5])
    outcome = site("run", *settings)
    assert outcome.code == 0, outcome.stderr
    assert contents(site.work) == expected


@every_stage
def test_a_stage_that_is_stopped_is_finished_by_the_next_run(
    copied: Site, expected: dict[str, Any], stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before its second file gets its name, or the first where that is all: an export appears as a folder."""
    files = files_of(copied.work, stage)
    for path in files:
        path.unlink()
    results = [path for path in files if path.parent.name != "reports"]
    last = 1 if stage == "export" else min(2, len(results))
    written: list[Path] = []

    def stopping(rename: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
        def renamed(source: Path, target: Path) -> Path:
            if any(path.is_relative_to(target) for path in results):
                written.append(target)
                if len(written) == last:
                    raise KeyboardInterrupt
            return rename(source, target)

        return renamed

    with monkeypatch.context() as patched:
        for name in ("replace", "rename"):
            patched.setattr(Path, name, stopping(getattr(Path, name)))
        assert copied("run", *ALONE).code == 130
    assert not written[-1].exists()
    assert copied("run", *ALONE).code == 0
    assert held(copied) == expected
