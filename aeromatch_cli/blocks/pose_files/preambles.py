"""Reports of GNSS and INS programs (Applanix POSPac's exterior orientation): text first, then a line that names the
columns, then one line for every exposure."""

from __future__ import annotations

import re
from dataclasses import replace

from aeromatch_cli.blocks.pose_files.source import Source, is_number
from aeromatch_cli.blocks.poses import PoseList, read_poses
from aeromatch_cli.words import counted, form

# The line that names the columns stands among the first ones.
_LONGEST_PREAMBLE = 80
_IMAGES = frozenset(("id", "image", "photo", "photoid", "photo_id", "name", "filename", "file", "exposure"))
_PLACES = ({"easting", "northing"}, {"x", "y"}, {"lat", "lon"}, {"latitude", "longitude"}, {"lat", "long"})
_UNITS = re.compile(r"\b(units?|angles?|heights?|coordinates)\b", re.IGNORECASE)


def is_report(source: Source) -> bool:
    return bool(_place_of_header(source))


def read_report(source: Source) -> PoseList:
    """Raises ConfigError with line and column."""
    place = _place_of_header(source)
    # What says something of units stays a comment, which is read; a projection without its datum is no CRS.
    above = [f"# {line.strip()}" if _UNITS.search(line) else "#" for line in source.lines[:place]]
    header = re.sub(r"^\s*\w+", "image", source.lines[place])
    found = read_poses(source.path, text="\n".join([*above, header, *source.lines[place + 1 :]]))
    first = next(line.strip() for line in source.lines if line.strip())
    remark = (
        f"{source.path.name}: {counted(place, 'line')} above the one that names the columns ({first[:40]!r} ...) "
        f"{form(place, 'is', 'are')} passed over but for units: give the CRS with --crs"
    )
    return replace(found, warnings=(remark, *found.warnings), format="report with named columns")


def _place_of_header(source: Source) -> int:
    """Index of the line that names the columns below a preamble, 0 for none."""
    for place, line in enumerate(source.lines[:_LONGEST_PREAMBLE]):
        words = [word.lower() for word in re.split(r"[\s,;]+", line.strip()) if word]
        if (
            words
            and words[0] in _IMAGES
            and any(both <= set(words) for both in _PLACES)
            and not any(map(is_number, words))
        ):
            return place if any(above.strip() for above in source.lines[:place]) else 0
        if line.lstrip().startswith("#"):
            return 0
    return 0
