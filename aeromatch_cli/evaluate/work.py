"""evaluate: every pair of a workspace against the truth of its block."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import FloatArray, Image
from aeromatch_cli.errors import InputError
from aeromatch_cli.evaluate.mapping import map_both
from aeromatch_cli.evaluate.opening import BlockTruth
from aeromatch_cli.evaluate.totals import NOT_TRIED, PairRow
from aeromatch_cli.executor import Progress, SilentProgress
from aeromatch_cli.fingerprints import file_digest
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.store.matches import match_points
from aeromatch_cli.store.opened import OpenedBlock
from aeromatch_cli.words import form, of_images
from aeromatch_cli.workspace import Workspace

# Pairs that truly share this much count, whether they were tried or not.
MIN_OVERLAP = 0.20
# The quick estimate is of a coarse grid: pairs somewhat below are looked at properly.
_QUICK_OVERLAP = 0.15
_NOTHING: FloatArray = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A workspace against truth.

    truth_kind: "rendered" or "reference". images: that were judged; left_out: names without reference pose. pairs:
    sorted by image ids. consumer: figures of pycolmap's mapping, or {"skipped": reason}.
    """

    work: Path
    truth_folder: Path
    truth_kind: str
    images: int
    left_out: tuple[str, ...]
    pairs: tuple[PairRow, ...]
    consumer: Mapping[str, Any]
    seconds: float


def evaluate_workspace(
    work: Path,
    truth_folder: Path,
    open_truth: Callable[[Path], BlockTruth],
    *,
    mapping: bool = True,
    progress: Progress | None = None,
) -> Evaluation:
    """Judge all pairs that are verified in a workspace, and all others that overlap by 20 % in truth, as found nothing.

    open_truth: what opens the folder; the laboratory's knows rendered blocks, too. mapping: also run pycolmap's mapping
    from the exported database. Raises InputError where workspace and truth do not belong together, BrokenFileError
    where a file of the workspace is missing or damaged.
    """
    started, progress = time.monotonic(), progress or SilentProgress()
    block = OpenedBlock(work)
    workspace = block.workspace
    truth = open_truth(truth_folder)
    images, left_out = _judged(list(block.images.values()), truth, truth_folder)
    if truth.kind == "rendered":
        _check_pictures(workspace, images, truth, truth_folder)
    known = ((pair, block.final(pair)) for pair in block.pairs)
    entries = {(pair.image_id0, pair.image_id1): entry for pair, entry in known if entry is not None}
    if not entries:
        raise InputError(f"no pair of {work} has a verdict: run `aeromatch run`, or match and filter, first")
    ordered = sorted(images, key=lambda image: image.image_id)
    rows = []
    progress.start("evaluate", len(ordered))
    try:
        for number, image0 in enumerate(ordered):
            rest = ordered[number + 1 :]
            near = truth.near(image0.name, [image.name for image in rest])
            for image1, meets in zip(rest, near, strict=True):
                entry = entries.get((image0.image_id, image1.image_id))
                row = _judge(truth, image0, image1, entry, block) if meets or entry is not None else None
                rows += [row] if row is not None else []
            progress.advance()
    finally:
        progress.stop()
    consumer: Mapping[str, Any] = {"skipped": "not asked for"}
    if mapping and workspace.export_is_older:
        consumer = {"skipped": "the export is of earlier matches: run aeromatch export"}
    elif mapping:
        consumer = map_both(workspace.export("colmap") / "database.db", truth.images_folder)
    seconds = time.monotonic() - started
    return Evaluation(work, truth_folder, truth.kind, len(images), left_out, tuple(rows), consumer, seconds)


def _check_pictures(workspace: Workspace, images: Sequence[Image], truth: BlockTruth, truth_folder: Path) -> None:
    """Raise InputError where the workspace matched other pictures of the same names; those that have moved may pass."""
    settings = load(str(workspace.config)) if workspace.config.is_file() else None
    for image in images:
        matched = Path(settings.block.images) / image.name if settings else Path(image.name)
        rendered = (truth.images_folder or truth_folder) / image.name
        if matched.is_file() and rendered.is_file() and file_digest(matched) != file_digest(rendered):
            raise InputError(
                f"{matched} is not the picture of that name that the truth {truth_folder} belongs to: "
                "give the truth of the block that was matched"
            )


def _judged(
    images: Sequence[Image], truth: BlockTruth, truth_folder: Path
) -> tuple[tuple[Image, ...], tuple[str, ...]]:
    """Images that the truth knows, and names of the others. Raises InputError where both are not of one block."""
    known = tuple(image for image in images if image.name in truth.cameras)
    unknown = tuple(image.name for image in images if image.name not in truth.cameras)
    # Every image of a rendered block has its truth; an adjustment may have left some out.
    if len(known) < 2 or (unknown and truth.kind == "rendered"):
        raise InputError(
            f"{of_images(unknown, images)} of the workspace {form(len(unknown), 'is', 'are')} not in the truth "
            f"{truth_folder}: give the truth of the same block"
        )
    for image in known:
        camera = truth.cameras[image.name]
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
            raise InputError(
                f"image {image.name} has {image.width_px}x{image.height_px} px in the workspace and "
                f"{camera.width_px}x{camera.height_px} px in the truth {truth_folder}: give that of the same images"
            )
    return known, unknown


def _judge(
    truth: BlockTruth, image0: Image, image1: Image, entry: VerifiedEntry | None, block: OpenedBlock
) -> PairRow | None:
    """The row of one pair, None where it is neither verified nor overlaps."""
    state = NOT_TRIED if entry is None else str(entry.verdict.state)
    verified = entry is not None and state == "verified"
    if not verified and truth.overlap_at_most(image0.name, image1.name) < _QUICK_OVERLAP:
        return None
    conditions = truth.conditions(image0.name, image1.name)
    if not verified and conditions.overlap < MIN_OVERLAP:
        return None
    all0, all1 = block.keypoints_px(image0.image_id), block.keypoints_px(image1.image_id)
    sides, scores = (_NOTHING, _NOTHING), np.zeros(0)
    if verified and entry is not None:
        if not len(all0) or not len(all1):
            raise InputError(
                f"the features of {image0.name} or {image1.name} are gone from the workspace: run `aeromatch run` again"
            )
        sides, scores = match_points(entry.matches, all0, all1), np.asarray(entry.matches.scores)
    score = truth.judge(image0.name, image1.name, all0, all1, *sides, scores)
    return PairRow(image0.name, image1.name, state, conditions, score)
