"""What every stage shares: the context it runs in, sharding, and the report it leaves."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Image, Neighbour, Pair, PairGeometry, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor, Outcome
from aeromatch_cli.formats import csv_text
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.workspace import Workspace, fingerprint, read_json, stable_hash, write_json, write_text

# Part of every fingerprint that pixels enter; raised when decoding, masking, warping or merging change results.
PIPELINE_VERSION = 3
T = TypeVar("T")
R = TypeVar("R")
log = logging.getLogger("aeromatch")

# Stages whose items are images or pairs; the others name files or exporters.
ITEM_STAGES = ("enhance", "simulate", "extract", "match", "filter")


@dataclass(frozen=True)
class Shard:
    """Part i of n of the items, chosen by a stable hash of their id: 1/2 and 2/2 are disjoint and complete."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From "i/n", 1 <= i <= n. Raises ConfigError."""
        first, _, second = text.partition("/")
        if not (first.isdigit() and second.isdigit() and 1 <= int(first) <= int(second)):
            raise ConfigError(f"--shard {text!r}: write i/n with 1 <= i <= n, for example 1/4")
        return cls(int(first), int(second))

    def owns(self, item_id: str) -> bool:
        return stable_hash(item_id) % self.count == self.index - 1

    @property
    def label(self) -> str:
        return f"{self.index}-of-{self.count}"


@dataclass(frozen=True, eq=False)
class Context:
    """Everything a stage needs to know. Made once per command by `stages.pairs.prepare`."""

    settings: Settings
    workspace: Workspace
    executor: Executor
    block: Block
    pairs: tuple[Pair, ...]
    image_fingerprints: Mapping[str, str]
    given_poses: Mapping[str, Pose]
    guessed_cameras: frozenset[str] = frozenset()
    # Images that no match ties to their surroundings although their poses say so (`stages.distrust`).
    suspects: frozenset[str] = frozenset()
    shard: Shard | None = None
    overwrite: bool = False
    # Filled on demand; `dataclasses.replace` starts them anew, so that they never outlive what they were made from.
    known_fingerprints: dict[tuple[str, frozenset[str]], str] = field(default_factory=dict, init=False, repr=False)
    known_tasks: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def owns(self, item_id: str) -> bool:
        return self.shard is None or self.shard.owns(item_id)

    def images(self) -> list[Image]:
        """The images of this shard."""
        return [image for image in self.block.images if self.owns(image.image_id)]

    def rows(self) -> dict[str, list[Pair]]:
        """Pairs of this shard by image_id0, in order."""
        rows: dict[str, list[Pair]] = {}
        for pair in self.pairs:
            if self.owns(pair.image_id0):
                rows.setdefault(pair.image_id0, []).append(pair)
        return rows

    def image_path(self, image: Image) -> Path:
        return Path(self.settings.block.images) / image.name

    def pose(self, image_id: str) -> Pose | None:
        return self.block.poses.get(image_id)

    def ground_z_m(self, image_id: str) -> float | None:
        """Ground height where an image looks (below it, without attitude), None without ground or position."""
        return _ground_heights(self.block).get(image_id)

    @property
    def image_by_id(self) -> Mapping[str, Image]:
        return _image_index(self.block)

    def geometry(self, pair: Pair) -> PairGeometry:
        images = self.image_by_id
        heights = [h for h in (self.ground_z_m(pair.image_id0), self.ground_z_m(pair.image_id1)) if h is not None]
        return PairGeometry(
            pair=pair,
            camera0=self.block.camera(images[pair.image_id0]),
            camera1=self.block.camera(images[pair.image_id1]),
            pose0=self._believed(pair.image_id0),
            pose1=self._believed(pair.image_id1),
            ground_z_m=sum(heights) / len(heights) if heights else None,
        )

    def _believed(self, image_id: str) -> Pose | None:
        """The pose by which matches are searched and limited: of a suspect only where it was."""
        pose = self.pose(image_id)
        return replace(pose, world_rotation=None) if pose is not None and image_id in self.suspects else pose

    def lacks_north(self, image_id: str) -> bool:
        """Whether an image, or one that it is paired with, has no attitude to be trusted: what turns its north up
        cannot be compared with it, the picture as it was taken can."""
        ids = (image_id, *(other for other, _ in _paired(self.pairs).get(image_id, ())))
        poses = [self._believed(i) for i in ids]
        return any(pose is None or pose.world_rotation is None for pose in poses)

    def neighbours(self, image_id: str) -> tuple[Neighbour, ...]:
        """Where else the ground of an image is looked at from: the images it is paired with that have an attitude."""
        found = []
        for other_id, overlap in _paired(self.pairs).get(image_id, ()):
            pose = self.pose(other_id)
            if pose is not None and pose.world_rotation is not None:
                camera = self.block.camera(self.image_by_id[other_id])
                found.append(Neighbour(camera, pose, overlap, self.ground_z_m(other_id)))
        return tuple(found)

    def under_one_sun(self, image_id: str, minutes: float) -> bool:
        """Whether an image and all that it is paired with are known to be taken within so many minutes."""
        images = self.image_by_id
        times = [images[i].time for i in (image_id, *(other for other, _ in _paired(self.pairs).get(image_id, ())))]
        if minutes <= 0.0 or not all(times):
            return False
        taken, *others = (datetime.fromisoformat(time) for time in times)
        return all(abs((other - taken).total_seconds()) <= 60.0 * minutes for other in others)

    def geometry_fingerprint(self, image_id: str, needs: frozenset[str]) -> str:
        """What strategies with these `needs` read of one image's geometry."""
        key = image_id, needs
        if key not in self.known_fingerprints:
            self.known_fingerprints[key] = self._geometry_fingerprint(image_id, needs)
        return self.known_fingerprints[key]

    def _geometry_fingerprint(self, image_id: str, needs: frozenset[str]) -> str:
        pose = self.pose(image_id)
        parts: dict[str, Any] = {}
        if "camera" in needs:
            parts["camera"] = self.block.camera(self.image_by_id[image_id])
        if "pose" in needs:
            parts["pose"] = (pose.center_m, pose.world_rotation) if pose else None
        if "pose" in needs and image_id in self.suspects:
            parts["suspect"] = True
        if "sigma" in needs:
            parts["sigma"] = (pose.sigma_position_m, pose.sigma_angle_deg) if pose else None
        if "ground" in needs:
            parts["ground"] = (self.ground_z_m(image_id), self.block.gsd_m)
        if "neighbours" in needs:
            parts["neighbours"] = [
                (n.camera, n.pose.center_m, n.pose.world_rotation, n.overlap, n.ground_z_m)
                for n in self.neighbours(image_id)
            ]
        return fingerprint(parts)


