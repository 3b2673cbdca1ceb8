from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from conftest import heed_interrupts
from dask_cluster import Processes, dask_cluster, dask_worker
from make_slow import Task, slow_square, work, worker_name

from aeromatch_cli.blocks.exif import read_exif
from aeromatch_cli.cli.progress import TerminalProgress
from aeromatch_cli.errors import ConfigError, WorkspaceError
from aeromatch_cli.executor import Executor, Outcome, guarded
from aeromatch_cli.fingerprints import stable_hash
from aeromatch_cli.workers import available_cores


def threads(_: int) -> tuple[int, int, str]:
    """Of OpenCV, of the BLAS that numpy loaded long ago, and for what is loaded later."""
    import cv2
    import numpy as np
    import threadpoolctl

    np.ones((2, 2)) @ np.ones((2, 2))
    loaded = max(library["num_threads"] for library in threadpoolctl.threadpool_info())
    return cv2.getNumThreads(), loaded, os.environ.get("OMP_NUM_THREADS", "")


@dataclass
class Counter:
    """A progress that remembers what it was told."""

    told: list[str] = field(default_factory=list)

    def start(self, label: str, total: int) -> None:
        self.told.append(f"{label} {total}")

    def advance(self, count: int = 1) -> None:
        self.told.append("+")

    def stop(self) -> None:
        self.told.append("end")


@pytest.fixture(scope="module")
def pool():
    """One pool of two workers for all tests that leave it alive."""
    with Executor("processes", 2) as executor:
        yield executor


def test_results_come_in_task_order_whatever_the_executor(pool: Executor) -> None:
    tasks = [Task(number) for number in range(20)]
    serial = Executor("serial").run(work, tasks, "x")
    assert serial == pool.run(work, tasks, "x") == [Outcome(number**2) for number in range(20)]


def test_one_failing_task_leaves_the_others(pool: Executor) -> None:
    tasks = [Task(1), Task(2, "fail"), Task(3, "defect"), Task(4, "memory"), Task(5)]
    for executor in (Executor("serial"), pool):
        found = executor.run(work, tasks, "x")
        assert [one.value for one in found] == [1, None, None, None, 25]
        assert found[1].error == "image 2 is corrupt"
        assert found[2].error.startswith("unexpected IndexError at make_slow.py:")
        assert found[2].error.endswith("an unforeseen thing")
        assert "out of memory" in found[3].error


@pytest.mark.slow
def test_a_worker_that_dies_is_blamed_and_the_rest_is_done(tmp_path: Path) -> None:
    tasks = [Task(number, "die" if number in (3, 9) else "square", str(tmp_path)) for number in range(12)]
    progress = Counter()
    with Executor("processes", 2, progress) as executor:
        found = executor.run(work, tasks, "extract")
        again = executor.run(work, [Task(1), Task(2)], "match")
    assert [one.value for one in found] == [None if number in (3, 9) else number**2 for number in range(12)]
    for number in (3, 9):
        assert "worker process died" in found[number].error
        # In flight with another one, whoever it was, and then alone; or alone at once.
        assert len((tmp_path / str(number)).read_text()) in (1, 2)
    assert [one.value for one in again] == [1, 4]
    assert progress.told.count("+") == 14
    assert progress.told[0] == "extract 12"
    assert progress.told[-1] == "end"


@pytest.mark.slow
def test_a_task_that_dies_once_is_done_in_the_end(tmp_path: Path) -> None:
    tasks = [Task(number, "die-once" if number == 2 else "square", str(tmp_path)) for number in range(5)]
    with Executor("processes", 2) as executor:
        assert [one.value for one in executor.run(work, tasks, "x")] == [0, 1, 4, 9, 16]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_a_full_disk_stops_everything(tmp_path: Path, kind: str) -> None:
    tasks = [Task(0, "disk"), *(Task(number, marks=str(tmp_path)) for number in range(1, 1000))]
    with pytest.raises(WorkspaceError, match="disk full"), Executor(kind, 2) as executor:
        executor.run(work, tasks, "x")
    begun = len(list(tmp_path.iterdir()))
    # Workers have some in hand when the first one fails.
    assert begun == 0 if kind == "serial" else begun < 250


