"""This module reads every file of a workspace and compares it with its checksum, and so finds damage before a command
needs the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from aeromatch_cli.errors import BrokenFileError, ConfigError, WorkspaceError
from aeromatch_cli.files import read_json
from aeromatch_cli.fingerprints import file_digest
from aeromatch_cli.formats.archives import check_archive
from aeromatch_cli.store.index import check_index
from aeromatch_cli.workspace import Workspace

# Folders whose files are vouched for by reports alone: other programs may have written into them as well.
_OTHERS = ("export", "report", "evaluation", "show")
# Folders in which the record of an image vouches for the pictures that lie beside it.
_PICTURES = ("enhanced", "simulated")


@dataclass
class Damage:
    """What was found. Files are named as they stand below the workspace. damaged: with the reason. without_checksum:
    those of which nothing says how they were written."""

    files: int = 0
    size_bytes: int = 0
    damaged: dict[str, str] = field(default_factory=dict)
    without_checksum: list[str] = field(default_factory=list)


def find_damage(workspace: Workspace) -> Damage:
    """Return which files of a workspace are not as they were written, or gone."""
    found, root = Damage(), workspace.root
    paths = sorted(_files(root))
    digests: dict[Path, str] = {}
    for path in paths:
        if _is_record(path.relative_to(root)):
            _note(found, root, path, lambda one: digests.update(_vouched(root, one)))
    for path in paths:
        found.files, found.size_bytes = found.files + 1, found.size_bytes + path.stat().st_size
        if path in digests:
            _note(found, root, path, lambda one: _compare(one, digests[one]))
        elif path.relative_to(root).parts[0] in _OTHERS:
            found.without_checksum.append(str(path.relative_to(root)))
        elif path.suffix == ".npz":
            _note(found, root, path, check_archive)
        elif path.suffix == ".json":
            _note(found, root, path, read_json)
        elif path.suffix == ".sqlite":
            _note(found, root, path, check_index)
        else:
            found.without_checksum.append(str(path.relative_to(root)))
    for path in sorted(digests.keys() - set(paths)):
        found.damaged[str(path.relative_to(root))] = "it is missing"
    return found


def _files(root: Path) -> Iterator[Path]:
    """All files but those that a command at work has: its lock, and what it has not finished writing."""
    return (path for path in root.rglob("*") if path.is_file() and not path.name.startswith("."))


def _is_record(name: Path) -> bool:
    """Whether a file, named below the workspace, says what others were like when they were written."""
    return name.suffix == ".json" and name.parts[0] in ("reports", *_PICTURES)


def _vouched(root: Path, record: Path) -> dict[Path, str]:
    folder = root if record.relative_to(root).parts[0] == "reports" else record.parent
    return {folder / name: digest for name, digest in read_json(record).get("files", {}).items()}


def _compare(path: Path, digest: str) -> None:
    if file_digest(path) != digest:
        raise BrokenFileError(str(path), "its contents contradict the SHA-256 in the report of its stage")


def _note(found: Damage, root: Path, path: Path, read: Callable[[Path], object]) -> None:
    """Note what reading a file says of it."""
    try:
        read(path)
    except BrokenFileError as error:
        found.damaged[str(path.relative_to(root))] = error.reason
    except (ConfigError, WorkspaceError) as error:  # it may not be read
        found.damaged[str(path.relative_to(root))] = str(error)
