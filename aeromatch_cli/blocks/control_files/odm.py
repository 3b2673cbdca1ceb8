"""OpenDroneMap's gcp_list.txt: coordinates and image measurements in one file.

First line: the CRS of the coordinates, as a code (EPSG:32633), a PROJ string, or "WGS84 UTM 33N". Then one line for
every point in every image, separated by blanks, tabs, commas or semicolons:

  geo_x geo_y geo_z im_x im_y image_name [gcp_name] [check] [accuracy_xy accuracy_z [accuracy_px]]

im_x, im_y: pixels from the upper left corner of the image. A point without a name is known by its coordinates. A point
with the word "check" (or "checkpoint") behind its name, or whose name begins with CHK-, takes no part in the fit. ODM
ignores what stands behind the name; two or three positive numbers there are standard deviations in metres, and in
pixels. Lines that start with # are comments, which may
state units and, where the first line is missing, the CRS; names of the columns may follow the CRS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.control_files.survey import Mark, Survey, SurveyedPoint, is_check, mark
from aeromatch_cli.blocks.fields import IMAGE, fields_of, with_name
from aeromatch_cli.blocks.pose_files.geodesy import described_crs
from aeromatch_cli.blocks.pose_files.source import Source, coordinate, is_number, units_of_comments
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import form

_COLUMNS = "geo_x geo_y geo_z im_x im_y image_name [gcp_name] [check] [accuracy_xy accuracy_z]"
_CHECK_NAME = "CHK-"
# Coordinates of one point may differ by rounding alone.
_SAME = 1e-8


def read_gcp_list(source: Source) -> Survey:
    """Raises ConfigError with file and line."""
    records = list(source.records())
    if len(records) < 2:
        raise ConfigError(f"{source.path}: no control points: the first line names the CRS, then {_COLUMNS}")
    said = units_of_comments(source)
    (head, crs), *records = _with_crs(source, records, said.said.crs)
    factors = 1.0, 1.0, 1.0
    if said.across_m or said.up_m:  # what comments state counts before the unit of the CRS
        stated = described_crs(source.at(head), crs)
        across, up = (said.across_m or stated.across_m) / stated.across_m, (said.up_m or stated.up_m) / stated.up_m
        factors = across, across, up
    exchanged = all(_names_exchanged(record) for _, record in records)
    points: dict[str, SurveyedPoint] = {}
    marks: list[Mark] = []
    for line, record in records:
        point, one = _row(source, line, record, factors, said.accuracy_m or 1.0, exchanged=exchanged)
        known = points.setdefault(point.name, point)
        if any(abs(a - b) > _SAME * max(1.0, abs(a)) for a, b in zip(known.position, point.position, strict=True)):
            raise ConfigError(f"{source.at(line)}: {point.name} has other coordinates than before: one is wrong")
        points[point.name] = replace(known, check=known.check or point.check, sigmas_m=known.sigmas_m or point.sigmas_m)
        marks.append(one)
    named = [name for name in points if name.upper().startswith(_CHECK_NAME)]
    remarks = []
    if named:
        some = form(len(named), "point is a check point", "points are check points")
        remarks.append(f"{source.path.name}: {len(named)} {some} by name ({_CHECK_NAME}...)")
    if exchanged:
        remarks.append(f"{source.path.name}: the names of image and point are exchanged: they were put right")
    return Survey(
        tuple(points.values()), tuple(marks), crs, source.at(head),
        remarks=(*remarks, *said.remarks(source)), measured_in=source.path, heights=said.said.zero,
    )  # fmt: skip


def _with_crs(source: Source, records: Sequence[tuple[int, str]], stated_crs: str | None) -> list[tuple[int, str]]:
    """Return the lines of a list with their numbers: the CRS first, then those of points, without one of names.

    records: two lines or more. stated_crs: as a comment states it, for a list whose first line does not. Raises
    ConfigError for other files.
    """
    records = list(records)
    if is_number(fields_of(records[0][1])[0][0]):
        if not stated_crs:
            raise ConfigError(
                f"{source.at(records[0][0])}: the first line names the CRS of the coordinates, such as EPSG:32633: "
                "add it"
            )
        records.insert(0, (1, stated_crs))
    if _is_header(records[1][1]):
        del records[1]
    elif not _starts_with_numbers(records[1][1]):
        raise ConfigError(
            f"{source.path} is no file of control points that is known (it begins with {records[0][1][:60]!r}): write "
            f"the CRS, then {_COLUMNS}; or a table whose first line names label, x, y, z or label, lat, lon, alt"
        )
    return records


def is_gcp_line(record: str) -> bool:
    """Whether a line is three coordinates, two pixels and the name of an image."""
    cells = with_name(fields_of(record)[0], 5)
    return len(cells) > 5 and all(map(is_number, cells[:5])) and bool(IMAGE.fullmatch(cells[5]))


def _is_header(record: str) -> bool:
    """Whether a line names the columns, as they stand in this order."""
    names = [name.lower() for name in fields_of(record)[0][:6]]
    return len(names) == 6 and names[5].startswith(("image", "file", "photo")) and not any(map(is_number, names))


def _starts_with_numbers(record: str) -> bool:
    cells = fields_of(record)[0]
    return bool(cells) and is_number(cells[0])


def _names_exchanged(record: str) -> bool:
    """Whether the name of an image stands where the point's does, and none where it should."""
    cells = fields_of(record)[0]
    return len(cells) > 6 and bool(IMAGE.fullmatch(cells[6])) and not IMAGE.fullmatch(cells[5])


