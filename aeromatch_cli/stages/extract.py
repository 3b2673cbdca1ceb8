"""extract: features of every image, once per image, from its views."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aeromatch_cli.data import Features, Image
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import write_features
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.images.depth import sample_colours
from aeromatch_cli.results.stages import ExtractResult, StageResult
from aeromatch_cli.stages import enhance, simulate
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import run_images
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.store.block_store import BlockStore, KnownFeatures
from aeromatch_cli.strategies import Extractor


@dataclass(frozen=True, eq=False)
class ExtractTask:
    """One image to find features in."""

    views: simulate.SimulateTask
    extractor: Extractor
    keep_images: bool
    fingerprint: str

    @property
    def image_id(self) -> str:
        return self.views.enhance.image_id

    @property
    def path(self) -> Path:
        return self.views.enhance.workspace.features(self.image_id)


def make_task(context: Context, image: Image) -> ExtractTask:
    """Return the task of one image, with the fingerprint of everything that its result depends on."""
    views = simulate.make_task(context, image)
    settings = context.settings
    geometry = context.geometry_fingerprint(image.image_id, settings.extract.needs)
    own = fingerprint(views.fingerprint, settings.extract, geometry)
    return ExtractTask(views, settings.extract, settings.run.keep_images, own)


@dataclass(frozen=True)
class Extracted:
    """What was found in one image, and what its views cost."""

    image_id: str
    features: KnownFeatures
    cost: simulate.ViewCost


def run_task(task: ExtractTask) -> Extracted:
    """Write features/<id>.npz."""
    pictures, enhancement = simulate.render(task.views)
    source = task.views.enhance.source
    further = simulate.further_views(pictures)
    features = (task.extractor.with_extra_views(further) if further else task.extractor)(
        source.working_camera, pictures
    )
    if task.extractor.colours:
        colours = sample_colours(enhancement.pixels, features.keypoints_px, features.sizes_px)
        features = replace(features, colours=colours)
    features = in_stored_frame(features, source.scale)
    enhance.keep(task.views.enhance, enhancement, picture=task.keep_images)
    simulate.keep(task.views, pictures, with_pictures=task.keep_images)
    write_atomically(task.path, lambda stream: write_features(stream, features, task.fingerprint))
    known = KnownFeatures(task.fingerprint, len(features.keypoints_px))
    return Extracted(task.image_id, known, simulate.ViewCost.of(pictures))


def in_stored_frame(features: Features, scale: float) -> Features:
    """Return keypoints of a reduced raster in the stored one, half-pixel correct."""
    if scale >= 1.0:
        return features
    keypoints = apply_homography(np.linalg.inv(resize_matrix(scale)), features.keypoints_px)
    return replace(
        features,
        keypoints_px=keypoints.astype("float32"),
        sizes_px=(features.sizes_px / scale).astype("float32"),
    )


def task_of(context: Context, image_id: str) -> ExtractTask:
    """Return the task of one image, made once per command."""
    return context.once("extract", image_id, make=lambda: make_task(context, context.image_by_id[image_id]))


def run(context: Context, image_ids: Iterable[str] | None = None, before: StageReport | None = None) -> StageReport:
    """Write features for the images of the shard (or the given ones) that are not up to date.

    before: report of images that this command has already been through; they are left out and the counts are added.
    """
    report = before or StageReport("extract")
    chosen = [image.image_id for image in context.images()] if image_ids is None else sorted(set(image_ids))
    tasks = [task_of(context, image_id) for image_id in chosen]
    network = context.settings.extract.network
    made = run_images(context, report, run_task, tasks, lambda task: _is_done(context.store, task), network=network)
    for one in made:
        context.store.made_features(one.image_id, one.features)
    context.index.flush()
    if made:
        report.result = _result(made, tasks, report.result)
    return report.write(context.workspace, context.scope.shard, context.block.names)


def _result(made: Sequence[Extracted], tasks: Sequence[ExtractTask], before: StageResult | None) -> ExtractResult:
    """Summarise the images made now, and those that the same command has made before."""
    counts = [item.features.keypoints for item in made]
    found = ExtractResult(
        keypoints=sum(counts),
        images_without_keypoints=sum(count == 0 for count in counts),
        images_skipped_same_illumination=enhance.skipped_images(task.views.enhance for task in tasks),
        **simulate.views_result([item.cost for item in made]).as_json(),
    )
    return found if not isinstance(before, ExtractResult) else before.plus(found)


def run_own_first(context: Context, image_ids: Iterable[str]) -> StageReport:
    """Extract features of these images, in a shard its own first: by the time of the others another machine may have
    made them."""
    ids = set(image_ids)
    own = {image_id for image_id in ids if context.owns(image_id)}
    report = run(context, own)
    return run(context.with_scope(overwrite=False), ids - own, report) if own < ids else report


def _is_done(store: BlockStore, task: ExtractTask) -> bool:
    source = task.views.enhance
    if store.features_fingerprint(task.image_id) != task.fingerprint:
        return False
    if task.keep_images:
        return enhance.is_done(store, source) and simulate.is_done(store, task.views)
    return enhance.is_kept(store, source) and simulate.is_kept(store, task.views)
