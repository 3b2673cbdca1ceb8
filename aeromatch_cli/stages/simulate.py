"""simulate: virtual views of every image, chosen from its pose and ground."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from aeromatch_cli.data import Image, Neighbour, Pose, View
from aeromatch_cli.files import digests, read_json, write_atomically, write_json
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.files import write_png
from aeromatch_cli.images.views import render_view
from aeromatch_cli.results.stages import ViewsResult
from aeromatch_cli.stages import enhance
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import run_images
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.strategies import Simulator, ViewPixels
from aeromatch_cli.strategies.simulators import source_view
from aeromatch_cli.workspace import Workspace

# Name of the source view that images get besides their simulated ones where other images have no attitude.
_ADDED = "as-taken"
# A largest view of fewer pixels than this share of the image's shows next to nothing of it.
_LEAST_PIXELS = 1.0 / 16.0


@dataclass(frozen=True, eq=False)
class SimulateTask:
    """One image to look at from elsewhere; ground_z_m and gsd_m are None where unknown. as_taken: also as it is.

    remark: why another ground than that below the image is looked at, else "".
    """

    enhance: enhance.EnhanceTask
    pose: Pose | None
    ground_z_m: float | None
    gsd_m: float | None
    neighbours: tuple[Neighbour, ...]
    as_taken: bool
    simulator: Simulator
    fingerprint: str
    remark: str = ""

    @property
    def image_id(self) -> str:
        return self.enhance.image_id


def make_task(context: Context, image: Image) -> SimulateTask:
    """Return the task of one image, with the fingerprint of everything that its result depends on."""
    enhancing = enhance.make_task(context, image)
    simulator = context.settings.simulate
    ground_z_m = context.ground_z_m(image.image_id)
    geometry = context.geometry_fingerprint(image.image_id, simulator.needs)
    as_taken = context.settings.extract.north_up_only and context.lacks_attitude(image.image_id)
    own = fingerprint(enhancing.fingerprint, enhancing.skipped, simulator, geometry, as_taken)
    neighbours = context.neighbours(image.image_id) if "neighbours" in simulator.needs else ()
    pose = context.pose(image.image_id)
    gsd_m, remark = context.block.views_gsd_m, context.ground_remark(image.image_id)
    return SimulateTask(enhancing, pose, ground_z_m, gsd_m, neighbours, as_taken, simulator, own, remark)


def views_of(task: SimulateTask) -> tuple[View, ...]:
    """Return the views of one image: geometry only."""
    camera = task.enhance.source.working_camera
    views = task.simulator(camera, task.pose, task.ground_z_m, task.gsd_m, task.neighbours)
    if task.as_taken and not any(view.is_source for view in views):
        near = (view for view in views if view.beyond is None)
        return (replace(source_view(camera, task.pose), name=_ADDED), *near)
    return views


def render(task: SimulateTask) -> tuple[list[ViewPixels], Any]:
    """Return gray pictures of every view of one image, and the enhancement they were made from.

    With an enhancement `beside` the source that changed anything, all views of the source and then all of that.
    """
    pixels, valid, result = enhance.for_views(task.enhance)
    grays = [(to_gray8(result.pixels), False)]
    if task.enhance.enhancer.keep_source and result.pixels is not pixels:
        grays = [(to_gray8(pixels), False), (grays[0][0], True)]
    camera = task.enhance.source.working_camera
    views, pictures = views_of(task), []
    for gray, enhanced in grays:
        for view in views:
            picture, seen = render_view(gray, valid, camera, view)
            name = f"{view.name}-enhanced" if enhanced else view.name
            pictures.append(ViewPixels(replace(view, name=name, enhanced=enhanced), picture, seen))
    return pictures, result


def further_views(pictures: Sequence[ViewPixels]) -> int:
    """Return 1 where the image as it was taken was added to simulated views because of other images' attitudes, else
    0."""
    return int(any(item.view.name == _ADDED for item in pictures))


@dataclass(frozen=True)
class ViewCost:
    """Counts the views that were made, and their megapixels together."""

    views: int
    megapixels: float

    @classmethod
    def of(cls, pictures: Sequence[ViewPixels]) -> ViewCost:
        return cls(len(pictures), sum(item.view.width_px * item.view.height_px for item in pictures) / 1e6)


def keep(task: SimulateTask, pictures: Sequence[ViewPixels], *, with_pictures: bool) -> None:
    """Write views.json, and with `with_pictures` a PNG of every view and pictures.json, which tells of these.

    Pictures that somebody asked for stay as they are where none are asked for, also those of other settings: features
    can be found without them, and pictures.json says what they show.
    """
    workspace, image_id = task.enhance.workspace, task.enhance.image_id
    record = {
        "fingerprint": task.fingerprint,
        "scale": task.enhance.source.scale,
        "remark": task.remark,
        "views": [
            {
                "name": view.name,
                "width_px": view.width_px,
                "height_px": view.height_px,
                "is_source": view.is_source,
                "angle_deg": view.angle_deg,
                "enhanced": view.enhanced,
                "undistorted_from_view": view.undistorted_from_view.tolist(),
            }
            for view in (item.view for item in pictures)
        ],
    }
    write_json(workspace.views(image_id), record)
    if with_pictures:
        _write_pictures(task, pictures, record)


def _write_pictures(task: SimulateTask, pictures: Sequence[ViewPixels], record: Mapping[str, Any]) -> None:
    """Write the pictures of the views in place of those that are there."""
    workspace, image_id = task.enhance.workspace, task.enhance.image_id
    names = [f"{item.view.name}.png" for item in pictures]
    folder = workspace.views(image_id).parent
    for path in sorted(set(folder.glob("*.png")) - {folder / name for name in names}):
        path.unlink(missing_ok=True)  # of other settings: pictures.json would not list it
    for item in pictures:
        gray = item.gray if item.valid is None else np.where(item.valid, item.gray, 0).astype(np.uint8)
        write_atomically(workspace.view(image_id, item.view.name), partial(write_png, pixels=gray))
    write_json(workspace.view_pictures(image_id), {**record, "files": digests(folder, names)})


def degenerate_view(workspace: Workspace, image: Image) -> str:
    """Return what views.json says of a ground view that shows nothing, "" where there is none: the reason stated, or
    views that together have too few pixels."""
    path = workspace.views(image.image_id)
    record = read_json(path) if path.is_file() else {}
    if not record or record.get("remark"):
        return str(record.get("remark", ""))
    width_px, height_px = max(((v["width_px"], v["height_px"]) for v in record["views"]), key=math.prod, default=(0, 0))
    if width_px * height_px >= _LEAST_PIXELS * record["scale"] ** 2 * image.width_px * image.height_px:
        return ""
    return f"degenerate ground view ({width_px}x{height_px} px of an image of {image.width_px}x{image.height_px} px)"


def views_result(costs: Sequence[ViewCost]) -> ViewsResult:
    """Return the views of images made now."""
    megapixels = round(math.fsum(cost.megapixels for cost in costs), 6)
    return ViewsResult(images=len(costs), views=sum(cost.views for cost in costs), view_megapixels=megapixels)


def _run_task(task: SimulateTask) -> ViewCost:
    pictures, _ = render(task)
    keep(task, pictures, with_pictures=True)
    return ViewCost.of(pictures)


def run(context: Context) -> StageReport:
    """Write simulated/<id>/ for every image of the shard that is not up to date."""
    report = StageReport("simulate")
    tasks = [make_task(context, image) for image in context.images()]
    costs = run_images(context, report, _run_task, tasks, lambda task: is_done(context.store, task))
    if costs:
        report.result = views_result(costs)
    return report.write(context.workspace, context.scope.shard)


def is_done(store: BlockStore, task: SimulateTask) -> bool:
    """Whether the pictures on file are those that the task would make."""
    record = store.record(task.enhance.workspace.view_pictures(task.enhance.image_id))
    return is_kept(store, task) and record.get("fingerprint") == task.fingerprint


def is_kept(store: BlockStore, task: SimulateTask) -> bool:
    """Whether what `keep` leaves in any case is on file."""
    record = store.record(task.enhance.workspace.views(task.enhance.image_id))
    return bool(record.get("fingerprint") == task.fingerprint)
