"""Block map of the report: footprints, pairs coloured by verified matches, cameras; with tooltips. No disk."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.report.figures import COLOURS, evenly_chosen, label_width, name_ground_axes, new_axes, svg

MAP_CLASSES = 6
# Above this many pairs their lines lose the tooltips and are joined into one path per colour; above the second they are
# thinned evenly, so that a block of any size stays a page that a browser can draw.
MAX_TITLED_LINES = 3000
MAX_LINES = 20000
MAX_FOOTPRINTS = 3000
MAX_LABELS = 60

_WIDTH, _LEGEND_WIDTH, _AXES_HEIGHTS = 1000.0, 190.0, (330.0, 860.0)
# Side of the frame over the extent of the cameras, and over the extent of what it shows.
_LARGEST_FRAME = 5.0
_AIR = 1.08
# Where a label may stand beside its camera, the best place first: points to the right and up, and what of it is there.
_BESIDE: dict[tuple[float, float], dict[str, str]] = {
    (right, up): {"ha": "left" if right > 0 else "right", "va": "bottom" if up > 0 else "top"}
    for right, up in ((5.0, 3.0), (5.0, -4.0), (-5.0, 3.0), (-5.0, -4.0))
}
# What a browser's font may need more than matplotlib's, points.
_LABEL_AIR = 2.0
_REJECTED: dict[str, Any] = {"color": COLOURS["bad"], "linewidth": 0.8, "linestyle": (0, (5, 4)), "alpha": 0.7}
_UNJUDGED: dict[str, Any] = {"color": COLOURS["soft"], "linewidth": 0.8, "linestyle": (0, (1.5, 3)), "alpha": 0.7}
_CAMERAS = {
    "fine": ("image", {"facecolor": COLOURS["ink"], "edgecolor": COLOURS["panel"], "linewidth": 0.8}),
    "weak": ("weakly tied image", {"facecolor": COLOURS["panel"], "edgecolor": COLOURS["bad"], "linewidth": 2.0}),
    "wrong": ("wrong attitude given", {"facecolor": COLOURS["bad"], "edgecolor": COLOURS["bad"], "linewidth": 0.8}),
}


# Picture (h, w, 4) RGBA of the ground between two corners (2,) of the world, metres, north up; None if unknown.
Sketch = Callable[[FloatArray, FloatArray], NDArray[np.uint8] | None]


@dataclass(frozen=True)
class Station:
    """One camera on the map. title: tooltip. kind: fine, weak (few verified matches) or wrong (attitude given)."""

    image_id: str
    label: str
    title: str
    x_m: float
    y_m: float
    kind: str = "fine"


@dataclass(frozen=True)
class Link:
    """One pair on the map. state: as in a Verdict, or "not judged"."""

    image_id0: str
    image_id1: str
    state: str
    verified: int
    title: str


@dataclass(frozen=True)
class MapFigure:
    """The map's SVG, and remarks on what is left out."""

    svg: str
    remarks: tuple[str, ...]


def match_classes(counts: Iterable[int]) -> tuple[int, ...]:
    """Lower limits of up to six classes of verified matches, geometrically spaced and rounded to 1, 2, 5 x 10^n."""
    positive = [count for count in counts if count > 0]
    if not positive:
        return ()
    low, high = min(positive), max(positive)
    limits = {low}
    for part in range(1, MAP_CLASSES):
        value = low * (high / low) ** (part / MAP_CLASSES)
        power = 10.0 ** math.floor(math.log10(value))
        limits.add(round(min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(math.log(m * power / value))) * power))
    return tuple(sorted(limit for limit in limits if low <= limit <= high))


def class_of(count: int, limits: Sequence[int]) -> int:
    """Colour class 0-5 of a count; with fewer than six classes they are spread over the whole scale."""
    index = sum(count >= limit for limit in limits) - 1
    return round(max(index, 0) * (MAP_CLASSES - 1) / max(len(limits) - 1, 1))


