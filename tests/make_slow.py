"""Tasks that take their time, fail or end their process. Workers import this file and little else."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from aeromatch_cli.errors import ItemError, WorkspaceError


@dataclass(frozen=True)
class Task:
    """What to do with a number: square | fail | defect | memory | disk | die | die-once."""

    number: int
    action: str = "square"
    marks: str = ""


def work(task: Task) -> int:
    if task.marks:
        with Path(task.marks, str(task.number)).open("a") as stream:
            stream.write("x")
    if task.action == "fail":
        raise ItemError(f"image {task.number} is corrupt")
    if task.action == "defect":
        raise IndexError("an unforeseen thing")
    if task.action == "memory":
        raise MemoryError
    if task.action == "disk":
        raise WorkspaceError("disk full")
    if task.action == "die" or (task.action == "die-once" and len(Path(task.marks, str(task.number)).read_text()) == 1):
        os._exit(1)
    time.sleep(0.002 * (task.number % 3))
    return task.number**2


def slow_square(number: int) -> int:
    time.sleep(0.2)
    return number * number


def worker_name(number: int) -> str:
    """Of the dask worker that runs the task."""
    from distributed import get_worker

    return str(get_worker().name)
