"""Benchmarks that are a list of runs of others."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Sequence

from benchmarks.stamps import REPOSITORY

# NAME of a benchmark, and its arguments.
Run = Sequence[str]


def run_all(runs: Sequence[Run], *, listed: bool) -> int:
    """Each in a process of its own, in order, up to one that fails: its exit code. listed: print them instead."""
    for run in runs:
        print(shlex.join(["scripts/bench", *run]), file=sys.stdout if listed else sys.stderr, flush=True)
        if not listed:
            done = subprocess.run([sys.executable, "-m", "benchmarks", *run], cwd=REPOSITORY / "scripts", check=False)
            if done.returncode:
                return done.returncode
    return 0
