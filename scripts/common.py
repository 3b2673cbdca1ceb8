"""What the training scripts share with the benchmarks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from aeromatch_cli.errors import AeromatchError


@contextmanager
def errors_as_exits() -> Iterator[None]:
    """The package's errors as message and exit code."""
    try:
        yield
    except AeromatchError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