def test_workers_use_one_thread(pool: Executor) -> None:
    before = dict(os.environ)
    assert {one.value for one in pool.run(threads, range(4), "x")} == {(1, 1, "1")}
    assert dict(os.environ) == before


def test_serial_work_uses_one_thread() -> None:
    import cv2

    cv2.setNumThreads(2)
    with Executor("serial", 1) as executor:
        assert executor.run(threads, range(1), "x")[0].value == (1, 1, "1")
    assert cv2.getNumThreads() == 2


def test_no_tasks_are_no_work(pool: Executor) -> None:
    assert Executor("serial").run(work, [], "x") == pool.run(work, [], "x") == []


def test_dask_without_the_extra_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="cluster"):
        Executor("dask").run(work, [Task(1)], "x")


@pytest.mark.slow
def test_dask_gives_what_serial_gives() -> None:
    texts = [f"image {number}" for number in range(20)]
    with Executor("dask", jobs=2) as executor:
        assert executor.run(stable_hash, texts, "x") == Executor("serial").run(stable_hash, texts, "x")
        outcomes = executor.run(read_exif, [Path("nowhere.jpg")], "y")
    assert outcomes[0].value is None
    assert "nowhere.jpg" in outcomes[0].error


def test_cores_are_those_of_this_process() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)


SCRIPT = """
import os, sys, time
from pathlib import Path
from aeromatch_cli.executor import Executor
def slow(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(60)
{guard}
    with Executor("processes", 2) as executor:
        executor.run(slow, [sys.argv[1]] * 4, "x")
"""


