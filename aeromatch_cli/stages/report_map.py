"""Block map of the report as inline SVG: footprints, pairs coloured by verified matches, cameras. No disk.

Colours are CSS classes of the page (k0-k5: few to many matches), so that the map follows its light, dark and print
themes. Every text that comes from outside is escaped here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.footprints import clip_half_plane
from aeromatch_cli.stages.report_figures import evenly_chosen, nice_step

MAP_CLASSES = 6
# Above this many lines they lose their tooltips and are joined into one path per colour; above the second they are
# thinned evenly, so that a block of any size stays a page that a browser can draw.
MAX_TITLED_LINES = 3000
MAX_LINES = 20000
MAX_FOOTPRINTS = 3000
MAX_LABELS = 60

_LABEL_CHARACTER, _LABEL_HEIGHT = 6.2, 9.0
_MAP_WIDTH = 1100.0
_MAP_HEIGHTS = (320.0, 1000.0)
# Side of the frame over the extent of the cameras, and over the extent of what it shows.
_LARGEST_FRAME = 5.0
_AIR = 1.08
_MARGIN_LEFT, _MARGIN_BOTTOM, _MARGIN = 64.0, 44.0, 14.0


@dataclass(frozen=True)
class Station:
    """One camera on the map. title: tooltip. weak: too few verified matches. suspect: attitude contradicted."""

    image_id: str
    label: str
    title: str
    x_m: float
    y_m: float
    weak: bool = False
    suspect: bool = False


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
    """The map's SVG, its colour legend as (CSS class, words), and remarks on what is left out."""

    svg: str
    legend: tuple[tuple[str, str], ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class _Frame:
    """World metres to SVG user units; north is up."""

    left_m: float
    bottom_m: float
    right_m: float
    top_m: float
    scale: float

    @property
    def width(self) -> float:
        return (self.right_m - self.left_m) * self.scale

    @property
    def height(self) -> float:
        return (self.top_m - self.bottom_m) * self.scale

    def x(self, x_m: float) -> float:
        return _MARGIN_LEFT + (x_m - self.left_m) * self.scale

    def y(self, y_m: float) -> float:
        return _MARGIN + (self.top_m - y_m) * self.scale


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


def block_map(stations: Sequence[Station], footprints: Sequence[FloatArray], links: Sequence[Link]) -> MapFigure:
    """Footprints, pairs and cameras in world metres. footprints: polygons (N, 2). At least one station."""
    frame = _frame(stations, footprints)
    place = {s.image_id: (frame.x(s.x_m), frame.y(s.y_m)) for s in stations}
    placed = [link for link in links if link.image_id0 in place and link.image_id1 in place]
    limits = match_classes(link.verified for link in placed if link.state == "verified")
    drawn = [placed[i] for i in evenly_chosen(len(placed), MAX_LINES)]
    outlines = [footprints[i] for i in evenly_chosen(len(footprints), MAX_FOOTPRINTS)]
    remarks = []
    if len(drawn) < len(placed):
        remarks.append(f"{len(drawn):,} of {len(placed):,} pair lines are drawn, evenly chosen.")
    if len(outlines) < len(footprints):
        remarks.append(f"{len(outlines):,} of {len(footprints):,} footprints are drawn, evenly chosen.")
    if len(placed) < len(links):
        remarks.append(f"{len(links) - len(placed):,} pairs have an image without position and are not drawn.")
    height = frame.height + _MARGIN + _MARGIN_BOTTOM
    parts = [
        f'<svg class="map" viewBox="0 0 {_MAP_WIDTH:.0f} {height:.0f}" role="img" aria-label="Block map">',
        '<clipPath id="inside">',
        f'<rect x="{_MARGIN_LEFT}" y="{_MARGIN}" width="{frame.width:.1f}" height="{frame.height:.1f}"/></clipPath>',
        *_grid(frame),
        '<g clip-path="url(#inside)">',
        *_outlines(frame, outlines),
        *_lines(place, drawn, limits),
        "</g>",
        *_stations(place, stations),
        _north_arrow(frame),
        "</svg>",
    ]
    return MapFigure("".join(parts), _map_legend(limits, placed), tuple(remarks))


def _frame(stations: Sequence[Station], footprints: Sequence[FloatArray]) -> _Frame:
    """All cameras, and of the footprints what does not shrink the cameras to a dot, as views of the horizon would."""
    centers = np.array([[s.x_m, s.y_m] for s in stations])
    low, high = centers.min(axis=0), centers.max(axis=0)
    if footprints:
        corners = np.concatenate(list(footprints))
        sizes = [float(np.ptp(polygon, axis=0).max()) for polygon in footprints]
        # Of cameras close together, or only one, the footprints alone tell a size.
        most = max((_LARGEST_FRAME / _AIR - 1.0) / 2.0 * float((high - low).max()), 0.15 * float(np.median(sizes)))
        low = np.maximum(np.minimum(low, corners.min(axis=0)), low - most)
        high = np.minimum(np.maximum(high, corners.max(axis=0)), high + most)
    span = np.maximum(high - low, max(float((high - low).max()) * 0.02, 1.0))
    middle = (low + high) / 2
    low, high = middle - span * _AIR / 2, middle + span * _AIR / 2
    inner = _MAP_WIDTH - _MARGIN_LEFT - _MARGIN
    scale = min(inner / float(high[0] - low[0]), _MAP_HEIGHTS[1] / float(high[1] - low[1]))
    # What is left of the page's width and of the least height shows more ground.
    span = np.array([inner / scale, max(float(high[1] - low[1]), _MAP_HEIGHTS[0] / scale)])
    low, high = middle - span / 2, middle + span / 2
    return _Frame(float(low[0]), float(low[1]), float(high[0]), float(high[1]), scale)


def _grid(frame: _Frame) -> list[str]:
    step = nice_step(frame.right_m - frame.left_m, 9)
    digits = max(0, -math.floor(math.log10(step)))
    bottom, right = frame.y(frame.bottom_m), frame.x(frame.right_m)
    lines, texts = [], []
    for k in range(math.ceil(frame.left_m / step), math.floor(frame.right_m / step) + 1):
        x = frame.x(k * step)
        lines.append(f"M{x:.1f} {_MARGIN}V{bottom:.1f}")
        texts.append(f'<text x="{x:.1f}" y="{bottom + 17:.1f}" text-anchor="middle">{k * step:.{digits}f}</text>')
    for k in range(math.ceil(frame.bottom_m / step), math.floor(frame.top_m / step) + 1):
        y = frame.y(k * step)
        lines.append(f"M{_MARGIN_LEFT} {y:.1f}H{right:.1f}")
        texts.append(f'<text x="{_MARGIN_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{k * step:.{digits}f}</text>')
    axes = (
        f'<text x="{(_MARGIN_LEFT + right) / 2:.0f}" y="{bottom + 36:.1f}" text-anchor="middle">x (east), metres</text>'
        f'<text transform="translate(14 {(_MARGIN + bottom) / 2:.0f}) rotate(-90)" text-anchor="middle">'
        "y (north), metres</text>"
    )
    return [f'<path class="grid" d="{"".join(lines)}"/><g class="ticks">{"".join(texts)}{axes}</g>']


def _outlines(frame: _Frame, polygons: Sequence[FloatArray]) -> list[str]:
    """What is covered at all, and every outline; cut a little outside the frame, so that coordinates stay short."""
    parts = []
    margin = 0.02 * (frame.right_m - frame.left_m)
    for polygon in polygons:
        for axis, low, high in ((0, frame.left_m, frame.right_m), (1, frame.bottom_m, frame.top_m)):
            if len(polygon):
                polygon = clip_half_plane(polygon, low - margin - polygon[:, axis])
            if len(polygon):
                polygon = clip_half_plane(polygon, polygon[:, axis] - high - margin)
        if len(polygon) >= 3:
            parts.append(f"M{'L'.join(f'{frame.x(x):.1f} {frame.y(y):.1f}' for x, y in polygon)}Z")
    joined, many = "".join(parts), " many" if len(parts) > 200 else ""
    return [f'<g class="footprints"><path class="covered" d="{joined}"/><path class="outline{many}" d="{joined}"/></g>']


def _lines(place: dict[str, tuple[float, float]], links: Sequence[Link], limits: Sequence[int]) -> list[str]:
    """Pair lines, refused ones lowest, then from many matches to few: thin lines stay visible upon thick ones."""
    groups: dict[str, list[Link]] = {"no": [], "refused": []}
    groups.update({f"k{k}": [] for k in reversed(range(MAP_CLASSES))})
    for link in links:
        if link.state == "verified":
            groups[f"k{class_of(link.verified, limits)}"].append(link)
        else:
            groups["refused" if link.state == "rejected" else "no"].append(link)
    # Many lines are drawn thinner, so that a dense block does not become one blot.
    factor = max(0.3, min(1.0, math.sqrt(400 / max(len(links), 1))))
    titled = len(links) <= MAX_TITLED_LINES
    parts = [f'<g class="links" style="--thin:{factor:.2f}">']
    for name, members in groups.items():
        paths = []
        for link in members:
            (x0, y0), (x1, y1) = place[link.image_id0], place[link.image_id1]
            path = f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}"
            paths.append(f'<path d="{path}"><title>{escape(link.title)}</title></path>' if titled else path)
        if paths:
            joined = "".join(paths)
            parts.append(f'<g class="{name}">{joined if titled else f"""<path d="{joined}"/>"""}</g>')
    return [*parts, "</g>"]


