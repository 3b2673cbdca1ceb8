"""What stands behind the pixels of a PNG file, without decoding them: writers may put EXIF and XMP there."""

from __future__ import annotations

from pathlib import Path

from aeromatch_cli.images.png import chunks

_LONGEST_CHUNK = 16 * 2**20  # of what is read of it; EXIF has 64 KB at most
_XMP = b"XML:com.adobe.xmp"


def late_chunks(path: Path) -> dict[str, bytes]:
    """Pillow's `info` of EXIF ("exif") and uncompressed XMP ("xmp") in any chunk; what is cut off is left out.

    Source: PNG specification, third edition, 11.3.3.4 (iTXt), 11.3.3.6 (eXIf).
    """
    found: dict[str, bytes] = {}
    size = path.stat().st_size
    with path.open("rb") as stream:
        for kind, start, length, after in chunks(stream):
            if after > size:
                break
            if kind in (b"eXIf", b"iTXt") and length <= _LONGEST_CHUNK:
                stream.seek(start)
                data = stream.read(length)
                if kind == b"eXIf":
                    found["exif"] = b"Exif\0\0" + data
                elif (packet := _packet(data)) is not None:
                    found["xmp"] = packet
    return found


def _packet(text: bytes) -> bytes | None:
    """The XMP packet of an iTXt chunk: keyword, compression flag and method, language, translated keyword, text."""
    keyword, _, rest = text.partition(b"\0")
    if keyword != _XMP or rest[:1] != b"\0":
        return None
    parts = rest[2:].split(b"\0", 2)
    return parts[2] if len(parts) == 3 else None
