"""Tables of the rows of `bench keypoints`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from benchmarks.keypoints.orientations import WITHIN_DEG
from benchmarks.tables import Column, Row, code, grouped, mean, median, number, percent, ratio, table, total

_ABOVE_40 = ("40-60", ">60")
_Rows = Sequence[Row]


def repeatability(rows: _Rows, field: str) -> float:
    """Sum of the repeated over the sum of keypoints of the side that has fewer."""
    return ratio(total(rows, field), sum(min(row["keypoints0"], row["keypoints1"]) for row in rows))


_DETECTOR: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("keypoints", lambda rows: number(float(np.mean([(r["keypoints0"] + r["keypoints1"]) / 2 for r in rows])))),
    ("repeatability 3 px", lambda rows: percent(repeatability(rows, "repeated_3px"), 1)),
    ("repeatability 1 px", lambda rows: percent(repeatability(rows, "repeated_1px"), 1)),
    ("error px", lambda rows: number(median(rows, "error_px"), 2)),
)


def _within(limit: float) -> Column[_Rows]:
    """Share of keypoints within so many degrees."""
    field = f"within_{limit:g}_deg"
    return f"within {limit:g}°", lambda rows: percent(ratio(total(rows, field), total(rows, "keypoints")), 1)


_ORIENTATION: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("keypoints", lambda rows: number(total(rows, "keypoints"))),
    *(_within(limit) for limit in WITHIN_DEG),
    ("median error °", lambda rows: number(median(rows, "median_error_deg"), 1)),
)
_DESCRIPTOR: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("corresponding", lambda rows: number(total(rows, "corresponding"))),
    ("FPR95", lambda rows: percent(mean(rows, "fpr95"), 2)),
    ("mAP, by ratio", lambda rows: percent(mean(rows, "map_by_ratio"), 1)),
    ("mAP, by distance", lambda rows: percent(mean(rows, "map_by_distance"), 1)),
    ("nearest is right", lambda rows: percent(mean(rows, "right"), 1)),
)


def _table(section: str, heads: Sequence[str], also: str, columns: Sequence[Column[_Rows]]) -> Callable[[_Rows], str]:
    """One line per class of view angle, value of `also` and method; those above 40 degrees together at the end."""

    def groups(rows: _Rows) -> Iterator[tuple[tuple[str, ...], _Rows]]:
        own = [row for row in rows if row["section"] == section]
        classes = [(name, (name,)) for name, _ in VIEW_ANGLE_CLASSES]
        for title, wanted in (*classes, (">40", _ABOVE_40)):
            members = [row for row in own if class_of(row["view_angle_deg"], VIEW_ANGLE_CLASSES) in wanted]
            for (value, method), found in grouped(members, also, "method"):
                yield (title, value, code(method)), found

    return lambda rows: table(heads, groups(rows), columns)


detector_table = _table("detectors", ("view angle", "on", "detector"), "frame", _DETECTOR)
orientation_table = _table("orienters", ("view angle", "on", "angles by"), "frame", _ORIENTATION)
descriptor_table = _table("descriptors", ("view angle", "suns", "descriptor"), "suns", _DESCRIPTOR)
