"""Pairs and images of the report: what became of each, read from the rows of files of the workspace.

Reading the files is most of a large report's time: stretches of the pairs are read by several processes.
"""

from __future__ import annotations

import contextlib
import gc
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, Image, Pair, Pose
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import read_json
from aeromatch_cli.formats.features import checked_final_keypoints, read_keypoints
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.geometry.coverage import cells_of
from aeromatch_cli.images.remote import RemoteFile
from aeromatch_cli.report.previews import DrawnMatches
from aeromatch_cli.report.rows import NOT_JUDGED, OWN_FRAME, ImageRow, PairRow
from aeromatch_cli.report.stretches import made_of, stretches
from aeromatch_cli.results.stages import Ninths
from aeromatch_cli.stages.cascade import feature_workspaces
from aeromatch_cli.stages.consistency import final_pairs
from aeromatch_cli.stages.context import Context
from aeromatch_cli.store.matches import match_points

T = TypeVar("T")
# Coverage counts the cells of a grid of this many rows and columns that hold a verified match.
COVERAGE_CELLS = 16
# Fewer pairs are read faster than several processes take to begin.
_FEW_PAIRS = 3000
# For each process: one that is done early takes another, but the block travels with each.
_STRETCHES = 3
# Keypoints of so many images are at hand at a time.
_IMAGES_AT_HAND = 512

Key = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Gathered:
    """Pairs in the order of pairs.csv and images in the order of images.csv. drawn: of every verified or rejected pair
    whose files can be read, what `draw` made of its matches."""

    pairs: list[PairRow]
    images: list[ImageRow]
    drawn: dict[Key, str]


# Makes what is drawn of a pair: both images, stored pixels (M, 2) of its matches in either, errors (M,) px; of a
# rejected pair of those before verification, without errors.
Draw = Callable[[tuple[Image, Image], tuple[FloatArray, FloatArray], FloatArray | None], str]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some of the pairs of a block: those of the context."""

    context: Context
    draw: Draw | None


@dataclass(eq=False)
class _Found:
    """What files tell of a stretch. seen: image_id -> which cells hold a verified match. keypoints: image_id -> number,
    None where an image has no readable features."""

    rows: dict[Key, PairRow] = field(default_factory=dict)
    drawn: dict[Key, str] = field(default_factory=dict)
    seen: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    keypoints: dict[str, int | None] = field(default_factory=dict)

    def add(self, other: _Found) -> None:
        self.rows |= other.rows
        self.drawn |= other.drawn
        self.keypoints |= other.keypoints
        for image_id, cells in other.seen.items():
            self.seen[image_id] = self.seen[image_id] | cells if image_id in self.seen else cells

    def mark(self, image: Image, points_px: FloatArray) -> None:
        """The cells of an image that its matches (M, 2) touch."""
        cells = cells_of((image.width_px, image.height_px), points_px, COVERAGE_CELLS)
        seen = self.seen.setdefault(image.image_id, np.zeros((COVERAGE_CELLS, COVERAGE_CELLS), dtype=bool))
        seen[cells[:, 0], cells[:, 1]] = True


def gather(
    context: Context,
    draw: Draw | None = None,
    spread: Mapping[str, Ninths] | None = None,
    poses: Mapping[str, Pose] | None = None,
    own_frame: Collection[str] = (),
) -> Gathered:
    """Everything about pairs and images. spread: image_id -> its ninths with a point, empty ones, points of three
    images. poses: image_id -> the pose that rows state, by default that of the context. own_frame: images whose
    poses lie in a frame that nothing ties to the world. Raises WorkspaceError where a file is broken."""
    found = _Found()
    for stretch in _stretches(context, draw):
        found.add(stretch)
    pairs = [found.rows.get((p.image_id0, p.image_id1)) or _pair_row(context, p, None) for p in context.pairs]
    steps = _steps(context)
    for place, row in enumerate(pairs):
        taken, reasons = steps.get((row.image_id0, row.image_id1), ("", ""))
        pairs[place] = replace(row, steps=taken, step_reasons=reasons)
    known = context.block.poses if poses is None else poses
    words = {i: OWN_FRAME if i in own_frame else _pose_words(pose) for i, pose in known.items()}
    return Gathered(pairs, _image_rows(context, pairs, found, spread or {}, words), found.drawn)


def _stretches(context: Context, draw: Draw | None) -> list[_Found]:
    jobs = context.executor.jobs
    if jobs == 1 or len(context.pairs) < _FEW_PAIRS:
        return [_read(Stretch(context, draw))]
    alone = replace(context, executor=Executor("serial"))  # workers begin no workers
    parts = stretches(len(context.pairs), _STRETCHES * jobs)
    tasks = [Stretch(replace(alone, pairs=context.pairs[part]), draw) for part in parts]
    return made_of(context.executor, _read, tasks, [len(task.context.pairs) for task in tasks])


@contextlib.contextmanager
def settled() -> Iterator[None]:
    """Python's garbage collector passes over what is there already: over all objects of a large block, again and again,
    it takes a fifth of the time."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _read(stretch: Stretch) -> _Found:
    with settled():
        return _found(stretch)


