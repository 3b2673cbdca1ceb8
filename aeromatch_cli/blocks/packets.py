"""Exif blocks and XMP packets of a file as they stand in it: writers split them, repeat them, and put them anywhere.

Sources: Exif 3.0, 4.7.2 (APP1); XMP specification part 3, 1.1.3 (JPEG, with extended XMP, and JPEG 2000); PNG
specification, third edition, 11.3.3.3 (zTXt), 11.3.3.4 (iTXt), 11.3.3.6 (eXIf); ExifTool's modules for what is found
besides.
"""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from aeromatch_cli.images.png import chunks

# Some writers put up to four bytes before the mark, or write it in small letters.
_EXIF = re.compile(rb".{0,4}exif\0.", re.DOTALL | re.IGNORECASE)
_BYTE_ORDERS = (b"II", b"MM")
_XMP = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
_GUID_BYTES, _NUMBER_BYTES = 32, 4
_XMP_BEGINS = re.compile(rb"<\?xpacket|<x:xmpmeta|<\w+:xmpmeta|<rdf:RDF")
# JPEG 2000: boxes of an id and data; Exif of two writers.
_JP2_SIGNATURE = b"\0\0\0\x0cjP  \r\n\x87\n"
_JP2_XMP = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")
_JP2_EXIF = (b"JpgTiffExif->JP2", bytes.fromhex("0537cdab9d0c4431a72afa561f2a113e"))
_LONGEST_CHUNK = 16 * 2**20  # of what is read of a PNG or a JPEG 2000; Exif has 64 KB at most
_PNG_XMP = b"XML:com.adobe.xmp"
_PNG_PROFILE = re.compile(rb"Raw profile type (exif|xmp|APP1)")
_PNG_HEX = re.compile(rb"\s*\w+\s+\d+\s+([0-9a-fA-F\s]*)")


@dataclass(frozen=True)
class Packets:
    """exif: blocks that begin with their byte order. xmp: packets. In the order of the file."""

    exif: list[bytes] = field(default_factory=list)
    xmp: list[bytes] = field(default_factory=list)

    def add(self, data: bytes) -> None:
        """An APP1 segment. A part of Exif without a byte order goes on with the block before it."""
        if found := _EXIF.match(data):
            block = data[found.end() :]
            if self.exif and not block.startswith(_BYTE_ORDERS):
                self.exif[-1] += block
            else:
                self.exif.append(block)
        elif data.startswith(_XMP):
            self.xmp.append(data[len(_XMP) :])
        elif found := _XMP_BEGINS.search(data):
            self.xmp.append(data[found.start() :])


def jpeg_packets(segments: Iterable[tuple[str, bytes]]) -> Packets:
    """Of the application segments ("APP1", data) of a JPEG; parts of extended XMP are put together."""
    found = Packets()
    parts: dict[bytes, list[tuple[int, bytes]]] = defaultdict(list)
    for marker, data in segments:
        if marker != "APP1":
            continue
        if not data.startswith(_EXTENSION):
            found.add(data)
            continue
        guid_end = len(_EXTENSION) + _GUID_BYTES
        start = guid_end + 2 * _NUMBER_BYTES  # behind the full length and the offset
        offset = int.from_bytes(data[start - _NUMBER_BYTES : start], "big")
        parts[data[len(_EXTENSION) : guid_end]].append((offset, data[start:]))
    for pieces in parts.values():
        found.xmp.append(b"".join(data for _, data in sorted(pieces)))
    return found


def png_packets(path: Path) -> Packets:
    """Of the chunks of a PNG, before and behind its pixels; what is cut off is left out."""
    found = Packets()
    size = path.stat().st_size
    with path.open("rb") as stream:
        for kind, start, length, after in chunks(stream):
            if after > size:
                break
            if kind not in (b"eXIf", b"iTXt", b"zTXt", b"tEXt") or length > _LONGEST_CHUNK:
                continue
            stream.seek(start)
            data = stream.read(length)
            if kind == b"eXIf":
                found.add(data if _EXIF.match(data) else b"Exif\0\0" + data)
                continue
            keyword, text = _png_text(kind, data)
            if keyword == _PNG_XMP:
                found.xmp.append(text)
            elif (profile := _PNG_PROFILE.fullmatch(keyword)) and (packed := _PNG_HEX.match(text)):
                # ImageMagick's: a name, a length, and the segment in hexadecimal digits.
                digits = b"".join(packed[1].split()).decode()
                segment = bytes.fromhex(digits[: len(digits) // 2 * 2])
                bare = profile[1] == b"exif" and not _EXIF.match(segment)
                found.add(b"Exif\0\0" + segment if bare else segment)
    return found


def jp2_packets(path: Path) -> Packets:
    """Of the outer boxes of a JPEG 2000; a bare code stream has none."""
    found = Packets()
    size, place = path.stat().st_size, 0
    with path.open("rb") as stream:
        if stream.read(len(_JP2_SIGNATURE)) != _JP2_SIGNATURE:
            return found
        while place < size:
            stream.seek(place)
            head = stream.read(16)
            length, kind, start = int.from_bytes(head[:4], "big"), head[4:8], place + 8
            if length == 1:
                length, start = int.from_bytes(head[8:], "big"), place + 16
            after = place + length if length else size  # 0: to the end of the file
            if len(head) < 8 or after <= place or after > size:
                break
            if kind == b"uuid" and after - start <= _LONGEST_CHUNK:
                stream.seek(start)
                name, data = stream.read(16), stream.read(after - start - 16)
                if name == _JP2_XMP:
                    found.xmp.append(data)
                elif name in _JP2_EXIF:
                    found.add(data if _EXIF.match(data) else b"Exif\0\0" + data)
            place = after
    return found


def _png_text(kind: bytes, data: bytes) -> tuple[bytes, bytes]:
    """Keyword and text of a chunk; no text where it is damaged."""
    keyword, _, rest = data.partition(b"\0")
    packed = kind == b"zTXt"
    if kind == b"iTXt":  # a flag and a method of compression, language, translated keyword, text
        parts = rest[2:].split(b"\0", 2)
        packed, rest = rest[:1] == b"\1", parts[2] if len(parts) == 3 else b""
    elif packed:
        rest = rest[1:]
    if not packed:
        return keyword, rest
    try:
        return keyword, zlib.decompressobj().decompress(rest, _LONGEST_CHUNK)
    except zlib.error:
        return keyword, b""
