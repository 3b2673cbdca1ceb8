"""Units and conventions that a file states beside its numbers: in the name of a column, or in a comment.

Numbers become metres and degrees. A unit that is none of a column's kind is refused by name, never passed over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Literal

from aeromatch_cli.errors import ConfigError

Kind = Literal["length", "angle"]

US_FOOT_M = 1200.0 / 3937.0
_METRES: Mapping[str, float] = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres", "mtr"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
    **dict.fromkeys(("ft", "feet", "foot", "ift", "intft", "internationalfeet", "internationalfoot"), 0.3048),
    **dict.fromkeys(("usft", "ftus", "sft", "usfeet", "usfoot", "ussurveyfeet", "ussurveyfoot"), US_FOOT_M),
}  # fmt: skip
_DEGREES: Mapping[str, float] = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "decimaldegrees", "decimaldegree", "dd", "°"), 1.0),
    **dict.fromkeys(("dms", "degreesminutesseconds", "degminsec"), 1.0),  # cells are read with minutes and seconds
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1.0)),
    **dict.fromkeys(("mrad", "milliradian", "milliradians"), math.degrees(1e-3)),
    **dict.fromkeys(("gon", "gons", "grad", "grads", "gradian", "gradians"), 0.9),
    **dict.fromkeys(("arcmin", "arcminutes"), 1.0 / 60.0),
    **dict.fromkeys(("arcsec", "arcseconds"), 1.0 / 3600.0),
}
_UNITS: Mapping[Kind, Mapping[str, float]] = {"length": _METRES, "angle": _DEGREES}
# What else stands in brackets behind a column's name and changes no number.
_SILENT = frozenset(
    ("", "wgs84", "utm", "easting", "northing", "east", "north", "up", "e", "n", "x", "y", "z", "lat", "lon",
     "longitude", "latitude", "altitude", "height", "true", "grid", "gimbal", "camera", "absolute", "abs", "1sigma",
     "sigma", "rms", "rmse", "std")
)  # fmt: skip
# Zeros of heights.
_DATUMS = re.compile(
    r"(above)?(wgs84)?(the)?(msl|amsl|asl|sealevel|meansealevel|hae|ellipsoid(al)?(height)?|orthometric(height)?"
    r"|geoid(al)?(height)?|egm(96|08|2008|84)|navd88|ngvd29|evrf\d*|dhhn\d*|odn)(height|datum)?"
)
# Of these the zeros that are known exactly: vertical CRSs, and the ellipsoid.
_ZEROS: Mapping[str, str] = {
    **dict.fromkeys(("hae", "ellipsoid", "ellipsoidal"), "ellipsoid"),
    **{"egm84": "EPSG:5798", "egm96": "EPSG:5773", "egm08": "EPSG:3855", "egm2008": "EPSG:3855"},
    **{"navd88": "EPSG:5703", "ngvd29": "EPSG:7968", "evrf2000": "EPSG:5730", "evrf2007": "EPSG:5621"},
    **{"evrf2019": "EPSG:9389", "dhhn92": "EPSG:5783", "dhhn2016": "EPSG:7837", "odn": "EPSG:5701"},
}
_RELATIVE = re.compile(r"(above|over)?(the)?(agl|ground|groundlevel|relative|rel|ato|takeoff|takeoffpoint|home)")
_BRACKET = re.compile(r"(.*\S)[\s_]*[\[(]([^\[\]()]*)[\])]\s*")
_SUBJECTS: Mapping[str, tuple[str, ...]] = {
    "heights": ("height", "heights", "altitude", "altitudes", "elevation", "elevations", "z"),
    "angles": ("angle", "angles", "rotations", "attitude", "attitudes", "orientation", "orientations", "opk", "ypr",
               "omega phi kappa", "yaw pitch roll", "phi omega kappa"),
    "coordinates": ("coordinates", "positions", "position", "x y", "x y z", "easting northing", "lengths", "distances"),
    "accuracies": ("accuracy", "accuracies", "standard deviations", "sigmas"),
    "units": ("unit", "units"),
}  # fmt: skip
_LINKS = frozenset(
    ("are", "is", "in", "given", "stated", "measured", "unit", "units", "all", "the", "as", "of", "m", "above")
)


def named_column(cell: str, names: Mapping[str, str]) -> tuple[str, str]:
    """A column's canonical name, and the unit that its name states, "" for none.

    names: every name in lower case with underscores -> the canonical one. `Alt [ft]` and `alt_ft` are alt, ft. A name
    that is not known stays as it is, without its bracket.
    """
    text = cell.strip().strip("\"'").strip().lower()
    match = _BRACKET.fullmatch(text)
    name, unit = (match[1], match[2].strip()) if match else (text, "")
    name = re.sub(r"[\s-]+", "_", name.strip()).strip("_")
    if name not in names:
        for cut in (name.rpartition("_"), _last_two(name)):
            if cut[0] in names and any(_bare(cut[2]) in units for units in _UNITS.values()) and not unit:
                return names[cut[0]], cut[2]
    return names.get(name, name), unit


def _last_two(name: str) -> tuple[str, str, str]:
    """`z_us_ft` cut before its last two words."""
    parts = name.rsplit("_", 2)
    return (parts[0], "_", "_".join(parts[1:])) if len(parts) == 3 else ("", "", "")


def is_relative(unit: str) -> bool:
    """Whether a word in brackets says that heights count from the ground or the take-off point."""
    return bool(_RELATIVE.fullmatch(_bare(unit)))


def factor(where: str, column: str, unit: str, kind: Kind) -> float:
    """Metres or degrees of one unit of a column. unit: as it stands there, "" for the usual one.

    Raises ConfigError where it is none of this kind.
    """
    parts = [part for part in re.split(r"[,;/|]", unit) if part.strip()]
    found = [_UNITS[kind][_bare(part)] for part in parts if _bare(part) in _UNITS[kind]]
    others = [part.strip() for part in parts if _bare(part) not in _UNITS[kind] and not _is_silent(part)]
    if len(set(found)) > 1 or others:
        usual = "m, ft, us-ft, km, cm or mm" if kind == "length" else "deg, gon or rad"
        raise ConfigError(
            f"{where}: column {column!r} counts in {unit!r}, which is no {kind} that is known: convert it, or name its "
            f"unit {usual}"
        )
    return found[0] if found else 1.0


def _is_silent(text: str) -> bool:
    return _bare(text) in _SILENT or bool(_DATUMS.fullmatch(_bare(text)))


def _bare(text: str) -> str:
    return re.sub(r"[\s._-]+", "", text.lower())


def stated_units(lines: Iterable[str], mark: str = "#") -> dict[str, str]:
    """What comments say of units: "heights", "angles", "coordinates", "accuracies" or "units" -> the unit, and
    "relative" -> the words of one that says that heights count from the ground, "datum" -> that name another zero.

    `# angles in gon`, `# heights: ellipsoidal, feet`: the unit follows the subject at once; other comments say nothing.
    """
    found: dict[str, str] = {}
    for line in lines:
        text = line.strip().lower()
        if not text.startswith(mark):
            continue
        words = [word for word in re.split(r"[\s,;:=()\[\]/]+", text.strip(mark)) if word]
        for what, subjects in _SUBJECTS.items():
            for subject in subjects:
                start = subject.split()
                if words[: len(start)] != start:
                    continue
                unit, relative = _unit_of(words[len(start) :])
                if unit:
                    found.setdefault(what, unit)
                if relative and what == "heights":
                    found.setdefault("relative", line.strip())
                if what == "heights" and _names_datum(words[len(start) :]):
                    found.setdefault("datum", line.strip())
    return found


def _names_datum(words: list[str]) -> bool:
    spans = (words[first : first + count] for first in range(len(words)) for count in (1, 2, 3))
    return any(_DATUMS.fullmatch(_bare("".join(span))) for span in spans)


def heights_named(comment: str) -> str:
    """What heights count from by a comment of theirs, as of `crs.heights_of`; "" where it names no zero, or several."""
    words = re.split(r"[\s,;:=()\[\]/#]+", comment.lower())
    found = {_ZEROS[word] for word in map(_bare, words) if word in _ZEROS}
    return found.pop() if len(found) == 1 else ""


def _unit_of(words: list[str]) -> tuple[str, bool]:
    """The unit that stands first behind linking words, "" for none, and whether they say that heights are relative."""
    for count in range(len(words)):
        for length in (3, 2, 1):
            text = _bare("".join(words[count : count + length]))
            if any(text in units and text not in ("m",) for units in _UNITS.values()):
                return text, False
            if _RELATIVE.fullmatch(text):
                return "", True
        word = words[count]
        if word not in _LINKS and not _DATUMS.fullmatch(_bare(word)):
            break
    return "", False


_NUMBER = r"\d+(?:[.,]\d+)?"
_SIDE = r"([NSEW]?)\s*([-+]?)"
# Capital letters are sides, small ones units: S is south, s seconds.
_ONE = re.compile(rf"{_SIDE}\s*({_NUMBER})\s*(?:°|º|d|deg|degrees)?()()\s*([NSEW]?)")
_SEVERAL = re.compile(
    rf"{_SIDE}\s*(\d+)\s*(?:°|º|\s|:|,|d|deg)\s*(?:(\d+)\s*(?:'|′|’|\s|:|,|m|min)\s*({_NUMBER})|({_NUMBER}))"
    r"\s*(?:\"|″|”|''|'|′|’|s|m|sec|min)?\s*([NSEW]?)",
)


def degrees_of(text: str, sides: str = "") -> float | None:
    """Signed degrees of `52.5`, `52,5`, `52.5 N`, `S 52° 30' 36.1"`, `52 30 36.1`, `52:30:36.1 N`; else None.

    sides: the letters that may stand there, the positive one first ("NS", "EW"), "" for none.
    """
    text = text.strip()
    if not text or len(text) > 60:
        return None
    try:
        return float(text)
    except ValueError:
        pass
    match = _ONE.fullmatch(text) or _SEVERAL.fullmatch(text)
    if match is None:
        return None
    front, sign, degrees, *minutes, back = match.groups()
    side = front or back
    if (front and back) or (side and (side not in sides or sign)):
        return None
    minutes = minutes if len(minutes) < 3 or not minutes[2] else [minutes[2]]
    values = [float(cell.replace(",", ".")) for cell in (degrees, *minutes) if cell]
    if any(value >= 60.0 for value in values[1:]):  # sixty minutes are a degree
        return None
    total = sum(value / 60.0**k for k, value in enumerate(values))
    return -total if sign == "-" or (side and side == sides[1]) else total


# As ExifTool writes heights.
_SEA_LEVEL = re.compile(r"\s(above|below) sea level$", re.IGNORECASE)
# Long numbers of a spreadsheet whose column is too narrow: those from a hundred on of which no decimal is left.
_ROUNDED = re.compile(r"[-+]?\d(?:[.,](\d*))?e\+?(\d+)", re.IGNORECASE)
_LONG = 2


def refuse_rounded(where: str, cell: str) -> None:
    """Raises ConfigError for a coordinate that a spreadsheet has rounded: 3.91E+05."""
    match = _ROUNDED.fullmatch(cell.strip())
    if match and int(match[2][:9]) >= _LONG and len(match[1] or "") <= int(match[2][:9]):
        raise ConfigError(
            f"{where}: {cell[:30]} has lost its last digits, as spreadsheets write long numbers: format the column as "
            "numbers with decimals, and save the list again"
        )


def metres_of(text: str, usual_m: float = 1.0) -> float | None:
    """Metres of `467.84`, `467,84`, `142.6 m`, `467.84 ft`, `142.6 m Above Sea Level`; None of anything else. usual_m:
    one unit where none stands behind the number."""
    text = text.strip()[:80]
    level = _SEA_LEVEL.search(text)
    if level is not None:
        value = metres_of(text[: level.start()], usual_m)
        return -value if value is not None and level[1].lower() == "below" else value
    match = re.fullmatch(r"([-+]?[\d.,]+(?:e[-+]?\d+)?|nan|[-+]?inf(?:inity)?)\s*([a-z][a-z _-]*)?", text, re.I)
    if match is None:
        return None
    number, unit = match[1], _bare(match[2] or "")
    if unit and unit not in _METRES:
        return None
    try:
        value = float(number.replace(",", ".") if number.count(",") == 1 and "." not in number else number)
    except ValueError:
        return None
    return value * (_METRES[unit] if unit else usual_m)


def kind_of(unit: str) -> Kind | None:
    """Of what a unit is one, None for none that is known."""
    return next((kind for kind, units in _UNITS.items() if _bare(unit) in units), None)
