"""Worker processes: one thread each, deaf to Ctrl-C, gone with their parent."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing.context import SpawnContext, SpawnProcess

# One thread inside each worker: the processes are the parallelism, and results do not depend on thread counts.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
# glibc gives the large arrays of every image back to the system and faults them in again for the next one: 40 % of
# the time of SIFT. Workers keep them instead; their peak grows by a tenth (measured on 12 megapixels).
KEPT_ARRAYS = dict.fromkeys(("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"), str(4_000_000_000))
_WORKER_ENVIRONMENT = ONE_THREAD | KEPT_ARRAYS


def single_threaded() -> None:
    """Make this process's libraries use one thread. Runs at the start of every worker."""
    import cv2

    cv2.setNumThreads(1)
    os.environ.update(ONE_THREAD)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """The same for as long as serial work takes. A BLAS of two threads, loaded long ago, sums in another order."""
    import cv2
    import threadpoolctl

    before = cv2.getNumThreads()
    single_threaded()
    try:
        with threadpoolctl.threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


class _WorkerProcess(SpawnProcess):
    """Ends without a traceback where it has no memory to read its next task: the parent sees that it is gone."""

    def run(self) -> None:
        try:
            super().run()
        except MemoryError:
            os._exit(1)


class WorkerContext(SpawnContext):
    Process = _WorkerProcess


def start_worker() -> None:
    # Ctrl-C is the parent's to handle: workers would only print tracebacks.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A parent that is killed can tell no one: its workers would wait for tasks for ever.
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    single_threaded()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def worker_environment() -> Iterator[None]:
    """Workers inherit these settings; BLAS and glibc read them when they are loaded, before any initializer runs."""
    before = {name: os.environ.get(name) for name in _WORKER_ENVIRONMENT}
    os.environ.update(_WORKER_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """SIGINT waits until the block ends; processes started inside never see it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def available_cores() -> int:
    """Cores that this process may use (cgroups and affinity respected)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
