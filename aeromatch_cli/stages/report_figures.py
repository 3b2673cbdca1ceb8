"""Figures of the report as inline SVG: block map, histograms, match previews. Arrays in, markup out; no disk.

Colours are CSS classes of the page (k0-k5: few to many matches, e0-e3: small to large error), so that figures follow
its light, dark and print themes. Every text that comes from outside is escaped here.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.footprints import clip_half_plane
from aeromatch_cli.images import shrink, to_gray8

MAP_CLASSES = 6
# Above this many lines they lose their tooltips and are joined into one path per colour; above the second they are
# thinned evenly, so that a block of any size stays a page that a browser can draw.
MAX_TITLED_LINES = 3000
MAX_LINES = 20000
MAX_FOOTPRINTS = 3000
MAX_LABELS = 60
MAX_PREVIEW_LINES = 150
MAX_PREVIEW_POINTS = 2000
ERROR_LIMITS_PX = (0.5, 1.0, 2.0)

_MAP_WIDTH = 1100.0
_MAP_HEIGHTS = (320.0, 1000.0)
_MARGIN_LEFT, _MARGIN_BOTTOM, _MARGIN = 64.0, 44.0, 14.0
_PREVIEW_SIDE_PX = 442
_PREVIEW_GAP_PX = 12
# (transpose, mirror x, mirror y) that turn the stored raster upright, by EXIF Orientation (TIFF 6.0, tag 274).
_TURNS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}


def nice_step(span: float, count: int) -> float:
    """The 1, 2 or 5 times a power of ten that divides `span` into about `count` parts."""
    raw = max(span, 1e-9) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    return next((m * power for m in (1.0, 2.0, 5.0) if m * power >= raw * 0.999), 10.0 * power)


def evenly_chosen(count: int, limit: int) -> IntArray:
    """At most `limit` of the indices 0 .. count-1, evenly spaced, ends included."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.rint(np.linspace(0, count - 1, limit)).astype(np.int64))


# --- block map --------------------------------------------------------------------------------------------------


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
    """All cameras, and of the footprints what does not shrink the block to a dot, as views of the horizon would."""
    centers = np.array([[s.x_m, s.y_m] for s in stations])
    low, high = centers.min(axis=0), centers.max(axis=0)
    if footprints:
        corners = np.concatenate(list(footprints))
        sizes = [float(np.ptp(polygon, axis=0).max()) for polygon in footprints]
        most = max(0.6 * float((high - low).max()), 0.15 * float(np.median(sizes)))
        low = np.maximum(np.minimum(low, corners.min(axis=0)), low - most)
        high = np.minimum(np.maximum(high, corners.max(axis=0)), high + most)
    span = np.maximum(high - low, max(float((high - low).max()) * 0.02, 1.0))
    middle = (low + high) / 2
    low, high = middle - span * 0.54, middle + span * 0.54
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
        texts.append(
            f'<text x="{_MARGIN_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{k * step:.{digits}f}</text>'
        )
    axes = (
        f'<text x="{(_MARGIN_LEFT + right) / 2:.0f}" y="{bottom + 36:.1f}" text-anchor="middle">x (east), metres</text>'
        f'<text transform="translate(14 {(_MARGIN + bottom) / 2:.0f}) rotate(-90)" text-anchor="middle">'
        "y (north), metres</text>"
    )
    return [f'<path class="grid" d="{"".join(lines)}"/><g class="ticks">{"".join(texts)}{axes}</g>']


def _outlines(frame: _Frame, polygons: Sequence[FloatArray]) -> list[str]:
    """One path of all outlines. Polygons are cut a little outside the frame: coordinates stay short and sane."""
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
    if len(polygons) > 200:
        return [f'<path class="outline many" d="{"".join(parts)}"/>']
    # Overlapping fills add up: the whole block together must stay paler than its pair lines.
    fill = f'<g fill-opacity="{min(0.05, 0.4 / max(len(parts), 1)):.4f}">'
    return [fill, *(f'<path class="outline" d="{part}"/>' for part in parts), "</g>"]


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
        parts += [
            f'<text x="{place[s.image_id][0] + 6:.1f}" y="{place[s.image_id][1] - 5:.1f}">{escape(s.label)}</text>'
            for s in stations
        ]
    return [*parts, "</g>"]


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


# --- histograms -------------------------------------------------------------------------------------------------


