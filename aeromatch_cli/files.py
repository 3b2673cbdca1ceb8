"""Files of a workspace: how they are written and read, and how it is known that they are as they were written.

Files appear under their final name complete or not at all. JSON ends with a checksum of itself.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import socket
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.fingerprints import file_digest
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.results.record import Record

R = TypeVar("R", bound=Record)

log = logging.getLogger("aeromatch")
# What precedes the checksum of a JSON file.
_CHECKSUM = ',\n "checksum": "'


def _host() -> str:
    """This machine in a file name; no dots, which separate the parts of a temporary name."""
    return socket.gethostname().replace(".", "-")


def temporary_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{_host()}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp")


@contextlib.contextmanager
def translated_os_errors(path: Path) -> Iterator[None]:
    """Turn failures of the disk into WorkspaceError: what, where, what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise WorkspaceError(
                f"disk full while writing {path}; free space and run the same command again, it resumes"
            ) from error
        if error.errno in (errno.EISDIR, errno.ENOTEMPTY):
            raise WorkspaceError(
                f"cannot write {path}: a folder stands where the file belongs; move it away"
            ) from error
        if error.errno in (errno.EEXIST, errno.ENOTDIR):
            raise WorkspaceError(
                f"cannot write {path}: a file stands where a folder is needed; choose another --workspace"
            ) from error
        reason = error.strerror or error
        raise WorkspaceError(f"cannot write {path} ({reason}); choose another --workspace") from error


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write beside `path` and rename: a reader or a killed run never sees half a file.

    No fsync: after a power cut a file may be empty, which the readers treat as absent.
    """
    with translated_os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(path)
        try:
            with temporary.open("wb") as stream:
                write(stream)
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Atomic, UTF-8; a file that already holds the text is left untouched."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Atomic; a file that already holds the bytes is left untouched."""
    with translated_os_errors(path):
        if path.is_file() and path.read_bytes() == data:
            return
    write_atomically(path, lambda stream: stream.write(data))


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """An object that is not empty; its last key is the checksum of what stands before."""
    text = json.dumps(value, indent=1, sort_keys=False, allow_nan=False)
    write_text(path, _with_checksum(text.removesuffix("\n}")))


def _with_checksum(head: str) -> str:
    return f'{head}{_CHECKSUM}{zlib.crc32(head.encode("utf-8")):08x}"\n}}\n'


def read_json(path: Path) -> dict[str, Any]:
    """The object that `write_json` wrote. Raises BrokenFileError on anything else."""
    with readable(path, ValueError):
        text = path.read_text(encoding="utf-8")
        value = json_object(text)
        if text != _with_checksum(text.rpartition(_CHECKSUM)[0]):
            raise ValueError("its contents contradict its checksum")
        del value["checksum"]
    return value


def read_record(path: Path, kind: type[R]) -> R | None:
    """Return the record that a file holds; None where there is no file, or one of another version. Raises
    BrokenFileError."""
    return kind.of_json(read_json(path)) if path.is_file() else None


def json_object(text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it holds no JSON object")
    return value


def digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of files below a folder, by their names in it."""
    return {name: file_digest(folder / name) for name in sorted(names)}


def changed_files(folder: Path, known: Mapping[str, str], digest: Callable[[Path], str] = file_digest) -> list[str]:
    """Return the names of files below a folder that are gone or no longer have the digests that are known of them.
    digest: gives that of a file; by default it reads the file."""
    return [name for name, one in known.items() if not (folder / name).is_file() or digest(folder / name) != one]


def remove_stale_temporaries(root: Path) -> None:
    """Delete what a killed process of this machine left behind; files of live processes stay."""
    # os.walk passes over folders that another process removes meanwhile; Path.rglob raises.
    names = (Path(parent) / name for parent, _, files in os.walk(root) for name in files if name.endswith(".tmp"))
    for path in names:
        parts = path.name.rsplit(".", 4)
        # In a container a restarted run has the process id of the killed one: no file of its own exists yet.
        ours = len(parts) == 5 and path.name.startswith(".") and parts[1] == _host() and parts[2].isdigit()
        if ours and (int(parts[2]) == os.getpid() or not _alive(int(parts[2]))):
            with contextlib.suppress(OSError):
                path.unlink()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        facts = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return True  # no Linux
    # A zombie was killed and its parent has not asked for it yet: it writes nothing any more.
    return facts.rpartition(")")[2].split()[0] != "Z"
