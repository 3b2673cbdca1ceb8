"""Rows of the benchmark, their file, and the tables made from it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.evaluate import PairScore
from aeromatch_cli.evaluate.metrics import auc
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from aeromatch_cli.workspace import write_text
from methods.base import Options
from methods.goal_tables import goals_table, markdown, noise_table, shadow_table, strategies_table
from methods.goals import ENOUGH_CORRECT, EXACT, NOISY, Comparison, Row, noisy_label
from methods.oblique import oblique_table
from methods.scenes import NOISY_POSES, Judged, JudgedPair
from methods.table import Named
from methods.worker import Measured

# What every row holds, in this order; what follows in a row is an extra.
FIELDS = (
    "method", "scene", "condition", "pair", "view_angle_deg", "shadow_share", "overlap", "keypoints", "possible",
    "kept", "correct", "correctness", "recall", "mean_error_px", "median_error_px", "coverage", "rotation_error_deg",
    "translation_error_deg", "seconds", "peak_mb",
)  # fmt: skip
EXTRAS = ("within_5px", "hidden", "unseen", "kept_in_shadow", "correct_in_shadow", "wrong_at_border")
PARTS = ("goals", "oblique", "shadow", "strategies", "noise", "condition", "scene", "angle")


def make_row(
    name: Named, judged: Judged, pair: JudgedPair, score: PairScore, measured: Measured, options: Options, key: str
) -> Row:
    """One row: FIELDS, then extras. NaN becomes null. keypoints: descriptors of an image that entered matching, mean of
    both. spec: what the method's label stands for. key: what the row depends on; a row with this key need not be made
    again."""
    poses = NOISY if judged.scene.poses.name == NOISY_POSES else EXACT
    found = {
        **score.row(),
        "method": noisy_label(name.label) if poses == NOISY else name.label,
        "scene": judged.scene.name,
        "condition": pair.condition,
        "pair": " ".join(pair.images),
        "view_angle_deg": pair.conditions.view_angle_deg,
        "shadow_share": pair.conditions.shadow_share,
        "overlap": pair.conditions.overlap,
        "keypoints": measured.found.descriptors,
        "seconds": measured.seconds,
        "peak_mb": measured.peak_mb,
    }
    row = {field: _plain(found[field]) for field in (*FIELDS, *EXTRAS)}
    asked = {"asked_keypoints": options.keypoints, "budget": options.budget, "seed": options.seed}
    asked |= {"threads": options.threads, "poses": poses, "spec": name.spec}
    return row | {"texture": _plain(pair.conditions.texture), **asked, "key": key}


def _plain(value: Any) -> Any:
    if not isinstance(value, float | np.floating):
        return value
    return round(float(value), 6) if math.isfinite(value) else None


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """All of them at once, atomically: a killed run leaves the rows it had made."""
    write_text(path, "[\n" + ",\n".join(json.dumps(row, allow_nan=False) for row in rows) + "\n]\n")


def tables(rows: Sequence[Row], comparison: Comparison, parts: Sequence[str] = PARTS) -> str:
    """Markdown: the goals, and figures by condition, by scene and by view angle."""
    if not rows:
        return "No rows.\n"
    first = rows[0]
    text = [
        f"Budget {first['asked_keypoints']} descriptors per {first['budget']}, seed {first['seed']}, "
        f"{first['threads']} threads, one process per method and scene.",
        *_legend(rows),
        "Correct, kept, correctness, recall: sums over pairs. Median error: median of the pairs' medians. Coverage: "
        "mean. AUC: of the larger of rotation and translation error. Seconds: median pair, features of both images "
        "included. Peak MB: largest. Real blocks: judged by reference epipolar lines, recall unknown.",
    ]
    makers: dict[str, tuple[str, Callable[[], str]]] = {
        "goals": ("Goals", lambda: goals_table(rows, comparison)),
        "oblique": ("Goals above 40 degrees", lambda: oblique_table(rows)),
        "shadow": ("Shadow", lambda: shadow_table(rows, comparison)),
        "strategies": ("Single strategies and combinations", lambda: strategies_table(rows, comparison)),
        "noise": ("Pose noise", lambda: noise_table(rows)),
        "condition": ("By condition", lambda: _table(rows, lambda row: row["condition"], "condition", _CONDITIONS)),
        "scene": ("By scene", lambda: _table(rows, lambda row: row["scene"], "scene", _scenes(rows))),
        "angle": ("By view angle, degrees", lambda: _table(rows, _view_class, "view angle", _VIEW_CLASSES)),
    }
    for part in parts:
        title, make = makers[part]
        text += [f"### {title}", make()]
    return "\n\n".join(text) + "\n"


_CONDITIONS = ["hard", "easy"]
_VIEW_CLASSES = [name for name, _ in VIEW_ANGLE_CLASSES]


def _legend(rows: Sequence[Row]) -> list[str]:
    """What labels stand for."""
    specs = {row["method"]: row["spec"] for row in rows if row["poses"] == EXACT}
    named = [f"`{label}` = `{spec}`" for label, spec in specs.items() if label != spec]
    return ["Methods: " + "; ".join(named) + "."] if named else []


def _scenes(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["scene"] for row in rows))


def _view_class(row: Row) -> str:
    return class_of(_number(row["view_angle_deg"]), VIEW_ANGLE_CLASSES)


def _table(rows: Sequence[Row], group_of: Callable[[Row], str], title: str, groups: Sequence[str]) -> str:
    columns = (
        title, "method", "pairs", "correct", "kept", "correctness", "recall", f">= {ENOUGH_CORRECT} correct",
        "median error px", "coverage", "AUC 5°", "AUC 10°", "seconds", "peak MB",
    )  # fmt: skip
    lines = []
    for group in groups:
        members = [row for row in rows if group_of(row) == group]
        for method in dict.fromkeys(row["method"] for row in members):
            own = [row for row in members if row["method"] == method]
            lines.append([group, f"`{method}`", *summary(own)])
    return markdown(columns, lines)


def summary(rows: Sequence[Row]) -> list[str]:
    """The cells of one line, "-" where unknown."""
    correct, kept = _sum(rows, "correct"), _sum(rows, "kept")
    known = [row for row in rows if row["possible"] is not None]
    auc5, auc10 = auc(np.array([_pose_error(row) for row in rows]), (5.0, 10.0))
    enough = sum(row["correct"] >= ENOUGH_CORRECT for row in rows) / len(rows)
    return [
        str(len(rows)),
        f"{correct:.0f}",
        f"{kept:.0f}",
        _share(correct, kept),
        _share(_sum(known, "correct"), _sum(known, "possible")),
        f"{100 * enough:.0f} %",
        _figure(_values(rows, "median_error_px"), np.median, 2),
        _figure(_values(rows, "coverage"), np.mean, 3),
        f"{auc5:.2f}",
        f"{auc10:.2f}",
        _figure(_values(rows, "seconds"), np.median, 2),
        _figure(_values(rows, "peak_mb"), np.max, 0),
    ]


def _pose_error(row: Row) -> float:
    """The larger angle, NaN where there is none; images from one place have no direction to be wrong about."""
    angles = (row["rotation_error_deg"], row["translation_error_deg"])
    return max((float(angle) for angle in angles if angle is not None), default=math.nan)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _values(rows: Sequence[Row], field: str) -> list[float]:
    return [float(row[field]) for row in rows if row[field] is not None]


def _sum(rows: Sequence[Row], field: str) -> float:
    return sum(_values(rows, field))


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole > 0 else "-"


def _figure(values: list[float], of: Callable[[list[float]], Any], digits: int) -> str:
    return f"{float(of(values)):.{digits}f}" if values else "-"
