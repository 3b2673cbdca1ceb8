"""An evaluation on disk and on the terminal.

WORK/evaluation/evaluation.json   truth, totals, conditions, consumer: figures as in totals.py, null where unknown
WORK/evaluation/pairs.csv         one line per pair: names, state, conditions, figures as in scores.py
WORK/evaluation/conditions.csv    one line per class of a condition: figures as in totals.py
WORK/evaluation/*.png             plots of errors, view angles and coverage
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.evaluate.totals import ENOUGH_CORRECT, PairRow, by_condition, total
from aeromatch_cli.evaluate.work import MIN_OVERLAP, Evaluation
from aeromatch_cli.files import write_atomically, write_json, write_text
from aeromatch_cli.formats.tables import csv_text
from aeromatch_cli.report.figures import COLOURS, new_axes, png
from aeromatch_cli.stages.run import execute
from aeromatch_cli.workspace import Workspace

FORMAT_VERSION = 1
_SHOWN = ("pairs", "possible", "kept", "correct", "correctness", "recall", "median_error_px", "coverage", "auc_5deg")
_BLUE, _ORANGE, _GRAY = COLOURS["accent"], COLOURS["second"], COLOURS["soft"]
_ERROR_RANGE_PX = (0.01, 1000.0)


def write_evaluation(evaluation: Evaluation) -> tuple[Path, ...]:
    """Write every file of WORK/evaluation; returns their paths. Raises WorkspaceError where it cannot be written."""
    folder = Workspace(evaluation.work).evaluation
    write_json(folder / "evaluation.json", facts(evaluation))
    pairs = [_pair_row(row) for row in evaluation.pairs]
    write_text(folder / "pairs.csv", csv_text(_PAIR_COLUMNS, [tuple(row[c] for c in _PAIR_COLUMNS) for row in pairs]))
    classes = by_condition(evaluation.pairs)
    columns = tuple(total([]))
    lines = [(condition, name, *(figures[c] for c in columns)) for condition, name, figures in classes]
    write_text(folder / "conditions.csv", csv_text(("condition", "class", *columns), lines))
    written = [folder / name for name in ("evaluation.json", "pairs.csv", "conditions.csv")]
    for name, draw in PLOTS.items():
        path, picture = folder / f"{name}.png", draw(evaluation.pairs)
        write_atomically(path, lambda stream, picture=picture: stream.write(picture))  # type: ignore[misc]
        written.append(path)
    return tuple(written)


def refresh_report(work: Path) -> str:
    """Remake WORK/report/index.html, which shows the evaluation; returns what to say of it.

    The page needs the block's own files; where they have moved, the evaluation stands by itself.
    """
    settings = Workspace(work).config
    if not settings.is_file():
        return "report not remade: the workspace has no config.yaml"
    try:
        execute("report", load(str(settings)))
    except AeromatchError as error:
        return f"report not remade: {error}"
    return f"report {Workspace(work).report}"


def facts(evaluation: Evaluation) -> dict[str, Any]:
    """Everything of evaluation.json; unknown figures are None."""
    return {
        "format_version": FORMAT_VERSION,
        "workspace": str(evaluation.work),
        "truth": str(evaluation.truth_folder),
        "truth_kind": evaluation.truth_kind,
        "images": evaluation.images,
        "left_out": list(evaluation.left_out),
        "min_overlap": MIN_OVERLAP,
        "totals": _plain(total(evaluation.pairs)),
        "conditions": [
            {"condition": condition, "class": name, **_plain(figures)}
            for condition, name, figures in by_condition(evaluation.pairs)
        ],
        "summary": [list(row) for row in summary_rows(evaluation)],
        "consumer": _plain(dict(evaluation.consumer)),
        "seconds": round(evaluation.seconds, 3),
    }


def summary_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """(metric, value) of the whole block, for people."""
    figures, consumer = total(evaluation.pairs), evaluation.consumer
    share = f"{figures['pairs_verified']:.0f} of {figures['pairs']:.0f}"
    left_out = f" ({len(evaluation.left_out)} left out: no reference pose)" if evaluation.left_out else ""
    rows = [
        ("truth", f"{evaluation.truth_kind}, {evaluation.images} images{left_out}"),
        ("pairs verified", f"{share} ({figures['pairs_not_tried']:.0f} not tried)"),
        (f"pairs with {ENOUGH_CORRECT} correct", _shown(figures[f"pairs_with_{ENOUGH_CORRECT}_correct"])),
        ("kept matches", _shown(figures["kept"])),
        ("correct", f"{_shown(figures['correct'])} (correctness {_shown(figures['correctness'])})"),
        ("within 5 px", _shown(figures["within_5px_share"])),
        ("recall", f"{_shown(figures['recall'])} of {_shown(figures['possible'])} possible"),
        (
            "hidden, unseen",
            f"{_shown(figures['hidden'])}, {_shown(figures['unseen'])} (wrong: on a surface that the other image does "
            "not see; in the sky, or outside the other image)",
        ),
        ("error mean, median", f"{_shown(figures['mean_error_px'])}, {_shown(figures['median_error_px'])} px"),
        ("coverage, median", _shown(figures["coverage"])),
        (
            "rotation, translation",
            f"{_shown(figures['rotation_error_deg'])}, {_shown(figures['translation_error_deg'])} degrees "
            f"(medians of {figures['pairs_with_pose']:.0f} pairs with a pose)",
        ),
        ("AUC at 1, 3, 5, 10 deg", ", ".join(_shown(figures[f"auc_{t}deg"]) for t in (1, 3, 5, 10))),
        ("correct in shadow", _shown(figures["correct_in_shadow"])),
        ("wrong at its border", _shown(figures["wrong_at_border"])),
    ]
    # Mapping takes all images of the export, also those without truth.
    images = evaluation.images + len(evaluation.left_out)
    rows += _mapping_rows("mapping", consumer, images)
    if "global" in consumer:
        rows += _mapping_rows("global mapping", consumer["global"], images)
    return rows


def _mapping_rows(name: str, consumer: Mapping[str, Any], images: int) -> list[tuple[str, str]]:
    if "skipped" in consumer:
        return [(name, f"skipped: {consumer['skipped']}")]
    why = "" if consumer["registered"] else ": COLMAP found no pair to begin with (points of two images do not count)"
    rows = [(name, f"{consumer['registered']} of {images} images in one model{why}")]
    if "points" in consumer:
        length, error = _shown(consumer["track_length"]), _shown(consumer["reprojection_error_px"])
        rows.append((f"{name}, points", f"{consumer['points']}, track length {length}, error {error} px"))
    return rows


def condition_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """A table by condition, for people: the header, then a row per class that has pairs."""
    header = ("condition", "class", *(name.replace("_", " ") for name in _SHOWN))
    rows = by_condition(evaluation.pairs)
    return [header, *((condition, name, *(_shown(figures[k]) for k in _SHOWN)) for condition, name, figures in rows)]


def lines(evaluation: Evaluation) -> tuple[str, ...]:
    """Both tables as text for a terminal: names to the left, figures to the right."""
    metrics = [f"{name:24}  {value}" for name, value in summary_rows(evaluation)]
    table = condition_rows(evaluation)
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    aligned = []
    for row in table:
        names = [cell.ljust(w) for cell, w in zip(row[:2], widths[:2], strict=True)]
        figures = [cell.rjust(w) for cell, w in zip(row[2:], widths[2:], strict=True)]
        aligned.append("  ".join([*names, *figures]))
    return (*metrics, "", *aligned)


_CONDITION_COLUMNS = (
    "view_angle_deg",
    "view_angle_class",
    "overlap",
    "shadow_share",
    "shadow_class",
    "texture",
    "texture_class",
    "hard",
)
_SCORE_COLUMNS = (
    "keypoints0",
    "keypoints1",
    "possible",
    "kept",
    "correct",
    "wrong",
    "within_5px",
    "hidden",
    "unseen",
    "correctness",
    "recall",
    "mean_error_px",
    "median_error_px",
    "coverage",
    "rotation_error_deg",
    "translation_error_deg",
    "keypoints_in_shadow",
    "kept_in_shadow",
    "correct_in_shadow",
    "wrong_at_border",
)
_PAIR_COLUMNS = ("image0", "image1", "state", *_CONDITION_COLUMNS, *_SCORE_COLUMNS)


def _pair_row(row: PairRow) -> dict[str, Any]:
    named = {"image0": row.name0, "image1": row.name1, "state": row.state}
    return named | {name: getattr(row.conditions, name) for name in _CONDITION_COLUMNS} | row.score.row()


def _plain(figures: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN."""
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in figures.items()}


def _shown(value: float) -> str:
    """Counts whole, shares and errors with three digits, "-" for unknown."""
    if isinstance(value, float) and math.isnan(value):
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.3f}"


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
