"""extract: features of every image, once per image, from its views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from aeromatch_cli.data import Features, Image
from aeromatch_cli.formats import features_fingerprint, write_features
from aeromatch_cli.images import shrink_camera
from aeromatch_cli.stages import enhance, simulate
from aeromatch_cli.stages.common import Context, StageReport, run_stage
from aeromatch_cli.strategies import Extractor
from aeromatch_cli.workspace import fingerprint, write_atomically


@dataclass(frozen=True, eq=False)
class ExtractTask:
    """One image to find features in."""

    views: simulate.SimulateTask
    extractor: Extractor
    keep_images: bool
    fingerprint: str

    @property
    def image_id(self) -> str:
        return self.views.source.image_id

    @property
    def path(self) -> Path:
        return self.views.source.workspace.features(self.image_id)


def make_task(context: Context, image: Image) -> ExtractTask:
    """The task of one image, with the fingerprint of everything that its result depends on."""
    views = simulate.make_task(context, image)
    settings = context.settings
    return ExtractTask(
        views, settings.extract, settings.run.keep_images, fingerprint(views.fingerprint, settings.extract)
    )


def run_task(task: ExtractTask) -> int:
    """Write features/<id>.npz; returns the number of keypoints."""
    pictures, enhancement = simulate.render(task.views)
    source = task.views.source
    camera = shrink_camera(source.camera, source.scale)
    features = task.extractor(camera, pictures)
    features = _in_stored_frame(features, source.scale)
    enhance.keep(source, enhancement, picture=task.keep_images)
    simulate.keep(task.views, pictures, with_pictures=task.keep_images)
    write_atomically(task.path, lambda stream: write_features(stream, features, task.fingerprint))
    return len(features.keypoints_px)


def _in_stored_frame(features: Features, scale: float) -> Features:
    """Keypoints of a reduced raster in the stored one, half-pixel correct."""
    if scale >= 1.0:
        return features
    keypoints = (features.keypoints_px.astype("float64") + 0.5) / scale - 0.5
    return replace(
        features,
        keypoints_px=keypoints.astype("float32"),
        sizes_px=(features.sizes_px / scale).astype("float32"),
    )


def run(context: Context, images: Iterable[Image] | None = None) -> StageReport:
    """Write features for the images of the shard (or the given ones) that are not up to date."""
    report = StageReport("extract")
    tasks = [make_task(context, image) for image in (context.images() if images is None else images)]
    todo = [task for task in tasks if context.overwrite or features_fingerprint(task.path) != task.fingerprint]
    report.items, report.skipped = len(tasks), len(tasks) - len(todo)
    counts = run_stage(context, report, run_task, todo, [task.image_id for task in todo])
    report.facts = {"keypoints": sum(counts), "images_without_keypoints": sum(count == 0 for count in counts)}
    report.fingerprint = fingerprint([task.fingerprint for task in tasks])
    return report.write(context.workspace, context.shard)


def ensure(context: Context, image_ids: Iterable[str]) -> dict[str, str]:
    """Make missing features of these images; returns image_id -> fingerprint of those that have them now."""
    by_id = context.image_by_id
    tasks = {image_id: make_task(context, by_id[image_id]) for image_id in sorted(set(image_ids))}
    missing = [i for i, task in tasks.items() if features_fingerprint(task.path) != task.fingerprint]
    if missing:
        run(replace(context, overwrite=False), [by_id[i] for i in missing])
    have = partial(_has_features, tasks)
    return {i: task.fingerprint for i, task in tasks.items() if i not in missing or have(i)}


def _has_features(tasks: dict[str, ExtractTask], image_id: str) -> bool:
    return features_fingerprint(tasks[image_id].path) == tasks[image_id].fingerprint
