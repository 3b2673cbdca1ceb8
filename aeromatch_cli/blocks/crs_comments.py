"""Which CRS comments name: by a label (`# CRS: ...`), a code, PROJ's words, WKT, or the zone of UTM and its datum."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from aeromatch_cli.blocks.crs import parsed_crs
from aeromatch_cli.blocks.zeros import is_datum, names_datum

_LABEL = re.compile(
    r"(?:(?:gps|horizontal|geodetic|geographic)\s+)?(?P<label>crs|srs|srid|epsg|projection|projcs|projcrs|geogcs|geogcrs"
    r"|coordinates|positions|(?:coordinate|spatial)\s*(?:reference\s*)?(?:system)?|reference\s*system|datum|koordinatensystem)"
    r"\s*(?P<mark>[:=,]|\s(?=\S))\s*(?P<text>\S.*)",
    re.IGNORECASE,
)
# Labels behind which other words may stand without a mark between.
_LOOSE = ("projection", "coordinate", "spatial", "coordinate system", "reference system")
# Labels of much else than a CRS.
_OFTEN = ("coordinates", "positions", "coordinate", "spatial")
_CODE = re.compile(r"\b(EPSG|ESRI|IGNF|SRID)\b(?:\s*code)?[\s:=/]{1,4}(\d{4,6})((?:\+\d{4,6})?)", re.IGNORECASE)
_PROJ = re.compile(r"\+(?:proj|init)=.*")
_WKT = re.compile(r"(?:PROJ|GEOG|COMPD|GEOD|BOUND|COMPOUND|LOCAL_|ENG)(?:CS|CRS)\[.*")
_ZONE = re.compile(
    r"\bUTM[\s_-]*(?:zone[\s_:=-]*)?(\d{1,2})(?:\s*([A-Z])\b|[\s,]*(north|south)(?:ern(?:\s+hemisphere)?)?)?(?![A-Z\d])",
    re.IGNORECASE,
)
_DATUM = re.compile(
    r"\b(WGS\s*[_-]?\s*84|WGS\s*72|NAD\s*27|NAD\s*83(?:\s*\([\w ]+\))?|ETRS\s*89|ED\s*50|GDA\s*(?:94|2020)"
    r"|JGD\s*(?:2000|2011)|SIRGAS\s*2000|RGF\s*93|OSGB\s*36|Tokyo|DHDN|CH1903\+?|SAD69|Pulkovo\s*1942)(?!\w)",
    re.IGNORECASE,
)
_SPELLED = {"WGS84": "WGS 84", "WGS72": "WGS 72", "SIRGAS2000": "SIRGAS 2000", "PULKOVO1942": "Pulkovo 1942",
            "TOKYO": "Tokyo"}  # fmt: skip
# What speaks of a CRS, or of sides of the globe, and names none that is whole.
_HINT = re.compile(
    r"\b(utm|state\s*plane|spcs|gauss|lambert|mercator|hemisphere|(?<!time )zone\s*[:=]?\s*\d+\s*[A-Z]?"
    r"|(south|west)(ern)?\s+(lat|lon)\w*)\b",
    re.IGNORECASE,
)
# How names of projected CRSs are written.
_NAME = re.compile(r"[\w().+ -]{3,40} / [\w().+ -]{3,40}")
_WGS84 = ("WGS 84", "WGS84")
# Words by which a comment tells of another list than this one.
_OF_OTHERS = re.compile(r"\b(from|converted|transformed|original|originally|not|was|were)\b", re.IGNORECASE)


@dataclass(frozen=True)
class CrsComment:
    """crs: text for `crs.parsed_crs`, as it stands there where that cannot read it, "" where it names none that is
    whole. rest: what else the comment says. datum: whether only a datum is named, which says nothing of grids. unclear:
    a remark where it cannot be applied."""

    crs: str = ""
    rest: str = ""
    datum: bool = False
    unclear: str = ""


def crs_comment(line: str) -> CrsComment | None:
    """Return what a comment says of the CRS, None where it says nothing of one."""
    comment = line.strip()
    if not comment.startswith("#"):
        return None
    body = comment.strip("# \t,;")
    label = _LABEL.match(body)
    if label is not None:
        found = _labelled(comment, label["label"].lower(), label["mark"].strip(), label["text"].strip(" \t,;"))
        if found is not None:
            return found
    whole = _WKT.search(body) or _PROJ.search(body)
    if whole:
        return CrsComment(whole[0])
    return _of_code(comment, body) or _of_words(comment, body)


def _of_code(comment: str, body: str) -> CrsComment | None:
    """Return the CRS whose code a comment names, None where it names none."""
    codes = list(_CODE.finditer(body))
    if not codes:
        return None
    if len({code[2] for code in codes}) > 1 or _OF_OTHERS.search(body):
        return CrsComment(rest=body, unclear=f"{comment!r} does not say which CRS the list has: name it, # CRS: ...")
    return CrsComment(_code(codes[0]), _without(body, codes[0]))


def _of_words(comment: str, body: str) -> CrsComment | None:
    """Return the CRS that a comment names by a zone of UTM, by its name or by its datum, None where it names none."""
    zone = _ZONE.search(body)
    if zone is not None and not _OF_OTHERS.search(body):
        crs, rest = _of_zone(body, zone), body[zone.end() :]
        return CrsComment(crs, rest) if crs else CrsComment(rest=rest, unclear=_not_whole(comment))
    if _NAME.fullmatch(body) and _parses(body):
        return CrsComment(body)
    datum = _DATUM.search(body)
    if datum and datum[0] == body and _parses(_spelled(body)):
        return _of_datum(comment, body, "")
    if _HINT.search(body) or (datum and _spelled(datum[0]) not in _WGS84):
        return CrsComment(rest=body, unclear=_not_whole(comment))
    return None


def _labelled(comment: str, label: str, mark: str, text: str) -> CrsComment | None:
    """Return the CRS behind a label, None where the text is none of a CRS. mark: between both, "" for a blank."""
    if _is_no_crs(label, text):
        return None
    code, datum = _CODE.search(text), _DATUM.match(text)
    if label in ("epsg", "srid") and re.fullmatch(r":?\s*\d{4,6}(\+\d{4,6})?", text):
        return CrsComment(f"EPSG:{text.strip(': ')}")
    if not mark and (code or label in _LOOSE or (label == "datum" and datum is None)):
        return None  # prose, in which a code counts as elsewhere
    parsed = _parsed_label(comment, label, text)
    if parsed is not None:
        return parsed
    if code:
        return CrsComment(_code(code), _without(text, code))
    zone = _ZONE.search(text)
    if zone:
        crs = _of_zone(text, zone)
        return CrsComment(crs, text[zone.end() :]) if crs else CrsComment(text)
    if datum and (label == "datum" or datum.end() == len(text)):
        return _of_datum(comment, datum[0], text[datum.end() :])
    if label == "datum":
        return CrsComment(rest=text, unclear=f"{comment!r} names no datum that is known: name a CRS, # CRS: EPSG:...")
    return CrsComment(text) if mark and label not in _OFTEN else None


def _is_no_crs(label: str, text: str) -> bool:
    """Whether the text behind a label is a datum of heights, or a date."""
    if is_datum(text):
        return True
    return label == "datum" and (names_datum(text.lower().split()) or text[:1].isdigit())


def _parsed_label(comment: str, label: str, text: str) -> CrsComment | None:
    """Return the CRS that the text behind a label, or its first part, is the name of; None where it is none."""
    bare = text.strip("\"'")
    for words in dict.fromkeys((bare, re.split(r"[,;]", bare)[0].strip())):
        if _parses(words):
            rest = bare[len(words) :]
            alone = label in ("datum", *_OFTEN) and _DATUM.fullmatch(words) is not None
            return _of_datum(comment, words, rest) if alone else CrsComment(words, rest)
    return None


def _code(match: re.Match[str]) -> str:
    authority = match[1].upper().replace("SRID", "EPSG")
    return f"{authority}:{match[2]}{match[3]}"


def _without(text: str, code: re.Match[str]) -> str:
    """What stands behind a code; before it stands the name of the CRS."""
    return text[code.end() :].strip(" )]\"'")


def _of_zone(text: str, zone: re.Match[str]) -> str:
    """The CRS of a zone of UTM with the datum beside it; "" without one, or without hemisphere."""
    datum = _DATUM.search(text)
    letter = (zone[2] or zone[3] or "")[:1].upper()
    if datum is None or not letter:
        return ""
    side = "N" if letter >= "N" and letter != "S" else "S"
    crs = f"{_spelled(datum[0])} / UTM zone {int(zone[1])}{side}"
    return crs if _parses(crs) else ""


def _of_datum(comment: str, name: str, rest: str) -> CrsComment:
    crs = _spelled(name)
    return CrsComment(crs, rest, datum=True, unclear="" if crs in _WGS84 else _not_whole(comment))


def _spelled(datum: str) -> str:
    text = re.sub(r"[\s_-]+(?![\w ]*\))", "", datum).upper()
    return _SPELLED.get(text, text)


@lru_cache(maxsize=64)
def _parses(text: str) -> bool:
    """Whether a text names a CRS that has coordinates. Ordinary words are not looked up, which takes seconds."""
    if not (re.search(r"[\d/\[]", text) or _DATUM.match(text)):
        return False
    from pyproj.exceptions import CRSError

    try:
        found = parsed_crs(text)
    except CRSError:
        return False
    return bool(found.is_projected or found.is_geographic)


def _not_whole(comment: str) -> str:
    return (
        f"{comment!r} names no whole CRS and is not applied: the coordinates must count in that of --crs, or of a "
        "comment such as # CRS: EPSG:32633, with signs for the sides of the globe"
    )
