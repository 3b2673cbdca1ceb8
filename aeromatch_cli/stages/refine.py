"""refine: measures tie points anew in the pixels of their images, once it is known which keypoints correspond.

Of the keypoints of one point the one with most matches stands for it; the others are brought onto what it shows, each
by the keypoint through which it is tied to it. First patches around all these keypoints are cut out of every image,
which is read once; then every image's keypoints are measured by its patches and those of its neighbours.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray, Pair, PairGeometry
from aeromatch_cli.files import translated_os_errors, write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import read_keypoints, write_refined
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import RefineResult
from aeromatch_cli.sfm.spanning_trees import Trees, shifts_through, trees_of
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import run_stage
from aeromatch_cli.stages.enhance import source_of
from aeromatch_cli.stages.measuring import (
    ByImage,
    CutTask,
    Measured,
    MeasureTask,
    cut_patches,
    kept_measurements,
    measure,
    measurement_fingerprint,
    patches_of,
)
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.refiners.least_squares import LeastSquares

VERSION = 2
# Images whose keypoints are measured before patches are given up that no later image needs.
_IMAGES_AT_ONCE = 128


def run(context: Context) -> StageReport:
    """Write refined/<id>.npz of all images where they are not up to date."""
    report = StageReport("refine")
    recipe, folder = context.settings.least_squares, context.workspace.refined("").parent
    if recipe is None:
        _remove(folder)
        report.result = RefineResult()
        return report.write(context.workspace)
    context, _ = BlockState.of(context).with_current_pairs()
    report.items = len(context.block.images)
    report.fingerprint = _fingerprint(context, recipe)
    if _is_up_to_date(context, report):
        return report.write(context.workspace)
    _make_room(context)
    with context.executor.step("refine"):
        table = _Table.of(context)
    found = _measured(context, table, recipe, report)
    report.result = _write(context, table, found, recipe)
    report.done = report.items - len(report.failures)
    report.record_files(context, folder.glob("*.npz"))
    return report.write(context.workspace)


def is_current(context: Context) -> bool:
    """Whether what is on file is of the pairs whose results are up to date; also where nothing is measured, False."""
    recipe, record = context.settings.least_squares, context.recorded("refine")
    if recipe is None or record is None:
        return False
    return record.fingerprint == _fingerprint(BlockState.of(context).with_current_pairs()[0], recipe)


def _fingerprint(context: Context, recipe: LeastSquares) -> str:
    return fingerprint(*_versions(), recipe, BlockState.of(context).inputs_fingerprint("refine"))


def _is_up_to_date(context: Context, report: StageReport) -> bool:
    """Whether what is on file is of these matches, and nothing more can be measured: pictures of images that failed
    still cannot be read. Then these are the failures of this run, too."""
    record = context.recorded(report.stage)
    if record is None or record.fingerprint != report.fingerprint:
        return False
    result = RefineResult.of_json(record.result)
    if result is None:
        return False
    lacking = _lacking(record)
    sources = [source_of(context, context.image_by_id[image_id]) for image_id in lacking]
    run_stage(context, report, _read, sources, lacking)
    report.done = 0
    if len(report.failures) < len(lacking):
        report.failures.clear()
        return False
    report.failures = record.failures
    report.skipped, report.result, report.files = report.items - len(lacking), result, record.files
    return True


def _lacking(record: StageRecord) -> list[str]:
    """Images whose measurements failed; they are tried again as soon as their pictures can be read."""
    return sorted({item for item, _ in record.failures})


def _read(source: Source) -> bool:
    read_source(source, colour=False)
    return True


def _versions() -> tuple[int, str]:
    return VERSION, library_version("opencv-python-headless")


def _make_room(context: Context) -> None:
    """Leave nothing that the report of an earlier run vouches for; measurements of images of the block stay, unless all
    is to be made anew."""
    workspace = context.workspace
    folder, kept = workspace.refined("").parent, workspace.measured("").parent
    context.workspace.forget("refine")
    if context.scope.overwrite:
        _remove(folder)
    with translated_os_errors(kept):
        kept.mkdir(parents=True, exist_ok=True)
    ids = {image.image_id for image in context.block.images}
    for path in [*folder.iterdir(), *(path for path in kept.iterdir() if path.stem not in ids)]:
        with translated_os_errors(path):
            if path != kept:
                path.unlink()


def _remove(folder: Path) -> None:
    with translated_os_errors(folder):
        shutil.rmtree(folder, ignore_errors=not folder.is_dir())


@dataclass(frozen=True, eq=False)
class _Table:
    """Matched keypoints of the whole block, numbered through. first: image_id -> its first one. indices: which of the
    image's keypoints they are. places_px: (N, 2) of each image. names, starts: ids and first keypoints (N,) of the
    images, in order. Blocks of 10,000 images have 100 million of them: hence 32 bits."""

    first: Mapping[str, int]
    indices: Mapping[str, IntArray]
    places_px: Mapping[str, FloatArray]
    sources: Mapping[str, Source]
    trees: Trees
    names: tuple[str, ...]
    starts: IntArray

    @classmethod
    def of(cls, context: Context) -> _Table:
        matches, scores = [], [np.zeros(0, np.float32)]
        used: dict[str, BoolArray] = {}
        places = _places(context)
        for pair, entry in BlockState.of(context).judged_pairs():
            # Without both attitudes nobody knows how one image's surroundings look in the other.
            if entry.verdict.state == "verified" and _comparable(context.geometry(pair)):
                ids = pair.image_id0, pair.image_id1
                for image_id, indices in zip(ids, entry.matches.indices.T, strict=True):
                    if image_id not in used:
                        used[image_id] = np.zeros(len(places[image_id]), dtype=bool)
                    used[image_id][indices] = True
                matches.append((ids, entry.matches.indices.astype(np.int32)))
                scores.append(entry.matches.scores.astype(np.float32))
        indices = {i: np.flatnonzero(used[i]).astype(np.int32) for i in places if i in used}
        starts = np.cumsum([0, *map(len, indices.values())])
        first = dict(zip(indices, starts[:-1].tolist(), strict=True))
        ends = [np.zeros((0, 2), np.int32)]
        for ids, pair_indices in matches:
            sides = zip(ids, pair_indices.T, strict=True)
            ends.append(
                np.column_stack([first[i] + np.searchsorted(indices[i], of) for i, of in sides]).astype(np.int32)
            )
        trees = trees_of(int(starts[-1]), np.concatenate(ends), np.concatenate(scores))
        sources = {i: source_of(context, context.image_by_id[i]) for i in indices}
        matched = {i: places[i][of] for i, of in indices.items()}
        return cls(first, indices, matched, sources, trees, tuple(first), starts[:-1])

    def measured_by(self, image_id: str) -> dict[str, tuple[IntArray, IntArray]]:
        """Other image -> which of its matched keypoints measure which of this image's, by their places in the lists."""
        parents = self.trees.parent[self.part(image_id)]
        children = np.flatnonzero(parents >= 0)
        parents = parents[children]
        of_image = np.searchsorted(self.starts, parents, side="right") - 1
        return {
            self.names[number]: (parents[of_image == number] - self.starts[number], children[of_image == number])
            for number in np.unique(of_image)
        }

    def part(self, image_id: str) -> slice:
        """The numbers of an image's keypoints."""
        return slice(self.first[image_id], self.first[image_id] + len(self.indices[image_id]))


