"""NumPy archives (`.npz`) of the workspace: read with their checksums, without Python objects.

`numpy.load` parses the header of every array as Python source; large blocks have a hundred thousand small arrays, of
which most headers are alike.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

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


def load_arrays(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Arrays of an archive by name, those of `optional` where it has them. Raises BrokenFileError."""
    with readable(path, *ARCHIVE_FAULTS), zipfile.ZipFile(path) as archive:
        held = set(archive.namelist())
        return {
            name: _array(_contents(archive, f"{name}.npy"))
            for name in (*names, *(name for name in optional if f"{name}.npy" in held))
        }


def load_all(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an archive, of which every byte is compared with its checksum (CRC-32). Raises BrokenFileError."""
    with readable(path, *ARCHIVE_FAULTS), zipfile.ZipFile(io.BytesIO(path.read_bytes())) as archive:
        return {name.removesuffix(".npy"): _array(_contents(archive, name)) for name in archive.namelist()}


def load_checked(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of an archive, after all its contents were compared with their checksums, also those that no stage reads
    any more because what follows is up to date. Raises BrokenFileError.
    """
    with readable(path, *ARCHIVE_FAULTS), zipfile.ZipFile(path) as archive:
        contents = {name: _contents(archive, name) for name in archive.namelist()}
        return {name: _array(contents[f"{name}.npy"]) for name in names}


def _contents(archive: zipfile.ZipFile, name: str) -> bytes:
    """Compared with its checksum. What is compressed is none of ours: a few kilobytes could hold gigabytes."""
    if archive.getinfo(name).compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
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
