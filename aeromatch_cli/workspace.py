"""Where everything lies in a workspace, how it is written, and how it is known to be up to date.

Resume rests on evidence: a result counts as done when it is present and its fingerprint equals the one that the
current settings and inputs give. Files appear under their final name complete or not at all.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from aeromatch_cli.errors import InputError, WorkspaceError
from aeromatch_cli.fingerprints import file_digest
from aeromatch_cli.formats.reading import readable

log = logging.getLogger("aeromatch")

FORMAT_VERSION = 1
# What precedes the checksum of a JSON file.
_CHECKSUM = ',\n "checksum": "'


@dataclass(frozen=True)
class Workspace:
    """Every path and file name below one root folder. Holds no state.

    features_of: the workspace whose features this one uses, None for its own.
    """

    root: Path
    features_of: Workspace | None = None

    @property
    def lock(self) -> Path:
        return self.root / ".lock"

    @property
    def config(self) -> Path:
        return self.root / "config.yaml"

    @property
    def block(self) -> Path:
        return self.root / "block.json"

    @property
    def images(self) -> Path:
        return self.root / "images.csv"

    @property
    def cameras(self) -> Path:
        return self.root / "cameras.csv"

    @property
    def poses(self) -> Path:
        return self.root / "poses.csv"

    @property
    def pairs(self) -> Path:
        return self.root / "pairs.csv"

    @property
    def failures(self) -> Path:
        return self.root / "failures.csv"

    @property
    def finished(self) -> Path:
        """What a run that ended without a failure has left, to know whether anything has changed since."""
        return self.root / "finished.json"

    @property
    def orientation(self) -> Path:
        return self.root / "orientation"

    @property
    def adjusted(self) -> Path:
        return self.orientation / "adjusted.npz"

    @property
    def final(self) -> Path:
        """The adjusted block without what only dropped matches have held; absent where that is nothing."""
        return self.orientation / "final.npz"

    @property
    def final_or_adjusted(self) -> Path:
        return self.final if self.final.is_file() else self.adjusted

    @property
    def dropped(self) -> Path:
        """Verified matches that contradict the adjusted block."""
        return self.orientation / "dropped.npz"

    @property
    def first_pass(self) -> Workspace:
        """The first pass is a small workspace of its own."""
        return Workspace(self.orientation / "first_pass")

    def step(self, name: str, features_of: str) -> Workspace:
        """A step of a cascade is a workspace of its own. features_of: the step whose features it uses."""
        root = self.root / "steps"
        return Workspace(root / name, None if features_of == name else Workspace(root / features_of))

    @property
    def steps(self) -> Path:
        return self.root / "steps.csv"

    @property
    def reports(self) -> Path:
        return self.root / "reports"

    @property
    def exports(self) -> Path:
        """Record of the files that the exporters wrote."""
        return self.root / "export" / "files.json"

    @property
    def evaluation(self) -> Path:
        return self.root / "evaluation"

    @property
    def report(self) -> Path:
        return self.root / "report" / "index.html"

    @property
    def report_files(self) -> Path:
        """Record of the report's files."""
        return self.root / "report" / "files.json"

    def enhanced(self, image_id: str, suffix: str) -> Path:
        return self._pictures / "enhanced" / f"{image_id}{suffix}"

    def views(self, image_id: str) -> Path:
        return self._pictures / "simulated" / image_id / "views.json"

    def view(self, image_id: str, view_name: str) -> Path:
        return self._pictures / "simulated" / image_id / f"{view_name}.png"

    def features(self, image_id: str) -> Path:
        return self._pictures / "features" / f"{image_id}.npz"

    @property
    def _pictures(self) -> Path:
        """Where features lie, and the records of the views that they were found in."""
        return (self.features_of or self).root

    def matches(self, image_id0: str) -> Path:
        return self.root / "matches" / f"{image_id0}.npz"

    def verified(self, image_id0: str) -> Path:
        return self.root / "verified" / f"{image_id0}.npz"

    def refined(self, image_id: str) -> Path:
        """Where its keypoints were measured anew."""
        return self.root / "refined" / f"{image_id}.npz"

    @property
    def refined_files(self) -> Path:
        """Record of these files."""
        return self.root / "refined" / "files.json"

    def export(self, exporter: str) -> Path:
        return self.root / "export" / exporter

    def changed_tables(self) -> list[str]:
        """Names of the tables of the block that are not as they were written, or gone. Raises as `check_version`."""
        self.check_version()
        if not self.block.is_file():
            return []
        record = read_json(self.block)
        return changed_files(self.root, record) if "files" in record else []  # none of earlier versions

    def check_tables(self) -> None:
        """Raises WorkspaceError where a table of the block is not as it was written."""
        if changed := self.changed_tables():
            words = "is damaged or was edited: run `aeromatch run`, which makes it again"
            raise WorkspaceError(f"{self.root / changed[0]} {words}")

    def stage_report(self, stage: str, shard: str = "") -> Path:
        return self.reports / (f"{stage}.{shard}.json" if shard else f"{stage}.json")

    def create(self) -> None:
        """Make the folder and prove that it can be written; refuse one of another format version, or with links that
        lead out of it."""
        with translated_os_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
        self.check_links()
        self.check_version()
        probe = _temporary_name(self.root / "writable")
        with translated_os_errors(self.root):
            probe.touch()
            probe.unlink()
        remove_stale_temporaries(self.root)

    def check_links(self) -> None:
        """Raises WorkspaceError where a link leads out of the folder: what is written through it would land there."""
        root = self.root.resolve()
        for parent, folders, files in os.walk(root):
            for path in (Path(parent) / name for name in (*folders, *files)):
                if path.is_symlink() and not path.resolve().is_relative_to(root):
                    raise WorkspaceError(
                        f"{path} is a link that leads out of the workspace, to {path.resolve()}: remove it; to keep "
                        "results on another disk, place the whole workspace there"
                    )

    def check_version(self) -> None:
        """Raises WorkspaceError where another format version wrote this workspace."""
        if not self.block.exists():
            return
        with readable(self.block, ValueError):  # of other versions it may have no checksum
            found = _object(self.block.read_text(encoding="utf-8")).get("format_version")
        if found != FORMAT_VERSION:
            raise WorkspaceError(
                f"workspace {self.root} has format version {found}, this program writes {FORMAT_VERSION}; "
                "use the version that wrote it, or choose another --workspace"
            )


