"""Tables of the rows of bench_detector and bench_descriptors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from methods.goal_tables import markdown, number, percent
from methods.goals import ratio

from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from keypoint_bench.orientations import WITHIN_DEG

Row = dict[str, Any]
_ABOVE_40 = ("40-60", ">60")


def detector_table(rows: Sequence[Row]) -> str:
    """One line per class of view angle, frame and detector; then the goals above 40 degrees."""
    columns = (
        "view angle", "on", "detector", "pairs", "keypoints", "repeatability 3 px", "repeatability 1 px", "error px",
    )  # fmt: skip
    lines = [
        [angles, frame, f"`{method}`", *_detector_cells(own)]
        for angles, frame, method, own in _grouped(_of(rows, "detector"))
    ]
    return markdown(columns, lines)


def _detector_cells(own: Sequence[Row]) -> list[str]:
    return [
        str(len(own)),
        f"{np.mean([(row['keypoints0'] + row['keypoints1']) / 2 for row in own]):.0f}",
        percent(repeatability(own, "repeated_3px"), 1),
        percent(repeatability(own, "repeated_1px"), 1),
        number(median_of(own, "error_px"), 2),
    ]


def repeatability(rows: Sequence[Row], field: str) -> float:
    """Sum of the repeated over the sum of keypoints of the side that has fewer."""
    return ratio(_sum(rows, field), sum(min(row["keypoints0"], row["keypoints1"]) for row in rows))


def orientation_table(rows: Sequence[Row]) -> str:
    """One line per class of view angle, frame and network: shares of keypoints within so many degrees."""
    columns = ["view angle", "on", "angles by", "pairs", "keypoints"]
    columns += [*(f"within {limit:g}°" for limit in WITHIN_DEG), "median error °"]
    lines = [
        [angles, frame, f"`{method}`", *_orientation_cells(own)]
        for angles, frame, method, own in _grouped(_of(rows, "orientation"))
    ]
    return markdown(columns, lines)


def _orientation_cells(own: Sequence[Row]) -> list[str]:
    count = _sum(own, "keypoints")
    shares = [percent(ratio(_sum(own, f"within_{limit:g}_deg"), count), 1) for limit in WITHIN_DEG]
    return [str(len(own)), str(count), *shares, number(median_of(own, "median_error_deg"), 1)]


def descriptor_table(rows: Sequence[Row]) -> str:
    """One line per class of view angle, sun and descriptor."""
    columns = (
        "view angle", "suns", "descriptor", "pairs", "corresponding", "FPR95", "mAP, by ratio", "mAP, by distance",
        "nearest is right",
    )  # fmt: skip
    lines = [
        [angles, suns, f"`{method}`", *_descriptor_cells(own)]
        for angles, suns, method, own in _grouped(_of(rows, "descriptor"), lambda row: row["suns"])
    ]
    return markdown(columns, lines)


def _descriptor_cells(own: Sequence[Row]) -> list[str]:
    return [
        str(len(own)),
        str(_sum(own, "corresponding")),
        percent(mean_of(own, "fpr95"), 2),
        *(percent(mean_of(own, field), 1) for field in ("map_by_ratio", "map_by_distance", "right")),
    ]


def _of(rows: Sequence[Row], section: str) -> list[Row]:
    return [row for row in rows if row["section"] == section]


def _grouped(rows: Sequence[Row], also: Callable[[Row], str] = lambda row: row["frame"]) -> Iterator[Any]:
    """Class of view angle, frame, method and rows; the classes above 40 degrees together at the end."""
    classes = [name for name, _ in VIEW_ANGLE_CLASSES]
    for title, wanted in (*((name, (name,)) for name in classes), (">40", _ABOVE_40)):
        members = [row for row in rows if class_of(row["view_angle_deg"], VIEW_ANGLE_CLASSES) in wanted]
        for second in dict.fromkeys(map(also, members)):
            within = [row for row in members if also(row) == second]
            for method in dict.fromkeys(row["method"] for row in within):
                yield title, second, method, [row for row in within if row["method"] == method]


def median_of(rows: Sequence[Row], field: str) -> float:
    """Median over the pairs that have a figure, NaN without any."""
    values = [row[field] for row in rows if row[field] is not None]
    return float(np.median(values)) if values else math.nan


def mean_of(rows: Sequence[Row], field: str) -> float:
    """Mean over the pairs that have a figure, NaN without any."""
    values = [row[field] for row in rows if row[field] is not None]
    return float(np.mean(values)) if values else math.nan


def _sum(rows: Sequence[Row], field: str) -> int:
    return int(sum(row[field] for row in rows))
