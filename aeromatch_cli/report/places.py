"""Figures of the ground: how many images show a place, how many points lie there; and of the points: their errors, and
how many images see them. No disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import AdjustedBlock, BoolArray, FloatArray, IntArray
from aeromatch_cli.report.figures import COLOURS, histogram_axes, label_width, name_ground_axes, new_axes, svg
from aeromatch_cli.words import counted, form

# Cells along the longer side of the ground, of the overlap count; and of the points, as many as their number allows.
_FINE, _COARSE = 160, (6, 40)
# A place that so many images show should have so many points; on average it has as many times more.
_WELL_SEEN, _FEW_POINTS, _AVERAGE = 3, 3, 5.0
_MORE_IMAGES = 10
_WIDTH_IN, _HEIGHTS_IN = 7.0, (3.2, 7.0)
# Room for the bar of colours and its numbers, for the labels below and for the title.
_BAR_IN, _LABELS_IN, _TITLE_IN = 1.0, 0.6, 0.35
# Footprints are drawn so many of their sizes beyond the outermost cameras: views of the horizon would shrink all else.
_FARTHEST = 1.5
_LARGEST_ERROR = 0.99  # quantile
_MANY_IMAGES = 20


@dataclass(frozen=True)
class Ground:
    """What is drawn of the world: corners (2,) in metres. in_world: else in a frame without north and metres. cut:
    whether ground that images show lies beyond."""

    low_m: FloatArray
    high_m: FloatArray
    in_world: bool = True
    cut: bool = False

    @classmethod
    def of(cls, centers_m: FloatArray, footprints: Sequence[FloatArray], *, in_world: bool = True) -> Ground:
        """Cameras (N, 2) and the footprints around them, as far as they are not many times as large as usual."""
        most_m = _FARTHEST * float(np.median([np.ptp(polygon, axis=0).max() for polygon in footprints]))
        corners = np.concatenate([polygon[:, :2] for polygon in footprints])
        shown = np.concatenate([centers_m, corners])
        low_m = np.maximum(shown.min(axis=0), centers_m.min(axis=0) - most_m)
        high_m = np.minimum(shown.max(axis=0), centers_m.max(axis=0) + most_m)
        return cls(low_m, high_m, in_world, bool(((corners < low_m) | (corners > high_m)).any()))

    def cells(self, longest: int) -> tuple[int, int]:
        """Columns and rows."""
        extent = self.high_m - self.low_m
        columns, rows = np.maximum(np.rint(longest * extent / extent.max()), 1).astype(int)
        return int(columns), int(rows)

    def shown_by(self, footprints: Sequence[FloatArray], longest: int) -> IntArray:
        """(rows, columns) of how many footprints hold the middle of a cell; row 0 in the south."""
        import cv2

        columns, rows = self.cells(longest)
        count = np.zeros((rows, columns), np.int64)
        scale = (columns, rows) / (self.high_m - self.low_m)
        for polygon in footprints:
            corners = (np.asarray(polygon, np.float64)[:, :2] - self.low_m) * scale - 0.5
            inside = np.zeros((rows, columns), np.uint8)
            # Far beyond the drawing OpenCV's fixed-point corners would overflow.
            bounded = np.clip(corners, -20.0 * longest, 20.0 * longest)
            cv2.fillPoly(inside, [np.rint(bounded * 256.0).astype(np.int32)], 1, shift=8)
            count += inside
        return count


def ground_figures(
    centers_m: FloatArray, footprints: Sequence[FloatArray], adjusted: AdjustedBlock | None, *, in_world: bool = True
) -> list[tuple[str, str]]:
    """(SVG, remark) of the overlap count and, of an adjusted block, of its points per place. centers_m (N, 2),
    footprints: of the images of its first part, whose points alone have a place beside them. in_world: else in a frame
    of the pictures' own."""
    if not footprints or not len(centers_m):
        return []
    ground = Ground.of(centers_m, footprints, in_world=in_world)
    count = ground.shown_by(footprints, _FINE)
    seen = count > 0
    share = 100.0 * (count >= _WELL_SEEN).sum() / max(1, seen.sum())
    label = f"images that show a place ({_MORE_IMAGES}: or more)"
    words = f"Three images and more show {share:.0f} % of the ground."
    figures = [(_field(ground, np.minimum(count, _MORE_IMAGES), seen, label), words)]
    parts = [] if adjusted is None else adjusted.parts()
    if parts and len(parts[0].points_m):
        figures.append(_points_figure(ground, footprints, parts[0].points_m))
    cut = f" Ground more than {_FARTHEST:g} footprints beyond the cameras is not drawn." if ground.cut else ""
    alone = cut + (" The other groups of images are left out." if len(parts) > 1 else "")
    return [(figure, words + alone) for figure, words in figures]


