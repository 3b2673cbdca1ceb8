"""Reading files: those that a user names, and what reading one of the workspace may raise."""

from __future__ import annotations

import errno
import logging
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from aeromatch_cli.errors import BrokenFileError, WorkspaceError

log = logging.getLogger("aeromatch")


def given_bytes(path: Path) -> bytes:
    """Contents of a file that a user names. Raises OSError, of pipes and devices too: their reading may never end."""
    check_given(path)
    return path.read_bytes()


def check_given(path: Path) -> None:
    """Raises OSError for what is missing, or neither a file nor a folder."""
    kind = path.stat().st_mode
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise OSError(errno.EINVAL, "it is a pipe or a device")


def text_encoding(raw: bytes) -> str:
    """ "utf-16" where text begins with its mark, else "utf-8-sig", UTF-8 with or without one."""
    return "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def say_damaged(path: Path, error: BrokenFileError) -> None:
    """A word on a file that counts as absent because it is broken; none on one that is absent."""
    if path.is_file():
        log.warning("warning: %s is damaged (%s)", path, error.reason)


@contextmanager
def readable(path: Path, *faults: type[Exception]) -> Iterator[None]:
    """Turn what reading a file of the workspace raises into BrokenFileError, or into WorkspaceError where the file
    itself may be sound (permissions, a failing disk). faults: what broken contents raise.
    """
    try:
        yield
    except faults as error:
        raise BrokenFileError(str(path), str(error) or type(error).__name__) from None
    except FileNotFoundError as error:
        raise BrokenFileError(str(path), error.strerror or "no such file") from None
    except IsADirectoryError:
        raise WorkspaceError(f"cannot read {path}: a folder stands where the file belongs; move it away") from None
    except OSError as error:
        raise WorkspaceError(f"cannot read {path}: {error.strerror or error}; check its permissions and disk") from None