def _stations(place: dict[str, tuple[float, float]], stations: Sequence[Station]) -> list[str]:
    parts = ['<g class="stations">']
    radius = 3.6 if len(stations) <= 200 else 2.0 if len(stations) <= 2000 else 1.2
    for station in sorted(stations, key=lambda s: (s.suspect, s.weak)):
        x, y = place[station.image_id]
        flag = "suspect" if station.suspect else "weak" if station.weak else "fine"
        parts.append(
            f'<circle class="{flag}" cx="{x:.1f}" cy="{y:.1f}" r="{radius * (1 if flag == "fine" else 1.4):.1f}">'
            f"<title>{escape(station.title)}</title></circle>"
        )
    if len(stations) <= MAX_LABELS:
        parts += _labels(place, stations)
    return [*parts, "</g>"]


def _labels(place: dict[str, tuple[float, float]], stations: Sequence[Station]) -> list[str]:
    """Labels that do not lie on an earlier one; the tooltips name every camera. Weak and suspect ones come first."""
    parts: list[str] = []
    taken: list[tuple[float, float, float]] = []
    for station in sorted(stations, key=lambda s: (not s.suspect, not s.weak)):
        x, y = place[station.image_id][0] + 6, place[station.image_id][1] - 5
        end = x + _LABEL_CHARACTER * len(station.label)
        if all(end < left or right < x or abs(y - line) > _LABEL_HEIGHT for left, right, line in taken):
            taken.append((x, end, y))
            parts.append(f'<text x="{x:.1f}" y="{y:.1f}">{escape(station.label)}</text>')
    return parts


def _north_arrow(frame: _Frame) -> str:
    x, y = _MARGIN_LEFT + frame.width - 22, _MARGIN + 12
    arrow = f"M{x:.1f} {y:.1f}l7 22l-7 -5l-7 5z"
    return f'<g class="north"><path d="{arrow}"/><text x="{x:.1f}" y="{y + 36:.1f}" text-anchor="middle">N</text></g>'


def _map_legend(limits: Sequence[int], links: Sequence[Link]) -> tuple[tuple[str, str], ...]:
    legend = []
    for index, limit in enumerate(limits):
        words = f"{limit:,}–{limits[index + 1] - 1:,}" if index + 1 < len(limits) else f"from {limit:,}"
        legend.append((f"k{class_of(limit, limits)}", words))
    states = {link.state for link in links}
    if "rejected" in states:
        legend.append(("refused", "rejected"))
    if states - {"verified", "rejected"}:
        legend.append(("no", "not verifiable or not judged"))
    return tuple(legend)
