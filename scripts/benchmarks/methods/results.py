"""Rows of the benchmark, and the tables made from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from aeromatch_cli.evaluate import PairScore
from aeromatch_cli.evaluate.metrics import auc
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from benchmarks.methods.goals import (
    ENOUGH_CORRECT,
    EXACT,
    NOISY,
    Comparison,
    goals_table,
    noise_table,
    noisy_label,
    shadow_table,
    strategies_table,
)
from benchmarks.methods.oblique import oblique_table
from benchmarks.methods.worker import Measured
from benchmarks.peers.base import Options
from benchmarks.peers.table import Named
from benchmarks.scenes import CONDITIONS, NOISY_POSES, Judged, JudgedPair
from benchmarks.tables import (
    Column,
    Row,
    code,
    grouped,
    mean,
    median,
    number,
    percent,
    plain,
    ratio,
    table,
    total,
    values,
)

# What every row holds, in this order; what follows in a row is an extra.
FIELDS = (
    "method", "scene", "condition", "pair", "view_angle_deg", "shadow_share", "overlap", "keypoints", "possible",
    "kept", "correct", "correctness", "recall", "mean_error_px", "median_error_px", "coverage", "rotation_error_deg",
    "translation_error_deg", "seconds", "peak_mb",
)  # fmt: skip
EXTRAS = ("within_5px", "hidden", "unseen", "kept_in_shadow", "correct_in_shadow", "wrong_at_border")


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
    row = {field: plain(found[field]) for field in (*FIELDS, *EXTRAS)}
    asked = {"asked_keypoints": options.keypoints, "budget": options.budget, "seed": options.seed}
    asked |= {"threads": options.threads, "poses": poses, "spec": name.spec}
    return row | {"texture": plain(pair.conditions.texture), **asked, "key": key}


def tables(rows: Sequence[Row], comparison: Comparison, parts: Sequence[str] | None = None) -> str:
    """Markdown: the goals, and figures by condition, by scene and by view angle. parts: of PARTS; all by default."""
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
    for part in parts or PARTS:
        title, make = PARTS[part]
        text += [f"### {title}", make(rows, comparison)]
    return "\n\n".join(text) + "\n"


def _legend(rows: Sequence[Row]) -> list[str]:
    """What labels stand for."""
    specs = {row["method"]: row["spec"] for row in rows if row["poses"] == EXACT}
    named = [f"{code(label)} = {code(spec)}" for label, spec in specs.items() if label != spec]
    return ["Methods: " + "; ".join(named) + "."] if named else []


def _by(title: str, group_of: Callable[[Row], str], order: Sequence[str] = ()) -> Callable[..., str]:
    """A table of a line for every group and method."""

    def make(rows: Sequence[Row], _comparison: Comparison) -> str:
        members = [row for group in order for row in rows if group_of(row) == group] if order else rows
        lines = [((group, code(method)), own) for (group, method), own in grouped(members, group_of, "method")]
        return table((title, "method"), lines, COLUMNS)

    return make


def _view_class(row: Row) -> str:
    angle = row["view_angle_deg"]
    return class_of(math.nan if angle is None else float(angle), VIEW_ANGLE_CLASSES)


def _auc(rows: Sequence[Row], limit_deg: float) -> str:
    return f"{auc(np.array([_pose_error(row) for row in rows]), (limit_deg,))[0]:.2f}"


def _pose_error(row: Row) -> float:
    """The larger angle, NaN where there is none; images from one place have no direction to be wrong about."""
    return max(values([row], "rotation_error_deg") + values([row], "translation_error_deg"), default=math.nan)


def _recall(rows: Sequence[Row]) -> str:
    known = [row for row in rows if row["possible"] is not None]
    return percent(ratio(total(known, "correct"), total(known, "possible")), 1)


COLUMNS: tuple[Column[Sequence[Row]], ...] = (
    ("pairs", len),
    ("correct", lambda rows: number(total(rows, "correct"))),
    ("kept", lambda rows: number(total(rows, "kept"))),
    ("correctness", lambda rows: percent(ratio(total(rows, "correct"), total(rows, "kept")), 1)),
    ("recall", _recall),
    (f">= {ENOUGH_CORRECT} correct", lambda rows: percent(np.mean([r["correct"] >= ENOUGH_CORRECT for r in rows]))),
    ("median error px", lambda rows: number(median(rows, "median_error_px"), 2)),
    ("coverage", lambda rows: number(mean(rows, "coverage"), 3)),
    ("AUC 5°", lambda rows: _auc(rows, 5.0)),
    ("AUC 10°", lambda rows: _auc(rows, 10.0)),
    ("seconds", lambda rows: number(median(rows, "seconds"), 2)),
    ("peak MB", lambda rows: number(max(values(rows, "peak_mb"), default=math.nan))),
)
# What --docs writes any of: title, and how it is made of rows and what is compared with.
PARTS: dict[str, tuple[str, Callable[..., str]]] = {
    "goals": ("Goals", goals_table),
    "oblique": ("Goals above 40 degrees", lambda rows, _: oblique_table(rows)),
    "shadow": ("Shadow", shadow_table),
    "strategies": ("Single strategies and combinations", strategies_table),
    "noise": ("Pose noise", lambda rows, _: noise_table(rows)),
    "condition": ("By condition", _by("condition", lambda row: row["condition"], CONDITIONS["all"])),
    "scene": ("By scene", _by("scene", lambda row: row["scene"])),
    "angle": ("By view angle, degrees", _by("view angle", _view_class, [name for name, _ in VIEW_ANGLE_CLASSES])),
}
