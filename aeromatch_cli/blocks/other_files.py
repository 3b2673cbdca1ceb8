"""Files of a folder of images that are none of the block, by their names and by what they hold: masks, and what is not
read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from aeromatch_cli.images import heif
from aeromatch_cli.images.files import JPEG_SUFFIXES
from aeromatch_cli.images.masks import compresses_like_a_mask, is_black_and_white

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".jp2", ".j2k", *JPEG_SUFFIXES[2:])
KINDS = ", ".join(suffix[1:] for suffix in _SUFFIXES)  # as messages say it
MASK = "masks of images, not images: give the folder with --masks to use them"

# Metashape and ODM (a_mask.png, a_mask.jpg), RealityCapture (a.jpg.mask.png).
_MASK_ENDINGS = ("_mask", ".mask")
_MASK_FOLDERS = ("mask", "masks")
# Of masks that have the name of their image: their format, and how many are decoded.
_LOSSLESS, _DECODED = ".png", 3
_RAW = (
    *(".dng", ".arw", ".cr2", ".cr3", ".nef", ".nrw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".iiq", ".3fr", ".fff"),
    *(".raw", ".gpr", ".rwl", ".x3f", ".erf", ".kdc", ".mrw", ".sr2", ".srf", ".crw", ".dcr", ".mef", ".mos", ".ptx"),
)
_OTHER_PICTURES = (
    *(".avif", ".webp", ".jxl", ".bmp", ".dib", ".gif", ".mpo", ".jpf", ".jpx", ".jxr", ".psd", ".psb", ".tga", ".exr"),
    *(".ppm", ".pgm", ".pnm", ".ecw", ".sid", ".rjpg"),
)
# What files begin with whose suffix is not known.
_CONTENTS = {
    b"\xff\xd8\xff": "a JPEG by its content: rename it to .jpg",
    b"\x89PNG\r\n": "a PNG by its content: rename it to .png",
    b"II*\0": "TIFF or raw by its content: rename it to .tif, or develop it",
    b"MM\0*": "TIFF or raw by its content: rename it to .tif, or develop it",
}
# By-products that hold a picture: thumbnails of videos, and what programs and downloads leave.
_BY_PRODUCTS = (".thm", ".lrv", ".bak", ".tmp", ".part", ".crdownload")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".insv", ".lrv")


def image_suffixes() -> tuple[str, ...]:
    """Of what is read here: HEIC only where pillow-heif is installed."""
    return (*_SUFFIXES, *heif.SUFFIXES) if heif.readable() else _SUFFIXES


def masks_among(names: Iterable[str]) -> set[str]:
    """Those of these pictures that are masks of others of them. names: relative, with forward slashes."""
    found = list(names)
    places = {name: PurePosixPath(name) for name in found}
    pictures = {name for name in found if not _in_mask_folder(places[name])}
    beside = {(places[name].parent, key) for name in pictures for key in _keys(places[name].name)}
    anywhere = {key for _, key in beside}
    masks = set()
    for name in found:
        place, own = places[name], places[name].stem.lower()
        masked = next((own.removesuffix(end) for end in _MASK_ENDINGS if own.endswith(end)), "")
        if name not in pictures:
            is_mask = bool({own, masked} & anywhere)
        elif masked:
            is_mask = (place.parent, masked) in beside
        else:  # COLMAP's: a.jpg.png beside a.jpg
            is_mask = own.endswith(image_suffixes()) and (place.parent, own) in beside
        if is_mask:
            masks.add(name)
    return masks


def twins(names: Iterable[str]) -> list[list[str]]:
    """Pictures of one name with different suffixes in one folder, those together."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[str(PurePosixPath(name).with_suffix("")).lower()].append(name)
    return [same for same in found.values() if len(same) > 1]


def masks_by_content(folder: Path, names: Iterable[str]) -> set[str]:
    """Those of these pictures that are masks of one of the same name (a.png beside a.jpg): of two values alone.

    A mask compresses to far less than a picture. Of those that do the first few are decoded.
    """
    likely: list[str] = []
    for same in twins(names):
        small = [name for name in same if name.lower().endswith(_LOSSLESS) and compresses_like_a_mask(folder / name)]
        if len(small) < len(same):
            likely += small
    if all(is_black_and_white(folder / name) for name in likely[:_DECODED]):
        return set(likely)
    return set()


def unread_kind(name: str) -> str:
    """What a file is that shows something and is not read, with the remedy; "" for any other file."""
    if PurePosixPath(name).suffix.lower() in _VIDEOS:
        return "videos are not read: `aeromatch frames VIDEO --out DIR` writes pictures of one, and their positions"
    return unread_picture(name)


def unread_picture(name: str) -> str:
    """The same of pictures alone, by their suffix."""
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in _RAW:
        return "raw pictures are not read: develop them to JPEG or TIFF in full size, without correction of the lens"
    if suffix in heif.SUFFIXES:
        return (
            "HEIC is read where pillow-heif is installed (pip install 'aeromatch[heif]'); else convert to JPEG or TIFF "
            "in full size, with the metadata"
        )
    if suffix in _OTHER_PICTURES:
        return f"{suffix[1:].upper()} is not read: convert to JPEG or TIFF in full size, with the metadata"
    return ""


def unread_content(path: Path) -> str:
    """The same of a file whose suffix says nothing, by what it begins with."""
    suffix = path.suffix.lower()
    if suffix in _BY_PRODUCTS or suffix in _VIDEOS:
        return ""
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
    except OSError:
        return ""
    return next((words for begins, words in _CONTENTS.items() if head.startswith(begins)), "")


def _keys(file: str) -> set[str]:
    """Under which names a mask may speak of a picture."""
    lowered = file.lower()
    return {lowered, lowered.rpartition(".")[0]}


def _in_mask_folder(place: PurePosixPath) -> bool:
    return any(part.lower() in _MASK_FOLDERS for part in place.parts[:-1])
