"""What the report shows, read from the workspace: rows per pair, image, stage and failure, and the evaluation.

Of reports/*.json every stage's counts and plain facts are shown as they are named there; by name the report reads
`summary` and `warnings` of pairs, those of orient and adjust (page.py), `spread` and `doubtful` of consistency.
"""

from __future__ import annotations

import base64
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, Image, Pair
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.images.remote import RemoteFile
from aeromatch_cli.stages.consistency import final_pairs
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import match_points
from aeromatch_cli.workspace import Workspace, read_json

T = TypeVar("T")
# Coverage counts the cells of a grid of this many rows and columns that hold a verified match.
COVERAGE_CELLS = 16
NOT_JUDGED = "not judged"
STAGE_ORDER = (
    "orient",
    "pairs",
    "enhance",
    "simulate",
    "extract",
    "match",
    "filter",
    "adjust",
    "consistency",
    "export",
)


@dataclass(frozen=True)
class PairRow:
    """One pair of pairs.csv and what became of it. NaN where unknown.

    chosen_by: the rule that proposed the pair. steps, step_reasons: of a cascade, which steps the pair took, and why,
    and what it lacks in the end.
    """

    image_id0: str
    image_id1: str
    name0: str
    name1: str
    overlap: float
    view_angle_deg: float
    chosen_by: str
    matches_in: int
    verified: int
    median_error_px: float
    state: str
    reason: str
    model_kind: str
    rejects: Mapping[str, int]
    steps: str = ""
    step_reasons: str = ""

    @property
    def share(self) -> float:
        return self.verified / self.matches_in if self.matches_in else float("nan")


@dataclass(frozen=True)
class ImageRow:
    """One image. href: relative link to the picture, or "". keypoints, coverage: None where there are no features.

    pose: "full", "position" or "none". coverage: share of the image's cells that hold a verified match. views: virtual
    views that its features come from, None where none are on file. shadow: share of the picture that the enhancement
    treated as shadow, None where it looks for none. ninths: how many of the image (3 x 3) hold a point of the adjusted
    block, empty_ninths: how many hold none though other images show them, points_of_three: its points that three and
    more images see; None where it is not adjusted.
    """

    image_id: str
    name: str
    href: str
    pose: str
    keypoints: int | None
    pairs: int
    verified_pairs: int
    verified_matches: int
    coverage: float | None
    views: int | None = None
    shadow: float | None = None
    ninths: int | None = None
    empty_ninths: int | None = None
    points_of_three: int | None = None


@dataclass(frozen=True)
class StageRow:
    """reports/<stage>.json, or the sum over the shards of one stage."""

    label: str
    seconds: float
    items: int
    done: int
    skipped: int
    failed: int
    facts: str


@dataclass(frozen=True)
class EvaluationFigures:
    """What `aeromatch evaluate` found. summary: (name, value). pictures: (name, data URI of a PNG).

    outdated: matches were verified since.
    """

    summary: Sequence[tuple[str, str]]
    pictures: Sequence[tuple[str, str]]
    outdated: bool


# Gets a verified pair, stored pixels (M, 2) of its matches in either image, and errors (M,) in pixels.
Visitor = Callable[[PairRow, tuple[FloatArray, FloatArray], FloatArray | None], None]


class _Coverage:
    """Which cells of every image hold a verified match."""

    def __init__(self, context: Context) -> None:
        self._images = context.image_by_id
        self._workspace = context.workspace
        self._keypoints_px: dict[str, FloatArray | None] = {}
        self._seen: dict[str, NDArray[np.bool_]] = {}

    def keypoints_px(self, image_id: str) -> FloatArray | None:
        """(K, 2), or None where the image has no readable features."""
        if image_id not in self._keypoints_px:
            try:
                self._keypoints_px[image_id] = read_keypoints(self._workspace.features(image_id))[0]
            except WorkspaceError:
                self._keypoints_px[image_id] = None
        return self._keypoints_px[image_id]

    def add(self, pair: Pair, entry: VerifiedEntry) -> tuple[FloatArray, FloatArray] | None:
        """Mark the cells of both images that this pair's matches touch. Stored pixels (M, 2) of these in either image,
        None where it has no readable features."""
        keypoints0, keypoints1 = self.keypoints_px(pair.image_id0), self.keypoints_px(pair.image_id1)
        if keypoints0 is None or keypoints1 is None:
            return None
        points = match_points(entry.matches, keypoints0, keypoints1)
        for image_id, points_px in zip((pair.image_id0, pair.image_id1), points, strict=True):
            image = self._images[image_id]
            cells = np.floor((points_px + 0.5) * COVERAGE_CELLS / (image.width_px, image.height_px)).astype(np.int64)
            cells = np.clip(cells, 0, COVERAGE_CELLS - 1)
            seen = self._seen.setdefault(image_id, np.zeros((COVERAGE_CELLS, COVERAGE_CELLS), dtype=bool))
            seen[cells[:, 1], cells[:, 0]] = True
        return points

    def share(self, image_id: str) -> float | None:
        if self.keypoints_px(image_id) is None:
            return None
        return float(self._seen[image_id].mean()) if image_id in self._seen else 0.0


