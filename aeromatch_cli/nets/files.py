"""Weights files: those that ship, their checksums, and the tensors in a file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from aeromatch_cli.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor


# Weights that come with the package, each beside its model card.
SHIPPED_FOLDER = Path(__file__).parent / "trained"

_SUMS = "SHA256SUMS"  # of what ships, as sha256sum writes and checks them

SUFFIXES = (".safetensors", ".pth", ".pt")


@dataclass(frozen=True)
class WeightsEntry:
    """A file of the weights folder as it was when it was added, or one that ships.

    architecture: the network's; "lightglue" and "aliked" can be added.
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


def sha256_of_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def content_stamp(path: Path) -> tuple[int, int] | None:
    """Size and time of a file's last change, None where it is missing: what tells a replaced file apart."""
    if not path.is_file():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def shipped_path(name: str) -> Path:
    """The file of a network that ships. Raises ConfigError where it is missing."""
    path = SHIPPED_FOLDER / f"{name}.safetensors"
    if not path.is_file():
        raise ConfigError(f"{path} is missing: install aeromatch again (`aeromatch weights verify` lists what ships)")
    return path


def ships(path: Path) -> bool:
    """Whether a file has the contents of the network of its name that ships."""
    return sha256_of_file(path) == sha256_of_file(shipped_path(path.stem))


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
    # Batch norms count what they were trained with, in integers, and compute with it only while they are trained.
    content = {name: value for name, value in content.items() if not str(name).endswith(".num_batches_tracked")}
    for name, value in content.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise ConfigError(f"weights file {path}: entry {name!r} is not a tensor; export the network's state dict")
        if not value.is_floating_point():
            raise ConfigError(f"weights file {path}: tensor {name} is of type {value.dtype}; export floating point")
        if not bool(torch.isfinite(value).all()):
            raise ConfigError(f"weights file {path}: tensor {name} holds NaN or infinity; the file is damaged")
    return content
