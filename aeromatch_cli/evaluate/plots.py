"""Plots of an evaluation as PNG. Pairs in, bytes out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.evaluate.totals import PairRow, by_condition
from aeromatch_cli.report.figures import COLOURS, new_axes, png

_BLUE, _ORANGE, _GRAY = COLOURS["accent"], COLOURS["second"], COLOURS["soft"]
_ERROR_RANGE_PX = (0.01, 1000.0)


def _axes() -> Any:
    return new_axes(6.4, 3.8, dpi=110)


def draw_errors(rows: Sequence[PairRow]) -> bytes:
    """Histogram of the errors of all kept matches and their cumulative share, over a logarithmic axis."""
    axes = _axes()
    errors = np.concatenate([np.zeros(0), *(row.score.errors_px for row in rows)])
    kept, known = len(errors), np.sort(errors[np.isfinite(errors)])
    low, high = _ERROR_RANGE_PX
    bins = np.geomspace(low, high, 76)
    axes.hist(np.clip(known, low, high), bins=bins, color=_BLUE, alpha=0.55)
    axes.set(xscale="log", xlim=_ERROR_RANGE_PX, xlabel="error, px", ylabel="matches")
    axes.axvline(CORRECT_PX, color=_GRAY, linestyle="--", linewidth=1.0)
    share = axes.twinx()
    if kept:
        share.step(np.clip(known, low, high), 100.0 * np.arange(1, len(known) + 1) / kept, where="post", color=_ORANGE)
    share.set(ylim=(0.0, 102.0), ylabel="share of kept matches, %")
    share.spines["top"].set_visible(False)
    share.tick_params(colors=_GRAY)
    share.yaxis.label.set_color(_GRAY)
    axes.set_title(f"Error of {kept} kept matches (dashed: {CORRECT_PX:g} px, the limit of a correct one)", fontsize=10)
    return png(axes.figure)


def draw_view_angles(rows: Sequence[PairRow]) -> bytes:
    """Correctness and recall by class of view angle."""
    axes = _axes()
    classes = [(name, figures) for condition, name, figures in by_condition(rows) if condition == "view angle"]
    places = np.arange(len(classes))
    for shift, metric, colour in ((-0.2, "correctness", _BLUE), (0.2, "recall", _ORANGE)):
        values = np.array([100.0 * figures[metric] for _, figures in classes])
        known = np.isfinite(values)
        bars = axes.bar(places[known] + shift, values[known], width=0.38, color=colour, label=metric)
        axes.bar_label(bars, fmt="%.0f", fontsize=8, padding=1)
        for place in places[~known]:
            axes.annotate("none", (place + shift, 1.0), ha="center", fontsize=8, color=_GRAY)
    axes.set_xticks(places, [f"{name}\n{figures['pairs']:.0f} pairs" for name, figures in classes])
    axes.set(ylim=(0.0, 109.0), xlabel="view angle, degrees", ylabel="%")
    axes.grid(visible=False, axis="x")
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return png(axes.figure)


def draw_coverage(rows: Sequence[PairRow]) -> bytes:
    """Coverage by correct matches against the overlap, a dot per pair."""
    axes = _axes()
    hard = np.array([row.conditions.hard for row in rows], dtype=bool)
    overlap = 100.0 * np.array([row.conditions.overlap for row in rows])
    covered = 100.0 * np.array([row.score.coverage for row in rows])
    for kind, colour, label in ((~hard, _BLUE, "easy"), (hard, _ORANGE, "hard")):
        axes.scatter(overlap[kind], covered[kind], s=16, color=colour, label=f"{label}: {kind.sum()} pairs", alpha=0.8)
    axes.set(xlim=(0.0, 102.0), ylim=(-2.0, 102.0), xlabel="overlap, %", ylabel="coverage by correct matches, %")
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return png(axes.figure)


PLOTS: Mapping[str, Callable[[Sequence[PairRow]], bytes]] = {
    "errors": draw_errors,
    "view_angles": draw_view_angles,
    "coverage": draw_coverage,
}