def _points_figure(ground: Ground, footprints: Sequence[FloatArray], points_m: FloatArray) -> tuple[str, str]:
    longest = int(np.clip(np.sqrt(len(points_m) / (_FEW_POINTS * _AVERAGE)), *_COARSE))
    columns, rows = ground.cells(longest)
    edges = [np.linspace(ground.low_m[k], ground.high_m[k], n + 1) for k, n in enumerate((columns, rows))]
    points = np.histogram2d(points_m[:, 1], points_m[:, 0], bins=(edges[1], edges[0]))[0]
    well_seen = ground.shown_by(footprints, longest) >= _WELL_SEEN
    weak = well_seen & (points < _FEW_POINTS)
    label = "points of the adjusted block per place, logarithmic"
    share = 100.0 * weak.sum() / max(1, well_seen.sum())
    words = (
        f"Red: {weak.sum():,} of {well_seen.sum():,} places that three images and more show have fewer than "
        f"{_FEW_POINTS} points ({share:.0f} %)."
    )
    if beyond := len(points_m) - int(points.sum()):
        words += f" {beyond:,} of {len(points_m):,} points {form(beyond, 'lies', 'lie')} beyond the drawing."
    return _field(ground, points, points > 0, label, weak), words


def _field(ground: Ground, values: FloatArray, known: BoolArray, label: str, marked: BoolArray | None = None) -> str:
    """Values (rows, columns) in colours where they are known; marked cells red."""
    from matplotlib.colors import LinearSegmentedColormap, ListedColormap, LogNorm, Normalize
    from matplotlib.ticker import MaxNLocator

    extent_m = ground.high_m - ground.low_m
    left = label_width((ground.low_m[1], ground.high_m[1])) / 72.0
    wide = _WIDTH_IN - left - _BAR_IN
    height = float(np.clip(wide * extent_m[1] / extent_m[0] + _LABELS_IN + _TITLE_IN, *_HEIGHTS_IN))
    margins = {
        "left": left / _WIDTH_IN, "right": 1.0 - _BAR_IN / _WIDTH_IN,
        "bottom": _LABELS_IN / height, "top": 1.0 - _TITLE_IN / height,
    }  # fmt: skip
    axes = new_axes(_WIDTH_IN, height, margins=margins)
    largest = float(values.max(initial=1.0))
    logarithmic = marked is not None
    norm = LogNorm(1.0, max(largest, 2.0)) if logarithmic else Normalize(0.0, max(largest, 1.0))
    colours = [COLOURS[f"k{k}"] for k in range(6)]
    scale = LinearSegmentedColormap.from_list("matches", colours)
    where = {"extent": (ground.low_m[0], ground.high_m[0], ground.low_m[1], ground.high_m[1]), "origin": "lower"}
    drawn = axes.imshow(np.ma.masked_where(~known, values), cmap=scale, norm=norm, interpolation="none", **where)
    if marked is not None and marked.any():
        red = ListedColormap([COLOURS["bad"]])
        axes.imshow(np.ma.masked_where(~marked, marked.astype(float)), cmap=red, interpolation="none", **where)
    axes.apply_aspect()
    place = axes.get_position()
    beside = axes.figure.add_axes((place.x1 + 0.02, place.y0, 0.03, place.height))
    bar = axes.figure.colorbar(drawn, cax=beside)
    if logarithmic:
        bar.ax.yaxis.set_major_formatter("{x:,.0f}")
        bar.ax.yaxis.set_minor_formatter("")
    else:
        bar.locator = MaxNLocator(integer=True)
    name_ground_axes(axes, in_world=ground.in_world)
    axes.set_title(label, fontsize=10)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.grid(visible=False)
    return svg(axes.figure, label, "field", {})


def point_figures(adjusted: AdjustedBlock | None) -> list[str]:
    """Of the points of an adjusted block: reprojection errors, and images per point."""
    if adjusted is None or not len(adjusted.points_m):
        return []
    seen = np.zeros(len(adjusted.points_m), np.int64)
    for track in adjusted.tracks.values():
        seen += np.bincount(np.unique(track[:, 1]), minlength=len(seen))
    return [_errors_figure(adjusted.errors_px), _images_figure(seen)]


def _images_figure(seen: IntArray) -> str:
    """Points by the number of images that see them."""
    numbers, counts = np.unique(np.minimum(seen, _MANY_IMAGES), return_counts=True)
    axes = histogram_axes(counts)
    for bar in axes.bar(numbers, counts, 0.9, color=COLOURS["accent"], linewidth=0):
        bar.set_gid("bar")
    label = f"images that see a point ({_MANY_IMAGES}: or more)"
    axes.set(xlabel=label, ylabel="points", xticks=range(int(numbers[0]), int(numbers[-1]) + 1))
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_formatter("{x:,.0f}")
    titles = [f"{number} images: {counted(count, 'point')}" for number, count in zip(numbers, counts, strict=True)]
    return svg(axes.figure, "images that see a point", "histogram", {"bar": titles})


def _errors_figure(errors_px: FloatArray) -> str:
    errors = errors_px[np.isfinite(errors_px)]
    largest = max(float(np.quantile(errors, _LARGEST_ERROR)) if len(errors) else 1.0, 0.1)
    counts, edges = np.histogram(np.minimum(errors, largest), 24, (0.0, largest))
    axes = histogram_axes(counts)
    bars = axes.bar(
        edges[:-1], counts, 0.94 * (edges[1] - edges[0]), align="edge", color=COLOURS["accent"], linewidth=0
    )
    for bar in bars:
        bar.set_gid("bar")
    axes.set(
        xlim=(0.0, largest), xlabel="mean reprojection error of a point, px (the last bar: and more)", ylabel="points"
    )
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_formatter("{x:,.0f}")
    titles = [
        f"{low:.2f} to {high:.2f} px: {counted(count, 'point')}"
        for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
    ]
    return svg(axes.figure, "reprojection errors", "histogram", {"bar": titles})
