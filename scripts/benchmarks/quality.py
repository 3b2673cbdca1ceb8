"""The picture of quality against seconds: correct matches and seconds of every method, over the same pairs."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import Row, grouped, ratio, total

_SIZE_IN = (7.5, 5.0)
_OURS, _PEERS = "#1f6f3f", "#8a8a8a"
_WHOLE, _STEPS = "auto", "auto[cascade="
# Where a label may stand beside its point: its end there, and points to the right and above.
_PLACES = tuple((*end, above) for above in (5, -11, 17, -23) for end in (("left", 6), ("right", -6)))
# Lines of as many correct matches a second.
_RATES = (10, 30, 100, 300, 1000, 3000)


def quality(rows: Sequence[Row]) -> list[tuple[str, float, float, float]]:
    """Method, seconds and correct matches per pair, and the share of kept matches that is correct."""
    return [
        (
            method,
            total(own, "seconds") / len(own),
            total(own, "correct") / len(own),
            ratio(total(own, "correct"), total(own, "kept")),
        )
        for (method,), own in grouped(rows, "method")
    ]


def _words(method: str) -> str:
    """auto[cascade=guided]: auto up to the step guided. Others by their names."""
    last = method.removeprefix(_STEPS).removesuffix("]")
    if not _is_step(method) or method == _WHOLE:
        return method
    return "auto's first step" if last == "none" else f"auto up to {last}"


def _is_step(method: str) -> bool:
    return method == _WHOLE or (method.startswith(_STEPS) and "," not in method)


def _label(axis: Any, points: Sequence[tuple[str, float, float, float]], ours: Container[object]) -> None:
    """Beside every point, where no other label and no point is. Limits and scales of the axis must stand."""
    from matplotlib.transforms import Bbox

    taken = []
    for _, seconds, correct, _ in points:
        x, y = axis.transData.transform((seconds, correct))
        taken.append(Bbox.from_bounds(x - 4, y - 4, 8, 8))
    for method, seconds, correct, right in sorted(points, key=lambda point: -point[1]):
        for side, right_of, above in _PLACES:
            label = axis.annotate(
                f"{_words(method)}, {100 * right:.1f} % right", (seconds, correct), xytext=(right_of, above),
                textcoords="offset points", fontsize=8, color=_OURS if method in ours else _PEERS, ha=side, zorder=4,
            )  # fmt: skip
            box = label.get_window_extent()
            free = box.x0 > axis.bbox.x0 and not any(box.overlaps(other) for other in taken)
            if free or (side, right_of, above) == _PLACES[-1]:
                taken.append(box)
                break
            label.remove()


def draw_quality(path: Path, rows: Sequence[Row]) -> None:
    """Write an SVG. Ours have the seconds of the whole command too, which tells them from peers."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "quality"
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    ours = {row["method"] for row in rows if "run_seconds" in row}
    figure, axis = plt.subplots(figsize=_SIZE_IN)
    points = [point for point in quality(rows) if point[2] > 0.0]  # a logarithm has no place for none
    for method, seconds, correct, _ in points:
        axis.scatter(seconds, correct, color=_OURS if method in ours else _PEERS, s=36, zorder=3)
    steps = sorted(point[1:3] for point in points if _is_step(point[0]))
    axis.plot(*zip(*steps, strict=True), color=_OURS, linewidth=0.8, zorder=2)
    # Room for the labels.
    low, high = 0.8 * min(point[1] for point in points), 4.0 * max(point[1] for point in points)
    bottom, top = 0.8 * min(point[2] for point in points), 1.2 * max(point[2] for point in points)
    for rate in _RATES:
        axis.plot([low, high], [rate * low, rate * high], color="#dddddd", linewidth=0.8, zorder=1)
        at = min(high, top / rate)
        if at > low and rate * at > bottom:
            axis.annotate(f"{rate} / s", (at, rate * at), fontsize=7, color="#999999", ha="right", va="top")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlim(low, high)
    axis.set_ylim(bottom, top)
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        scale.set_major_formatter("{x:g}")
        scale.set_minor_formatter(NullFormatter())
    axis.set_xlabel("seconds per pair, orientation left out")
    axis.set_ylabel("correct matches per pair")
    figure.tight_layout()
    _label(axis, points, ours)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
