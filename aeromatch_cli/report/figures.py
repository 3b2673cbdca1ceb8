"""Plots by matplotlib in one style, as SVG for the page or PNG for a file; no disk."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

# The page's light theme by the name of its CSS variable; k0-k5: few to many matches.
COLOURS = {
    **{"paper": "#fbfbfa", "panel": "#ffffff", "ink": "#1d2327", "soft": "#5c666d", "rule": "#d9dedf"},
    **{"grid": "#e4e6ea", "accent": "#1f5f8b", "second": "#d9822b"},
    **{"bad": "#b3261e", "bad-paper": "#fdf0ee", "warn": "#8a5a00", "warn-paper": "#fdf6e7"},
    **{"k0": "#e07b1a", "k1": "#b9942b", "k2": "#6f9a4c", "k3": "#2f8f86", "k4": "#1f6aa5", "k5": "#1a2f6b"},
}
_STYLE: dict[Any, Any] = {
    **{f"axes.spines.{side}": False for side in ("top", "right")},
    **dict.fromkeys(("axes.labelcolor", "axes.edgecolor", "text.color", "xtick.color", "ytick.color"), COLOURS["soft"]),
    **{"axes.grid": True, "axes.axisbelow": True, "grid.color": COLOURS["grid"], "grid.linewidth": 0.8},
    **{"xtick.major.size": 0, "ytick.major.size": 0, "legend.frameon": False},
    # Text stays text; the salt keeps the names of clip paths and markers from run to run.
    **{"svg.fonttype": "none", "svg.hashsalt": "aeromatch"},
}
_HISTOGRAM_IN = (7.0, 2.7)
_VARIABLES = {colour: f"var(--{name})" for name, colour in COLOURS.items()}


def new_axes(
    width_inches: float, height_inches: float, dpi: float = 72.0, margins: Mapping[str, float] | None = None
) -> Any:
    """Axes on a figure of their own (`axes.figure`), without a window. At 72 dpi a point is a unit of the SVG.

    margins: left, right, bottom, top of the axes as shares of the figure. None: as the labels need them, which draws
    everything twice.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        if margins is None:
            return Figure(figsize=(width_inches, height_inches), dpi=dpi, layout="constrained").add_subplot()
        figure = Figure(figsize=(width_inches, height_inches), dpi=dpi)
        figure.subplots_adjust(**margins)
        return figure.add_subplot()


def name_ground_axes(axes: Any, *, in_world: bool) -> None:
    """in_world: else in a frame of the pictures' own, where neither north nor a metre is known."""
    if in_world:
        axes.set(xlabel="x (east), metres", ylabel="y (north), metres")
    else:
        axes.set(xlabel="x, arbitrary units", ylabel="y, arbitrary units")


def label_width(values: Iterable[float]) -> float:
    """Points that the axis label and the tick labels of metres need beside a vertical axis that shows these values."""
    return 32.0 + 6.4 * max(len(f"{value:.0f}") for value in values)


@dataclass(frozen=True)
class PlanSize:
    """Inches of a plan: width, least and largest height, room for a colour bar at the right, below and above."""

    width: float
    heights: tuple[float, float]
    bar: float
    below: float = 0.6
    above: float = 0.35


def plan_axes(low: FloatArray, high: FloatArray, size: PlanSize, *, in_world: bool) -> Any:
    """Axes of a plan from the corner low (2,) to high (2,), metres, of one scale in both directions."""
    left = label_width((low[1], high[1])) / 72.0
    wide = size.width - left - size.bar
    edges = size.below + size.above
    height = float(np.clip(wide * (high - low)[1] / (high - low)[0] + edges, *size.heights))
    margins = {
        "left": left / size.width, "right": 1.0 - size.bar / size.width,
        "bottom": size.below / height, "top": 1.0 - size.above / height,
    }  # fmt: skip
    axes = new_axes(size.width, height, margins=margins)
    name_ground_axes(axes, in_world=in_world)
    half = (0.5 * (high - low) / axes.bbox.size).max() * axes.bbox.size
    middle = 0.5 * (low + high)
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    return axes


def histogram_axes(counts: Iterable[int]) -> Any:
    """Axes of a chart of these counts, with room for their tick labels."""
    left = (24.0 + 6.4 * len(f"{max(counts):,}")) / (72.0 * _HISTOGRAM_IN[0])
    margins = {"left": max(0.105, left), "right": 0.965, "bottom": 0.2, "top": 0.96}
    return new_axes(*_HISTOGRAM_IN, margins=margins)