def block_map(
    stations: Sequence[Station],
    footprints: Sequence[FloatArray],
    links: Sequence[Link],
    *,
    in_world: bool = True,
    aside: Set[str] = frozenset(),
    sketch: Sketch | None = None,
) -> MapFigure:
    """Footprints, pairs and cameras in world metres. footprints: polygons (N, 2). At least one station.

    in_world: else in a frame of the pictures' own, where neither north nor a metre is known. aside: images of groups
    that lie in frames of their own. sketch: what the ground looks like, of two corners of the map.
    """
    place = {s.image_id: (s.x_m, s.y_m) for s in stations}
    placed = [link for link in links if link.image_id0 in place and link.image_id1 in place]
    drawn = [placed[i] for i in evenly_chosen(len(placed), MAX_LINES)]
    outlines = [footprints[i] for i in evenly_chosen(len(footprints), MAX_FOOTPRINTS)]
    remarks = [*_of_all(drawn, placed, "pair lines"), *_of_all(outlines, footprints, "footprints")]
    if aside:
        words = "1 image" if len(aside) == 1 else f"{len(aside):,} images"
        remarks.append(f"Not drawn: {words} of other groups, whose place beside the first is not known.")
    known = place.keys() | aside
    if missing := sum(not {link.image_id0, link.image_id1} <= known for link in links):
        words = "1 pair has an image" if missing == 1 else f"{missing:,} pairs have images"
        remarks.append(f"Not drawn: {words} without position.")
    axes = _frame(stations, footprints)
    _name_axes(axes, in_world)
    _draw_footprints(axes, outlines)
    limits = match_classes(link.verified for link in placed if link.state == "verified")
    titles, handles = _draw_links(axes, place, drawn, limits)
    _draw_cameras(axes, stations, titles, handles)
    axes.figure.legend(
        handles=handles, loc="upper right", alignment="left", frameon=False, title="Verified matches per pair"
    )
    if len(stations) <= MAX_LABELS:
        _draw_labels(axes, stations)
    if sketch is not None:
        _draw_sketch(axes, sketch)
    return MapFigure(svg(axes.figure, "Block map", "map", titles), tuple(remarks))


def _of_all(shown: Sequence[Any], known: Sequence[Any], words: str) -> list[str]:
    """Return a remark where only some of many things are drawn."""
    if len(shown) == len(known):
        return []
    return [f"{len(shown):,} of {len(known):,} {words} are drawn, evenly chosen."]


def _draw_cameras(axes: Any, stations: Sequence[Station], titles: dict[str, list[str]], handles: list[Any]) -> None:
    """Draw the cameras kind by kind, and add their titles and what the legend shows of them. Many are drawn small."""
    diameter = 2.1
    if len(stations) <= 200:
        diameter = 6.4
    elif len(stations) <= 2000:
        diameter = 3.6
    for kind, (words, style) in _CAMERAS.items():
        members = [station for station in stations if station.kind == kind]
        if not members:
            continue
        places = np.array([(station.x_m, station.y_m) for station in members])
        area = diameter**2 * (1.0 if kind == "fine" else 2.0)
        handles.append(axes.scatter(*places.T, area, label=words, gid=kind, zorder=4, **style))
        titles[kind] = [station.title for station in members]


def _frame(stations: Sequence[Station], footprints: Sequence[FloatArray]) -> Any:
    """Axes that show all cameras, and of the footprints what does not shrink the cameras to a dot, as views of the
    horizon would."""
    centers = np.array([[s.x_m, s.y_m] for s in stations])
    low, high = centers.min(axis=0), centers.max(axis=0)
    if footprints:
        corners = np.concatenate(list(footprints))
        sizes = [float(np.ptp(polygon, axis=0).max()) for polygon in footprints]
        # Of cameras close together, or only one, the footprints alone tell a size.
        most = max((_LARGEST_FRAME / _AIR - 1.0) / 2.0 * float((high - low).max()), 0.15 * float(np.median(sizes)))
        low = np.maximum(np.minimum(low, corners.min(axis=0)), low - most)
        high = np.minimum(np.maximum(high, corners.max(axis=0)), high + most)
    half = np.maximum(high - low, max(float((high - low).max()) * 0.02, 1.0)) * _AIR / 2
    middle = (low + high) / 2
    height = float(np.clip((_WIDTH - _LEGEND_WIDTH) * half[1] / half[0], *_AXES_HEIGHTS))
    left = label_width((middle[1] - half[1], middle[1] + half[1]))
    margins = {
        "left": left / _WIDTH,
        "right": 1.0 - _LEGEND_WIDTH / _WIDTH,
        "bottom": 42.0 / height,
        "top": 1.0 - 8.0 / height,
    }
    axes = new_axes(_WIDTH / 72, height / 72, margins=margins)
    # Equal scales: what is left of the axes' width or height shows more ground.
    size = axes.bbox.size
    _show(axes, middle, (half / size).max() * size)
    axes.ticklabel_format(useOffset=False, style="plain")
    return axes


def _name_axes(axes: Any, in_world: bool) -> None:
    """Their names, and an arrow to the north where that is known."""
    name_ground_axes(axes, in_world=in_world)
    if not in_world:
        return
    arrow = {"arrowstyle": "-|>", "color": COLOURS["ink"]}
    where = {"xycoords": "axes fraction", "textcoords": "offset points", "ha": "center", "color": COLOURS["ink"]}
    axes.annotate("N", (0.975, 0.985), (0.0, -38.0), arrowprops=arrow, zorder=5, **where)


