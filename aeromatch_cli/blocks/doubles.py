"""Files that are there twice under different names, and pictures in two formats."""

from __future__ import annotations

import filecmp
import re
from collections import defaultdict
from collections.abc import Mapping, Sized
from pathlib import Path, PurePosixPath

from aeromatch_cli.blocks.other_files import twins
from aeromatch_cli.words import counted, form, listed, of_images

# Files of equal size differ in their first or last bytes, or nowhere: these many are compared before whole ones.
_EDGE_BYTES = 65_536
# What is added to the names of small copies; how much smaller than others they are, and how far their shape is rounded.
_SMALL_NAME = re.compile(r"^(thumb|thumbnail|preview|tn|small)[_-]|[_-](thumb|thumbnail|preview|tn|small)$")
_SMALLER, _ROUNDED_PX = 3, 2


def doubles(files: Mapping[str, Path]) -> dict[str, str]:
    """Name -> the name before it, in the order given, whose file has the same contents. Files that cannot be read have
    none."""
    by_size: dict[int, list[str]] = defaultdict(list)
    for name, path in files.items():
        try:
            by_size[path.stat().st_size].append(name)
        except OSError:
            continue
    found: dict[str, str] = {}
    for size, names in by_size.items():
        by_edges: dict[bytes, list[str]] = defaultdict(list)
        for name in names if len(names) > 1 and size else []:
            try:
                edges = _edges(files[name], size)
                same = next((n for n in by_edges[edges] if filecmp.cmp(files[n], files[name], shallow=False)), None)
            except OSError:
                continue
            if same is None:
                by_edges[edges].append(name)
            else:
                found[name] = same
    return found


def remarks_on(found: Mapping[str, str], of_all: Sized) -> list[str]:
    """One sentence about all of them. found: as `doubles` returns it. of_all: the images, with the copies."""
    if not found:
        return []
    pairs = [f"{name} is a copy of {first}" for name, first in found.items()]
    what = f"{form(len(pairs), 'has', 'have')} the same contents as {form(len(pairs), 'another', 'others')}"
    done = form(len(pairs), "the copy is left out and can be deleted", "the copies are left out and can be deleted")
    return [f"{len(pairs):,} of {len(of_all):,} images {what} ({listed(pairs)}): {done}"]


def in_two_formats(sizes_px: Mapping[str, tuple[int, int]]) -> list[str]:
    """What is said of pictures that are there in two formats. sizes_px: of every picture by name."""
    pairs = [same for same in twins(sizes_px) if len({sizes_px[name] for name in same}) == 1]
    if not pairs:
        return []
    shown = listed((" and ".join(same) for same in pairs), between="; ")
    what = counted(len(pairs), "picture is", "pictures are")
    return [f"{what} there in two formats ({shown}): remove one of each"]


def thumbnails(sizes_px: Mapping[str, tuple[int, int]]) -> list[str]:
    """What is said of small pictures that have the name and the shape of large ones. sizes_px: of every picture."""
    by_name: dict[str, list[str]] = defaultdict(list)
    for name in sizes_px:
        by_name[_SMALL_NAME.sub("", PurePosixPath(name).stem.lower())].append(name)
    small = []
    for names in by_name.values():
        width_px, height_px = max((sizes_px[name] for name in names), key=max)
        for name in names:
            own = sizes_px[name]
            alike = abs(own[0] * height_px - own[1] * width_px) <= _ROUNDED_PX * max(width_px, height_px)
            if alike and _SMALLER * max(own) <= max(width_px, height_px):
                small.append(f"{name}: {own[0]} x {own[1]}")
    if not small:
        return []
    what = of_images(small, sizes_px, "is a small copy", "are small copies")
    return [f"{what} of others, such as thumbnails: --exclude leaves them out"]


def _edges(path: Path, size: int) -> bytes:
    with path.open("rb") as stream:
        head = stream.read(_EDGE_BYTES)
        stream.seek(max(0, size - _EDGE_BYTES))
        return head + stream.read(_EDGE_BYTES)
