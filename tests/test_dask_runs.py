"""A run over a dask cluster of which a worker is killed in every stage ends with the bytes of a serial one."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from conftest import Site, contents
from dask_cluster import Processes, dask_cluster, dask_worker

pytestmark = pytest.mark.slow
FOLDERS = ("features", "matches", "verified", "refined")


class Killer(threading.Thread):
    """Kills a worker as soon as the first file of each stage is there, and starts another in its place."""

    def __init__(self, work: Path, address: str, workers: Processes) -> None:
        super().__init__(daemon=True)
        self.work, self.address, self.workers = work, address, workers
        self.killed: list[str] = []
        self.over = threading.Event()

    def run(self) -> None:
        for folder in FOLDERS:
            while not any((self.work / folder).glob("*.np?")) and not self.over.is_set():
                time.sleep(0.001)
            if self.over.is_set():
                return
            self.workers[0].kill()
            self.workers.append(dask_worker(self.address))
            self.workers.pop(0).wait()
            self.killed.append(folder)


def test_a_worker_killed_in_every_stage_changes_nothing(done_site: Site) -> None:
    pytest.importorskip("distributed")
    work = done_site.root / "spread"
    with dask_cluster() as (address, processes):
        workers = [*processes[1:], *(dask_worker(address) for _ in range(2))]
        killer = Killer(work, address, workers)
        killer.start()
        try:
            outcome = done_site("run", "--executor", "dask", "--scheduler", address, "--workspace", work)
        finally:
            killer.over.set()
            killer.join()
            for process in killer.workers:
                process.kill()
                process.wait()
    assert outcome.code == 0
    assert killer.killed == [*FOLDERS]
    assert done_site("run", "--workspace", work).done() == {}
    assert contents(work) == contents(done_site.work)
