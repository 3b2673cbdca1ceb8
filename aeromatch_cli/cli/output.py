"""Results to stdout, messages to stderr and the log file, errors to exit codes."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from aeromatch_cli import __version__
from aeromatch_cli.errors import AeromatchError, ConfigError, lacks_memory

if TYPE_CHECKING:
    from aeromatch_cli.stages.command_result import Result

EXIT_SOME_FAILED = 1
EXIT_DOUBTFUL = 4
EXIT_INTERRUPTED = 130
# Where the application keeps the arguments as they were written, in the object of the root context.
ARGUMENTS = "aeromatch.arguments"
# And when its process began, on the clock of time.monotonic(); absent where a command is called in another program.
STARTED = "aeromatch.started"
_FAILURES_SHOWN = 5
_LONGEST_WORD = 1000
LOGGER = "aeromatch"
# What the screen shows in its own way: for the log file only.
record = logging.getLogger(f"{LOGGER}.record")


def guarded(
    call: Callable[[], Result],
    command: str,
    *,
    quiet: bool,
    as_json: bool,
    log_file: Path | None,
    context: typer.Context | None = None,
    strict: bool = False,
) -> None:
    """Run one command; print its result, or its error, and leave with the right exit code. strict: a doubtful result
    has one of its own."""
    started = time.monotonic()
    with ExitStack() as stack:

        def logged() -> Result:
            stack.enter_context(logged_to(log_file, quiet=quiet))
            record.info("aeromatch %s: aeromatch %s", __version__, shlex.join(_arguments(context)))
            with _terminated_like_interrupt():
                return call()

        facts: dict[str, Any] = {"command": command} | _outcome(logged, quiet=quiet, strict=strict)
        record.info("exit code %d after %.1f s", facts["exit_code"], time.monotonic() - started)
    if as_json:
        printed(json.dumps(_finite(facts), allow_nan=False))
    if facts["exit_code"]:
        raise typer.Exit(int(facts["exit_code"]))


def _arguments(context: typer.Context | None) -> Sequence[str]:
    return () if context is None else tuple(context.find_root().obj[ARGUMENTS])


def _outcome(call: Callable[[], Result], *, quiet: bool, strict: bool) -> dict[str, Any]:
    """The facts of one call, with its exit code; its lines, or its error, are printed and recorded."""
    try:
        result = call()
    except AeromatchError as error:
        text = _shortened(str(error))
        printed(f"error: {text}", err=True)
        record.error("error: %s", text)
        record.debug("stopped by", exc_info=True)
        return {"error": text, "exit_code": error.exit_code}
    except KeyboardInterrupt:
        _forget_interrupt()
        printed("interrupted; run the same command again to resume", err=True)
        record.error("interrupted")
        return {"error": "interrupted", "exit_code": EXIT_INTERRUPTED}
    except Exception as error:  # noqa: BLE001 - recorded: a defect must not look like exit code 1, "some items failed"
        frame = traceback.extract_tb(error.__traceback__)[-1]
        text = f"unexpected {type(error).__name__} in {Path(frame.filename).name}:{frame.lineno}: {error}"
        remedy = "this is a defect of aeromatch, --log-file FILE keeps its traceback"
        if lacks_memory(error):
            text = "out of memory"
            remedy = "use fewer --jobs, or --max-size, and run the same command again, which goes on"
        printed(f"error: {text}; {remedy}", err=True)
        record.error("error: %s", text, exc_info=True)
        return {"error": text, "exit_code": AeromatchError.exit_code}
    say = said(quiet)
    for line in result.lines:
        say(line)
    if quiet:  # what failed is an error, and a result that is not whole must not pass for a good one
        for failure in result.failures[:_FAILURES_SHOWN]:
            printed(": ".join(failure[1:]), err=True)
        if len(result.failures) > _FAILURES_SHOWN:
            printed(f"and {len(result.failures) - _FAILURES_SHOWN} more", err=True)
        for line in result.urgent:
            printed(line, err=True)
    return result.facts | {"exit_code": _exit_code(result, strict=strict)}


def _exit_code(result: Result, *, strict: bool) -> int:
    if result.failures or result.verdict == "bad":
        return EXIT_SOME_FAILED
    return EXIT_DOUBTFUL if strict and result.verdict == "doubtful" else 0


def _shortened(text: str) -> str:
    """Without the middle of very long words: a cell of a file may hold megabytes."""
    return re.sub(rf"\S{{{_LONGEST_WORD},}}", lambda found: f"{found[0][:60]}...{found[0][-20:]}", text)


def said(quiet: bool) -> Callable[[str], None]:
    """Prints a line, unless `quiet`, and records it."""

    def say(line: str) -> None:
        record.info("%s", line)
        if not quiet:
            printed(line)

    return say


def printed(line: str, *, err: bool = False) -> None:
    """To stdout or stderr. Where its reader has left (`| head`), the work goes on and nothing more is said."""
    try:
        typer.echo(line, err=err)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if err else sys.stdout).fileno())


def _finite(value: Any) -> Any:
    """JSON knows no NaN: it becomes null."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _forget_interrupt() -> None:
    """Keeps the exit code: `python -m` ends as if killed by SIGINT where an interrupt has left code that was made from
    text, as dataclasses make it while a module is imported. Running other such code takes that mark away.
    """
    exec("")


@contextmanager
def _terminated_like_interrupt() -> Iterator[None]:
    """SIGTERM (a scheduler's time limit) stops as cleanly as Ctrl-C."""

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def as_texts(values: dict[str, Any]) -> dict[str, Any]:
    """Given options only, paths as text."""
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if v is not None}


def as_epilog(examples: Sequence[str]) -> str:
    """Examples below a command's help, each on a line of its own: \b keeps click from filling the paragraph."""
    return "\b\nExamples:\n" + "\n".join(f"  {example}" for example in examples)


def _once() -> Callable[[logging.LogRecord], bool]:
    """A filter that lets the same words through once: the first pass, every step of a cascade and the stage that joins
    them meet the same broken image."""
    said = set[str]()

    def is_new(message: logging.LogRecord) -> bool:
        words, before = message.getMessage(), len(said)
        said.add(words)
        return len(said) > before

    return is_new


@contextmanager
def logged_to(log_file: Path | None, *, quiet: bool) -> Iterator[None]:
    """Send messages to stderr, and all of them and the record, with time, to the log file: when the command began, what
    each stage did, and how it ended. Raises ConfigError."""
    logger = logging.getLogger(LOGGER)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    screen = logging.StreamHandler(sys.stderr)
    screen.setLevel(logging.ERROR if quiet else logging.INFO)
    screen.setFormatter(logging.Formatter("%(message)s"))
    screen.addFilter(lambda message: message.name != record.name)
    screen.addFilter(_once())
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
