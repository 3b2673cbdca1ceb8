"""The log file of a command: all that the screen says, when it began, what each stage did, and how it ended."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from aeromatch_cli.errors import ConfigError

LOGGER = "aeromatch"
# What the screen shows in its own way: for the log file only.
record = logging.getLogger(f"{LOGGER}.record")


@contextmanager
def logged_to(log_file: Path | None, *, quiet: bool) -> Iterator[None]:
    """Messages to stderr, and all of them and the record, with time, to the log file. Raises ConfigError."""
    logger = logging.getLogger(LOGGER)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    screen = logging.StreamHandler(sys.stderr)
    screen.setLevel(logging.ERROR if quiet else logging.INFO)
    screen.setFormatter(logging.Formatter("%(message)s"))
    screen.addFilter(lambda message: message.name != record.name)
    handlers: list[logging.Handler] = [screen]
    if log_file is not None:
        try:
            log_file.parent.mkdir(parents=True, exist_ok=True)
            file = logging.FileHandler(log_file, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"--log-file {log_file} cannot be written: {error.strerror}") from None
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        handlers.append(file)
    for handler in handlers:
        logger.addHandler(handler)
    logging.raiseExceptions = False  # a log file on a full disk must not print tracebacks
    try:
        yield
    finally:
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()
