"""run_tasks(function, tasks): serial, processes or dask. Nothing else in the package knows how work is spread.

A task is a small picklable object that names its files; results come back in task order whatever finished first. One
failing task never stops the others, except when the disk or the workspace itself fails: then nothing can be saved.
"""

from __future__ import annotations

import logging
import os
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from aeromatch_cli.dask_client import connected, has_workers, offers_gpu
from aeromatch_cli.errors import AeromatchError, ConfigError, WorkspaceError, lacks_memory
from aeromatch_cli.workers import (
    WorkerContext,
    available_cores,
    interrupts_held,
    one_thread,
    single_threaded,
    start_worker,
    worker_environment,
)

T = TypeVar("T")
R = TypeVar("R")
log = logging.getLogger("aeromatch")
# For the log file only: the screen shows progress in its own way.
record = logging.getLogger("aeromatch.record")
# How often a task is given to another dask worker.
_DASK_RETRIES = 3


class Progress(Protocol):
    """Told about the advance of one stage; the command line draws it."""

    def start(self, label: str, total: int) -> None: ...

    def advance(self, count: int = 1) -> None: ...

    def stop(self) -> None: ...


class SilentProgress:
    """Draws nothing."""

    def start(self, label: str, total: int) -> None:
        """A stage of `total` items begins."""

    def advance(self, count: int = 1) -> None:
        """One task is finished."""

    def stop(self) -> None:
        """The stage is over."""


@dataclass(frozen=True)
class Outcome(Generic[R]):
    """What became of one task: a value, or the reason why there is none.

    lost: whether the reason lies with the machine (memory, a worker that died), so that another try may do.
    """

    value: R | None
    error: str = ""
    lost: bool = False


def guarded(function: Callable[[T], R], task: T) -> Outcome[R]:
    """Run one task; a user's error becomes its message, a defect its traceback's last line. Disk failures pass."""
    try:
        return Outcome(function(task))
    except WorkspaceError:
        raise
    except AeromatchError as error:
        return Outcome(None, str(error))
    except Exception as error:  # noqa: BLE001 - one item must never stop the rest; the report names it
        if lacks_memory(error):
            return Outcome(None, "out of memory; use --max-size or fewer --jobs", lost=True)
        log.debug("%s", traceback.format_exc())
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{os.path.basename(frame.filename)}:{frame.lineno}"  # noqa: PTH119
        return Outcome(None, f"unexpected {type(error).__name__} at {where}: {error}")