def _show(axes: Any, middle: FloatArray, half: FloatArray) -> None:
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))


def _draw_sketch(axes: Any, sketch: Sketch) -> None:
    """Below everything else."""
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    picture = sketch(low, high)
    if picture is not None:
        extent = (low[0], high[0], low[1], high[1])
        axes.imshow(picture, extent=extent, aspect="auto", zorder=0.5, gid="sketch", alpha=0.75, interpolation="none")
        _show(axes, (low + high) / 2, (high - low) / 2)


def _draw_footprints(axes: Any, polygons: Sequence[FloatArray]) -> None:
    """What is covered at all, and every outline."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    if polygons:
        paths = Path.make_compound_path(*(Path(np.vstack([p, p[:1]]), closed=True) for p in polygons))
        width, opacity = (0.8, 0.45) if len(polygons) <= 200 else (0.5, 0.16)
        face, edge = to_rgba(COLOURS["accent"], 0.06), to_rgba(COLOURS["soft"], opacity)
        axes.add_artist(PathPatch(paths, gid="footprints", facecolor=face, edgecolor=edge, linewidth=width, zorder=1))


def _draw_links(
    axes: Any, place: dict[str, tuple[float, float]], links: Sequence[Link], limits: Sequence[int]
) -> tuple[dict[str, list[str]], list[Any]]:
    """Pair lines, rejected ones lowest, then from many matches to few: thin lines stay visible upon thick ones.

    Returns their tooltips by gid, and handles of the legend.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    # Many lines are drawn thinner, so that a dense block does not become one blot.
    factor = max(0.3, min(1.0, math.sqrt(400 / max(len(links), 1))))
    classes: dict[str, tuple[str, dict[str, Any]]] = {}
    for index, limit in enumerate(limits):
        words = f"{limit:,}–{limits[index + 1] - 1:,}" if index + 1 < len(limits) else f"{limit:,} or more"
        k = class_of(limit, limits)
        classes[f"k{k}"] = words, {"color": COLOURS[f"k{k}"], "linewidth": 0.9 + 0.36 * k}
    classes |= {"rejected": ("rejected", _REJECTED), "unjudged": ("not verifiable or not judged", _UNJUDGED)}
    members: dict[str, list[Link]] = {gid: [] for gid in classes}
    for link in links:
        other = "rejected" if link.state == "rejected" else "unjudged"
        members[f"k{class_of(link.verified, limits)}" if link.state == "verified" else other].append(link)
    titles: dict[str, list[str]] = {}
    handles: list[Any] = []
    for order, (gid, (words, style)) in enumerate(reversed(classes.items())):
        lines = np.array([[place[k.image_id0], place[k.image_id1]] for k in members[gid]]).reshape(-1, 2, 2)
        if not len(lines):
            continue
        thinned = style | {"linewidth": factor * style["linewidth"], "gid": gid, "zorder": 2 + 0.1 * order}
        if len(links) <= MAX_TITLED_LINES:
            axes.add_artist(LineCollection(list(lines), **thinned))
            titles[gid] = [link.title for link in members[gid]]
        else:
            joined = np.insert(lines, 2, np.nan, axis=1).reshape(-1, 2)
            axes.plot(*joined.T, **thinned)
        handles.insert(0, Line2D([], [], label=words, **style))
    return titles, handles


def _draw_labels(axes: Any, stations: Sequence[Station]) -> None:
    """Labels that lie on no earlier one and on no other camera, within the map; the tooltips name all. Weak and wrong
    come first."""
    taken = [text.get_window_extent() for text in axes.texts]
    places = axes.transData.transform([(s.x_m, s.y_m) for s in stations])
    inside = axes.get_window_extent()
    # Names are no formulas, even with two dollar signs.
    style = {"gid": "label", "color": COLOURS["ink"], "parse_math": False, "zorder": 3.5}
    for station in sorted(stations, key=lambda s: s.kind, reverse=True):
        for (right, up), sides in _BESIDE.items():
            text = axes.annotate(
                station.label, (station.x_m, station.y_m), (right, up), textcoords="offset points", **sides, **style
            )
            box = text.get_window_extent().padded(_LABEL_AIR)
            free = not any(box.overlaps(other) for other in taken) and not box.count_contains(places)
            if free and inside.containsx(box.x0) and inside.containsx(box.x1):
                taken.append(box)
                break
            text.remove()