def _places(context: Context) -> dict[str, FloatArray]:
    """image_id -> stored pixels (K, 2) of the keypoints of images that have features."""
    paths = {image.image_id: context.workspace.features(image.image_id) for image in context.block.images}
    return {image_id: read_keypoints(path)[0] for image_id, path in paths.items() if path.is_file()}


def _comparable(geometry: PairGeometry) -> bool:
    poses = geometry.pose0, geometry.pose1
    return geometry.ground_z_m is not None and all(p is not None and p.world_rotation is not None for p in poses)


def _measured(context: Context, table: _Table, recipe: LeastSquares, report: StageReport) -> Measured:
    """Measure all keypoints of the block; those of images for which nothing has changed are on file. Patches are there
    as long as they are needed: those of 10,000 images would fill a disk."""
    folder = context.workspace.refined("").parent
    by = {image_id: table.measured_by(image_id) for image_id in table.names}
    found, todo = Measured.nothing(len(table.trees.parent)), list[str]()
    for image_id in (image_id for image_id in table.names if by[image_id]):
        # Where nothing is kept, nobody need know what it would have to be of.
        known = context.workspace.measured(image_id).is_file()
        task = _task(context, table, recipe, image_id, by[image_id]) if known else None
        kept = None if task is None else kept_measurements(task)
        if task is None or kept is None:
            todo.append(image_id)
        else:
            found.set(table.first[image_id] + task.rows, kept)
    batches = [todo[at : at + _IMAGES_AT_ONCE] for at in range(0, len(todo), _IMAGES_AT_ONCE)]
    needed = [sorted({*batch, *(other for image_id in batch for other in by[image_id])}) for batch in batches]
    last = {image_id: number for number, names in enumerate(needed) for image_id in names}
    cut = set[str]()
    for number, batch in enumerate(batches):
        new = [image_id for image_id in needed[number] if image_id not in cut]
        cuts = [CutTask(table.sources[i], table.places_px[i], patches_of(folder, i)) for i in new]
        part = f"{number + 1} of {len(batches)} parts: " if len(batches) > 1 else ""
        context = context.with_scope(part=part)
        run_stage(context, report, cut_patches, cuts, new)
        cut.update(new)
        tasks = [_task(context, table, recipe, image_id, by[image_id]).with_patches() for image_id in batch]
        tasks = [task for task in tasks if task.by]
        outcomes = context.executor.run(measure, tasks, part + report.stage)
        for task, outcome in zip(tasks, outcomes, strict=True):
            if outcome.value is None:
                report.failures.append((task.image_id, outcome.error))
                continue
            found.set(table.first[task.image_id] + task.rows, outcome.value)
        for image_id in needed[number]:
            if last[image_id] == number:
                patches_of(folder, image_id).unlink(missing_ok=True)
    return found


