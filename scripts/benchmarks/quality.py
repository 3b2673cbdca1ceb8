"""The picture of quality against seconds: correct matches and seconds of every method, over the same pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.tables import Row, grouped, ratio, total

_SIZE_IN = (7.5, 5.0)
_OURS, _PEERS = "#1f6f3f", "#8a8a8a"
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
    places = np.log([point[1:3] for point in points])
    for (method, seconds, correct, right), place in zip(points, places, strict=True):
        colour = _OURS if method in ours else _PEERS
        axis.scatter(seconds, correct, color=colour, s=36, zorder=3)
        # Of two neighbours the upper one's label stands above it.
        nearest = places[np.argsort(np.linalg.norm(places - place, axis=1))[:2]][-1]
        beside = 6, 5 if place[1] >= nearest[1] else -11
        axis.annotate(
            f"{method}, {100 * right:.1f} % right", (seconds, correct), xytext=beside, textcoords="offset points",
            fontsize=8, color=colour, zorder=4,
        )  # fmt: skip
    # Room for the labels, which stand to the right.
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
    axis.set_xlabel("seconds per pair: features, matching, verification")
    axis.set_ylabel("correct matches per pair")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
