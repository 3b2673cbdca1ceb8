"""A dask scheduler and two workers as processes of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

Processes = list[subprocess.Popen[str]]


@contextmanager
def dask_cluster() -> Iterator[tuple[str, Processes]]:
    """The address, and the processes: the scheduler, a plain worker, and one that offers a GPU. They can be killed."""
    scheduler = _started("distributed.cli.dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
    assert scheduler.stderr is not None
    address = next(m[0] for line in scheduler.stderr if (m := re.search(r"tcp://127\.0\.0\.1:\d+", line)))
    workers = [dask_worker(address, "--name", "plain"), dask_worker(address, "--name", "gpu", "--resources", "GPU=1")]
    try:
        yield address, [scheduler, *workers]
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.communicate()


def dask_worker(address: str, *options: str) -> subprocess.Popen[str]:
    """A worker of one thread of the scheduler at `address`."""
    return _started(
        "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", *options
    )  # fmt: skip


def _started(*arguments: str) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths, "DASK_DISTRIBUTED__WORKER__DAEMON": "false"}
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
        text=True,
    )  # fmt: skip