def png(figure: Any) -> bytes:
    """No date and no version inside: equal figures give equal bytes."""
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def svg(figure: Any, label: str, css: str, titles: Mapping[str, Sequence[str]]) -> str:
    """Inline SVG in the page's font and colours, of CSS class `css`; equal figures give equal text.

    titles: gid of an artist -> tooltips of all shapes that it draws, in order. A gid becomes a CSS class; the shapes of
    one gid look alike.
    """
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format="svg", transparent=True)
    root = ElementTree.fromstring(buffer.getvalue())
    for element in root.iter():
        _plain(element)
    for parent in (root, *root.iter("defs")):
        for element in [child for child in parent if child.tag in ("metadata", "style")]:
            parent.remove(element)  # the date, and rules that would hold for the whole page
    root.attrib = {"viewBox": root.attrib["viewBox"], "class": f"plot {css}", "role": "img", "aria-label": label}
    waiting = {gid: iter(texts) for gid, texts in titles.items()}
    for group in root.iter("g"):
        gid = group.attrib.pop("id", "")
        if gid and not re.search(r"_\d+$", gid):  # matplotlib's own names end in a number
            group.set("class", gid)
            for shape in _shapes(group):
                group.attrib |= {key: shape.attrib.pop(key) for key in ("style", "clip-path") if key in shape.attrib}
                if gid in waiting:
                    ElementTree.SubElement(shape, "title").text = next(waiting[gid])
    return ElementTree.tostring(root, encoding="unicode")


def _plain(element: ElementTree.Element) -> None:
    """Without namespaces, which inline SVG has no need of; short numbers; the page's font and colours."""
    element.tag, element.tail = element.tag.rpartition("}")[2], None
    element.text = element.text if element.text and element.text.strip() else None
    element.attrib = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
    for key in {"d", "x", "y", "width", "height", "transform"} & set(element.attrib):
        element.set(key, " ".join(re.sub(r"(\.\d\d)\d+", r"\1", element.attrib[key]).split()))
    if style := element.get("style"):
        # Releases of matplotlib write the font in one of two ways.
        style = re.sub(r"font: ([\d.]+px) [^;]+", r"font-size: \1", re.sub("font-family: [^;]+(; )?", "", style))
        element.set("style", re.sub("#[0-9a-f]{6}", lambda found: _VARIABLES.get(found[0], found[0]), style))


def _shapes(group: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """What a group draws: paths, or uses of a marker that is defined once."""
    for child in group:
        if child.tag in ("path", "use"):
            yield child
        elif child.tag != "defs":
            yield from _shapes(child)


def histogram(values: Sequence[int], label: str, unit: str) -> str:
    """Bars over about 24 equal classes with rounded limits. values: at least one. unit: what they count, a plural."""
    from matplotlib.ticker import MaxNLocator

    locator = MaxNLocator(24, steps=[1, 2, 5, 10], integer=True)
    edges = np.asarray(locator.tick_values(0, max(values) + 1))
    counts, _ = np.histogram(values, edges)
    axes = histogram_axes(counts)
    filled = np.flatnonzero(counts)
    step = edges[1] - edges[0]
    bars = axes.bar(edges[filled], counts[filled], 0.94 * step, align="edge", color=COLOURS["accent"], linewidth=0)
    for bar in bars:
        bar.set_gid("bar")
    axes.set(xlim=(0, edges[-1]), xlabel=label, ylabel=unit)
    axes.grid(visible=False, axis="x")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_formatter("{x:,.0f}")
    units = {1: unit.removesuffix("s")}
    titles = [
        f"{edges[k]:,.0f} to {edges[k] + step - 1:,.0f}: {counts[k]:,} {units.get(counts[k], unit)}" for k in filled
    ]
    return svg(axes.figure, label, "histogram", {"bar": titles})


def round_length(length: float) -> float:
    """1, 2 or 5 times a power of ten, not more than it: of the arrow that explains others."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor for factor in (1.0, 2.0, 5.0) if factor * power <= length * (1.0 + 1e-9)) * power)


@lru_cache(maxsize=1 << 12)
def evenly_chosen(count: int, limit: int) -> IntArray:
    """At most `limit` of the indices 0 .. count-1, evenly spaced, ends included."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, limit))).astype(np.int64))
