"""NumPy archives (`.npz`) of the workspace: written with a checksum of the whole file, read without Python objects.

The comment of the zip archive is the checksum. Those of its members say nothing of their list, names and dates.
`numpy.load` parses the header of every array as Python source; large blocks have a hundred thousand small arrays, of
which most headers are alike.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from aeromatch_cli.formats.reading import readable

# What numpy and zipfile raise on contents that are no sound archive, or not the arrays that it should hold.
ARCHIVE_FAULTS = (
    KeyError,
    IndexError,
    ValueError,
    TypeError,
    EOFError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
)
# Magic string, version 1.0 and length of the header, as numpy writes all arrays of less than 64 kB of header.
_VERSION_1 = b"\x93NUMPY\x01\x00"
_PREFIX_BYTES = 10
# Of a zip archive (APPNOTE.TXT 4.3.7, 4.3.16): the end record without a comment, and where the header of a member has
# the lengths of what follows it.
_END, _END_BYTES = b"PK\5\6", 22
_LENGTHS, _MEMBER_BYTES = struct.Struct("<HH"), 30
_MARK, _DIGITS = b"CRC-32 ", 8


def save_arrays(stream: BinaryIO, **arrays: NDArray[Any]) -> None:
    """Arrays by name, uncompressed. The same arrays make the same bytes."""
    made = io.BytesIO()
    np.savez(made, **arrays)  # type: ignore[arg-type]
    # The last field of the end record is the length of the comment.
    head, length = made.getbuffer()[:-2], (len(_MARK) + _DIGITS).to_bytes(2, "little")
    stream.write(head)
    stream.write(length + _MARK + b"%08x" % zlib.crc32(length, zlib.crc32(head)))


def load_arrays(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Arrays of an archive by name, those of `optional` where it has them. Raises BrokenFileError."""
    with readable(path, *ARCHIVE_FAULTS), path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        stream.seek(-_END_BYTES, io.SEEK_END)
        _has_checksum(stream.read())
        held = set(archive.namelist())
        return {
            name: _array(_contents(archive, f"{name}.npy"))
            for name in (*names, *(name for name in optional if f"{name}.npy" in held))
        }


def load_all(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an archive, of which every byte is compared with its checksum (CRC-32). Raises BrokenFileError."""
    with readable(path, *ARCHIVE_FAULTS):
        return {name.removesuffix(".npy"): _array(contents) for name, contents in _members(path.read_bytes()).items()}


def load_checked(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of an archive, after all its contents were compared with their checksums, also those that no stage reads
    any more because what follows is up to date. Raises BrokenFileError.
    """
    with readable(path, *ARCHIVE_FAULTS):
        members = _members(path.read_bytes())
        return {name: _array(members[f"{name}.npy"]) for name in names}


def check_archive(path: Path) -> None:
    """Compare every byte of an archive with its checksums. Raises BrokenFileError."""
    with readable(path, *ARCHIVE_FAULTS):
        _members(path.read_bytes())


def _members(data: bytes) -> dict[str, bytes]:
    """All members of an archive, every byte of which is compared with a checksum."""
    _check_whole(data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {info.filename: _stored(data, info) for info in archive.infolist()}


def _check_whole(data: bytes) -> None:
    end = len(data) - len(_MARK) - _DIGITS
    if _has_checksum(data[-_END_BYTES:]) and data[-_DIGITS:] != b"%08x" % zlib.crc32(memoryview(data)[:end]):
        raise ValueError("its contents contradict its checksum")


def _has_checksum(end: bytes) -> bool:
    """Whether the last _END_BYTES of an archive say so: an earlier version wrote no comment. Raises ValueError."""
    if end[-len(_MARK) - _DIGITS : -_DIGITS] == _MARK:
        return True
    if not (end.startswith(_END) and end.endswith(b"\0\0")):
        raise ValueError("it does not end as it was written")
    return False


def _stored(data: bytes, info: zipfile.ZipInfo) -> bytes:
    """A member, cut out of its archive: `ZipFile.read` takes longer than all else that is done with a small one."""
    _check_stored(info)
    start = info.header_offset + _MEMBER_BYTES + sum(_LENGTHS.unpack_from(data, info.header_offset + _MEMBER_BYTES - 4))
    found = data[start : start + info.file_size]
    if zlib.crc32(found) != info.CRC:
        raise ValueError(f"{info.filename} contradicts its checksum")
    return found


def _check_stored(info: zipfile.ZipInfo) -> None:
    """What is compressed is none of ours: a few kilobytes could hold gigabytes."""
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{info.filename} is compressed")


def _contents(archive: zipfile.ZipFile, name: str) -> bytes:
    """One member, compared with its checksum, without a look at the others."""
    _check_stored(archive.getinfo(name))
    return archive.read(name)


def _array(data: bytes) -> NDArray[Any]:
    """Of the contents of a `.npy` file; one that may be written to."""
    if not data.startswith(_VERSION_1):
        return npy.read_array(io.BytesIO(data), allow_pickle=False)
    start = _PREFIX_BYTES + int.from_bytes(data[8:_PREFIX_BYTES], "little")
    shape, fortran, dtype = _header(data[:start])
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    values = np.frombuffer(data, dtype, offset=start)
    return values.reshape(shape, order="F" if fortran else "C").copy()


@lru_cache(maxsize=1024)
def _header(data: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    stream = io.BytesIO(data)
    npy.read_magic(stream)
    found: tuple[tuple[int, ...], bool, np.dtype[Any]] = npy.read_array_header_1_0(stream)
    return found
