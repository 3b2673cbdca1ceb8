"""Work on many items of a block cut into stretches, for several processes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from aeromatch_cli.executor import Executor

Task = TypeVar("Task")
Made = TypeVar("Made")


def stretches(items: int, parts: int) -> list[slice]:
    """So many parts of so many items, in order, of about the same size."""
    ends = np.linspace(0, items, parts + 1).astype(int).tolist()
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def made_of(
    executor: Executor, make: Callable[[Task], Made], tasks: Sequence[Task], items: Sequence[int]
) -> list[Made]:
    """What `make` makes of every task, by the executor. What fails there is tried here once more: only so does its
    error say which file is broken. items: of each task, what the progress counts."""
    outcomes = executor.run(make, tasks, "report", items)
    return [
        make(task) if outcome.value is None else outcome.value for outcome, task in zip(outcomes, tasks, strict=True)
    ]