def _found(stretch: Stretch) -> _Found:
    context, found = stretch.context, _Found()

    @lru_cache(maxsize=_IMAGES_AT_HAND)
    def features(image_id: str) -> tuple[str, FloatArray | None]:
        return checked_final_keypoints(context.workspace.features(image_id), context.workspace.refined(image_id))

    candidates = DrawnMatches(context.workspace, features)
    for pair, entry in final_pairs(context, lambda image_id: features(image_id)[0]):
        key = pair.image_id0, pair.image_id1
        row = found.rows[key] = _pair_row(context, pair, entry)
        images = context.image_by_id[key[0]], context.image_by_id[key[1]]
        if row.state == "rejected" and row.matches_in and stretch.draw is not None:
            with contextlib.suppress(WorkspaceError):  # its files have gone: the row stays, without a picture
                found.drawn[key] = stretch.draw(images, *candidates.of(row))
        if row.state != "verified":
            continue
        both = [features(image_id)[1] for image_id in key]
        found.keypoints.update({i: None if one is None else len(one) for i, one in zip(key, both, strict=True)})
        if both[0] is None or both[1] is None:
            continue
        points = match_points(entry.matches, both[0], both[1])
        for image, points_px in zip(images, points, strict=True):
            found.mark(image, points_px)
        if stretch.draw is not None:
            found.drawn[key] = stretch.draw(images, points, entry.verdict.errors_px)
    return found


def _keypoints(context: Context, image_id: str) -> FloatArray | None:
    """(K, 2), or None where the image has no readable features."""
    try:
        return read_keypoints(context.workspace.features(image_id))[0]
    except WorkspaceError:
        return None


def _image_rows(
    context: Context,
    pairs: Sequence[PairRow],
    found: _Found,
    spread: Mapping[str, Ninths],
    poses: Mapping[str, str],
) -> list[ImageRow]:
    proposed = Counter(i for pair in context.pairs for i in (pair.image_id0, pair.image_id1))
    tied: Counter[str] = Counter()
    matches: Counter[str] = Counter()
    for row in pairs:
        if row.state == "verified":
            tied.update((row.image_id0, row.image_id1))
            matches.update({row.image_id0: row.verified, row.image_id1: row.verified})
    images, made_in = [], feature_workspaces(context.settings, context.workspace)
    for image in context.block.images:
        if image.image_id not in found.keypoints:
            points = _keypoints(context, image.image_id)
            found.keypoints[image.image_id] = None if points is None else len(points)
        keypoints, seen = found.keypoints[image.image_id], found.seen.get(image.image_id)
        coverage = None
        if keypoints is not None:
            coverage = 0.0 if seen is None else float(seen.mean())
        images.append(
            ImageRow(
                image_id=image.image_id,
                name=image.name,
                href=_href(context, image),
                pose=poses.get(image.image_id, "none"),
                keypoints=keypoints,
                pairs=proposed[image.image_id],
                verified_pairs=tied[image.image_id],
                verified_matches=matches[image.image_id],
                coverage=coverage,
                views=_fact([one.views(image.image_id) for one in made_in], "views", len),
                shadow=_fact([one.enhanced(image.image_id, ".json") for one in made_in], "shadow_share", float),
                **dict(zip(_SPREAD, spread.get(image.image_id, ()), strict=False)),
            )
        )
    return images


# The columns of `spread`.
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


def _fact(paths: Sequence[Path], key: str, of: Callable[[Any], T]) -> T | None:
    """One fact of the first of these JSON files that states it, None where the stage that writes them left none."""
    for path in paths:
        facts = read_json(path) if path.is_file() else {}
        if key in facts:
            return of(facts[key])
    return None


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
        median_error_px=_median(errors),
        state=verdict.state,
        reason=verdict.reason,
        model_kind=verdict.model_kind,
        rejects=verdict.rejected,
    )


def _median(values: FloatArray) -> float:
    """NaN of none. np.median takes ten times as long on a few hundred."""
    if not len(values):
        return float("nan")
    ordered = np.sort(values)
    return float((ordered[(len(values) - 1) // 2] + ordered[len(values) // 2]) / 2)


def _pose_words(pose: Pose) -> str:
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
