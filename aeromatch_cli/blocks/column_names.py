"""Columns of lists beyond those with a known name: heights by their words, sides of the globe, and units."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from aeromatch_cli.blocks.statements import quantity_of
from aeromatch_cli.blocks.units import is_usual, kind_of
from aeromatch_cli.blocks.zeros import is_datum
from aeromatch_cli.errors import ConfigError

_HEIGHT = frozenset(
    ("height", "heights", "altitude", "alt", "elevation", "elev", "z", "hgt", "höhe", "hoehe", "hauteur", "altura",
     "altitud", "quota")
)  # fmt: skip
_WITH_HEIGHT = frozenset(
    ("gps", "gnss", "camera", "above", "sea", "level", "mean", "absolute", "abs", "geodetic", "normal")
)
_DATUMS_ALONE = frozenset(("msl", "amsl", "asl", "hae"))
# Words of columns that hold other heights, or accuracies of heights.
_NO_HEIGHT = frozenset(
    (
        "agl",
        "ato",
        "ground",
        "takeoff",
        "home",
        "relative",
        "rel",
        "accuracy",
        "std",
        "sigma",
        "sd",
        "rms",
        "error",
        "unit",
    )
)
_REFERENCE_COLUMN = re.compile(
    r"(gps|horizontal|geodetic)?_?(map)?_?datum|(gps)?_?(alt|altitude|height|elevation|vertical|z)_?(ref|reference|datum|mode|type)"
)
# Altitudes that EXIF calls those above sea level.
_USUAL_REFERENCES = ("0", "above sea level", "above", "absolute")
_UNIT_COLUMN = re.compile(r"(?:(.+)_)?(?:unit|units|uom)")
_BLANK = frozenset(("", "nan", "na", "n/a", "none", "null", "-"))

_LATITUDE, _LONGITUDE = ("lat", "latitude", "gpslatitude", "gps_latitude"), (
    "lon", "long", "lng", "longitude", "gpslongitude", "gps_longitude",
)  # fmt: skip
_ENDS = ("ref", "_ref", "_hemisphere", "_hemi", "_dir", "_direction")
# Columns that hold the side of the globe: N or S, E or W.
LATITUDE_SIDES = frozenset((*(f"{name}{end}" for name in _LATITUDE for end in _ENDS), "lat_ns", "n/s", "n_s"))
LONGITUDE_SIDES = frozenset((*(f"{name}{end}" for name in _LONGITUDE for end in _ENDS), "lon_ew", "e/w", "e_w"))


def words_of_height(cell: str) -> tuple[str, str]:
    """The name and the unit of a column whose words are all those of a height: `Alt(m) MSL` is alt_msl and m; "" and ""
    for any other."""
    words = [word for word in re.split(r"[\s_()\[\],.-]+", cell.strip().strip("\"'").lower()) if word]
    name, unit = [], []
    for word in words[:8]:
        if word in _HEIGHT or word in _WITH_HEIGHT or is_datum(word):
            name.append(word)
        elif kind_of(word) == "length" or word in ("us", "survey"):
            unit.append(word)
        else:
            return "", ""
    if len(words) > 8 or not (_HEIGHT | _DATUMS_ALONE) & set(name):
        return "", ""
    if unit and kind_of("".join(unit)) is None:
        return "", ""
    return "_".join(name), "".join(unit)


def is_height(name: str) -> bool:
    """Whether a column that `words_of_height` has named is one."""
    return bool(name) and words_of_height(name)[0] == name


def seems_height(name: str) -> bool:
    """Whether a name has a word of heights among others."""
    words = set(re.split(r"[^\w]|_|\d", name))
    if words & _NO_HEIGHT or _REFERENCE_COLUMN.fullmatch(name):
        return False
    return bool((_HEIGHT - {"z"} | _DATUMS_ALONE) & words)


def side(where: str, cell: str, sides: str) -> str:
    """N, S, E or W of a cell; "" where it is empty. Raises ConfigError for anything else. sides: "NS" or "EW"."""
    text = cell.strip().upper()
    if text.lower() in _BLANK:
        return ""
    words = {"NORTH": "N", "SOUTH": "S", "EAST": "E", "WEST": "W", "NORD": "N", "SUD": "S"}
    found = words.get(text, text)
    if found not in tuple(sides):
        raise ConfigError(f"{where}: {cell!r} is no side of the globe: write {sides[0]} or {sides[1]}")
    return found


def on_side(where: str, degrees: float, found: str) -> float:
    """Signed degrees of those that lie on a side. Raises ConfigError where their sign says the other one."""
    if found in ("S", "W"):
        return -abs(degrees)
    if found and degrees < 0.0:
        raise ConfigError(f"{where}: {degrees:g} and the side {found} contradict each other: correct one")
    return degrees


def comments_of_columns(
    where: str, columns: Sequence[str], records: Iterable[Mapping[int, str]]
) -> tuple[list[str], tuple[int, ...], list[str]]:
    """Return what columns of units (`altitude_unit`: ft), datums and zeros (`altitude_ref`: takeoff) say, as comments,
    the places of these columns, and remarks.

    records: cells of every line by their place. Raises ConfigError where a column says several things.
    """
    quantities = _quantities(columns)
    stated: dict[int, set[str]] = {place: set() for place in quantities}
    for record in records if quantities else ():
        for place, seen in stated.items():
            cell = record.get(place, "").strip().lower()
            if cell not in _BLANK:
                seen.add(cell)
    comments, taken, remarks = [], [], []
    for place, quantity in quantities.items():
        column, texts = columns[place], sorted(stated[place])
        if len(texts) > 1:
            raise ConfigError(f"{where}, column {column}: {texts[0]} and {texts[1]}: only one can be applied")
        text = texts[0] if texts else ""
        if quantity == "datum":
            taken.append(place)
            if text in ("1", "below sea level"):
                remarks.append(f"column {column!r} says below sea level, which is not applied: write a minus")
            elif text and text not in _USUAL_REFERENCES:
                of_heights = re.search(r"alt|height|elev|vert|^z", column)
                comments.append(f"# altitude reference: {text}" if of_heights else f"# Datum: {text}")
        elif text and kind_of(text) is None:
            remarks.append(f"column {column!r} names {text!r}, which is no unit that is known: not applied")
        elif text:
            taken.append(place)
            if quantity or not is_usual(text):
                comments.append(f"# {quantity} unit: {text}")
    return comments, tuple(taken), remarks


def _quantities(columns: Sequence[str]) -> dict[int, str]:
    """Return place of a column -> of what it states units, in words; "datum" where it states what values count from."""
    found = {}
    for place, name in enumerate(columns):
        match = _UNIT_COLUMN.fullmatch(name)
        if match and quantity_of(match[1] or "") is not None:
            found[place] = (match[1] or "").replace("_", " ")
        elif _REFERENCE_COLUMN.fullmatch(name):
            found[place] = "datum"
    return found
