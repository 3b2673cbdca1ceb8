"""Goals of oblique pairs: every preset against the peers on source images and on rectified views, by view angle."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from benchmarks.methods.goals import EXACT
from benchmarks.peers.table import ON_GROUND, PEERS
from benchmarks.tables import Column, Row, code, factor, median, number, percent, ratio, table, total

OVER_SOURCE, OVER_RECTIFIED, CORRECTNESS = 2.0, 1.2, 0.95
SIFT = "opencv-sift"
CLASSES = tuple(name for name, bound in VIEW_ANGLE_CLASSES if bound > 40.0)  # above 40 degrees
_Place = tuple[str, str]
_Rows = Mapping[_Place, Row]


@dataclass(frozen=True)
class Best:
    """The peer with most correct matches in sum; label None where there is none."""

    label: str | None
    correct: int


@dataclass(frozen=True)
class ObliqueGoals:
    """The figures of one method over some pairs, NaN where unknown.

    recall, coverage: sums and means over the pairs; of_peers: the highest of any peer. median_error_px, sift_error_px:
    medians of the pairs' medians, over the pairs where both kept something.
    """

    pairs: int
    correct: int
    on_source: Best
    on_rectified: Best
    correctness: float
    recall: float
    recall_of_peers: float
    coverage: float
    coverage_of_peers: float
    median_error_px: float
    sift_error_px: float

    @property
    def over_source(self) -> float:
        return ratio(self.correct, self.on_source.correct) if self.on_source.label else math.nan

    @property
    def over_rectified(self) -> float:
        return ratio(self.correct, self.on_rectified.correct) if self.on_rectified.label else math.nan

    def missed(self) -> list[str]:
        """Names of the goals that are not reached; what is unknown is not missed."""
        checks = {
            "source": self.over_source < OVER_SOURCE,
            "rectified": self.over_rectified < OVER_RECTIFIED,
            "correctness": self.correctness < CORRECTNESS,
            "recall": self.recall <= self.recall_of_peers,
            "coverage": self.coverage <= self.coverage_of_peers,
            "pixel error": self.median_error_px > self.sift_error_px,
        }
        return [name for name, missed in checks.items() if missed]


def oblique_goals(rows: Sequence[Row], label: str) -> ObliqueGoals:
    """Of one method, over all pairs among the rows; every method has the same ones."""
    by_label: dict[str, dict[_Place, Row]] = {}
    for row in rows:
        if row.get("poses", EXACT) == EXACT:
            by_label.setdefault(row["method"], {})[row["scene"], row["pair"]] = row
    mine = by_label[label]
    specs = {row["method"]: row["spec"] for row in rows}
    peers = {name: found for name, found in by_label.items() if specs[name] in PEERS}
    sift = next((found for name, found in peers.items() if specs[name] == SIFT), {})
    both = [at for at in mine if at in sift and None not in (mine[at]["median_error_px"], sift[at]["median_error_px"])]
    return ObliqueGoals(
        pairs=len(mine),
        correct=_sum(mine, "correct"),
        on_source=_best(peers, specs, on_ground=False),
        on_rectified=_best(peers, specs, on_ground=True),
        correctness=ratio(_sum(mine, "correct"), _sum(mine, "kept")),
        recall=_recall(mine),
        recall_of_peers=_highest(peers, _recall),
        coverage=_coverage(mine),
        coverage_of_peers=_highest(peers, _coverage),
        median_error_px=_median(mine, both),
        sift_error_px=_median(sift, both),
    )


def oblique_table(rows: Sequence[Row]) -> str:
    """One line per kind of pairs, class of view angle and preset."""
    text = (
        "Pairs above 40 degrees. Best peer: that with most correct matches over the pairs of a line. Recall and "
        "coverage: in brackets the highest of all peers. Median error: median of the pairs' medians, in brackets "
        f"`{SIFT}`'s, over the pairs where both kept something."
    )
    lines = [
        ((kind, angles, code(label)), oblique_goals(members, label))
        for kind, angles, members in _groups(rows)
        for label in dict.fromkeys(row["method"] for row in members if row["spec"] not in PEERS)
    ]
    if not lines:
        return "No preset has a pair above 40 degrees."
    return f"{text}\n\n{table(('pairs of', 'view angle', 'method'), lines, _COLUMNS)}"


def _groups(rows: Sequence[Row]) -> Iterator[tuple[str, str, list[Row]]]:
    """Kind, class and rows; each class by itself, then all above 40 degrees."""
    exact = [row for row in rows if row.get("poses", EXACT) == EXACT and row["view_angle_deg"] is not None]
    for kind, known in (("rendered blocks", True), ("real blocks", False)):
        of_kind = [row for row in exact if (row["possible"] is not None) == known]
        for classes, name in (*(((name,), name) for name in CLASSES), (CLASSES, ">40")):
            members = [row for row in of_kind if class_of(row["view_angle_deg"], VIEW_ANGLE_CLASSES) in classes]
            if members:
                yield kind, name, members


def _best_cell(best: Best) -> str:
    return f"`{best.label}` {best.correct}" if best.label else "-"


def _best(peers: Mapping[str, _Rows], specs: Mapping[str, str], *, on_ground: bool) -> Best:
    sums = {name: _sum(rows, "correct") for name, rows in peers.items() if specs[name].endswith(ON_GROUND) is on_ground}
    label = max(sums, key=lambda name: sums[name], default=None)
    return Best(label, 0 if label is None else sums[label])


def _highest(peers: Mapping[str, _Rows], of: Callable[[_Rows], float]) -> float:
    return max((value for value in map(of, peers.values()) if not math.isnan(value)), default=math.nan)


def _recall(rows: _Rows) -> float:
    if any(row["possible"] is None for row in rows.values()):
        return math.nan
    return ratio(_sum(rows, "correct"), _sum(rows, "possible"))


def _coverage(rows: _Rows) -> float:
    return ratio(total(rows.values(), "coverage"), len(rows))


def _sum(rows: _Rows, field: str) -> int:
    return int(total(rows.values(), field))


def _median(rows: _Rows, places: Sequence[_Place]) -> float:
    return median([rows[at] for at in places], "median_error_px")


_COLUMNS: tuple[Column[ObliqueGoals], ...] = (
    ("pairs", lambda found: found.pairs),
    ("correct", lambda found: found.correct),
    ("best on source", lambda found: _best_cell(found.on_source)),
    (f"x (goal {OVER_SOURCE:g})", lambda found: factor(found.over_source)),
    ("best on rectified", lambda found: _best_cell(found.on_rectified)),
    (f"x (goal {OVER_RECTIFIED:g})", lambda found: factor(found.over_rectified)),
    (f"correctness (goal {CORRECTNESS:.0%})", lambda found: percent(found.correctness, 1)),
    ("recall", lambda found: f"{percent(found.recall, 1)} ({percent(found.recall_of_peers, 1)})"),
    ("coverage", lambda found: f"{number(found.coverage, 3)} ({number(found.coverage_of_peers, 3)})"),
    ("median error px", lambda found: f"{number(found.median_error_px, 2)} ({number(found.sift_error_px, 2)})"),
    ("goals missed", lambda found: ", ".join(found.missed()) or "none"),
)
