"""What comments state of the numbers below them: what is meant, and its unit, its zero, or its north.

A comment is read word by word. Words for a quantity (heights, x and y, coordinates, angles, accuracies, or all values)
are kept until a unit follows, or precedes them at once: `# heights: ellipsoidal, feet`, `# Vertical unit: foot_us`,
`# angles [gon]`. Between the two stand only words that link them. A number before a unit makes a measurement, which
states nothing of columns (`# flight height 100 m`, `# images taken in 5 m steps`). What names a unit, and leaves open
what counts so, is applied to nothing and becomes a remark.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, cast

from aeromatch_cli.blocks.crs_comments import crs_comment
from aeromatch_cli.blocks.units import Kind, is_same, is_usual, kind_of
from aeromatch_cli.blocks.zeros import is_datum, is_named_datum, names_datum, says_relative, zero_of

Quantity = Literal["heights", "across", "coordinates", "angles", "accuracies", "all"]

_WORDS: Mapping[Quantity, str] = {
    "heights": "height heights altitude altitudes elevation elevations elev alt z vertical höhe höhen hoehe hoehen "
    "hauteur hauteurs altura alturas altitud",
    "across": "horizontal planimetric x y xy easting eastings northing northings latitude latitudes longitude "
    "longitudes lat lon",
    "coordinates": "coordinate coordinates position positions linear length lengths distance distances xyz koordinaten",
    "angles": "angle angles angular rotation rotations attitude attitudes orientation orientations omega phi kappa yaw "
    "pitch roll heading headings opk ypr winkel ángulos angulos",
    "accuracies": "accuracy accuracies sigma sigmas std stdev stddev sd deviation deviations dev rms rmse hrms vrms "
    "precision precisions uncertainty uncertainties",
    "all": "unit units all values everything numbers data measurements dimensions einheit einheiten unidades unités",
}
_QUANTITIES: Mapping[str, Quantity] = {word: what for what, words in _WORDS.items() for word in words.split()}
_KINDS: Mapping[Quantity, tuple[Kind, ...]] = {
    "heights": ("length",), "across": ("length", "angle"), "coordinates": ("length", "angle"), "angles": ("angle",),
    "accuracies": ("length", "angle"), "all": ("length", "angle"),
}  # fmt: skip


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


# What may stand between a quantity and its unit.
_LINKS = _set(
    "are is in given stated measured expressed reported recorded as of for and or the a by default above below system "
    "measure reference datum mean sea level over from to relative standard here this these file list table columns "
    "column following both each survey use uses used using count counts written sind ist en"
)
# Words that stand with a quantity and change nothing.
_WITH_QUANTITY = _set(
    "rotation camera gimbal gps gnss rtk ppk ellipsoidal orthometric geoid geodetic ground projection centre centres "
    "center centers true grid normal ellipsoid above takeoff agl relative wgs84 utm absolute decimal"
)
# Other things that have a unit, which are not in the columns.
_OTHERS = _set(
    "focal sensor pixel pixels gsd resolution speed overlap sidelap spacing interval intervals antenna lever offset "
    "offsets baseline wind lens size step steps flying flight flown mission buffer tolerance scale separation "
    "undulation"
)
# Of these the words that may mean the flight or the heights of the list.
_FLIGHT = _set("flying flight flown mission")
# Feet of other lengths than those that are known.
_FOREIGN = _set("indian clarke clarkes cape sears british gold")
# A comment with one of these may say the contrary of what its other words say.
_NEGATIONS = _set("not no nor without kein keine converted")
_HEADINGS = _set("yaw heading headings azimuth azimuths north angles kappa bearing bearings")
# The first name of a line that names columns.
_IMAGE_NAMES = _set(
    "image images name filename file label photo imagename image_name file_name photo_name point gcp id"
)
# A number and letters behind it are two words; of names of datums the number is a part.
_WORD = re.compile(r"[^\W\d_][^\W_]*|\d+(?:[.,]\d+)*|°")
_DATUM_NUMBER = re.compile(r"\b(egm|navd|ngvd|wgs|nad|etrs|dhhn|evrf|grs|jgd|gda)[\s_-]*(\d{2,4})\b")
_CLAUSE = re.compile(r"[;,]|\.(?=\s)|\s-\s")
_ZERO_ALONE = re.compile(r"(reference|ref|datum|zero)( point| level)? (the )?(ground|take ?off|home|launch)( .*)?")
_BEFORE_ACCURACY = re.compile(r"[,/&+]\s*(?=(accurac|sigma|std|standard|precis|uncert))")
# So many gon or degrees are a circle, and no measurement.
_CIRCLES = ("400", "360")


@dataclass
class Statements:
    """What the comments of a file state.

    crs: text for `crs.parsed_crs`; datum_crs: that of degrees, by a datum alone. units: by quantity and kind. relative:
    the comment by which heights count from the ground; datum: that which names another zero of theirs; zero: that as of
    `crs.heights_of`. north: "true", "grid" or "magnetic" as headings count from it, by the comment north_in. remarks:
    what cannot be applied, by name; not_whole: the same of words for a CRS, where nothing else names one.
    """

    crs: str | None = None
    datum_crs: str | None = None
    units: dict[tuple[Quantity, Kind], str] = field(default_factory=dict)
    relative: str = ""
    datum: str = ""
    zero: str = ""
    north: str = ""
    north_in: str = ""
    remarks: list[str] = field(default_factory=list)
    not_whole: list[str] = field(default_factory=list)

    def crs_of(self, *, grid: bool) -> str | None:
        """The CRS. grid: of grid coordinates, of which a datum alone says nothing."""
        return self.crs or (None if grid else self.datum_crs)

    def unit(self, kind: Kind, *quantities: Quantity) -> str:
        """The unit of the first of these that has one, "" for none. A unit of the other kind counts, so that it is
        refused, only where it is stated of the first quantity itself."""
        for what in quantities:
            if (what, kind) in self.units:
                return self.units[what, kind]
        first = quantities[0]
        if kind in _KINDS[first] and len(_KINDS[first]) > 1:
            return ""
        return self.units.get((first, "angle" if kind == "length" else "length"), "")


def statements_of(lines: Iterable[str], mark: str = "#") -> Statements:
    """What comments state; of two that state the same the first counts."""
    found = Statements()
    for line in lines:
        text = line.strip()
        if not text.startswith(mark) or _names_columns(text.lstrip(mark)):
            continue
        system = crs_comment(text)
        if system is not None:
            if system.datum:
                found.datum_crs = found.datum_crs or system.crs or None
            else:
                found.crs = found.crs or system.crs or None
            found.not_whole += [system.unclear] if system.unclear else []
        _read(found, text, text if system is None else f"{mark} {system.rest}")
    return found


def quantity_of(words: str) -> Quantity | None:
    """Return what a column of units is of, by its words; None for something else."""
    found = [_QUANTITIES.get(word) for word in words.split("_") if word]
    if None in found:
        return None
    return found[0] if found else "all"


def _names_columns(text: str) -> bool:
    """Whether a comment is a header, whose columns state their own units."""
    cells = [cell.strip().strip("\"'").lower() for cell in re.split(r"[,;\t]", text.strip())]
    if len(cells) > 2 and _IMAGE_NAMES & set(cells):
        return True
    words = text.lower().split()
    return len(words) > 3 and words[0] in _IMAGE_NAMES and _QUANTITIES.get(words[1], "all") in ("across", "heights")


def _read(found: Statements, comment: str, text: str) -> None:
    """comment: for messages. text: what of it is read here."""
    text = _DATUM_NUMBER.sub(r"\1\2", text.lower().replace("ß", "ss"))
    text = _BEFORE_ACCURACY.sub(" and ", text)
    words = _WORD.findall(text)
    if _NEGATIONS & set(words):
        if says_relative(words) or any(kind_of(word) and not is_usual(word) for word in words):
            found.remarks.append(_unplaced(comment))
        return
    _read_units(found, comment, words)
    if _ZERO_ALONE.fullmatch(" ".join(words)):
        found.remarks.append(f"{comment!r} may say what heights count from: if they do, leave them out")
    heights = any(_QUANTITIES.get(word) == "heights" or is_named_datum(word) for word in words)
    for clause in _CLAUSE.split(text):
        _read_zero(found, comment, _WORD.findall(clause), heights=heights)
    if "north" in words or "magnetic" in words:
        _read_north(found, comment, words)


def _read_units(found: Statements, comment: str, words: Sequence[str]) -> None:
    stated: dict[tuple[Quantity, Kind], str] = {}
    for unit, subjects in _pairs(words):
        if not subjects:
            if not is_usual(unit):
                found.remarks.append(_unplaced(comment))
            continue
        for subject in subjects:
            known = stated.setdefault((subject, kind_of(unit) or "length"), unit)
            if not is_same(known, unit):
                found.remarks.append(
                    f"{comment!r} names {known} and {unit} for one thing: neither is applied; write the unit behind "
                    "the names of the columns"
                )
                return
    for key, unit in stated.items():
        found.units.setdefault(key, unit)


def _pairs(words: Sequence[str]) -> Iterator[tuple[str, Sequence[Quantity]]]:
    """Units of a comment, each with what counts so; with nothing where that is not clear."""
    for phrase in _phrases(words):
        places = [place for place, (kind, _) in enumerate(phrase) if kind == "unit"]
        leading = places[:1] == [0]  # `US feet heights`, `feet: x y z`
        subjects: Sequence[Quantity] = ()
        for start, place, end in zip([-1, *places], places, [*places[1:], len(phrase)], strict=False):
            between = phrase[place + 1 : end] if leading else phrase[start + 1 : place]
            # Of two units in a row the second counts for the same quantities.
            subjects = _meant(between) or subjects
            yield phrase[place][1], subjects


_Item = tuple[Literal["unit", "what", "and"], str]


def _phrases(words: Sequence[str]) -> Iterator[list[_Item]]:
    """Units and quantities that no other word parts. Measurements, and other things with their unit, part them."""
    phrase: list[_Item] = []
    place, other = 0, False
    while place < len(words):
        word, (unit, count) = words[place], _unit_at(words, place)
        parts = False
        if unit:
            before = words[place - 1] if place else ""
            measured = before[:1].isdigit()
            circle = before in _CIRCLES and kind_of(unit) == "angle"
            parts = other or (measured and not circle)
            if other and not measured and _FLIGHT & set(words):
                yield [("unit", unit)]
            if not parts:
                phrase.append(("unit", unit))
            other = False
        elif word in _QUANTITIES or is_named_datum(word):
            phrase.append(("what", _QUANTITIES.get(word, "heights")))
        elif word in ("and", "und", "et"):
            phrase.append(("and", word))
        elif word in _OTHERS:
            parts = other = True
        else:
            parts = not (word in _LINKS or word in _WITH_QUANTITY | _FOREIGN or is_datum(word) or word[:1].isdigit())
        if parts or other:
            yield phrase
            phrase = []
        place += max(count, 1)
    yield phrase


def _unit_at(words: Sequence[str], place: int) -> tuple[str, int]:
    """Return the unit that begins at a word, and of how many words it is; "", 0 for none."""
    most = 1 if words[place] == "m" else min(4, len(words) - place)
    for count in range(most, 0, -1):
        text = "".join(words[place : place + count])
        if not kind_of(text) or text == "cc" or (len(text) == 1 and text not in ("m", "°")):
            continue
        if place and words[place - 1] in _FOREIGN:
            return f"{words[place - 1]} {text}", count
        return text, count
    return "", 0


def _meant(items: Sequence[_Item]) -> Sequence[Quantity]:
    """Of what a unit is: an accuracy of heights is an accuracy, where it does not stand beside them (`heights and
    accuracies`), and a unit of angles is one of angles."""
    found: list[Quantity] = []
    beside = False
    for place, (kind, what) in enumerate(items):
        if kind == "what":
            linked = place > 0 and items[place - 1][0] == "and"
            beside |= linked and what == "accuracies" and bool(found) and "accuracies" not in found
            found.append(cast(Quantity, what))
    if "accuracies" in found and not beside:
        return ("accuracies",)
    return list(dict.fromkeys([what for what in found if what != "all"] or found))


def _read_zero(found: Statements, comment: str, words: Sequence[str], *, heights: bool) -> None:
    """heights: whether the comment speaks of heights. A height above ground with its value is one of the flight."""
    if names_datum(words) and (heights or any(map(is_named_datum, words))):
        if not found.datum:
            of_geoid = bool({"geoid", "separation", "undulation"} & set(words))
            found.datum = comment
            found.zero = "" if of_geoid and not heights else zero_of(words)
        return
    if not heights and not {"agl", "ato"} & set(words):
        return
    number = next((place for place, word in enumerate(words) if word[:1].isdigit()), len(words))
    if number < len(words) and _QUANTITIES.get(words[0]) != "heights":
        return
    if not says_relative(words[:number]):
        return
    if _FLIGHT & set(words):
        found.remarks.append(
            f"{comment!r} speaks of heights above ground: if those of the list count so, leave them out"
        )
    elif not _OTHERS & set(words):
        found.relative = found.relative or comment


def _read_north(found: Statements, comment: str, words: Sequence[str]) -> None:
    if found.north or not _HEADINGS & set(words):
        return
    if "magnetic" in words and not {"declination", "corrected", "calibrated", "compensated"} & set(words):
        found.north, found.north_in = "magnetic", comment
    elif {"yaw", "heading", "headings", "azimuth", "azimuths", "angles"} & set(words):
        norths = {words[place - 1] for place, word in enumerate(words) if word == "north" and place}
        if len(norths & {"true", "grid"}) == 1:
            found.north, found.north_in = (norths & {"true", "grid"}).pop(), comment


def _unplaced(comment: str) -> str:
    return (
        f"{comment!r} names a unit, and not clearly of what: nothing is converted; if it is one of columns, write it "
        "behind their names, such as z [ft]"
    )
