"""Fingerprints: what says that two results are the same one, without comparing them."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.images.files import beyond_bytes
from aeromatch_cli.images.png import SIGNATURE
from aeromatch_cli.recent import read_once
from aeromatch_cli.strategies import Strategy

_PROBE_BYTES = 1 << 20
# An SQLite database begins with this; whoever only reads it may change its journal mode (1, 1 or 2, 2) and counters.
_SQLITE = b"SQLite format 3\0"
_SQLITE_MODE, _SQLITE_COUNTERS = slice(18, 20), (slice(24, 28), slice(92, 100))
# Bits and colour type in a PNG's first chunk, and those of gray of 8 bits and fewer, without and with alpha. Masks of
# other kinds are read by their bands, since this mark of theirs.
_JPEG, _PNG_KIND = b"\xff\xd8", slice(24, 26)
_PNG_GRAY = frozenset({b"\1\0", b"\2\0", b"\4\0", b"\x08\0", b"\x08\4"})
_MASKS_BY_BANDS = " bands"
# The same for pictures of other depths than 8 bits, or with a table of colours; raised when what is made of these
# alone changes.
_DEEP_PICTURES = 1


def fingerprint(*parts: Any) -> str:
    """SHA-256 (hex) of the canonical JSON of `parts`; strategies bring their name, settings and version."""
    return combined(*map(canonical, parts))


def canonical(value: Any) -> str:
    """The text of a part of a fingerprint: canonical JSON."""
    if type(value) is str and value.isalnum() and value.isascii():
        return f'"{value}"'  # most parts are fingerprints themselves
    return json.dumps(value, sort_keys=True, separators=(",", ":"), default=_plain, allow_nan=True)


def combined(*texts: str) -> str:
    """The same as `fingerprint`, from the canonical text of each part."""
    return hashlib.sha256(f"[{','.join(texts)}]".encode()).hexdigest()


# Marks of a field's json_schema_extra that keep its value out of the fingerprint.
_NO_RECIPE = frozenset({"path", "fingerprint"})


def _plain(value: Any) -> Any:
    if isinstance(value, Strategy):
        # Contents, not places: another folder, or another machine's, makes no other recipe, nor does its device.
        files = [file_digest(Path(path)) for path in value.fingerprint_files()]
        extras = {name: field.json_schema_extra for name, field in type(value).model_fields.items()}
        places = {name for name, extra in extras.items() if isinstance(extra, dict) and _NO_RECIPE & extra.keys()}
        recipe = value.model_dump(exclude=places)
        return {"class": type(value).__name__, "version": value.version, "files": files, **recipe}
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "__dataclass_fields__"):
        return {key: getattr(value, key) for key in value.__dataclass_fields__}
    raise TypeError(f"{type(value).__name__} cannot enter a fingerprint")


def file_digest(path: Path) -> str:
    """SHA-256 (hex) of a file that a strategy names, or that this program wrote; read again only when it has changed.
    Of an SQLite database, what programs change that only read it is left out. Raises ConfigError.
    """
    try:
        return _file_digest(path)
    except OSError as error:
        raise ConfigError(f"cannot read {path}, which the configuration names: {error.strerror}") from None


@read_once(64)
def _file_digest(path: Path) -> str:
    with path.open("rb") as stream:
        head = bytearray(stream.read(100))
        if head.startswith(_SQLITE) and head[_SQLITE_MODE] in (b"\1\1", b"\2\2"):
            for part in (_SQLITE_MODE, *_SQLITE_COUNTERS):
                head[part] = bytes(len(head[part]))
        digest = hashlib.sha256(head)
        while block := stream.read(_PROBE_BYTES):
            digest.update(block)
    return digest.hexdigest()


def contents_digest(path: Path) -> str:
    """SHA-256 (hex) of a whole file. Raises OSError."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def image_fingerprint(path: Path) -> str:
    """Size, modification time and SHA-256 of the first and last MiB: enough to notice a changed photograph."""
    status = path.stat()
    digest = hashlib.sha256(f"{status.st_size} {status.st_mtime_ns} ".encode())
    with path.open("rb") as stream:
        digest.update(stream.read(_PROBE_BYTES))
        if status.st_size > _PROBE_BYTES:
            stream.seek(max(_PROBE_BYTES, status.st_size - _PROBE_BYTES))
            digest.update(stream.read(_PROBE_BYTES))
    return digest.hexdigest()


def picture_fingerprint(path: Path) -> str:
    """The same of a picture of the block. Raises OSError."""
    found = image_fingerprint(path)
    return fingerprint(found, _DEEP_PICTURES) if beyond_bytes(path) else found


@read_once(4096)
def mask_fingerprint(path: Path) -> str:
    """The same of a mask, read again only when it has changed: one file may be the mask of all images."""
    with path.open("rb") as stream:
        head = stream.read(_PNG_KIND.stop)
    gray8 = head.startswith(SIGNATURE) and head[_PNG_KIND] in _PNG_GRAY
    # A JPEG, or gray of 8 bits at most, is read as it ever was.
    alike = gray8 or head.startswith(_JPEG)
    return image_fingerprint(path) + ("" if alike else _MASKS_BY_BANDS)


@cache
def program_digest() -> str:
    """SHA-256 (hex) of the size and time of every source of this program: what an earlier version has read of a file
    may be less than this one reads."""
    folder, digest = Path(__file__).parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        status = path.stat()
        digest.update(f"{path.relative_to(folder)} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def stable_hash(text: str) -> int:
    """The same number on every machine and in every process; shards and seeds come from it."""
    return int.from_bytes(hashlib.sha256(text.encode("utf-8")).digest()[:8], "big")