def gather(context: Context, visit: Visitor | None = None) -> tuple[list[PairRow], list[ImageRow]]:
    """Pairs in the order of pairs.csv and images in the order of images.csv. visit: sees the verified pairs meanwhile,
    as reading their files is what takes time."""
    coverage = _Coverage(context)
    judged: dict[tuple[str, str], PairRow] = {}
    tied: Counter[str] = Counter()
    matches: Counter[str] = Counter()
    for pair, entry in final_pairs(context):
        row = judged[pair.image_id0, pair.image_id1] = _pair_row(context, pair, entry)
        if row.state == "verified":
            points = coverage.add(pair, entry)
            if visit is not None and points is not None:
                visit(row, points, entry.verdict.errors_px)
            tied.update((pair.image_id0, pair.image_id1))
            matches.update({pair.image_id0: row.verified, pair.image_id1: row.verified})
    pairs = [judged.get((p.image_id0, p.image_id1)) or _pair_row(context, p, None) for p in context.pairs]
    steps = _steps(context)
    for place, row in enumerate(pairs):
        taken, reasons = steps.get((row.image_id0, row.image_id1), ("", ""))
        pairs[place] = replace(row, steps=taken, step_reasons=reasons)
    report = context.workspace.stage_report("consistency")
    spread = read_json(report)["facts"].get("spread", {}) if report.is_file() else {}
    proposed = Counter(i for pair in context.pairs for i in (pair.image_id0, pair.image_id1))
    images = []
    for image in context.block.images:
        keypoints = coverage.keypoints_px(image.image_id)
        images.append(
            ImageRow(
                image_id=image.image_id,
                name=image.name,
                href=_href(context, image),
                pose=_pose_words(context, image),
                keypoints=None if keypoints is None else len(keypoints),
                pairs=proposed[image.image_id],
                verified_pairs=tied[image.image_id],
                verified_matches=matches[image.image_id],
                coverage=coverage.share(image.image_id),
                views=_fact(context.workspace.views(image.image_id), "views", len),
                shadow=_fact(context.workspace.enhanced(image.image_id, ".json"), "shadow_share", float),
                **dict(zip(_SPREAD, spread.get(image.image_id, ()), strict=False)),
            )
        )
    return pairs, images


# The columns of the report of consistency.
_SPREAD = "ninths", "empty_ninths", "points_of_three"


def _steps(context: Context) -> dict[tuple[str, str], tuple[str, str]]:
    """Which steps every pair took, and why; nothing without a cascade."""
    if not context.settings.cascade or not context.workspace.steps.is_file():
        return {}
    rows = read_csv(context.workspace.steps)
    return {
        (row["image_id0"], row["image_id1"]): (row["steps"], "; ".join(filter(None, (row["reasons"], _lack(row)))))
        for row in rows
    }


def _lack(row: Mapping[str, str]) -> str:
    return f"in the end: {row['lacks']}" if row["lacks"] else ""


def _fact(path: Path, key: str, of: Callable[[Any], T]) -> T | None:
    """One fact of a JSON file of the workspace, None where the stage that writes it left none."""
    facts = read_json(path) if path.is_file() else {}
    return of(facts[key]) if key in facts else None


