"""Weights files: where they are, whether they are what they were, and what is in them.

Nothing is downloaded. A weights setting is a path, or the name of a file in the user's weights folder
($XDG_DATA_HOME/aeromatch/weights, by default ~/.local/share/aeromatch/weights), which `add_weights` fills. That folder
holds the files and index.json: file name -> {"sha256", "size_bytes", "architecture"}.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from aeromatch_cli.errors import ConfigError, WorkspaceError

if TYPE_CHECKING:
    from torch import Tensor

# Weights that come with the package, each beside its model card.
SHIPPED_FOLDER = Path(__file__).parent / "trained"
SHIPPED_LIGHTGLUE = SHIPPED_FOLDER / "lightglue.safetensors"
_SUMS = "SHA256SUMS"  # of what ships, as sha256sum writes and checks them
SUFFIXES = (".safetensors", ".pth", ".pt")

_INDEX_NAME = "index.json"


@dataclass(frozen=True)
class WeightsEntry:
    """A file of the weights folder as it was when it was added, or one that ships.

    architecture: the network's, such as "lightglue", which is the only one that can be added.
    """

    name: str
    sha256: str
    size_bytes: int
    architecture: str


@dataclass(frozen=True)
class WeightsCheck:
    """What became of a file: "ok", "changed" (other content), "missing", or "unrecorded" (never added)."""

    name: str
    state: Literal["ok", "changed", "missing", "unrecorded"]


def weights_folder() -> Path:
    """The user's weights folder, which need not exist."""
    data_home = os.environ.get("XDG_DATA_HOME", "")
    base = Path(data_home) if Path(data_home).is_absolute() else Path.home() / ".local" / "share"
    return base / "aeromatch" / "weights"


def sha256_of_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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


def shipped_path(name: str) -> Path:
    """The file of a network that ships. Raises ConfigError where it is missing."""
    path = SHIPPED_FOLDER / f"{name}.safetensors"
    if not path.is_file():
        raise ConfigError(f"{path} is missing: install aeromatch again (`aeromatch weights verify` lists what ships)")
    return path


def shipped_weights() -> tuple[WeightsEntry, ...]:
    """Every file that ships with the package, by name; its architecture is its name's."""
    paths = sorted(SHIPPED_FOLDER.glob("*.safetensors"))
    return tuple(WeightsEntry(path.name, sha256_of_file(path), path.stat().st_size, path.stem) for path in paths)


def verify_shipped() -> tuple[WeightsCheck, ...]:
    """Compare every file that ships with the package with the sum that ships beside it."""
    sums = (SHIPPED_FOLDER / _SUMS).read_text(encoding="ascii").split("\n")
    checks = []
    for expected, name in (line.split() for line in sums if line):
        path = SHIPPED_FOLDER / name
        if not path.is_file():
            checks.append(WeightsCheck(name, "missing"))
        else:
            checks.append(WeightsCheck(name, "ok" if sha256_of_file(path) == expected else "changed"))
    return tuple(checks)


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
    from aeromatch_cli.nets.lightglue_file import load_lightglue

    load_lightglue(path)
    return "lightglue"


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors by name of a .safetensors, .pth or .pt file, on the CPU; nothing in the file is executed.

    A training checkpoint is taken by its "model" or "state_dict" entry. Raises ConfigError on a missing or unreadable
    file, on another suffix, and on values that are not finite.
    """
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"weights file {path}: unknown suffix {path.suffix!r}; use one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise ConfigError(f"weights file {path} does not exist; check the path or add the file with its right name")
    content = _read(path)
    for container in ("model", "state_dict"):
        if isinstance(content, Mapping) and isinstance(content.get(container), Mapping):
            content = content[container]
    return _checked_tensors(path, content)


def _read(path: Path) -> Any:
    import pickle

    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            return load_file(path, device="cpu")
        return torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        holds = "a safetensors file" if path.suffix == ".safetensors" else "what torch.save writes, tensors only"
        raise ConfigError(
            f"weights file {path} is damaged or not {holds}; copy it again, or export the network's state dict"
        ) from error


def _checked_tensors(path: Path, content: Any) -> dict[str, Tensor]:
    import torch

    if not isinstance(content, Mapping) or not content:
        raise ConfigError(f"weights file {path} holds no named tensors; export the network's state dict")
    for name, value in content.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise ConfigError(f"weights file {path}: entry {name!r} is not a tensor; export the network's state dict")
        if not value.is_floating_point():
            raise ConfigError(f"weights file {path}: tensor {name} is of type {value.dtype}; export floating point")
        if not bool(torch.isfinite(value).all()):
            raise ConfigError(f"weights file {path}: tensor {name} holds NaN or infinity; the file is damaged")
    return dict(content)