@lru_cache(maxsize=4)
def _paired(pairs: tuple[Pair, ...]) -> Mapping[str, Sequence[tuple[str, float]]]:
    """image_id -> the other image and the overlap of each of its pairs, in the order of the ids."""
    found: dict[str, list[tuple[str, float]]] = {}
    for pair in pairs:
        found.setdefault(pair.image_id0, []).append((pair.image_id1, pair.overlap))
        found.setdefault(pair.image_id1, []).append((pair.image_id0, pair.overlap))
    return {image_id: sorted(others) for image_id, others in found.items()}


@lru_cache(maxsize=4)
def _ground_heights(block: Block) -> Mapping[str, float]:
    """World height of the ground by image_id: over relief an oblique image looks at other heights than it stands on."""
    if block.ground is None:
        return {}
    below = {i: float(block.ground.height_m(pose.center_m[None, :2])[0]) for i, pose in block.poses.items()}
    return below | {i: footprint.ground_z_m for i, footprint in block_footprints(block).items()}


@lru_cache(maxsize=4)
def _image_index(block: Block) -> Mapping[str, Image]:
    return {image.image_id: image for image in block.images}


@dataclass
class StageReport:
    """What one stage did; becomes reports/<stage>.json.

    items = done (made now) + skipped (up to date already) + failed; items are images, pairs or exporters.
    """

    stage: str
    seconds: float = 0.0
    items: int = 0
    done: int = 0
    skipped: int = 0
    fingerprint: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    def write(self, context_workspace: Workspace, shard: Shard | None = None) -> StageReport:
        """Close the clock, write the report and gather failures.csv from all stages.

        A stage that found everything up to date leaves the report of the run that made it, with its timing.
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
            "facts": self.facts,
            "failures": [list(failure) for failure in self.failures],
        }
        path = context_workspace.stage_report(self.stage, shard.label if shard else "")
        if not self._says_nothing_new(path):
            write_json(path, value)
        gather_failures(context_workspace)
        for item, reason in self.failures:
            log.warning("%s: %s: %s", self.stage, item, reason)
        return self

    def absorb(self, earlier: StageReport, workspace: Workspace) -> StageReport:
        """Count what an earlier pass of the same command did as done by this one, and write the sum."""
        self.done = min(self.items - len(self.failures), self.done + earlier.done)
        self.skipped = self.items - len(self.failures) - self.done
        self.started -= earlier.seconds
        return self.write(workspace)

    def _says_nothing_new(self, path: Path) -> bool:
        if self.done or self.failures or not path.is_file():
            return False
        old = read_json(path)
        # Without facts of its own the stage only counts what it makes: those on file still hold.
        self.facts = self.facts or old.get("facts", {})
        return not old.get("failures") and (old.get("fingerprint"), old.get("facts")) == (self.fingerprint, self.facts)


def gather_failures(workspace: Workspace) -> list[tuple[str, str, str]]:
    """failures.csv anew from the reports of all stages; returns its rows (stage, item, reason).

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
    ordered = sorted(rows)
    write_text(workspace.failures, csv_text(("stage", "item", "reason"), ordered))
    return ordered


