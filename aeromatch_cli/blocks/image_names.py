"""Which line of a pose list belongs to which image."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import PurePosixPath

from aeromatch_cli.blocks.cameras import listed
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError


def matched_rows(pose_list: PoseList, names: Sequence[str], source: str) -> tuple[dict[str, PoseRow], list[str]]:
    """Image name -> its line, and remarks on lines without image and images without line.

    An exact relative path comes first; then the same path in another case, the bare file name, and the name without
    suffix (Metashape's labels); of several, the one whose folders are named, too. Running numbers (DJI's MRK, PATB) are
    those at the end of the names, of one folder. Raises ConfigError where two images fit a line, or two lines an image.
    """
    by_key: dict[str, list[str]] = defaultdict(list)
    by_number: dict[int, list[str]] = defaultdict(list)
    for name in names:
        path = PurePosixPath(name)
        for key in {name.lower(), path.name.lower(), path.stem.lower(), str(path.with_suffix("")).lower()}:
            by_key[key].append(name)
        digits = re.findall(r"\d+", path.stem)
        if digits:
            by_number[int(digits[-1])].append(name)
    exact = set(names)
    rows: dict[str, PoseRow] = {row.image: row for row in pose_list.rows if row.image in exact}
    absent: list[str] = []
    for row in pose_list.rows:
        if row.image in exact:
            continue
        # Programs write paths of the machine that they ran on.
        found = by_key.get(row.image.lower()) or by_key.get(PurePosixPath(row.image).name.lower(), [])
        if row.numbered and not found:
            found = by_number.get(int(float(row.image)), [])
            if found and len({PurePosixPath(name).parent for name in found}) == 1:
                rows |= dict.fromkeys(found, row)  # the cameras of one exposure
                continue
        if len(found) > 1:
            found = _with_most_in_common(row.image, found)
        if len(found) > 1:
            raise ConfigError(
                f"{source}, line {row.line}, column image: {row.image!r} may be {found[0]} or {found[1]}: write the "
                "path relative to the images folder"
            )
        if not found:
            absent.append(row.image)
        elif found[0] in rows:
            raise ConfigError(
                f"{source}, line {row.line}, column image: {row.image!r} and {rows[found[0]].image!r} (line "
                f"{rows[found[0]].line}) both mean the image {found[0]}: keep one of the two lines"
            )
        else:
            rows[found[0]] = row
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


def _with_most_in_common(written: str, names: Sequence[str]) -> list[str]:
    """Those that share most folders, from the last on, with a path as it was written on another machine."""
    wanted = PurePosixPath(written.lower()).parent.parts[::-1]

    def shared(name: str) -> int:
        own = PurePosixPath(name.lower()).parent.parts[::-1]
        return next(
            (k for k, (a, b) in enumerate(zip(wanted, own, strict=False)) if a != b), min(len(wanted), len(own))
        )

    most = max(map(shared, names))
    return [name for name in names if shared(name) == most]
