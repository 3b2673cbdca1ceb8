"""Tables of ExifTool: `exiftool -csv` and `exiftool -json`, with or without -n and group names (-G), coordinates in any
form that its option -c writes; also saved by a spreadsheet, with semicolons or tabs.

The same tags as in the images themselves: GPSLatitude, GPSLongitude, GPSAltitude (DJI's AbsoluteAltitude before it),
the angles of the camera (`xmp.xmp_angles`) and their accuracies.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.calibration import angle_sigma_deg, position_sigmas_m
from aeromatch_cli.blocks.pose_files.source import Source, image_name
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.blocks.units import degrees_of, metres_of
from aeromatch_cli.blocks.xmp import from_level, tag_number, xmp_angles
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import form

_IMAGE = "SourceFile"
# Groups whose tag counts before that of others: degrees with a sign.
_FIRST = "Composite"
# ExifTool names tags without their namespace: which maker's they are.
_NAMESPACES = (
    (re.compile(r"Gimbal(Yaw|Pitch|Roll)Degree|RtkStd(Lon|Lat|Hgt)|RtkFlag"), "drone-dji"),
    (re.compile(r"Camera(Yaw|Pitch|Roll)Degree"), "drone-parrot"),
    (re.compile(r"Yaw|Pitch|Roll|GPS(XY|Z)Accuracy|IMU(Yaw|Pitch|Roll)Accuracy"), "Camera"),
)


def is_exiftool(source: Source) -> bool:
    if isinstance(source.tree, list):
        return bool(source.tree) and all(isinstance(item, dict) and _IMAGE in item for item in source.tree)
    if isinstance(source.tree, dict):
        return _IMAGE in source.tree
    return bool(source.lines) and _IMAGE in next(csv.reader(source.lines[:1], delimiter=_separator(source)), [])


def _separator(source: Source) -> str:
    return max(",;\t", key=source.lines[0].count)


def read_exiftool(source: Source) -> PoseList:
    """Raises ConfigError where no image has a position, naming what was looked for."""
    rows, unposed, said = [], 0, Counter[str]()
    for line, record in _records(source):
        row = _row(line, record, said)
        unposed += row.position is None
        rows.append(row)
    pitches = [row.attitude[1] for row in rows if row.attitude is not None and row.forward is False]
    if from_level(pitches):
        rows = [replace(row, forward=True) if row.forward is False else row for row in rows]
    if unposed == len(rows):
        raise ConfigError(
            f"{source.path}: no image of this ExifTool table has GPSLatitude and GPSLongitude: write it by "
            "`exiftool -csv -n -r IMGS`"
        )
    some = form(unposed, "image has", "images have")
    remarks = [f"{source.path.name}: {unposed} {some} no GPS position there"] if unposed else []
    remarks += [f"{source.path.name}: {count} of {len(rows)} images had {what}" for what, count in said.items()]
    return PoseList(tuple(rows), "geographic", tuple(remarks), "ExifTool table")


def _records(source: Source) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Line and tags of every image."""
    if source.tree is not None:
        items = source.tree if isinstance(source.tree, list) else [source.tree]
        yield from enumerate(items, start=1)
        return
    reader = csv.reader(source.lines, delimiter=_separator(source))
    names = next(reader)
    for cells in reader:
        if cells:
            yield reader.line_num, dict(zip(names, cells, strict=False))


def _row(line: int, record: Mapping[str, Any], said: Counter[str]) -> PoseRow:
    """Return what a record says of an image. said: gets what is to be said of it, counted."""
    tags = _tags(record)
    latitude, longitude = _degrees(tags, "GPSLatitude"), _degrees(tags, "GPSLongitude")
    height = _metres(tags.get("AbsoluteAltitude", tags.get("GPSAltitude")), tags.get("GPSAltitudeRef"))
    xmp = {f"{space}:{name}": str(v) for name, v in tags.items() for form, space in _NAMESPACES if form.fullmatch(name)}
    sigmas_m, remark = position_sigmas_m(xmp)
    if remark:
        said[remark] += 1
    elif sigmas_m is None:
        sigmas_m = completed_sigmas_m(across_m=tag_number(str(tags.get("GPSHPositioningError", "")).removesuffix(" m")))
    row = PoseRow(
        image=image_name(str(record[_IMAGE])), line=line, position=None, position_kind="geographic", attitude=None,
        attitude_kind="none", sigmas_m=sigmas_m, sigma_angle_deg=angle_sigma_deg(xmp), true_north=True,
    )  # fmt: skip
    angles = xmp_angles(xmp)
    if latitude is None or longitude is None:
        return row
    row = replace(row, position=(latitude, longitude, height))
    if angles is None:
        return row
    attitude = angles.yaw_deg, angles.pitch_deg, angles.roll_deg
    forward = angles.convention == "gimbal"
    return replace(row, attitude=attitude, attitude_kind="yaw_pitch_roll", forward=forward)


def _tags(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tags of a record that have a value, without their groups; GPSPosition stands for its two parts."""
    tags: dict[str, Any] = {}
    for name in sorted(record, key=lambda key: key.startswith(f"{_FIRST}:")):
        if record[name] not in ("", "-", None):
            tags[name.rpartition(":")[2]] = record[name]
    both = str(tags.get("GPSPosition", "")).split(",")
    if len(both) == 2:
        return {"GPSLatitude": both[0].strip(), "GPSLongitude": both[1].strip()} | tags
    return tags


def _degrees(tags: Mapping[str, Any], name: str) -> float | None:
    """Signed degrees of a tag; the reference tag counts where the value has no letter."""
    value = str(tags.get(name, "")).strip()
    sides = "NS" if name.endswith("Latitude") else "EW"
    degrees = degrees_of(value, sides)
    degrees = tag_number(value) if degrees is None else degrees
    if degrees is None or not set(value.upper()).isdisjoint(sides):
        return degrees
    side = str(tags.get(f"{name}Ref", ""))[:1].upper()
    return -abs(degrees) if side == sides[1] else degrees


def _metres(value: Any, reference: Any) -> float:
    """Of `161.96`, `+161.96`, `161.96 m Above Sea Level`; NaN for none."""
    number = metres_of("" if value is None else str(value))
    if number is None:
        return float("nan")
    below = str(reference).strip() == "1" or "below" in str(reference).lower()
    return -abs(number) if below else number
