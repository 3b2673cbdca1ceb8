"""A run that is killed or stopped leaves no process and no half file, and goes on where it was."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import UNORIENTED, Site, contents, heed_interrupts

pytestmark = pytest.mark.slow
SETTINGS = UNORIENTED


def start(site: Site, work: Path, *more: object) -> subprocess.Popen[str]:
    """`run` with two workers in a process group of its own."""
    options = [str(option) for option in site.options("--workspace", work, "--jobs", "2", "--json", *more)]
    command = [sys.executable, "-m", "aeromatch_cli.cli", "run", "baseline", *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    pipes |= {"start_new_session": True, "preexec_fn": heed_interrupts}
    return subprocess.Popen(command, **pipes)  # type: ignore[call-overload,no-any-return]


def wait_for_files(process: subprocess.Popen[str], work: Path, count: int) -> None:
    """Until the workspace holds `count` files, or the process has ended by itself."""
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        if sum(len(files) for _, _, files in os.walk(work)) >= count:
            return
        time.sleep(0.002)


def same(work: Path, expected: Path) -> None:
    found, wanted = contents(work), contents(expected)
    for one in (found, wanted):
        del one["config.yaml"]  # says how many jobs there were
    assert found == wanted


def test_a_run_killed_again_and_again_ends_like_an_uninterrupted_one(done_site):
    work = done_site.root / "killed"
    moments = random.Random(7).sample(range(2, 30), 3)
    killed = 0
    for count in sorted(moments):
        process = start(done_site, work)
        wait_for_files(process, work, count)
        time.sleep(0.01)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            killed += 1
        process.communicate()
        assert nothing_lives(process.pid)
    assert killed >= 2
    outcome = done_site("run", "--workspace", work, "--jobs", "1")
    assert outcome.code == 0
    same(work, done_site.work)


def living(group: int) -> list[str]:
    """Processes of a group that have not ended (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, process_group = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it has ended meanwhile
        if int(process_group) == group and state != "Z":
            found.append(path.parent.name)
    return found


def nothing_lives(group: int) -> bool:
    deadline = time.monotonic() + 10
    while living(group) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not living(group)


def test_workers_do_not_outlive_a_killed_parent(done_site):
    work = done_site.root / "orphans"
    process = start(done_site, work)
    wait_for_files(process, work, 10)
    assert process.poll() is None
    assert len(living(process.pid)) >= 3  # itself and two workers
    process.kill()
    process.communicate(timeout=30)  # ends when the last worker has closed the pipes
    assert nothing_lives(process.pid)


def test_sigterm_is_heard_while_pycolmap_is_loaded():
    """Importing pycolmap installs a handler of its own."""
    code = (
        "import os, signal\n"
        "from aeromatch_cli.cli.output import _terminated_like_interrupt\n"
        "from aeromatch_cli.strategies.exporters.colmap import import_pycolmap\n"
        "with _terminated_like_interrupt():\n"
        "    import_pycolmap()\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        signal.pause()\n"
        "    except KeyboardInterrupt:\n"
        "        print('heard')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "heard\n", done.stderr


def test_an_interrupt_in_code_made_from_text_leaves_with_130(tmp_path):
    """As while a module with dataclasses is imported: `python -m` would end as if killed by the signal."""
    lines = (
        "import typer",
        "from aeromatch_cli.cli.output import guarded",
        "def main():",
        "    guarded(lambda: exec('raise KeyboardInterrupt'), 'run', quiet=True, as_json=True, log_file=None)",
        "typer.run(main)",
    )
    (tmp_path / "stopped.py").write_text("\n".join(lines), encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "stopped"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 130, done.stderr
    assert "run the same command again" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_leaves_with_130_and_resumes(done_site, number):
    work = done_site.root / "stopped"
    process = start(done_site, work)
    wait_for_files(process, work, 12)
    # Ctrl-C reaches the whole group, a scheduler's SIGTERM only the process that it started.
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "run the same command again" in stderr
    assert "Traceback" not in stderr
    assert stdout.splitlines()[-1].endswith('"exit_code": 130}')
    assert nothing_lives(process.pid)  # no worker is left behind
    assert done_site("run", "--workspace", work).code == 0
    same(work, done_site.work)