def _pair_row(context: Context, pair: Pair, entry: VerifiedEntry | None) -> PairRow:
    names = (context.image_by_id[pair.image_id0].name, context.image_by_id[pair.image_id1].name)
    known = (pair.image_id0, pair.image_id1, *names, pair.overlap, pair.view_angle_deg, pair.reason)
    if entry is None:
        words = "no matches of the present keypoints on file: run match and filter"
        return PairRow(*known, 0, 0, float("nan"), NOT_JUDGED, words, "", {})
    verdict = entry.verdict
    errors = np.zeros(0) if verdict.errors_px is None else verdict.errors_px[np.isfinite(verdict.errors_px)]
    return PairRow(
        *known,
        matches_in=entry.matches_in,
        verified=len(entry.matches.indices) if verdict.state == "verified" else 0,
        median_error_px=float(np.median(errors)) if len(errors) else float("nan"),
        state=verdict.state,
        reason=verdict.reason,
        model_kind=verdict.model_kind,
        rejects=verdict.rejected,
    )


def _pose_words(context: Context, image: Image) -> str:
    pose = context.pose(image.image_id)
    if pose is None:
        return "none"
    return "position" if pose.world_rotation is None else "full"


def _href(context: Context, image: Image) -> str:
    """Link from the report to the picture; "" where there is none (another drive on Windows, an object store)."""
    if isinstance(context.picture(image), RemoteFile):
        address = str(context.picture(image))
        return address if address.startswith(("https://", "http://")) else ""
    try:
        relative = os.path.relpath(context.image_path(image), context.workspace.report.parent)
    except ValueError:
        return ""
    return quote(Path(relative).as_posix())


def stage_rows(workspace: Workspace) -> list[StageRow]:
    """Last run of every stage in the order of the chain; the shards of one stage are summed."""
    groups: dict[tuple[str, bool], list[dict[str, Any]]] = {}
    for path in sorted(workspace.reports.glob("*.json")):
        sharded = re.fullmatch(r".+\.\d+-of-\d+", path.stem) is not None
        report = read_json(path)
        groups.setdefault((str(report["stage"]), sharded), []).append(report)

    order = {name: place for place, name in enumerate(STAGE_ORDER)}
    rows = []
    for name, sharded in sorted(groups, key=lambda key: (order.get(key[0], len(order)), key)):
        # The report stage is running now: what is on file of it is about an earlier page.
        if name == "report":
            continue
        reports = groups[name, sharded]
        seconds = sum(float(report["seconds"]) for report in reports)
        items, done, skipped, failed = (
            sum(int(report[key]) for report in reports) for key in ("items", "done", "skipped", "failed")
        )
        label = f"{name} ({len(reports)} shards)" if sharded else name
        facts = "" if sharded else _facts_words(reports[0]["facts"])
        rows.append(StageRow(label, seconds, items, done, skipped, failed, facts))
    return rows


def _facts_words(facts: Mapping[str, Any]) -> str:
    """The plain numbers and words among a stage's facts, without checksums; what is nested has its own place."""
    plain = {k: value for k, value in facts.items() if isinstance(value, int | float | str) and "sha256" not in k}
    return ", ".join(f"{key.replace('_', ' ')} {_number(value)}" for key, value in plain.items())


def _number(value: float | str) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.2f}" if isinstance(value, float) else value


def failure_rows(context: Context) -> list[dict[str, str]]:
    """Rows of failures.csv: stage, item, reason; the items, where they are images or pairs, by their files' names."""
    path, images = context.workspace.failures, context.image_by_id
    rows = read_csv(path) if path.is_file() else []
    for row in rows:
        ids = row["item"].split(" ")
        if all(image_id in images for image_id in ids):
            row["item"] = " – ".join(images[image_id].name for image_id in ids)
    return rows


def evaluation_figures(workspace: Workspace) -> EvaluationFigures | None:
    """None where the workspace was never evaluated."""
    stated = workspace.evaluation / "evaluation.json"
    if not stated.is_file():
        return None
    pictures = []
    for path in sorted(workspace.evaluation.glob("*.png")):
        coded = base64.b64encode(path.read_bytes()).decode("ascii")
        pictures.append((path.stem.replace("_", " "), f"data:image/png;base64,{coded}"))
    made = [workspace.stage_report(stage) for stage in ("filter", "consistency")]
    outdated = any(path.is_file() and path.stat().st_mtime > stated.stat().st_mtime for path in made)
    summary = [(str(name), str(value)) for name, value in read_json(stated)["summary"]]
    return EvaluationFigures(summary, pictures, outdated)
