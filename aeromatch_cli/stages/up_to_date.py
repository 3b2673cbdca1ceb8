"""This module recognises a finished run of which nothing has changed since, so that the same command need not look into
it.

The index keeps what the stages have told, with a digest of the settings, the program, its libraries, and the status
(size, times of the last change of contents and of the file) of every input and every file of the workspace. Where it is
the same, every stage is up to date. Anything else, and any failure, takes the long way, which looks at each result.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.blocks.left_out import list_files
from aeromatch_cli.config import PATH_KEYS, Settings, dump
from aeromatch_cli.errors import BrokenFileError, ConfigError
from aeromatch_cli.images.remote import is_remote
from aeromatch_cli.stages.pairs import chosen_strategies
from aeromatch_cli.stages.stage_report import StageReport, result_on_file
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.store.index import Index
from aeromatch_cli.workspace import Workspace

# What the index calls the state of a finished run.
_FINISHED = "finished run"
# Their arithmetic decides results.
_LIBRARIES = ("numpy", "opencv-python-headless", "poselib", "pycolmap", "torch")
# What readers of poses and cameras look for beside the file or folder that is named, and one folder above.
_KINDS_BESIDE, _NAMES_BESIDE = (".bin", ".xml", ".xyz"), ("block.json", "world.json", "list.txt")


def state_of_inputs(settings: Settings) -> str:
    """Return a digest of what a run starts from; "" where that cannot be told, as images lie on another machine.

    To be asked before anything is read: what is replaced while a run reads it is no longer what it was then.
    """
    if not settings.block.images or is_remote(settings.block.images):
        return ""
    root = Path(settings.workspace)
    libraries = [f"{name} {library_version(name)}" for name in _LIBRARIES]
    own = (path for path in _files_below(Path(__file__).parent.parent, ()) if not path.endswith(".pyc"))
    try:
        inputs = sorted({os.fspath(path) for path in _inputs(settings, root)})
    except (ConfigError, OSError):  # a file is missing or may not be read: the run itself says so
        return ""
    return _digest([dump(settings), *libraries, *_statuses(own), *_statuses(inputs)])


def unchanged_reports(workspace: Workspace, inputs: str) -> list[StageReport] | None:
    """Return what the run from these inputs has left, as reports of stages that have made nothing; None where anything
    has changed since, or it left no record."""
    if not inputs or not workspace.index.is_file():
        return None
    with closing(Index(workspace.index, read_only=True)) as index:
        told = index.get_state(_FINISHED, _state(workspace, inputs))
    try:
        return None if told is None else [_report(workspace, stage, **own) for stage, own in told.items()]
    except BrokenFileError:  # the long way makes it again
        return None


def _report(workspace: Workspace, stage: str, *, items: int, result: Any) -> StageReport:
    """Return the report of a stage that has made nothing. result: None for the one on file."""
    kind = graph.BY_NAME[stage].result
    found = result_on_file(workspace, kind) if result is None else kind(**result)
    return StageReport(stage, items=items, skipped=items, result=found)


def remember(workspace: Workspace, index: Index, inputs: str, reports: Sequence[StageReport]) -> None:
    """Keep what the stages of a run that has ended without a failure have told. inputs: from before it began. reports:
    of its stages, in order; results that are on file are not kept once more."""
    if not inputs:
        return
    told = {}
    for one in reports:
        known = one.result is None or one.result == result_on_file(workspace, graph.BY_NAME[one.stage].result)
        told[one.stage] = {"items": one.items, "result": None if known or one.result is None else one.result.as_json()}
    index.put_state(_FINISHED, _state(workspace, inputs), told)


def _inputs(settings: Settings, root: Path) -> Iterator[Path | str]:
    block = settings.block
    for key in PATH_KEYS:
        path = Path(getattr(block, key) or os.devnull)
        if path.is_dir():
            yield from _files_below(path, [root])
        elif path.is_file():
            yield path
            yield from path.parent.glob(f"{path.stem}.*")  # of a raster: its world file, its projection
            yield from path.parent.glob(f"*{path.suffix}")  # of a table: those that belong to it
            yield from _beside(path.parent)
        if key != "images":
            yield from _beside(path.parent.parent if path.is_file() else path.parent)
    yield from list_files(block.exclude)
    for strategy in chosen_strategies(settings):
        yield from (Path(name) for name in strategy.fingerprint_files())


def _beside(folder: Path) -> Iterator[Path]:
    found = folder.iterdir() if folder.is_dir() else ()
    return (path for path in found if path.suffix.lower() in _KINDS_BESIDE or path.name in _NAMES_BESIDE)


def _files_below(folder: Path, passed_over: Iterable[Path]) -> Iterator[str]:
    """Yield all files, links followed, but of hidden folders and those passed over. As text: a large block has a
    hundred thousand, and paths take ten times as long to make as the disk takes to answer."""
    visited = {_identity(path) for path in passed_over if path.exists()}
    for parent, folders, files in os.walk(folder, followlinks=True):
        own = _identity(parent)
        if own in visited:
            folders.clear()
            continue
        visited.add(own)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (f"{parent}{os.sep}{name}" for name in sorted(files))


def _identity(folder: Path | str) -> tuple[int, int]:
    """Return what tells a folder from all others, by whatever path it is reached."""
    status = os.stat(folder)  # noqa: PTH116
    return status.st_dev, status.st_ino


def _state(workspace: Workspace, inputs: str) -> str:
    """Return a digest of the inputs and of the files of the workspace, without the index itself."""
    passing = {os.fspath(workspace.lock.absolute()), os.fspath(workspace.index)}
    files = (path for path in _files_below(workspace.root.absolute(), ()) if path not in passing)
    return _digest([inputs, *_statuses(files)])


def _statuses(paths: Iterable[str]) -> Iterator[str]:
    """Name, size and times of each file; what cannot be asked is no file that was asked before."""
    for path in paths:
        try:
            status = os.stat(path)  # noqa: PTH116
        except OSError as error:
            yield f"{path} {error.errno}"
        else:
            yield f"{path} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"


def _digest(lines: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for line in lines:
        digest.update(line.encode("utf-8", "surrogateescape") + b"\n")
    return digest.hexdigest()
