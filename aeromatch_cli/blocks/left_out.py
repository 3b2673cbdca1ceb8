"""Images that the user leaves out: by name, by pattern, or by files with one of these in each line."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from aeromatch_cli.blocks.cameras import listed
from aeromatch_cli.blocks.other_files import image_suffixes
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding


def list_files(text: str) -> list[Path]:
    """Files among the entries of `excluded`; what has the suffix of an image is the name of one."""
    paths = [Path(entry) for entry in _entries(text)]
    return [path for path in paths if path.suffix.lower() not in image_suffixes() and path.is_file()]


def excluded(text: str, names: Sequence[str]) -> tuple[frozenset[str], list[str]]:
    """Those of the images (relative paths) that the user leaves out, and remarks.

    text: names, patterns such as `takeoff/*` or `*_0001.jpg`, and files with lines of these, separated by commas. Each
    is compared with the whole path and with the name alone, whatever their case; of a line with commas the first cell
    counts, and # begins a comment. Raises ConfigError where a file cannot be read.
    """
    found, idle = set[str](), list[str]()
    files = set(list_files(text))
    for entry in _entries(text):
        for pattern in _lines(Path(entry)) if Path(entry) in files else [entry]:
            wanted = pattern.replace("\\", "/").removeprefix("./").lower()
            hits = [name for name in names if _fits(name.lower(), wanted)]
            found.update(hits)
            idle += [] if hits else [pattern]
    remarks = []
    if found:
        remarks.append(f"{len(found)} of {len(names)} images ({listed(sorted(found))}) are left out, as --exclude asks")
    if idle:
        remarks.append(f"--exclude fits no image of the folder: {listed(idle)}")
    return frozenset(found), remarks


def _entries(text: str) -> list[str]:
    return [entry.strip() for entry in text.split(",") if entry.strip()]


def _fits(name: str, wanted: str) -> bool:
    return any(one == wanted or fnmatchcase(one, wanted) for one in (name, name.rpartition("/")[2]))


def _lines(path: Path) -> list[str]:
    try:
        raw = given_bytes(path)
        text = raw.decode(text_encoding(raw))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--exclude {path} cannot be read ({error}): give a text file of names") from error
    cells = (line.partition("#")[0].partition(",")[0].strip().strip("\"'") for line in text.splitlines())
    return [cell for cell in cells if cell]
