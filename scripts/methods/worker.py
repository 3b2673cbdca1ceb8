"""One method on one scene, in a process of its own: its memory is its own, and start-up is not timed."""

from __future__ import annotations

import logging
import multiprocessing
import os
import resource
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from methods.base import Found, Method, Options, Scene
from methods.table import method

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class Measured:
    """One pair: seconds of both images' features, matching and verification; peak resident memory over these."""

    found: Found
    seconds: float
    peak_mb: float


def limit_threads(threads: int) -> None:
    """For this process and those started from it; numerical libraries read it when they are loaded."""
    for name in _THREAD_VARIABLES:
        os.environ[name] = str(threads)


class Worker:
    """Runs pairs in order; features of an image are made once, and their cost is part of each of its pairs."""

    def __init__(self, name: str, scene: Scene, options: Options) -> None:
        import cv2

        logging.getLogger("aeromatch").setLevel(logging.ERROR)  # images in no judged pair are no surprise here
        self.method: Method = method(name)(scene, options)
        cv2.setNumThreads(options.threads)  # after the method was made: stages set one thread
        self.known: dict[str, tuple[Any, float, float]] = {}
        # Imports, lazily built objects and first kernels: what the first pair would pay for all.
        self.run(scene.pairs[0])
        self.known.clear()

    def run(self, pair: tuple[str, str]) -> Measured:
        sides = [self._features(image) for image in pair]
        found, seconds, peak_mb = _watched(lambda: self.method.match(*pair, sides[0][0], sides[1][0]))
        total = seconds + sum(side[1] for side in sides)
        return Measured(found, total, max(peak_mb, *(side[2] for side in sides)))

    def _features(self, image: str) -> tuple[Any, float, float]:
        if image not in self.known:
            self.known[image] = _watched(lambda: self.method.features(image))
        return self.known[image]


def _watched(call: Any) -> tuple[Any, float, float]:
    """Value, seconds, and the peak of resident memory in MB while it ran (where the system cannot reset the peak: of
    the process so far)."""
    resettable = _reset_peak()
    started = time.perf_counter()
    value = call()
    seconds = time.perf_counter() - started
    return value, seconds, _peak_mb(resettable)


def _reset_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _peak_mb(resettable: bool) -> float:
    if resettable:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


_worker: Worker | None = None


def start(name: str, scene: Scene, options: Options) -> None:
    """Initialise this process."""
    global _worker
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    _worker = Worker(name, scene, options)


def _leave_with_parent() -> None:
    """A parent that is killed can tell no one: its workers would wait for pairs for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_pair(pair: tuple[str, str]) -> Measured:
    """The task of one pair; `start` has run in this process."""
    assert _worker is not None
    return _worker.run(pair)
