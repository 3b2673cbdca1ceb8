"""What the guide says of make, cron and the environment does what it says."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import QUICK, UNORIENTED, Site

SETTINGS = UNORIENTED

GUIDE = (Path(__file__).parent.parent / "docs" / "guide.md").read_text()


def block_after(heading: str) -> str:
    """The first indented block behind a bold heading of the guide."""
    text = GUIDE[GUIDE.index(f"**{heading}.**") :]
    match = re.search(r"\n\n((?:    .*\n|\n)+)", text)
    assert match is not None
    return re.sub(r"^    ", "", match[1], flags=re.MULTILINE).strip() + "\n"


@pytest.fixture
def shell(site: Site, tmp_path: Path) -> dict[str, str]:
    """An environment in which `aeromatch` is this one, one process, with cameras of the block; its runs are short."""
    folder = tmp_path / "bin"
    folder.mkdir()
    script = folder / "aeromatch"
    quick = shlex.join([*QUICK, *UNORIENTED])
    script.write_text(
        f'#!/bin/sh\n[ "$1" != run ] || set -- "$@" {quick}\nexec "{sys.executable}" -m aeromatch_cli.cli "$@"\n'
    )
    script.chmod(0o755)
    return os.environ | {
        "PATH": f"{folder}:{os.environ['PATH']}", "AEROMATCH_JOBS": "1",
        "AEROMATCH_CAMERAS": str(site.root / "block.json"),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_the_makefile_makes_once(site: Site, shell: dict[str, str]) -> None:
    rules = block_after("Makefile").replace("        aeromatch", "\taeromatch").replace("IMGS", "images")
    (site.root / "Makefile").write_text(rules)
    first = subprocess.run(["make", "-s"], cwd=site.root, env=shell, capture_output=True, text=True, check=False)
    assert first.returncode == 0, first.stderr
    database = site.root / "work" / "export" / "colmap" / "database.db"
    made = database.stat().st_mtime_ns
    again = subprocess.run(["make", "-s"], cwd=site.root, env=shell, capture_output=True, text=True, check=False)
    assert (again.returncode, again.stdout) == (0, "")
    assert database.stat().st_mtime_ns == made


@pytest.mark.slow
def test_a_cron_line_is_silent_and_keeps_a_log(site: Site, shell: dict[str, str]) -> None:
    command = (
        block_after("cron").split(" * * * ")[1].split("||")[0].replace("IMGS", "images").replace("--poses exif", "")
    )
    poses = {"AEROMATCH_POSES": "poses.csv"}
    done = subprocess.run(
        ["sh", "-c", command], cwd=site.root, env=shell | poses, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert "exit code 0" in (site.root / "run.log").read_text()


def test_every_variable_of_the_guide_is_one() -> None:
    from aeromatch_cli.cli import options

    known = set(re.findall(r'envvar="(AEROMATCH_[A-Z_]+)"', Path(options.__file__).read_text()))
    assert known == set(re.findall(r"AEROMATCH_[A-Z_]+", GUIDE))


@pytest.mark.slow
def test_a_reader_that_leaves_early_stops_nothing(shell: dict[str, str]) -> None:
    """`aeromatch list | head -1`, with the exit code of aeromatch itself."""
    command = "{ aeromatch list; echo $? >&2; } | head -1"
    done = subprocess.run(["sh", "-c", command], env=shell, capture_output=True, text=True, check=False)
    assert (done.stderr.strip(), done.stdout.count("\n")) == ("0", 1)
