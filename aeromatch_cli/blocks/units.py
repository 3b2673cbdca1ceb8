"""Units and conventions that a file states beside its numbers: in the name of a column, or in a comment.

Numbers become metres and degrees. A unit that is none of a column's kind is refused by name, never passed over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Literal

from aeromatch_cli.blocks.zeros import bare, is_datum
from aeromatch_cli.errors import ConfigError

Kind = Literal["length", "angle"]

US_FOOT_M = 1200.0 / 3937.0
_FEET = ("ft", "feet", "foot")
_SURVEY = ("us", "ussurvey", "survey", "usa", "american")
_METRES: Mapping[str, float] = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres", "mtr", "metern"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
    **dict.fromkeys(("yd", "yard", "yards"), 0.9144),
    **{f"{which}{foot}": 0.3048 for which in ("", "i", "int", "intl", "international") for foot in _FEET},
    **{f"{foot}{which}": 0.3048 for which in ("int", "intl", "international") for foot in _FEET},
    **dict.fromkeys(("pies", "pieds", "piedi", "fuss", "fuß"), 0.3048),
    **{f"{which}{foot}": US_FOOT_M for which in (*_SURVEY, "s") for foot in _FEET},
    **{f"{foot}{which}": US_FOOT_M for which in _SURVEY for foot in _FEET},
}  # fmt: skip
_DEGREES: Mapping[str, float] = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "decimaldegrees", "decimaldegree", "dd", "°"), 1.0),
    **dict.fromkeys(("dms", "degreesminutesseconds", "degminsec"), 1.0),  # cells are read with minutes and seconds
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1.0)),
    **dict.fromkeys(("mrad", "milliradian", "milliradians"), math.degrees(1e-3)),
    **dict.fromkeys(("gon", "gons", "grad", "grads", "gradian", "gradians"), 0.9),
    **dict.fromkeys(("centesimaldegree", "centesimaldegrees", "g", "400g", "gon400", "grad400"), 0.9),
    **dict.fromkeys(("mgon", "milligon"), 0.9e-3) | dict.fromkeys(("cc", "centesimalseconds"), 0.9e-4),
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
_BRACKET = re.compile(r"(.*\S)[\s_]*[\[(]([^\[\]()]*)[\])]\s*")


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
            if cut[0] in names and any(bare(cut[2]) in units for units in _UNITS.values()) and not unit:
                return names[cut[0]], cut[2]
    return names.get(name, name), unit


def _last_two(name: str) -> tuple[str, str, str]:
    """`z_us_ft` cut before its last two words."""
    parts = name.rsplit("_", 2)
    return (parts[0], "_", "_".join(parts[1:])) if len(parts) == 3 else ("", "", "")


def factor(where: str, column: str, unit: str, kind: Kind) -> float:
    """Metres or degrees of one unit of a column. unit: as it stands there, "" for the usual one.

    Raises ConfigError where it is none of this kind.
    """
    parts = [_without_silent(part) for part in re.split(r"[,;/|]", unit) if part.strip()]
    found = [_UNITS[kind][bare(part)] for part in parts if bare(part) in _UNITS[kind]]
    others = [part.strip() for part in parts if bare(part) not in _UNITS[kind] and not _is_silent(part)]
    if len(set(found)) > 1 or others:
        usual = "m, ft, us-ft, km, cm or mm" if kind == "length" else "deg, gon or rad"
        raise ConfigError(
            f"{where}: column {column!r} counts in {unit!r}, which is no {kind} that is known: convert it, or name its "
            f"unit {usual}"
        )
    return found[0] if found else 1.0


def _without_silent(text: str) -> str:
    """`ft` of `NAVD88 ft`; the text where nothing is left, or it is known as it is."""
    if kind_of(text) or _is_silent(text):
        return text
    return " ".join(word for word in text.split() if not _is_silent(word)) or text


def _is_silent(text: str) -> bool:
    return bare(text) in _SILENT or is_datum(text)


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
    if front and back:
        return None
    side = front or back
    if side and (side not in sides or sign):
        return None
    total = _sexagesimal(degrees, minutes)
    if total is None:
        return None
    negative = sign == "-" or (side != "" and side == sides[1])
    return -total if negative else total


def _sexagesimal(degrees: str, minutes: list[str]) -> float | None:
    """Return degrees of whole degrees and of minutes and seconds, or decimal minutes in the last of three cells; None
    where sixty minutes, which are a degree, are named."""
    if len(minutes) == 3 and minutes[2]:
        minutes = minutes[2:]
    values = [float(cell.replace(",", ".")) for cell in (degrees, *minutes) if cell]
    if any(value >= 60.0 for value in values[1:]):
        return None
    return sum(value / 60.0**k for k, value in enumerate(values))


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
    number, unit = match[1], bare(match[2] or "")
    if unit and unit not in _METRES:
        return None
    try:
        value = float(number.replace(",", ".") if number.count(",") == 1 and "." not in number else number)
    except ValueError:
        return None
    return value * (_METRES[unit] if unit else usual_m)


def is_same(one: str, other: str) -> bool:
    """Whether two names of units are those of one."""
    return one == other or any(units.get(one, 1.0) == units.get(other, 2.0) for units in _UNITS.values())


def is_usual(unit: str) -> bool:
    """Whether a unit is the metre or the degree."""
    return any(units.get(bare(unit)) == 1.0 for units in _UNITS.values())


def kind_of(unit: str) -> Kind | None:
    """Of what a unit is one, None for none that is known."""
    return next((kind for kind, units in _UNITS.items() if bare(unit) in units), None)