class Executor:
    """Runs tasks; keeps its workers between stages. Use as a context manager."""

    def __init__(
        self, kind: str = "serial", jobs: int = 0, progress: Progress | None = None, scheduler: str = ""
    ) -> None:
        """scheduler: address of a dask scheduler; "" for a local cluster."""
        self.kind = kind
        self._scheduler = scheduler or os.environ.get("DASK_SCHEDULER_ADDRESS", "")
        self.jobs = 1 if kind == "serial" else jobs or available_cores()
        self.progress = progress or SilentProgress()
        self._tried = 0
        self._sizes: Sequence[int] | None = None
        self._pool: ProcessPoolExecutor | None = None
        self._workers = 0  # of the pool
        self._client: Any = None

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        self.close(cancel=error is not None)

    def limit(self, jobs: int) -> None:
        """At most so many workers from now on. The others end."""
        if jobs < self.jobs:
            self.close()
            self.jobs = jobs

    def close(self, *, cancel: bool = False) -> None:
        if self._pool is not None:
            workers = list((getattr(self._pool, "_processes", None) or {}).values())
            manager = getattr(self._pool, "_executor_manager_thread", None)
            self._pool.shutdown(wait=not cancel, cancel_futures=True)
            if cancel:
                for worker in workers:
                    worker.terminate()
                for worker in workers:
                    worker.join(timeout=5.0)
                if manager is not None:  # else it closes its pipe while the interpreter's exit writes to it
                    manager.join(timeout=5.0)
            self._pool = None
        if self._client is not None:
            self._client.close()
            self._client = None

    def run(
        self,
        function: Callable[[T], R],
        tasks: Sequence[T],
        label: str,
        sizes: Sequence[int] | None = None,
        *,
        network: bool = False,
    ) -> list[Outcome[R]]:
        """Outcomes in task order. sizes: how many items each task counts in what is shown of the advance, by default 1.
        network: whether the tasks run a network, which dask workers that offer a GPU do, where there are any.

        Raises WorkspaceError when results can no longer be saved.
        """
        started = time.monotonic()
        record.info("%s: %d to do", label, len(tasks))
        self._tried, self._sizes = 0, sizes
        self.progress.start(label, len(tasks) if sizes is None else sum(sizes))
        try:
            if self.kind == "dask":
                return self._run_dask(function, tasks, network=network)
            if self.jobs == 1 or len(tasks) <= 1:
                return self._run_serial(function, tasks)
            return self._run_processes(function, tasks)
        finally:
            self.progress.stop()
            record.info("%s: %d of %d tried in %.1f s", label, self._tried, len(tasks), time.monotonic() - started)

    @contextmanager
    def step(self, label: str) -> Iterator[None]:
        """Shows a part that this process waits for, as one item; what runs inside it is not shown."""
        started = time.monotonic()
        record.info("%s: started", label)
        shown, self.progress = self.progress, SilentProgress()
        shown.start(label, 1)
        try:
            yield
            shown.advance()
        finally:
            self.progress = shown
            shown.stop()
            record.info("%s: %.1f s", label, time.monotonic() - started)

    def _advance(self, index: int) -> None:
        """The task at `index` is done."""
        self._tried += 1
        self.progress.advance(1 if self._sizes is None else self._sizes[index])

    def _run_serial(self, function: Callable[[T], R], tasks: Sequence[T]) -> list[Outcome[R]]:
        outcomes = []
        with one_thread():
            for index, task in enumerate(tasks):
                outcomes.append(guarded(function, task))
                self._advance(index)
        return outcomes

    def _run_processes(self, function: Callable[[T], R], tasks: Sequence[T]) -> list[Outcome[R]]:
        outcomes: dict[int, Outcome[R]] = {}
        waiting = list(range(len(tasks)))
        in_flight: list[int] = []
        while waiting:
            in_flight = self._drain(function, tasks, waiting, outcomes)
            waiting = [index for index in waiting if index not in outcomes and index not in in_flight]
            # A dead worker (killed for memory, a crash in a native library) takes the pool with it and does not say
            # which task it had: each task that was in flight is tried again alone, and blamed only if it dies alone.
            for index in in_flight:
                alone = self._drain(function, tasks, [index], outcomes)
                if alone:
                    words = "its worker process died (out of memory, or a crash in a library)"
                    outcomes[index] = Outcome(None, words, lost=True)
                    self._advance(index)
        return [outcomes[index] for index in range(len(tasks))]

    def _drain(
        self, function: Callable[[T], R], tasks: Sequence[T], indices: Sequence[int], outcomes: dict[int, Outcome[R]]
    ) -> list[int]:
        """Run the tasks at `indices`; returns those in flight when a worker died, none if all went well."""
        pool, queue = self._start(min(self.jobs, len(tasks))), iter(indices)
        flying: dict[Future[Outcome[R]], int] = {}
        try:
            while True:
                # Two per worker in flight: enough to keep them busy, few to repeat when one dies.
                for index in queue:
                    flying[pool.submit(guarded, function, tasks[index])] = index
                    if len(flying) >= 2 * self.jobs:
                        break
                if not flying:
                    return []
                finished, _ = wait(flying, return_when=FIRST_COMPLETED)
                for future in finished:
                    # The result of a broken pool raises: the task is still in flight then.
                    index = flying[future]
                    outcomes[index] = future.result()
                    del flying[future]
                    self._advance(index)
        except BrokenProcessPool:
            self._pool = None
            return sorted(flying.values())

    def _start(self, workers: int) -> ProcessPoolExecutor:
        """A pool of at least so many workers."""
        if self._pool is not None and self._workers >= workers:
            return self._pool
        self.close()
        with worker_environment():
            self._pool = ProcessPoolExecutor(workers, mp_context=WorkerContext(), initializer=start_worker)
            self._workers = workers
            # Spawning is lazy: make every worker now, while the environment says one thread. They are born deaf
            # to Ctrl-C: before their initializer has run they would print tracebacks.
            with interrupts_held():
                first = [self._pool.submit(os.getpid) for _ in range(workers)]
            try:
                for future in first:
                    future.result()
            except BrokenProcessPool:
                self._pool = None
                raise ConfigError(
                    f"worker processes die at their start (too little memory for {workers} jobs, or a script "
                    "without `if __name__ == '__main__':`); use --executor serial"
                ) from None
        return self._pool

    def _run_dask(self, function: Callable[[T], R], tasks: Sequence[T], *, network: bool) -> list[Outcome[R]]:
        try:
            from distributed import Client, as_completed
            from distributed.comm.core import CommClosedError
        except ImportError:
            raise ConfigError(
                "run.executor=dask needs the extra: pip install 'aeromatch[cluster]', or use --executor processes"
            ) from None
        try:
            return self._gathered(self._dask_client(Client), as_completed, function, tasks, network=network)
        except (CommClosedError, CancelledError) as error:  # a connection that closes while results travel
            assert self._client is not None
            raise _lost_scheduler(self._client) from error

    def _gathered(
        self,
        client: Any,
        as_completed: Callable[..., Any],
        function: Callable[[T], R],
        tasks: Sequence[T],
        *,
        network: bool,
    ) -> list[Outcome[R]]:
        # A worker that is lost takes its task with it: that is given to another one, so many times.
        needs = {"GPU": 1.0} if network and offers_gpu(client) else None
        many = [function] * len(tasks)
        futures = client.map(guarded, many, tasks, pure=False, retries=_DASK_RETRIES, resources=needs)
        places = {future.key: index for index, future in enumerate(futures)}
        outcomes: dict[int, Outcome[R]] = {}
        for future in as_completed(futures):
            index = places[future.key]
            if future.status == "finished":
                outcomes[index] = future.result()
            elif future.status == "error" and not isinstance(error := future.exception(), WorkspaceError):
                outcomes[index] = Outcome(None, f"its dask worker was lost ({type(error).__name__})", lost=True)
            elif future.status == "error":
                raise error
            else:
                raise _lost_scheduler(client)
            self._advance(index)
        return [outcomes[index] for index in range(len(tasks))]

    def _dask_client(self, connect: Callable[..., Any]) -> Any:
        if self._client is None:
            self._client = connected(connect, self._scheduler, self.jobs)
            # Of workers that come later, too.
            self._client.register_worker_callbacks(setup=single_threaded)
            if self._client.dashboard_link:
                log.info("dask dashboard at %s", self._client.dashboard_link)
            if not has_workers(self._client):
                log.warning(
                    "warning: the dask scheduler %s has no workers: waiting for one (`dask worker %s --nthreads 1`)",
                    self._scheduler,
                    self._scheduler,
                )
        return self._client


def _lost_scheduler(client: Any) -> WorkspaceError:
    lost = f"the dask scheduler {client.scheduler.address} is lost"
    return WorkspaceError(f"{lost}: start it again, and run the same command, which goes on")
