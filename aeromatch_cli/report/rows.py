"""What the report shows, read from the workspace: rows per pair, image, stage and failure, and the evaluation.

Of reports/*.json every stage's counts are shown, and of its result what `_details` has words for.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.files import read_json, read_record
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import (
    AdjustResult,
    ConsistencyResult,
    EnhanceResult,
    ExtractResult,
    FilterResult,
    MatchResult,
    OrientResult,
    PairsResult,
    RefineResult,
    StageResult,
    ViewsResult,
)
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.stage_report import result_of
from aeromatch_cli.store.naming import item_named
from aeromatch_cli.words import counted
from aeromatch_cli.workspace import Workspace

NOT_JUDGED = "not judged"
# Of a pose that lies in a frame which nothing ties to the world.
OWN_FRAME = "own frame"
_UNENHANCED = "image not enhanced (same illumination)", "images not enhanced (same illumination)"


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

    pose: "full", "position", "own frame" (one that nothing ties to the world) or "none". coverage: share of the image's
    cells that hold a verified match. views: virtual views that its features come from, None where none are on file.
    shadow: share of the picture that the enhancement treated as shadow, None where it looks for none. ninths: how many
    of the image (3 x 3) hold a point of the adjusted block, empty_ninths: how many hold none though other images show
    them, points_of_three: its points that three and more images see; None where it is not adjusted.
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


def stage_rows(workspace: Workspace) -> list[StageRow]:
    """Last run of every stage in the order of the chain; the shards of one stage are summed, over all steps of a
    cascade, whose shards report in the folders of the steps."""
    groups: dict[tuple[str, bool], list[StageRecord]] = {}
    shards: dict[str, set[str]] = {}
    for path, report in _reports(workspace):
        shard = re.fullmatch(r".+\.(\d+-of-\d+)", path.stem)
        groups.setdefault((report.stage, shard is not None), []).append(report)
        if shard:
            shards.setdefault(report.stage, set()).add(shard[1])

    order = {name: place for place, name in enumerate(graph.ORDER)}
    rows = []
    for name, sharded in sorted(groups, key=lambda key: (order.get(key[0], len(order)), key)):
        # The report stage is running now: what is on file of it is about an earlier page.
        if name == "report":
            continue
        reports = groups[name, sharded]
        row = StageRow(
            f"{name} ({len(shards[name])} shards)" if sharded else name,
            seconds=sum(report.seconds for report in reports),
            items=sum(report.items for report in reports),
            done=sum(report.done for report in reports),
            skipped=sum(report.skipped for report in reports),
            failed=sum(report.failed for report in reports),
            facts="" if sharded else ", ".join(_details(result_of(reports[0]))),
        )
        rows.append(row)
    return rows


def _reports(workspace: Workspace) -> Iterator[tuple[Path, StageRecord]]:
    """Of all stages, and of the shards of a cascade's steps."""
    in_steps = workspace.reports.glob("*/*-of-*.json")
    for path in (*sorted(workspace.reports.glob("*.json")), *sorted(in_steps)):
        record = read_record(path, StageRecord)
        if record is not None and record.stage in graph.BY_NAME:
            yield path, record


def seconds_by_stage(workspace: Workspace) -> dict[str, float]:
    """Of the last run of every stage, with those of its shards."""
    found: dict[str, float] = {}
    for _, report in _reports(workspace):
        found[report.stage] = found.get(report.stage, 0.0) + report.seconds
    return found


def _details(result: StageResult | None) -> Iterator[str]:
    """What a stage has found, in words; nothing is said of what is zero or unknown."""
    match result:
        case OrientResult():
            yield from _counts(
                (result.images_matched, "image matched in the first pass", "images matched in the first pass"),
                (result.points, "point"),
            )
        case PairsResult():
            yield f"of {result.images:,} images"
        case ViewsResult():
            yield from _view_words(result)
        case EnhanceResult():
            yield from _counts((result.images_skipped_same_illumination, *_UNENHANCED))
        case MatchResult():
            few = result.not_settled, "pair left with few matches", "pairs left with few matches"
            yield from _counts((result.matches, "match before verification", "matches before verification"), few)
        case FilterResult():
            yield from _counts((result.verified_matches, "verified match", "verified matches"))
        case RefineResult():
            yield from _counts(
                (result.measured, "keypoint measured", "keypoints measured"), (result.keypoints, "matched", "matched")
            )
            if result.shift_px:
                yield f"moved by {result.shift_px:.2f} px (median)"
        case AdjustResult():
            yield from _counts((result.images, "image oriented", "images oriented"), (result.points, "point"))
            if result.track_length:
                yield f"{result.track_length:.1f} images per point"
            if result.reprojection_error_px:
                yield f"mean reprojection error {result.reprojection_error_px:.2f} px"
        case ConsistencyResult():
            yield from _counts(
                (result.verified_matches, "verified match left", "verified matches left"),
                (result.dropped_matches, "dropped", "dropped"),
                (result.rejected_pairs, "pair dropped as a whole", "pairs dropped as a whole"),
                (result.points_left, "point left", "points left"),
            )


def _view_words(result: ViewsResult) -> Iterator[str]:
    if isinstance(result, ExtractResult):
        empty = result.images_without_keypoints, "image without keypoints", "images without keypoints"
        yield from _counts((result.keypoints, "keypoint"), empty)
    if result.images:
        yield f"{result.views_per_image:.3g} views per image"
        yield f"{result.megapixels_per_image:.3g} megapixels together"
    if isinstance(result, ExtractResult):
        yield from _counts((result.images_skipped_same_illumination, *_UNENHANCED))


def _counts(*counts: tuple[int | None, *tuple[str, ...]]) -> Iterator[str]:
    """Each with its words, of one and of several; the latter are left out where the noun alone has an s more."""
    return (counted(count, *words) for count, *words in counts if count)


def failure_rows(context: Context) -> list[dict[str, str]]:
    """Rows of failures.csv: stage, item, reason."""
    path = context.workspace.failures
    names = context.block.names
    rows = read_csv(path) if path.is_file() else []
    # Those of an earlier version have ids.
    return [{**row, "item": item_named(row["item"], names)} for row in rows]


def evaluation_figures(workspace: Workspace) -> EvaluationFigures | None:
    """None where the workspace was never evaluated."""
    stated = workspace.evaluation / "evaluation.json"
    if not stated.is_file():
        return None
    pictures = []
    for path in sorted(workspace.evaluation.glob("*.png")):
        coded = base64.b64encode(path.read_bytes()).decode("ascii")
        pictures.append((path.stem.replace("_", " "), f"data:image/png;base64,{coded}"))
    summary = [(str(name), str(value)) for name, value in read_json(stated)["summary"]]
    return EvaluationFigures(summary, pictures, _is_outdated(workspace, stated))


def present_evaluation(workspace: Workspace) -> dict[str, Any] | None:
    """What evaluation.json holds; None where the workspace was not evaluated since its matches were made."""
    stated = workspace.evaluation / "evaluation.json"
    return None if not stated.is_file() or _is_outdated(workspace, stated) else dict(read_json(stated))


def _is_outdated(workspace: Workspace, stated: Path) -> bool:
    """Whether matches were made since evaluation.json was written."""
    return workspace.ran_since(stated, "filter", "consistency")
