"""Which files of a folder are images, and what each is called in the workspace."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from aeromatch_cli.blocks.other_files import (
    MASK,
    image_suffixes,
    masks_among,
    masks_by_content,
    unread_content,
    unread_kind,
    unread_picture,
)
from aeromatch_cli.errors import ConfigError

_FOLDER_MARK = "--"
_LONGEST_SLUG = 150
_HASH_DIGITS = 10
_APPLE_DOUBLE = "is macOS metadata (AppleDouble), not an image"
_EMPTY = "file is empty: copy it again"
# Line breaks and what else no XML holds: other programs' files are lists of lines, reports are SVG.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ufffe\uffff]")
# What cells begin with that spreadsheets run as formulas; tables of the results hold names as they are.
_FORMULA = ("=", "+", "-", "@")
# Thumbnails that network storage makes, one folder of them in every folder.
_THUMBNAILS = "@eaDir"


@dataclass(frozen=True)
class ScanFailure:
    """Something that has the name of an image and is none.

    name: path relative to the images folder. reason: in words. image_lost: True where a picture is probably missing
    from the block (empty file, broken link, unreadable folder), False for by-products such as `._x.jpg`. unread: a
    picture of a kind that is not read.
    """

    name: str
    reason: str
    image_lost: bool
    unread: bool = False


def scan_images(folder: Path, exclude: Iterable[Path] = ()) -> tuple[list[str], list[ScanFailure]]:
    """Relative names (forward slashes, sorted) of the images below a folder, and what was passed over and why.

    Folders are searched at any depth, links included; hidden files and folders are skipped. A suffix in any case
    counts. exclude: folders that are not searched, such as masks, and files; nor is any folder that is a workspace of
    this program. Raises ConfigError where the folder is missing or cannot be read.
    """
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "does not exist"
        raise ConfigError(f"images folder {folder} {what}: give the folder that holds the images with --images")
    try:
        next(folder.iterdir(), None)
    except OSError as error:
        raise ConfigError(f"images folder {folder} cannot be read ({error.strerror}): check its permissions") from error
    names: list[str] = []
    failures: list[ScanFailure] = []

    def unreadable(error: OSError) -> None:
        name = Path(error.filename).relative_to(folder).as_posix() if error.filename else ""
        failures.append(ScanFailure(name, f"folder cannot be read ({error.strerror}): check its permissions", True))

    passed_over = {os.path.realpath(path) for path in exclude} - {os.path.realpath(folder)}
    files_passed_over = {path for path in passed_over if Path(path).is_file()}
    visited = set(passed_over)
    for parent, subfolders, files in os.walk(folder, onerror=unreadable, followlinks=True):
        real = os.path.realpath(parent)
        is_workspace = parent != str(folder) and {"block.json", "images.csv", "pairs.csv"} <= set(files)
        if real in visited or is_workspace:  # visited: excluded, or a link that leads back up
            subfolders.clear()
            continue
        visited.add(real)
        subfolders[:] = sorted(name for name in subfolders if not name.startswith(".") and name != _THUMBNAILS)
        failures += _folders_like_images(folder, Path(parent), subfolders)
        found, unfit = _scan_paths(folder, [Path(parent) / name for name in files], files_passed_over)
        names += found
        failures += unfit
    kept, failures = _sorted_out(names, failures)
    masks = masks_by_content(folder, kept)
    failures += [ScanFailure(name, MASK, False) for name in sorted(masks)]
    return [name for name in kept if name not in masks], sorted(failures, key=lambda failure: failure.name)


def _is_image(path: Path) -> bool:
    """Whether a path has the suffix of an image that is read."""
    return path.suffix.lower() in image_suffixes()


def _folders_like_images(folder: Path, parent: Path, subfolders: Sequence[str]) -> Iterator[ScanFailure]:
    for name in subfolders:
        if _is_image(Path(name)):
            relative = (parent / name).relative_to(folder).as_posix()
            yield ScanFailure(relative, "is a folder with the name of an image", False)


def _scan_paths(folder: Path, paths: Sequence[Path], passed_over: Set[str]) -> tuple[list[str], list[ScanFailure]]:
    """Return the relative names of those files that are images, and what is said of the others.

    passed_over: real paths of images that are not searched for.
    """
    names: list[str] = []
    failures: list[ScanFailure] = []
    for path in paths:
        relative = path.relative_to(folder).as_posix()
        if not _is_image(path):
            failures += _unread(relative, path)
        elif passed_over and os.path.realpath(path) in passed_over:
            continue
        elif (failure := _failure_of(path, relative)) is not None:
            failures.append(failure)
        elif not path.name.startswith("."):
            names.append(relative)
    return names, failures


def scan_files(sizes_bytes: Mapping[str, int | None]) -> tuple[list[str], list[ScanFailure]]:
    """The same of a listing: relative name -> size of every file below a folder that is not on this machine."""
    names: list[str] = []
    failures: list[ScanFailure] = []
    suffixes = image_suffixes()
    for name, size_bytes in sorted(sizes_bytes.items()):
        *parents, file = name.split("/")
        if Path(file).suffix.lower() not in suffixes:
            failures += _unread(name)
            continue
        if name.startswith("/") or ".." in name.replace("\\", "/").split("/"):
            failures.append(ScanFailure(name, "leads out of the folder: it is not read", True))
        elif any(part.startswith(".") or part == _THUMBNAILS for part in parents):
            continue
        elif file.startswith("._"):
            failures.append(ScanFailure(name, _APPLE_DOUBLE, False))
        elif (failure := _unfit(name)) is not None:
            failures.append(failure)
        elif size_bytes == 0:
            failures.append(ScanFailure(name, _EMPTY, True))
        elif not file.startswith("."):
            names.append(name)
    return _sorted_out(names, failures)


def _sorted_out(names: list[str], failures: list[ScanFailure]) -> tuple[list[str], list[ScanFailure]]:
    """Both sorted, masks among what is passed over, without what is not read of pictures that are there as well (raw
    beside JPEG)."""
    masks = masks_among(names)
    kept = sorted(name for name in names if name not in masks)
    twins = {str(Path(name).with_suffix("")).lower() for name in kept}
    failures = [
        one
        for one in failures
        if not ((one.unread or unread_kind(one.name)) and str(Path(one.name).with_suffix("")).lower() in twins)
    ]
    failures += [ScanFailure(name, MASK, False) for name in masks]
    return kept, sorted(failures, key=lambda failure: failure.name)


def _unread(name: str, path: Path | None = None) -> list[ScanFailure]:
    """What is said of a file that has another suffix than images. path: of it, where it is on this machine."""
    if any(part.startswith(".") for part in name.split("/")) or _CONTROL.search(name):
        return []
    if reason := unread_picture(name):
        return [ScanFailure(name, reason, False, unread=True)]
    if reason := unread_kind(name):
        return [ScanFailure(name, reason, False)]
    reason = unread_content(path) if path is not None and path.is_file() else ""
    return [ScanFailure(name, reason, False, unread=True)] if reason else []


def _unfit(name: str) -> ScanFailure | None:
    """Names that lists, tables or XML of the results could not hold, or that a spreadsheet would run."""
    readable = _CONTROL.sub("?", name)
    if readable != name:
        return ScanFailure(readable, "file name holds control characters: rename the file", True)
    if name.startswith(_FORMULA):
        words = f"name begins with {name[0]}, which a spreadsheet runs as a formula: rename the file or folder"
        return ScanFailure(f"./{name}", words, True)
    return None


def _failure_of(path: Path, name: str) -> ScanFailure | None:
    if path.name.startswith("._"):
        return ScanFailure(name, _APPLE_DOUBLE, False)
    if path.name.startswith("."):
        return None
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        readable = os.fsencode(name).decode("utf-8", "replace")
        return ScanFailure(readable, "file name is not valid UTF-8: rename the file", True)
    if (failure := _unfit(name)) is not None:
        return failure
    try:
        size_bytes = path.stat().st_size
    except OSError as error:
        return ScanFailure(name, f"cannot be read ({error.strerror}): broken link or missing permission", True)
    if not path.is_file():
        return ScanFailure(name, "is not a regular file", False)
    return ScanFailure(name, _EMPTY, True) if size_bytes == 0 else None


def identifier(text: str) -> str:
    """The text itself where it has only [A-Za-z0-9._-], else those characters of it and a hash: never two alike."""
    readable = re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-")
    return text if readable == text else f"{readable}-{_digest(text)}"


def image_id(name: str) -> str:
    """Identifier of an image, of characters [A-Za-z0-9._-], that depends on nothing but its relative path.

    `a/1.jpg` becomes `a--1_jpg`. Where this is not reversible (blanks, accents, "--" in a name, very long paths), a
    hash of the path is appended, so that different paths never share an identifier and adding images changes none.
    """
    stem, dot, suffix = name.rpartition(".")
    plain = f"{stem}_{suffix}" if dot else name
    readable = re.sub(r"[^A-Za-z0-9._-]", "_", plain.replace("/", _FOLDER_MARK))[:_LONGEST_SLUG]
    back = readable.replace(_FOLDER_MARK, "/")
    back_stem, _, back_suffix = back.rpartition("_")
    if f"{back_stem}.{back_suffix}" == name:
        return readable
    return f"{readable}-{_digest(name)}"


def image_ids(names: Iterable[str]) -> dict[str, str]:
    """Relative name -> identifier, see `image_id`."""
    return {name: image_id(name) for name in names}


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:_HASH_DIGITS]
