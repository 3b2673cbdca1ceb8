"""The user's weights folder: what is in it, by name, and whether it is what it was.

Nothing is downloaded. A weights setting is a path, or the name of a file in the user's weights folder
($XDG_DATA_HOME/aeromatch/weights, by default ~/.local/share/aeromatch/weights), which `add_weights` fills. That folder
holds the files and index.json: file name -> {"sha256", "size_bytes", "architecture"}.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from aeromatch_cli.errors import ConfigError, WorkspaceError
from aeromatch_cli.nets.files import SUFFIXES, WeightsCheck, WeightsEntry, sha256_of_file

_INDEX_NAME = "index.json"


def weights_folder() -> Path:
    """The user's weights folder, which need not exist."""
    data_home = os.environ.get("XDG_DATA_HOME", "")
    base = Path(data_home) if Path(data_home).is_absolute() else Path.home() / ".local" / "share"
    return base / "aeromatch" / "weights"


def resolve_weights(name_or_path: str) -> Path:
    """The weights file that a setting means: a file of the weights folder by name (suffix optional), else a path.

    Raises ConfigError where there is none.
    """
    folder = weights_folder()
    if Path(name_or_path).name == name_or_path:
        for name in (name_or_path, *(name_or_path + suffix for suffix in SUFFIXES)):
            if Path(name).suffix in SUFFIXES and (folder / name).is_file():
                return folder / name
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path.resolve()
    if path.is_dir():
        raise ConfigError(f"weights {name_or_path!r} is a folder; give the path of a {', '.join(SUFFIXES)} file in it")
    known = ", ".join(entry.name for entry in list_weights()) or "none yet"
    raise ConfigError(
        f"weights {name_or_path!r}: no such file, and no such name in {folder} (there: {known}); give the path of a "
        f"{', '.join(SUFFIXES)} file or add one with `aeromatch weights add PATH`"
    )


def list_weights() -> tuple[WeightsEntry, ...]:
    """Every recorded file of the weights folder, by name. Raises ConfigError on an unreadable index."""
    index = weights_folder() / _INDEX_NAME
    if not index.exists():
        return ()
    try:
        records = json.loads(index.read_text(encoding="utf-8"))
        return tuple(WeightsEntry(name=name, **record) for name, record in sorted(records.items()))
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"{index} cannot be read ({error}); delete it and add the weights again") from error


def verify_weights() -> tuple[WeightsCheck, ...]:
    """Compare every file of the weights folder with its record, by SHA-256."""
    folder = weights_folder()
    recorded = {entry.name: entry for entry in list_weights()}
    present = {path.name for path in folder.iterdir() if path.suffix in SUFFIXES} if folder.is_dir() else set()
    checks = []
    for name in sorted(recorded.keys() | present):
        if name not in recorded:
            checks.append(WeightsCheck(name, "unrecorded"))
        elif name not in present:
            checks.append(WeightsCheck(name, "missing"))
        else:
            same = sha256_of_file(folder / name) == recorded[name].sha256
            checks.append(WeightsCheck(name, "ok" if same else "changed"))
    return tuple(checks)


def add_weights(path: Path) -> WeightsEntry:
    """Copy a weights file into the weights folder and record its SHA-256, after it was loaded strictly.

    Adding the same file again changes nothing. Raises ConfigError on a file that no known network takes and on a
    name that is taken by other content, WorkspaceError where the folder cannot be written.
    """
    architecture = _architecture(path)
    entry = WeightsEntry(path.name, sha256_of_file(path), path.stat().st_size, architecture)
    folder = weights_folder()
    target = folder / path.name
    if target.exists() and sha256_of_file(target) != entry.sha256:
        raise ConfigError(f"{target} exists with other content; rename {path} or delete the old file first")
    entries = {known.name: known for known in list_weights()} | {entry.name: entry}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            partial = folder / f".{path.name}.partial"
            shutil.copyfile(path, partial)
            partial.replace(target)
        _write_index(folder, entries)
    except OSError as error:
        raise WorkspaceError(f"weights folder {folder} cannot be written: {error}") from error
    return entry


def _write_index(folder: Path, entries: Mapping[str, WeightsEntry]) -> None:
    records = {}
    for name, entry in sorted(entries.items()):
        record = asdict(entry)
        del record["name"]
        records[name] = record
    partial = folder / f".{_INDEX_NAME}.partial"
    partial.write_text(json.dumps(records, indent=2) + "\n", encoding="utf-8")
    partial.replace(folder / _INDEX_NAME)


def _architecture(path: Path) -> str:
    from aeromatch_cli.nets.aliked import AlikedNetwork, is_aliked
    from aeromatch_cli.nets.files import read_tensors
    from aeromatch_cli.nets.lightglue_file import load_lightglue

    tensors = read_tensors(path)
    if is_aliked(tensors):
        AlikedNetwork(tensors)
        return "aliked"
    load_lightglue(path)
    return "lightglue"
