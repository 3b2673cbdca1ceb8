"""The chunks of a PNG file, without what they hold."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEAD_BYTES, _CRC_BYTES = 8, 4


def chunks(stream: BinaryIO) -> Iterator[tuple[bytes, int, int, int]]:
    """Kind of every chunk up to the last, where its contents begin, how many bytes of them there are, and where the
    next one begins: beyond the end of a file that is cut off, as a chunk may claim any length.

    Source: PNG specification, third edition, 5.3.
    """
    place = len(SIGNATURE)
    stream.seek(place)
    while len(head := stream.read(_HEAD_BYTES)) == _HEAD_BYTES:
        length, kind = struct.unpack(">I4s", head)
        start = place + _HEAD_BYTES
        place = start + length + _CRC_BYTES
        yield kind, start, length, place
        if kind == b"IEND":
            return
        stream.seek(place)
