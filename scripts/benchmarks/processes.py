"""Threads, memory and processes of their own, so that seconds and megabytes are those of what is measured."""

from __future__ import annotations

import multiprocessing
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from aeromatch_cli.workers import KEPT_ARRAYS

T = TypeVar("T")
_EVERY_S = 0.2
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def limit_threads(threads: int) -> None:
    """For this process and those started from it; numerical libraries read it when they are loaded, torch is told."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(threads)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"


def keep_arrays() -> None:
    """In processes started from this one large arrays are not given back to the system each time, as in the program's
    own workers: else every method pays for page faults."""
    os.environ.update(KEPT_ARRAYS)


def fresh_process(workers: int = 1, start: Callable[..., None] | None = None, *given: Any) -> ProcessPoolExecutor:
    """Processes that have imported nothing yet; `start(*given)` initialises each."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, context, _started, (start, given))


def _started(start: Callable[..., None] | None, given: tuple[Any, ...]) -> None:
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    if start is not None:
        start(*given)


def _leave_with_parent() -> None:
    """A parent that is killed can tell no one: its workers would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def watched(call: Callable[[], T]) -> tuple[T, float, float]:
    """Value, seconds, and the peak of resident memory in MB while it ran (where the system cannot reset the peak: of
    the process so far)."""
    reset_peak()
    started = time.perf_counter()
    value = call()
    seconds = time.perf_counter() - started
    return value, seconds, peak_mb()


def reset_peak() -> None:
    """Forget the peak of resident memory, where the system can."""
    try:
        _CLEAR.write_text("5", encoding="ascii")
    except OSError:
        return


def peak_mb() -> float:
    """Largest resident memory of this process; getrusage would count its parent's before the exec, too."""
    if _STATUS.is_file():
        return int(_STATUS.read_text(encoding="ascii", errors="replace").partition("VmHWM:")[2].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run_watched(command: Sequence[str], log: Path) -> tuple[int, float, float]:
    """Exit code, seconds, and the largest sum, in MB, of what a command and all that it starts hold: PSS of Linux, in
    which pages that several share count once, looked at every 0.2 s."""
    started, peak = time.monotonic(), 0.0
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        while process.poll() is None:
            peak = max(peak, sum(_pss_mb(pid) for pid in _tree(process.pid)))
            time.sleep(_EVERY_S)
    return process.returncode, time.monotonic() - started, peak


def _tree(pid: int) -> Iterator[int]:
    yield pid
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:  # it has ended meanwhile
        return
    for child in children:
        yield from _tree(int(child))


def _pss_mb(pid: int) -> float:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024.0 for line in text.splitlines() if line.startswith("Pss:")), 0.0)


def children_seconds() -> float:
    """Processor seconds of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
