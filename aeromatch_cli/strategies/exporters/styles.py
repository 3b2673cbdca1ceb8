"""Styles of the map layers for QGIS (QML): pairs from weak to strong, weak images in red, faint footprints.

QGIS applies a .qml file beside a GeoJSON file of the same name, and the default of a GeoPackage's table layer_styles,
when it opens the layer (QGIS user manual, "Managing Custom Style").
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

# Upper limits of verified matches, and the colours of what lies below: red, orange, green.
_CLASSES = ((50, "215,48,39,255"), (300, "253,174,97,255"), (1_000_000_000, "26,152,80,255"))


def qml(layer: str) -> str:
    """The style of the layer "cameras", "footprints" or "pairs"."""
    return f'<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">\n{_QML[layer]}\n'


def _document(renderer: str) -> str:
    return f'<qgis version="3.28.0" styleCategories="Symbology">{renderer}</qgis>'


def _symbol(name: str, kind: str, layer: str, options: Sequence[tuple[str, str]]) -> str:
    values = "".join(f'<Option type="QString" name="{key}" value={quoteattr(value)}/>' for key, value in options)
    return (
        f'<symbol type="{kind}" name="{name}" alpha="1" clip_to_extent="1"><layer class="{layer}" enabled="1" pass="0" '
        f'locked="0"><Option type="Map">{values}</Option></layer></symbol>'
    )


def _pairs() -> str:
    ranges, symbols, lower = [], [], 0
    for place, (upper, colour) in enumerate(_CLASSES):
        words = f"fewer than {upper} matches" if place < len(_CLASSES) - 1 else f"{lower} matches and more"
        ranges.append(
            f'<range lower="{lower}" upper="{upper}" symbol="{place}" label="{words}" render="true"/>',
        )
        width = f"{0.5 - 0.15 * place:.2f}"
        symbols.append(_symbol(str(place), "line", "SimpleLine", (("line_color", colour), ("line_width", width))))
        lower = upper
    return _document(
        '<renderer-v2 type="graduatedSymbol" attr="matches" graduatedMethod="GraduatedColor">'
        f"<ranges>{''.join(ranges)}</ranges><symbols>{''.join(symbols)}</symbols></renderer-v2>"
    )


def _cameras() -> str:
    categories = "".join(
        f'<category value="{value}" symbol="{symbol}" label="{words}" type="bool" render="true"/>'
        for value, symbol, words in (("true", 0, "weakly tied"), ("false", 1, "well tied"))
    )
    symbols = "".join(
        _symbol(
            str(place), "marker", "SimpleMarker",
            (("name", "triangle"), ("color", colour), ("outline_color", "35,35,35,255"), ("size", size)),
        )
        for place, (colour, size) in enumerate(((_CLASSES[0][1], "3.4"), (_CLASSES[2][1], "2.2")))
    )  # fmt: skip
    return _document(
        '<renderer-v2 type="categorizedSymbol" attr="weak">'
        f"<categories>{categories}</categories><symbols>{symbols}</symbols></renderer-v2>"
    )


def _footprints() -> str:
    options = (("color", "69,117,180,12"), ("outline_color", "69,117,180,160"), ("outline_width", "0.2"))
    symbol = _symbol("0", "fill", "SimpleFill", options)
    return _document(f'<renderer-v2 type="singleSymbol"><symbols>{symbol}</symbols></renderer-v2>')


_QML = {"cameras": _cameras(), "footprints": _footprints(), "pairs": _pairs()}
