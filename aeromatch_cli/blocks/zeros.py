"""What heights count from, as columns and comments name it: a datum, or the ground and the take-off point."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

_DATUMS = re.compile(
    r"(above)?(wgs84)?(the)?(msl|amsl|asl|sealevel|meansealevel|hae|ellipsoid(al|e|isch)?(height)?|orthometric(height)?"
    r"|geoid(al)?(height)?|egm(96|08|2008|84)|navd88|ngvd29|evrf\d*|dhhn\d*|odn)(height|datum)?"
)
# Of these the zeros that are known exactly: vertical CRSs, and the ellipsoid.
_ZEROS: Mapping[str, str] = {
    **dict.fromkeys(("hae", "ellipsoid", "ellipsoidal"), "ellipsoid"),
    **{"egm84": "EPSG:5798", "egm96": "EPSG:5773", "egm08": "EPSG:3855", "egm2008": "EPSG:3855"},
    **{"navd88": "EPSG:5703", "ngvd29": "EPSG:7968", "evrf2000": "EPSG:5730", "evrf2007": "EPSG:5621"},
    **{"evrf2019": "EPSG:9389", "dhhn92": "EPSG:5783", "dhhn2016": "EPSG:7837", "odn": "EPSG:5701"},
}
# A word that names a datum of heights alone; the others say so beside heights.
_NAMED = re.compile(r"egm(84|96|08|2008)|navd88|ngvd29|evrf\d*|dhhn\d*")
_RELATIVE = re.compile(
    r"(m|ft)?(above|over|relativeto|to)?(the)?(agl|ground|groundlevel|relative|rel|ato|takeoff|takeoffpoint|home"
    r"|homepoint|launch|launchpoint)"
)
# Words of a comment, joined by blanks, that say the same of heights.
_RELATIVE_WORDS = re.compile(
    r"\b(agl|ato|relativetoground|relative(?! (accura|precis|error|orient|posi))"
    r"|(above|over|über|ueber|from|to|reference|ref|datum|zero|mode|type|is|are|relative|heights?|altitudes?|elevations?|z|alt)"
    r" (the |local |dem )*(ground|terrain|surface|take ?off|home|launch|grund|boden|gelände|startpunkt)"
    r"(?! (control|sampling|sample|truth|points\b|station)))"
)


def bare(text: str) -> str:
    """Small letters, without what stands between words."""
    return re.sub(r"[\s._-]+", "", text.lower())


def is_datum(text: str) -> bool:
    return bool(_DATUMS.fullmatch(bare(text)))


def is_named_datum(word: str) -> bool:
    """Whether a word names a datum that is one of heights wherever it stands."""
    return bool(_NAMED.fullmatch(word))


def is_relative(unit: str) -> bool:
    """Whether a word in brackets says that heights count from the ground or the take-off point."""
    return bool(_RELATIVE.fullmatch(bare(unit)))


def says_relative(words: Sequence[str]) -> bool:
    """Whether words that speak of heights say that they count from the ground or the take-off point."""
    return bool(_RELATIVE_WORDS.search(" ".join(words)))


def names_datum(words: Sequence[str]) -> bool:
    spans = (words[first : first + count] for first in range(len(words)) for count in (1, 2, 3))
    return any(is_datum("".join(span)) for span in spans)


def zero_of(words: Sequence[str]) -> str:
    """What heights count from by words, as of `crs.heights_of`; "" where these name no zero, or several."""
    found = {_ZEROS[word] for word in words if word in _ZEROS}
    return found.pop() if len(found) == 1 else ""
