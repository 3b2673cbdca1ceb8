"""This module keeps what a stage leaves behind: its report, and the list of all failures."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from aeromatch_cli import graph
from aeromatch_cli.data import Pair
from aeromatch_cli.files import read_json, write_json, write_text
from aeromatch_cli.formats.tables import csv_text
from aeromatch_cli.results.stages import StageResult
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.store.naming import item_named, names_on_file
from aeromatch_cli.workspace import Workspace

R = TypeVar("R", bound=StageResult)

log = logging.getLogger("aeromatch")


@dataclass
class StageReport:
    """Counts what one stage did; it becomes reports/<stage>.json.

    items = done (made now) + skipped (up to date already) + failed; items are images, pairs or exporters. part: of a
    step of a cascade, in words. files: of a stage of the whole block, the files that it has written, by their names in
    the workspace, with their SHA-256.
    """

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

    def write(self, context_workspace: Workspace, shard: Shard | None = None) -> StageReport:
        """Close the clock, write the report and gather failures.csv from all stages.

        A stage that made nothing, and fails where it failed before, leaves that report, with its timing; not where a
        shard has failed since, which this one supersedes.
        """
        self.seconds = round(time.perf_counter() - self.started, 3)
        value = {
            "stage": self.stage,
            "seconds": self.seconds,
            "items": self.items,
            "done": self.done,
            "skipped": self.skipped,
            "failed": len(self.failures),
            "fingerprint": self.fingerprint,
            "result": None if self.result is None else self.result.as_json(),
            "failures": [list(failure) for failure in self.failures],
            **({"files": self.files} if self.files else {}),
        }
        path = context_workspace.stage_report(self.stage, shard.label if shard else "")
        if not self._says_nothing_new(path) or (shard is None and _shard_failed_since(path)):
            write_json(path, value)
        gather_failures(context_workspace)
        if self.failures and self.stage != "orient":  # its first pass has named them
            names = names_on_file(context_workspace)
            for item, reason in self.failures:
                log.warning("%s: %s: %s", self.stage, item_named(item, names), reason)
        return self

    def _says_nothing_new(self, path: Path) -> bool:
        if self.done or not path.is_file():
            return False
        old = read_json(path)
        before = graph.BY_NAME[self.stage].result.of_json(old.get("result"))
        # Without a result of its own the stage only counts what it makes: the one on file still holds.
        self.result = self.result or before
        failures = [list(failure) for failure in self.failures]
        told = old.get("failures"), old.get("fingerprint"), old.get("files", {}), before
        return told == (failures, self.fingerprint, self.files, self.result)

    def vouches_for(self, context: Context, paths: Iterable[Path]) -> None:
        """State the files that the stage has written, as they are now."""
        root = context.workspace.root
        self.files = {path.relative_to(root).as_posix(): context.store.digest(path) for path in sorted(paths)}

    def is_up_to_date(self, context: Context) -> bool:
        """Whether what a stage of the whole block has left is of this report's fingerprint, and as it was written. Then
        the report has its result, and all items are skipped."""
        record = context.recorded(self.stage)
        result = graph.BY_NAME[self.stage].result.of_json(record.get("result"))
        if record.get("fingerprint") != self.fingerprint or record["failures"] or result is None:
            return False
        self.skipped, self.result, self.files = self.items, result, record.get("files", {})
        return True


def result_on_file(workspace: Workspace, kind: type[R]) -> R | None:
    """Return the result that a stage left in its report, None where there is none, or one of another version."""
    path = workspace.stage_report(kind.stage)
    return kind.of_json(read_json(path).get("result")) if path.is_file() else None


def _shard_failed_since(path: Path) -> bool:
    """Whether a shard's report of the stage of this whole report is newer and names failures."""
    made_ns = path.stat().st_mtime_ns
    shards = path.parent.glob(f"{path.stem}.*-of-*.json")
    return any(one.stat().st_mtime_ns > made_ns and read_json(one).get("failures") for one in shards)


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
            for item, reason in read_json(path).get("failures", []):
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
        report = read_json(path)
        if report.get("stage") not in graph.per_item():
            continue
        kept = [row for row in report["failures"] if row[0] in images or row[0] in pairs]
        if len(kept) < len(report["failures"]):
            stamp = path.stat().st_mtime_ns
            write_json(path, {**report, "failed": len(kept), "failures": kept})
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