def histogram(values: Sequence[float], label: str, unit: str) -> str:
    """Bars over about 24 equal classes with a rounded width. values: counts, at least one of them."""
    width, height, left, right, bottom, top = 540.0, 210.0, 44.0, 26.0, 40.0, 12.0
    step = max(1.0, nice_step(max(max(values), 1.0), 24))
    bins = int(max(values) // step) + 1
    counts = np.bincount((np.asarray(values, dtype=np.float64) // step).astype(int), minlength=bins)
    inner_width, inner_height = width - left - right, height - bottom - top
    peak, bar = float(counts.max()), inner_width / bins
    parts = [f'<svg class="histogram" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">']
    y_step = max(1.0, nice_step(peak, 4))
    for k in range(int(peak // y_step) + 1):
        y = top + inner_height * (1 - k * y_step / peak)
        parts.append(f'<path class="grid" d="M{left} {y:.1f}H{width - right:.1f}"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{k * y_step:,.0f}</text>')
    for index, count in enumerate(counts):
        if count:
            tall = inner_height * count / peak
            words = f"{index * step:,.0f} to {(index + 1) * step - 1:,.0f}: {count:,} {unit}"
            parts.append(
                f'<rect class="bar" x="{left + index * bar + 0.5:.1f}" y="{top + inner_height - tall:.1f}" '
                f'width="{max(bar - 1, 0.8):.1f}" height="{tall:.1f}"><title>{escape(words)}</title></rect>'
            )
    x_step = step * max(1, round(nice_step(bins * step, 6) / step))
    for k in range(int(bins * step // x_step) + 1):
        x = left + k * x_step / step * bar
        parts.append(f'<text x="{x:.1f}" y="{height - 24:.0f}" text-anchor="middle">{k * x_step:,.0f}</text>')
    parts.append(f'<text x="{left + inner_width / 2:.0f}" y="{height - 6:.0f}" text-anchor="middle">{escape(label)}</text>')
    return "".join([*parts, "</svg>"])


# --- previews ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Side:
    """One image of a preview: stored raster (H, W) or (H, W, 3) RGB, EXIF Orientation, matches (M, 2) in stored px."""

    pixels: NDArray[Any]
    exif_orientation: int
    points_px: FloatArray


def turned(pixels: NDArray[Any], exif_orientation: int) -> NDArray[Any]:
    """The stored raster as a viewer shows it."""
    transpose, mirror_x, mirror_y = _TURNS.get(exif_orientation, _TURNS[1])
    if transpose:
        pixels = np.swapaxes(pixels, 0, 1)
    return pixels[:: -1 if mirror_y else 1, :: -1 if mirror_x else 1]


def turned_points(points_px: FloatArray, width_px: int, height_px: int, exif_orientation: int) -> FloatArray:
    """Where stored pixels (N, 2) of a width_px x height_px raster lie after `turned`."""
    transpose, mirror_x, mirror_y = _TURNS.get(exif_orientation, _TURNS[1])
    x, y = np.asarray(points_px, dtype=np.float64).T
    if transpose:
        x, y, width_px, height_px = y, x, height_px, width_px
    return np.stack([width_px - 1 - x if mirror_x else x, height_px - 1 - y if mirror_y else y], axis=1)


def preview(side0: Side, side1: Side, errors_px: FloatArray | None, label: str) -> str:
    """Both images side by side, upright, with match lines coloured by error (M,); None or NaN: no error known."""
    uri0, size0, points0 = _upright(side0)
    uri1, size1, points1 = _upright(side1)
    offset = size0[0] + _PREVIEW_GAP_PX
    width, height = offset + size1[0], max(size0[1], size1[1])
    points1 = points1 + np.array([float(offset), 0.0])
    classes = _error_classes(errors_px, len(points0))
    chosen = _spread(points0, MAX_PREVIEW_LINES)
    dots = _spread(points0, MAX_PREVIEW_POINTS)
    parts = [
        f'<svg class="preview" viewBox="0 0 {width} {height}" style="max-width:{1.14 * width:.0f}px" role="img" '
        f'aria-label="{escape(label)}">',
        f'<image href="{uri0}" x="0" y="0" width="{size0[0]}" height="{size0[1]}"/>',
        f'<image href="{uri1}" x="{offset}" y="0" width="{size1[0]}" height="{size1[1]}"/>',
    ]
    for name in sorted(set(classes)):
        lines = "".join(f"M{_xy(points0[i])}L{_xy(points1[i])}" for i in chosen if classes[i] == name)
        spots = "".join(f"M{_xy(points0[i])}h0M{_xy(points1[i])}h0" for i in dots if classes[i] == name)
        parts.append(f'<path class="tie {name}" d="{lines}"/><path class="spot {name}" d="{spots}"/>')
    return "".join([*parts, "</svg>"])


def _xy(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _error_classes(errors_px: FloatArray | None, count: int) -> list[str]:
    if errors_px is None:
        return ["e9"] * count
    return ["e9" if math.isnan(e) else f"e{sum(e > limit for limit in ERROR_LIMITS_PX)}" for e in errors_px]


def _upright(side: Side) -> tuple[str, tuple[int, int], FloatArray]:
    """JPEG as data URI, its displayed (width, height), and the points (M, 2) in SVG units (corner origin)."""
    height, width = side.pixels.shape[:2]
    scale = min(1.0, _PREVIEW_SIDE_PX / max(width, height))
    small = to_colour8(shrink(side.pixels, scale))
    ratio = np.array([small.shape[1] / width, small.shape[0] / height])
    points = (np.asarray(side.points_px, dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
    points = turned_points(points, small.shape[1], small.shape[0], side.exif_orientation) + 0.5
    picture = turned(small, side.exif_orientation)
    return jpeg_uri(picture), (picture.shape[1], picture.shape[0]), points


def to_colour8(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits for display; other depths are stretched band by band."""
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.ndim == 2:
        return to_gray8(pixels)
    return np.stack([to_gray8(pixels[..., band]) for band in range(pixels.shape[2])], axis=-1)


def jpeg_uri(pixels: NDArray[np.uint8]) -> str:
    """data: URI of (H, W) gray or (H, W, 3) RGB."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "JPEG", quality=80, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _spread(points_px: FloatArray, limit: int) -> IntArray:
    """Indices of at most `limit` points, evenly over the picture: every k-th along a raster of cells."""
    if len(points_px) <= limit:
        return np.arange(len(points_px))
    cells = np.floor(points_px / (_PREVIEW_SIDE_PX / 16)).astype(np.int64)
    return np.lexsort((cells[:, 0], cells[:, 1]))[evenly_chosen(len(points_px), limit)]
