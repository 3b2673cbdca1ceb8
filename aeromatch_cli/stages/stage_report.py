"""This module keeps what a stage leaves behind: its report, and the list of all failures."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from aeromatch_cli import graph
from aeromatch_cli.data import Pair
from aeromatch_cli.files import read_record, write_json, write_text
from aeromatch_cli.formats.tables import csv_text
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import StageResult
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.store.naming import item_named, names_on_file
from aeromatch_cli.workspace import Workspace

R = TypeVar("R", bound=StageResult)

log = logging.getLogger("aeromatch")


@dataclass
class StageReport:
    """Counts what one stage does; in the end it becomes its `StageRecord`. part: of a step of a cascade, in words."""

    stage: str
    seconds: float = 0.0
    items: int = 0
    done: int = 0
    skipped: int = 0
    fingerprint: str = ""
    result: StageResult | None = None
    files: dict[str, str] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)
    part: str = ""

    def write(
        self, context_workspace: Workspace, shard: Shard | None = None, names: Mapping[str, str] | None = None
    ) -> StageReport:
        """Close the clock, write the report and gather failures.csv from all stages.

        names: of the files, by image_id; else those that the workspace has, which the first pass's has not.

        A stage that made nothing, and fails where it failed before, leaves that report, with its timing; not where a
        shard has failed since, which this one supersedes.
        """
        self.seconds = round(time.perf_counter() - self.started, 3)
        path = context_workspace.stage_report(self.stage, shard.label if shard else "")
        if not self._says_nothing_new(path) or (shard is None and _shard_failed_since(path)):
            write_json(path, self._record().as_json())
        gather_failures(context_workspace)
        if self.failures and self.stage != "orient":  # its first pass has named them
            names = names or names_on_file(context_workspace)
            for item, reason in self.failures:
                log.warning("%s: %s: %s", self.stage, item_named(item, names), reason)
        return self

    def _record(self) -> StageRecord:
        return StageRecord(
            stage=self.stage,
            seconds=self.seconds,
            items=self.items,
            done=self.done,
            skipped=self.skipped,
            failed=len(self.failures),
            fingerprint=self.fingerprint,
            result=None if self.result is None else self.result.as_json(),
            failures=self.failures,
            files=self.files,
        )

    def _says_nothing_new(self, path: Path) -> bool:
        old = None if self.done else read_record(path, StageRecord)
        if old is None:
            return False
        before = result_of(old)
        # Without a result of its own the stage only counts what it makes: the one on file still holds.
        self.result = self.result or before
        told = old.failures, old.fingerprint, old.files, None if before is None else before.as_json()
        # As they are written: what is not a number is null there, and differs from itself here.
        result = None if self.result is None else self.result.as_json()
        return told == (self.failures, self.fingerprint, self.files, result)

    def record_files(self, context: Context, paths: Iterable[Path]) -> None:
        """State the files that the stage has written, as they are now."""
        root = context.workspace.root
        self.files = {path.relative_to(root).as_posix(): context.store.digest(path) for path in sorted(paths)}

    def take_if_up_to_date(self, context: Context) -> bool:
        """Whether what a stage of the whole block has left is of this report's fingerprint, and as it was written. Then
        the report has its result, and all items are skipped."""
        record = context.recorded(self.stage)
        if record is None or record.fingerprint != self.fingerprint or record.failures:
            return False
        result = result_of(record)
        if result is None:
            return False
        self.skipped, self.result, self.files = self.items, result, record.files
        return True


def result_of(record: StageRecord) -> StageResult | None:
    """Return the result that a stage has left, None where it is of another version."""
    return graph.BY_NAME[record.stage].result.of_json(record.result)


def result_on_file(workspace: Workspace, kind: type[R]) -> R | None:
    """Return the result that a stage left in its report, None where there is none, or one of another version."""
    record = read_record(workspace.stage_report(kind.stage), StageRecord)
    return None if record is None else kind.of_json(record.result)


def _shard_failed_since(path: Path) -> bool:
    """Whether a shard's report of the stage of this whole report is newer and names failures."""
    made_ns = path.stat().st_mtime_ns
    shards = path.parent.glob(f"{path.stem}.*-of-*.json")
    newer = (read_record(one, StageRecord) for one in shards if one.stat().st_mtime_ns > made_ns)
    return any(record is not None and record.failures for record in newer)