def owner(item: str) -> str:
    """The image by which a failed item is sharded: itself, or the first of a pair "id0 id1"."""
    return item.partition(" ")[0]


def forget_absent(context: Context) -> None:
    """Drop failures of images and pairs that are no longer part of the block from earlier reports."""
    images = {image.image_id for image in context.block.images}
    pairs = {f"{pair.image_id0} {pair.image_id1}" for pair in context.pairs}
    for path in sorted(context.workspace.reports.glob("*.json")):
        report = read_json(path)
        if report.get("stage") not in ITEM_STAGES:
            continue
        kept = [row for row in report["failures"] if row[0] in images or row[0] in pairs]
        if len(kept) < len(report["failures"]):
            stamp = path.stat().st_mtime_ns
            write_json(path, {**report, "failed": len(kept), "failures": kept})
            os.utime(path, ns=(stamp, stamp))


@cache
def library_version(distribution: str) -> str:
    """Version of an installed library whose arithmetic decides results; another one makes them stale."""
    return metadata.version(distribution)


def unexplained(context: Context, pairs: Iterable[Pair], command: str) -> list[tuple[str, str]]:
    """Failures (image_id0, reason), one per row, for pairs that lack what `command` makes.

    Pairs that have failed there or before, themselves or by one of their images, are explained already.
    """
    before = ITEM_STAGES[: ITEM_STAGES.index(command) + 1]
    failed = {item for stage, item, _ in gather_failures(context.workspace) if stage in before}
    rows: dict[str, int] = {}
    for pair in pairs:
        if failed.isdisjoint((pair.image_id0, pair.image_id1, f"{pair.image_id0} {pair.image_id1}")):
            rows[pair.image_id0] = rows.get(pair.image_id0, 0) + 1
    remedy = "run `aeromatch run`, or the single stages match and filter in this order"
    text = f"missing, or made with other settings, attitudes or inputs: {remedy}"
    return [(image_id, f"results of {command} for {count} pair(s): {text}") for image_id, count in rows.items()]


def run_stage(
    context: Context,
    report: StageReport,
    function: Callable[[T], R],
    tasks: Sequence[T],
    names: Sequence[str],
) -> list[R]:
    """Run tasks, put failures into the report under their names, return the values of the rest."""
    outcomes: list[Outcome[R]] = context.executor.run(function, tasks, report.stage) if tasks else []
    values = []
    for name, outcome in zip(names, outcomes, strict=True):
        if outcome.value is None:
            report.failures.append((name, outcome.error))
        else:
            values.append(outcome.value)
    report.done += len(values)
    return values
