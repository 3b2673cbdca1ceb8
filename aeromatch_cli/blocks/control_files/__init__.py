"""Files of control points of other programs: one reader and one line of the table each, and which files go together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aeromatch_cli.blocks.control_files import metashape, odm, tables
from aeromatch_cli.blocks.control_files.survey import Mark, Survey, SurveyedPoint
from aeromatch_cli.blocks.pose_files.source import Source
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes

__all__ = ["Mark", "Survey", "SurveyedPoint", "opened_survey", "read_survey"]

# Files that may hold the other half, by the ends of their names; larger ones are something else.
_SUFFIXES, _LARGEST_BYTES = (".csv", ".txt", ".xml"), 20_000_000


# What people have besides, by the end of its name, and what to do.
_OTHERS = {
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "a workbook: save the sheet as CSV"),
    **dict.fromkeys((".kml", ".kmz", ".gpx", ".shp", ".gpkg", ".geojson", ".dxf"), "a layer of GIS: export it as CSV"),
}


@dataclass(frozen=True)
class _Format:
    recognises: Callable[[Source], bool]
    read: Callable[[Source], Survey]


_MARKS = _Format(tables.is_marks, tables.read_marks)
_COORDINATES = _Format(tables.is_coordinates, tables.read_coordinates)
_MARKERS = _Format(metashape.is_markers, metashape.read_markers)
# In the order in which they are tried; what none of them is must be ODM's, whose first line is hard to tell.
_FORMATS = (_MARKERS, _MARKS, _COORDINATES)


def read_survey(path: Path, marks: Path | None, usual_crs: str | None = None) -> Survey:
    """Coordinates and image measurements of a file, or of two; where one holds only the former or the latter, the other
    may lie beside it. usual_crs: of a table of grid coordinates that names none.

    Raises ConfigError where a file cannot be read or is malformed, where the other half is missing, and where several
    files could be it.
    """
    found = _read(path, usual_crs)
    if marks is not None:
        return _joined(path, found, marks, _read(marks, usual_crs))
    if found.points and found.marks:
        return found
    other = _beside(path, _COORDINATES if not found.points else _MARKS)
    return _joined(path, found, other, _read(other, usual_crs))


def _read(path: Path, usual_crs: str | None) -> Survey:
    source = opened_survey(path)
    known = next((one for one in _FORMATS if one.recognises(source)), None)
    if known is _COORDINATES:
        return tables.read_coordinates(source, usual_crs)
    return odm.read_gcp_list(source) if known is None else known.read(source)


def opened_survey(path: Path, *, marks: bool = False) -> Source:
    """The text of a file of control points; marks: of their image measurements alone. Raises ConfigError where the file
    cannot be read, or is none of text."""
    other = next((words for end, words in _OTHERS.items() if path.name.lower().endswith(end)), "")
    if other and path.is_file():
        raise ConfigError(f"control points {path} are {other}, with label, x, y, z or label, lat, lon, alt")
    try:
        given_bytes(path)
    except OSError as error:
        what, remedy = "control points", "give ODM's gcp_list.txt, or a file of Pix4D or Metashape, with --gcp"
        if marks:
            what, remedy = "image measurements", "give a table of image, label, x and y with --gcp-marks"
        raise ConfigError(f"{what} {path} cannot be read ({error.strerror}): {remedy}") from error
    source = Source(path)
    if source.raw and not source.text:
        raise ConfigError(f"control points {path} are a binary file: give a text file or XML")
    return source


def _beside(path: Path, wanted: _Format) -> Path:
    """The one file in the same folder that holds the other half."""
    what = "image measurements (image,label,x,y)" if wanted is _MARKS else "coordinates (label,x,y,z)"
    option = "--gcp-marks" if wanted is _MARKS else "--gcp"
    formats = (wanted, _MARKERS) if wanted is _MARKS else (wanted,)
    fit = []
    for other in sorted(path.parent.iterdir()):
        if other == path or other.suffix.lower() not in _SUFFIXES or not other.is_file():
            continue
        if other.stat().st_size <= _LARGEST_BYTES and _is_one_of(formats, other):
            fit.append(other)
    if len(fit) == 1:
        return fit[0]
    if not fit:
        raise ConfigError(f"{path} holds no {what}, and no file beside it does: give them with {option}")
    raise ConfigError(
        f"{path} holds no {what}, and {fit[0].name} and {fit[1].name} beside it do: name the right one with {option}"
    )


def _is_one_of(formats: Sequence[_Format], path: Path) -> bool:
    """Whether a file that nobody has named is of one of these; one that cannot be read is of none."""
    source = Source(path)
    try:
        return any(one.recognises(source) for one in formats)
    except ConfigError:
        return False


def _joined(first: Path, one: Survey, second: Path, two: Survey) -> Survey:
    """Coordinates of the first file that has any, and image measurements of the last."""
    surveyed, measured = (one, two) if one.points else (two, one)
    if not surveyed.points:
        raise ConfigError(f"{first} and {second} both hold image measurements alone: give coordinates with --gcp")
    if not measured.marks:
        raise ConfigError(f"{second} holds no image measurements (image,label,x,y), which --gcp-marks needs")
    remarks = (*surveyed.remarks, *measured.remarks)
    return replace(surveyed, marks=measured.marks, measured_in=measured.measured_in, remarks=remarks)
