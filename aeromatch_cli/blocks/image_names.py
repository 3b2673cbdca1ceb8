"""Which line of a pose list belongs to which image."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from pathlib import PurePosixPath

from aeromatch_cli.blocks.cameras import listed
from aeromatch_cli.blocks.captures import numbers_of_exposures
from aeromatch_cli.blocks.fields import IMAGE
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError

# Running numbers are looked for in so many groups of digits of a name, from the end.
_DIGIT_GROUPS = 3


def matched_rows(
    pose_list: PoseList, names: Sequence[str], source: str, times: Mapping[str, str] | None = None
) -> tuple[dict[str, PoseRow], list[str]]:
    """Image name -> its line, and remarks on lines without image and images without line.

    An exact relative path comes first; then the same path in another case, the bare file name, the name without suffix
    (Metashape's labels), and that with another suffix (a list of the raw pictures, or of PNG that became JPEG); of
    several, the one whose folders are named, too. A path does not fall back
    to an image that has a line of its own, nor, where the list has several of its file name, to one of another folder.
    Running numbers (PATB) stand in the names, of one folder; those of exposures with times (DJI's MRK) are matched by
    order and time (`captures`). times: of the images, ISO text by name. Raises ConfigError where two images fit a line,
    or two lines an image.
    """
    rows, absent = _matches(pose_list.rows, names, source, times or {})
    if names and not rows:
        raise ConfigError(
            f"{source} names none of the {len(names)} images in the folder: it says {pose_list.rows[0].image}, the "
            f"folder holds {names[0]}; write paths relative to the images folder"
        )
    remarks = []
    if absent:
        what = "1 image that is" if len(absent) == 1 else f"{len(absent)} images that are"
        remarks.append(f"{source} names {what} not in the folder: {listed(absent)}")
    unnamed = [name for name in names if name not in rows]
    if unnamed:
        remarks.append(f"{len(unnamed)} of {len(names)} images are not in {source}: {listed(unnamed)}")
    return rows, remarks


def matched_names(lines: Mapping[str, int], names: Sequence[str], source: str) -> tuple[dict[str, str], list[str]]:
    """Name as a file has it -> the image that it means, by the same rules, and those that mean none.

    lines: name as the file has it -> the line where it stands first. Raises ConfigError as `matched_rows`.
    """
    written = [PoseRow(name, line, None, "grid", None, "none") for name, line in lines.items()]
    rows, absent = _matches(written, names, source, {})
    return {row.image: name for name, row in rows.items()}, absent


def _matches(
    written: Sequence[PoseRow], names: Sequence[str], source: str, times: Mapping[str, str]
) -> tuple[dict[str, PoseRow], list[str]]:
    """Image name -> its line, and names of lines that mean no image."""
    exposures = {int(row.image): row for row in written if row.numbered and row.time_s is not None}
    if exposures:
        taken = numbers_of_exposures(names, times, {number: row.time_s or 0.0 for number, row in exposures.items()})
        if taken:
            rows = {name: exposures[number] for name, number in taken.items()}
            return rows, [row.image for number, row in exposures.items() if number not in set(taken.values())]
    by_key: dict[str, list[str]] = defaultdict(list)
    for name in names:
        path = PurePosixPath(name)
        for key in {name.lower(), path.name.lower(), path.stem.lower(), str(path.with_suffix("")).lower()}:
            by_key[key].append(name)
    by_number = _numbered(names, {int(float(row.image)) for row in written if row.numbered})
    alike = Counter(PurePosixPath(row.image.lower()).name for row in written)
    exact = set(names)
    rows = {row.image: row for row in written if row.image in exact}
    absent: list[str] = []
    for row in written:
        if row.image in exact:
            continue
        # Programs write paths of the machine that they ran on.
        written_as = row.image.lower()
        found = by_key.get(written_as) or by_key.get(PurePosixPath(written_as).name, [])
        if not found and IMAGE.fullmatch(written_as):
            stem = PurePosixPath(written_as).stem
            # An image that has a line of its own is not meant by another.
            found = [name for name in by_key.get(stem, []) if PurePosixPath(name).name.lower() not in alike]
        if row.numbered and not found:
            found = by_number.get(int(float(row.image)), [])
            if found and len({PurePosixPath(name).parent for name in found}) == 1:
                rows |= dict.fromkeys(found, row)  # the cameras of one exposure
                continue
        if "/" in row.image:
            several = alike[PurePosixPath(row.image.lower()).name] > 1
            found = [name for name in found if rows.get(name, row).image not in exact]
            found = [name for name in found if not several or _shared_folders(row.image, name)]
        image = _only(row, found, rows, source)
        if image is None:
            absent.append(row.image)
        else:
            rows[image] = row
    return rows, absent


def _only(row: PoseRow, found: Sequence[str], rows: Mapping[str, PoseRow], source: str) -> str | None:
    """The image that a line means, of those that it may: of several the one most of whose folders are named, too.
    Raises ConfigError where two images fit as well, or another line means that image, too."""
    most = max((_shared_folders(row.image, name) for name in found), default=0)
    found = [name for name in found if len(found) == 1 or _shared_folders(row.image, name) == most]
    if len(found) > 1:
        raise ConfigError(
            f"{source}, line {row.line}, column image: {row.image!r} may be {found[0]} or {found[1]}: write the "
            "path relative to the images folder"
        )
    if found and found[0] in rows:
        raise ConfigError(
            f"{source}, line {row.line}, column image: {row.image!r} and {rows[found[0]].image!r} (line "
            f"{rows[found[0]].line}) both mean the image {found[0]}: keep one of the two lines"
        )
    return found[0] if found else None


def _numbered(names: Sequence[str], numbers: Collection[int]) -> dict[int, list[str]]:
    """Running number -> the images that have it: of the groups of digits of their names, counted from the end, the one
    that most numbers of the list are found in."""
    found: dict[int, list[str]] = {}
    for place in range(1, _DIGIT_GROUPS + 1):
        by_number: dict[int, list[str]] = defaultdict(list)
        for name in names:
            digits = re.findall(r"\d+", PurePosixPath(name).stem)
            if len(digits) >= place:
                by_number[int(digits[-place])].append(name)
        if len(by_number.keys() & numbers) > len(found.keys() & numbers):
            found = by_number
    return found


def _shared_folders(written: str, name: str) -> int:
    """How many folders, from the last on, a path has in common with one as it was written on another machine."""
    wanted, own = (PurePosixPath(path.lower()).parent.parts[::-1] for path in (written, name))
    return next((k for k, (a, b) in enumerate(zip(wanted, own, strict=False)) if a != b), min(len(wanted), len(own)))
