"""Connecting with a dask scheduler, and what its workers offer."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from aeromatch_cli.errors import ConfigError

# Where a scheduler listens, it takes the connection within the first time; one that is busy answers within the second.
_CONNECT_S = 10.0
_ANSWER_S = 30.0
T = TypeVar("T")


def connected(client: Callable[..., Any], scheduler: str, jobs: int) -> Any:
    """distributed's Client of a scheduler, or of a cluster on this machine with so many workers where none is named.

    Raises ConfigError where no scheduler answers.
    """
    # dask would write tracebacks of what is said here in words: a lost worker, a lost scheduler.
    for name in ("distributed", "distributed.client", "distributed.nanny", "distributed.worker"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if not scheduler:
        # Port 0: one that is free. Two runs on one machine have their own.
        return client(None, n_workers=jobs, threads_per_worker=1, dashboard_address="127.0.0.1:0")
    try:
        return _within(_ANSWER_S, lambda: client(scheduler, timeout=_CONNECT_S))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no dask scheduler answers at {scheduler}: start one (`dask scheduler`), or leave out --scheduler "
            f"({error})"
        ) from None


def _within(seconds: float, make: Callable[[], T]) -> T:
    """What `make` returns or raises. TimeoutError where that takes longer: dask waits for ever for the first words of
    another kind of server."""
    found: list[T] = []
    raised: list[Exception] = []

    def call() -> None:
        try:
            found.append(make())
        except Exception as error:  # noqa: BLE001 - raised again below
            raised.append(error)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    if not found:
        raise TimeoutError(f"no answer within {seconds:.0f} s")
    return found[0]


def has_workers(client: Any) -> bool:
    """Whether any worker is connected now."""
    return bool(client.scheduler_info()["workers"])


def offers_gpu(client: Any) -> bool:
    """Whether a worker was started with `--resources GPU=1`."""
    return any(worker.get("resources", {}).get("GPU") for worker in client.scheduler_info()["workers"].values())