def opened_workspace(root: Path) -> Workspace:
    """One that a command wrote, to look at.

    Raises InputError where the folder is none, WorkspaceError where it has another format version or a table of the
    block is not as it was written.
    """
    workspace = Workspace(root)
    workspace.check_version()
    if not workspace.images.is_file():
        if workspace.orientation.is_dir():
            state = "holds no results yet (images.csv is missing): its run is estimating the orientation, or was ended"
            raise InputError(f"{root} {state} while it did; `aeromatch run` goes on with it")
        raise InputError(f"{root} is no workspace of aeromatch (images.csv is missing): give the folder of --workspace")
    workspace.check_tables()
    return workspace


@contextlib.contextmanager
def locked(workspace: Workspace, command: str, *, shared: bool) -> Iterator[None]:
    """Holds a workspace for one command; shared: shards hold it together. A process that ends, or is killed, lets go.

    Raises WorkspaceError where another command holds it. Where the system or the folder knows no locks (Windows, some
    network file systems), nothing is held.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = workspace.lock
    with translated_os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():  # the lock's words would be written to what it links to
            path.unlink()
        stream = path.open("a+", encoding="utf-8")
    with stream:
        try:
            fcntl.flock(stream, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            holder = stream.read().strip() or "another command"
            raise WorkspaceError(
                f"workspace {workspace.root} is in use by {holder}: wait until it ends, or choose another --workspace"
            ) from None
        except OSError:
            yield
            return
        stream.truncate(0)
        stream.write(f"`aeromatch {command}`, process {os.getpid()} on {socket.gethostname()}\n")
        stream.flush()
        try:
            yield
        finally:
            stream.truncate(0)


def _host() -> str:
    """This machine in a file name; no dots, which separate the parts of a temporary name."""
    return socket.gethostname().replace(".", "-")


def _temporary_name(path: Path) -> Path:
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
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise WorkspaceError(f"cannot write {path} ({error.strerror}); choose another --workspace") from error
        raise WorkspaceError(f"cannot write {path}: {error}") from error


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write beside `path` and rename: a reader or a killed run never sees half a file.

    No fsync: after a power cut a file may be empty, which the readers treat as absent.
    """
    with translated_os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = _temporary_name(path)
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
        value = _object(text)
        if text != _with_checksum(text.rpartition(_CHECKSUM)[0]):
            raise ValueError("its contents contradict its checksum")
        del value["checksum"]
    return value


def _object(text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it holds no JSON object")
    return value


def write_record(path: Path, head: Mapping[str, Any], names: Iterable[str]) -> None:
    """A JSON record with the digests of files below its folder, for which it vouches: it is written last."""
    write_json(path, {**head, "files": {name: file_digest(path.parent / name) for name in sorted(names)}})


def whole_record(path: Path, *, say: bool = False) -> dict[str, Any]:
    """A record whose files are as they were written; else nothing. say: which is not."""
    if not path.is_file():
        return {}
    record = read_json(path)
    changed = changed_files(path.parent, record)
    if changed and say:
        log.warning(
            "warning: %s was changed or removed since it was written, and counts as absent", path.parent / changed[0]
        )
    return {} if changed else record


def changed_files(folder: Path, record: Mapping[str, Any]) -> list[str]:
    """Those of a record's files that are no longer as they were written, or gone."""
    paths = {name: folder / name for name in record["files"]}
    return [n for n, path in paths.items() if not path.is_file() or file_digest(path) != record["files"][n]]


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