def _task(
    context: Context, table: _Table, recipe: LeastSquares, image_id: str, by: Mapping[str, tuple[IntArray, IntArray]]
) -> MeasureTask:
    """Return the task of one image, measured by all others that measure some of its keypoints."""
    parts = []
    for other, (numbers, own_numbers) in by.items():
        places = table.places_px[other][numbers], table.places_px[image_id][own_numbers]
        parts.append(ByImage(other, numbers, own_numbers, *places, _geometry(context, other, image_id)))
    sources = [table.sources[i] for i in (image_id, *by)]
    scales = {i: source.scale for i, source in zip((image_id, *by), sources, strict=True)}
    own = measurement_fingerprint(recipe, _versions(), parts, [source.fingerprint for source in sources])
    folder, path = context.workspace.refined("").parent, context.workspace.measured(image_id)
    return MeasureTask(image_id, tuple(parts), recipe, folder, scales, path, own)


def _geometry(context: Context, first: str, second: str) -> PairGeometry:
    nowhere = float("nan")
    geometry = context.geometry(Pair(min(first, second), max(first, second), nowhere, nowhere, ""))
    return geometry if first < second else geometry.turned()


def _write(context: Context, table: _Table, found: Measured, recipe: LeastSquares) -> RefineResult:
    """Files of all images, and what was measured."""
    # What could not be measured stands for itself, and for those that are measured by it.
    trees = replace(table.trees, depth=_depths(table.trees, found.held))
    moved = shifts_through(trees, found.matrices, found.shifts_px)
    scales = np.ones(len(moved))
    for image_id in table.names:
        scales[table.part(image_id)] = table.sources[image_id].scale
    held = found.held & (np.linalg.norm(moved, axis=1) * scales <= recipe.max_shift_px)
    moved[~held] = 0.0
    for image_id, detected in _places(context).items():
        places, measured = detected.astype(np.float64), np.zeros(len(detected), dtype=bool)
        if image_id in table.first:
            part, indices = table.part(image_id), table.indices[image_id]
            places[indices] += moved[part]
            measured[indices] = held[part] | (table.trees.depth[part] == 0)
        features = context.store.features_fingerprint(image_id)
        write_atomically(context.workspace.refined(image_id), partial(_written, (places, measured, features)))
    lengths = np.linalg.norm(moved[held], axis=1)
    return RefineResult(
        keypoints=int((table.trees.depth > 0).sum()),
        measured=int(held.sum()),
        shift_px=round(float(np.median(lengths)), 4) if len(lengths) else None,
    )


def _written(values: tuple[FloatArray, BoolArray, str], stream: BinaryIO) -> None:
    write_refined(stream, *values)


def _depths(trees: Trees, held: BoolArray) -> IntArray:
    """(K,) measured keypoints on the way to one that is not."""
    depth = np.where(held, -1, 0)
    depth[trees.depth < 0] = -1
    for level in range(1, int(trees.depth.max(initial=0)) + 1):
        here = np.flatnonzero(held & (trees.depth == level))
        depth[here] = depth[trees.parent[here]] + 1
    return np.asarray(depth)