def gather_failures(workspace: Workspace) -> list[tuple[str, str, str]]:
    """Return the failures (stage, item, reason) in the reports of all stages, with ids as reports have them. Those of
    the block, not of a cascade's step, are written to failures.csv, with names.

    What a later report of the same stage covers (the whole block, or a shard that owns the item) supersedes what an
    earlier one says of that item.
    """
    by_stage: dict[str, list[Path]] = {}
    for path in workspace.reports.glob("*.json"):
        by_stage.setdefault(path.stem.partition(".")[0], []).append(path)
    rows: set[tuple[str, str, str]] = set()
    for stage, paths in by_stage.items():
        later: list[Shard | None] = []
        for path in sorted(paths, key=lambda path: (-path.stat().st_mtime_ns, path.name)):
            record = read_record(path, StageRecord)
            for item, reason in record.failures if record else ():
                if not any(shard is None or shard.owns(owner(item)) for shard in later):
                    rows.add((stage, item, reason))
            label = path.stem.partition(".")[2]
            later.append(Shard.parse(label.replace("-of-", "/")) if label else None)
    ordered = sorted(once(rows))
    names = names_on_file(workspace) if ordered else {}
    shown = [(stage, item_named(item, names), reason) for stage, item, reason in ordered]
    if not workspace.step:
        write_text(workspace.failures, csv_text(("stage", "item", "reason"), shown))
    return ordered


def once(rows: Collection[tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    """Return rows (stage, item, reason) without those of a first pass that extraction names too."""
    extracted = {item for stage, item, _ in rows if stage == "extract"}
    return [row for row in rows if row[0] != "orient" or row[1] not in extracted]


def owner(item: str) -> str:
    """Return the image by which a failed item is sharded: itself, or the first of a pair "id0 id1"."""
    return item.partition(" ")[0]


def forget_absent(context: Context) -> None:
    """Drop failures of images and pairs that are no longer part of the block from earlier reports."""
    images = {image.image_id for image in context.block.images}
    pairs = {f"{pair.image_id0} {pair.image_id1}" for pair in context.pairs}
    for path in sorted(context.workspace.reports.glob("*.json")):
        record = read_record(path, StageRecord)
        if record is None or record.stage not in graph.per_item():
            continue
        kept = [(item, reason) for item, reason in record.failures if item in images or item in pairs]
        if len(kept) < len(record.failures):
            stamp = path.stat().st_mtime_ns
            write_json(path, record.model_copy(update={"failed": len(kept), "failures": kept}).as_json())
            os.utime(path, ns=(stamp, stamp))


def unexplained(context: Context, pairs: Iterable[Pair], command: str) -> list[tuple[str, str]]:
    """Return failures (image_id0, reason), one per row, for pairs that lack what `command` makes.

    Pairs that have failed there or before, themselves or by one of their images, are explained already.
    """
    items = graph.per_item()
    before = items[: items.index(command) + 1]
    failed = {item for stage, item, _ in gather_failures(context.workspace) if stage in before}
    rows: dict[str, int] = {}
    for pair in pairs:
        if failed.isdisjoint((pair.image_id0, pair.image_id1, f"{pair.image_id0} {pair.image_id1}")):
            rows[pair.image_id0] = rows.get(pair.image_id0, 0) + 1
    remedy = "run `aeromatch run`, or the single stages match and filter in this order"
    text = f"missing, or made with other settings, attitudes or inputs: {remedy}"
    return [(image_id, f"results of {command} for {count} pair(s): {text}") for image_id, count in rows.items()]