def _row(
    source: Source,
    line: int,
    record: str,
    factors: tuple[float, float, float],
    accuracy_m: float,
    *,
    exchanged: bool,
) -> tuple[SurveyedPoint, Mark]:
    """accuracy_m: metres of one unit of accuracies. exchanged: whether the names of image and point are."""
    fields, comma = fields_of(record)
    while fields and not fields[-1]:
        fields.pop()
    if exchanged:
        fields[5:7] = fields[6:4:-1]
    cells = with_name(fields, 5)
    if len(cells) < 6:
        raise ConfigError(f"{source.at(line)}: {len(cells)} columns, expected {_COLUMNS}")
    x, y, z = (
        coordinate(source.at(line, what), cell, decimal_comma=comma) * one
        for what, cell, one in zip(("x", "y", "z"), cells[:3], factors, strict=True)
    )
    named = len(cells) > 6 and not is_check(cells[6])
    name = cells[6] if named else " ".join(cells[:3])
    rest = [cell for cell in cells[7 if named else 6 :] if not is_check(cell)]
    across_m, up_m, sigma_px = _accuracies(rest, accuracy_m)
    check = any(map(is_check, cells[6:])) or name.upper().startswith(_CHECK_NAME)
    sigmas_m = completed_sigmas_m(z_m=up_m, across_m=across_m)
    point = SurveyedPoint(name, source.at(line), (x, y, z), sigmas_m, check)
    return point, mark(source, line, (name, cells[5], cells[3], cells[4]), sigma_px, comma=comma)


def _accuracies(cells: Sequence[str], unit_m: float) -> tuple[float | None, float | None, float | None]:
    """Return standard deviations across and up in metres, and of the pixel, as far as two or three numbers state them.

    unit_m: metres of one unit of the first two. None where the cells are none, or state what no accuracy can be.
    """
    if len(cells) not in (2, 3) or not all(map(is_number, cells)):
        return None, None, None
    sigmas = [float(cell.replace(",", ".")) for cell in cells]
    if not all(0.0 < sigma < float("inf") for sigma in sigmas):
        return None, None, None
    return unit_m * sigmas[0], unit_m * sigmas[1], sigmas[2] if len(sigmas) == 3 else None