def _alive(pid: int) -> bool:
    """Running, and no zombie that nobody has waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_ctrl_c_leaves_no_worker_behind(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.format(guard="if __name__ == '__main__':"))
    marks = tmp_path / "marks"
    marks.mkdir()
    process = subprocess.Popen(
        [sys.executable, str(script), str(marks)], stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    )
    deadline = time.monotonic() + 20
    while len(list(marks.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    workers = [int(path.name) for path in marks.iterdir()]
    assert len(workers) == 2
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=10)
    assert process.returncode != 0
    assert "KeyboardInterrupt" in messages
    deadline = time.monotonic() + 5
    while any(map(_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_alive, workers))


def test_workers_that_cannot_start_are_an_error_and_no_endless_loop(tmp_path: Path) -> None:
    """A script without main guard is run again by every worker, which multiprocessing refuses."""
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.format(guard="if True:"))
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode != 0
    assert "use --executor serial" in done.stderr


@pytest.fixture
def cluster() -> Iterator[tuple[str, Processes]]:
    """Its address, and the workers."""
    pytest.importorskip("distributed")
    with dask_cluster() as (address, processes):
        yield address, processes[1:]


@pytest.mark.slow
def test_a_killed_dask_worker_loses_no_task(cluster: tuple[str, Processes]) -> None:
    address, workers = cluster
    with Executor("dask", scheduler=address) as executor:
        assert [o.value for o in executor.run(slow_square, [3], "first")] == [9]
        deadline = time.monotonic() + 30
        while (came := names(executor)) != {"plain", "gpu"} and time.monotonic() < deadline:
            time.sleep(0.05)
        assert came == {"plain", "gpu"}
        done: list[int] = []

        def kill() -> None:
            while executor._tried < 2 and time.monotonic() < deadline:
                time.sleep(0.01)
            done.append(executor._tried)
            workers[0].kill()

        killer = threading.Thread(target=kill)
        killer.start()
        outcomes = executor.run(slow_square, list(range(10)), "squares")
        killer.join()
    assert [outcome.value for outcome in outcomes] == [number**2 for number in range(10)]
    assert 2 <= done[0] < 8  # the killed worker had its task, and others waited
    assert workers[0].wait(10) != 0


def names(executor: Executor) -> set[str]:
    """Of the dask workers that have come."""
    return {str(worker["name"]) for worker in executor._client.scheduler_info()["workers"].values()}


@pytest.mark.slow
def test_networks_run_where_a_gpu_is_offered(cluster: tuple[str, Processes]) -> None:
    address, workers = cluster
    with Executor("dask", scheduler=address) as executor:
        deadline = time.monotonic() + 30
        anywhere: set[str | None] = set()
        while anywhere != {"plain", "gpu"} and time.monotonic() < deadline:  # both have come
            anywhere = {outcome.value for outcome in executor.run(worker_name, range(8), "any")}
        assert anywhere == {"plain", "gpu"}
        chosen = {outcome.value for outcome in executor.run(worker_name, range(8), "network", network=True)}
        assert chosen == {"gpu"}
        workers[1].kill()
        workers[1].wait()
        while (left := len(executor._client.scheduler_info()["workers"])) > 1 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert left == 1
        # Without any, the others do.
        assert {o.value for o in executor.run(worker_name, range(4), "network", network=True)} == {"plain"}


def run_out(what: str) -> None:
    raise MemoryError if what == "memory" else RuntimeError(what)


@dataclass
class Unreadable:
    """A task that needs memory while it is read by a worker, the first time."""

    mark: Path

    def __setstate__(self, state: dict[str, Path]) -> None:
        self.__dict__ |= state
        if not self.mark.exists():
            self.mark.touch()
            raise MemoryError


def marked(task: Unreadable) -> bool:
    return task.mark.exists()


@pytest.mark.slow
def test_a_worker_without_memory_for_its_task_ends_silently(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "b").touch()  # a worker reads this one
    with Executor("processes", 2) as executor:
        outcomes = executor.run(marked, [Unreadable(tmp_path / "a"), Unreadable(tmp_path / "b")], "x")
    assert [outcome.value for outcome in outcomes] == [True, True]
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("what", ["memory", "DefaultCPUAllocator: can't allocate memory", "std::bad_alloc"])
def test_a_lack_of_memory_is_the_machines(what: str) -> None:
    outcome = guarded(run_out, what)
    assert (outcome.value, outcome.lost) == (None, True)
    assert outcome.error.startswith("out of memory; use --max-size")
    assert not guarded(run_out, "other").lost


@pytest.mark.slow
def test_a_scheduler_that_is_lost_while_results_travel_is_named(
    cluster: tuple[str, Processes], monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import Future
    from distributed.comm.core import CommClosedError

    def closed(_: object) -> None:
        raise CommClosedError("Stream is closed")

    monkeypatch.setattr(Future, "result", closed)
    with (
        Executor("dask", scheduler=cluster[0]) as executor,
        pytest.raises(WorkspaceError, match=r"the dask scheduler tcp://.* is lost: start it again"),
    ):
        executor.run(slow_square, [1], "x")


@pytest.mark.slow
def test_a_scheduler_without_workers_is_said_and_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("distributed")
    with dask_cluster() as (address, (_, *workers)), caplog.at_level("INFO", logger="aeromatch"):
        for worker in workers:
            worker.kill()
            worker.wait()
        waiting = f"the dask scheduler {address} has no workers: waiting for one"

        def come() -> None:
            deadline = time.monotonic() + 30
            while waiting not in caplog.text and time.monotonic() < deadline:
                time.sleep(0.05)
            workers.append(dask_worker(address, "--name", "late"))

        late = threading.Thread(target=come)
        late.start()
        with Executor("dask", scheduler=address) as executor:
            assert executor.run(slow_square, [3], "x")[0].value == 9
        late.join()
        assert waiting in caplog.text
        workers[-1].kill()
        workers[-1].wait()


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("aeromatch_cli.dask_client._CONNECT_S", 1.0)
    with pytest.raises(ConfigError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1:9: start one"):
        Executor("dask", scheduler="tcp://127.0.0.1:9").run(slow_square, [1], "x")


@pytest.mark.slow
def test_a_server_of_another_kind_is_no_dask_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes the connection, and never says what dask waits for."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("aeromatch_cli.dask_client._ANSWER_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            Executor("dask", 1, scheduler=address) as executor,
            pytest.raises(ConfigError, match=r"no dask scheduler answers at .* \(no answer within 1 s\)"),
        ):
            executor.run(slow_square, [1], "x")


def test_work_inside_a_step_is_part_of_it_in_a_terminal() -> None:
    executor = Executor("serial", 1, TerminalProgress())
    with executor.step("report"):
        outcomes = executor.run(abs, [-1, 2], "pictures")
    assert [outcome.value for outcome in outcomes] == [1, 2]
    assert [outcome.value for outcome in executor.run(abs, [-3], "shown again")] == [3]
