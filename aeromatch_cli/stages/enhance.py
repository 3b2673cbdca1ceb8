"""enhance: pictures whose shadows, or whatever the strategy treats, are readable."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Image
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images import (
    below_horizon,
    mask_path,
    read_mask,
    read_raster,
    sees_sky,
    shrink,
    shrink_camera,
    write_png,
)
from aeromatch_cli.stages.common import PIPELINE_VERSION, Context, StageReport, library_version, run_stage
from aeromatch_cli.strategies import Enhanced, Enhancer
from aeromatch_cli.workspace import Workspace, fingerprint, image_fingerprint, read_json, write_atomically, write_json

# Among a stage's facts: how many images are not enhanced because they and their partners were taken under one sun.
SPARED = "images_spared_by_one_sun"


@dataclass(frozen=True, eq=False)
class EnhanceTask:
    """One image to enhance.

    mask: file or None. sky_rotation: the attitude where the image sees above the horizon, else None. scale: stored
    raster to the raster worked on (--max-size). colour: whether a later stage reads the picture's colours. spared: no
    pair needs this image enhanced, so that later stages take it as it is.
    """

    image_id: str
    path: Path
    mask: Path | None
    camera: Camera
    sky_rotation: FloatArray | None
    scale: float
    colour: bool
    enhancer: Enhancer
    spared: bool
    workspace: Workspace
    fingerprint: str

    @property
    def as_taken(self) -> bool:
        """Whether later stages take the image as it is, so that no picture of it is worth a file."""
        return self.spared or not self.enhancer.changes


def make_task(context: Context, image: Image) -> EnhanceTask:
    """The task of one image, with the fingerprint of everything that its result depends on."""
    settings = context.settings
    camera = context.block.camera(image)
    longest = max(image.width_px, image.height_px)
    limit = settings.block.max_size_px
    scale = min(1.0, limit / longest) if limit else 1.0
    mask = mask_path(settings.block.masks, image.name)
    pose = context.pose(image.image_id)
    sky = sees_sky(camera, pose)
    colour = settings.enhance.needs_colour or settings.extract.colours
    parts = [
        PIPELINE_VERSION,
        library_version("opencv-python-headless"),
        context.image_fingerprints[image.image_id],
        image_fingerprint(mask) if mask else "",
        scale,
        settings.enhance,
        colour,
        context.geometry_fingerprint(image.image_id, frozenset({"camera", "pose"})) if sky else "",
    ]
    return EnhanceTask(
        image_id=image.image_id,
        path=context.image_path(image),
        mask=mask,
        camera=camera,
        sky_rotation=pose.world_rotation if sky and pose else None,
        scale=scale,
        colour=colour,
        enhancer=settings.enhance,
        spared=_is_spared(context, image),
        workspace=context.workspace,
        fingerprint=fingerprint(*parts),
    )


def _is_spared(context: Context, image: Image) -> bool:
    enhancer = context.settings.enhance
    return enhancer.beside and context.under_one_sun(image.image_id, enhancer.one_sun_minutes)


def load_source(task: EnhanceTask, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None]:
    """Pixels at the working scale and where they are valid (mask, nodata, frames, sky); None = everywhere."""
    pixels, recorded = read_raster(task.path, colour=colour)
    height, width = pixels.shape[:2]
    if (width, height) != (task.camera.width_px, task.camera.height_px):
        # The header and the decoded raster disagree: geometry would be wrong everywhere.
        raise ItemError(
            f"image {task.path} decodes to {width}x{height}, its camera is "
            f"{task.camera.width_px}x{task.camera.height_px}; give the right --cameras"
        )
    valid = read_mask(task.mask, width, height) if task.mask else None
    valid = _combine(_combine(valid, recorded), without_frames(pixels))
    pixels = shrink(pixels, task.scale)
    if valid is not None:
        valid = shrink(valid.astype(np.uint8) * 255, task.scale) > 254
    if task.sky_rotation is not None:
        valid = _combine(valid, below_horizon(shrink_camera(task.camera, task.scale), task.sky_rotation))
    return pixels, valid


def _combine(first: BoolArray | None, second: BoolArray | None) -> BoolArray | None:
    if first is None or second is None:
        return second if first is None else first
    return first & second


def without_frames(pixels: NDArray[Any]) -> BoolArray | None:
    """False in frames of exact zeros that touch the border, as orthorectified or rotated pictures have them.

    Black objects inside the picture stay valid; None when less than half of any border line is zero.
    """
    import cv2

    flat = pixels if pixels.ndim == 2 else pixels.max(axis=2)
    borders = (flat[0], flat[-1], flat[:, 0], flat[:, -1])
    if all(np.count_nonzero(line == 0) < 0.5 * line.size for line in borders):
        return None
    zero = (flat == 0).astype(np.uint8)
    _, labels = cv2.connectedComponents(zero, connectivity=4)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return ~np.isin(labels, edge[edge > 0])


def enhanced(task: EnhanceTask) -> tuple[NDArray[Any], BoolArray | None, Enhanced]:
    """Pixels as taken, their validity, and what the strategy made of them; always made anew: a PNG costs more."""
    pixels, valid = load_source(task, colour=task.colour)
    return pixels, valid, task.enhancer(pixels, valid)


def for_views(task: EnhanceTask) -> tuple[NDArray[Any], BoolArray | None, Enhanced]:
    """The same for the stages after this one: a spared image as it was taken."""
    if not task.spared:
        return enhanced(task)
    pixels, valid = load_source(task, colour=task.colour)
    return pixels, valid, Enhanced(pixels)


def keep(task: EnhanceTask, result: Enhanced, *, picture: bool) -> None:
    """Write mask and facts, and with `picture` the enhanced pixels; an image that stays as it was taken leaves nothing.

    What other settings left goes: a mask of theirs would be taken for this one's. A picture of these very settings
    stays, whether it is asked for or not.
    """
    picture = picture and not task.as_taken
    stays = picture or _has_picture(task)
    kept = {".png": stays, ".mask.png": result.mask is not None, ".json": stays or bool(result.info)}
    _remove(task, [suffix for suffix, wanted in kept.items() if not wanted])
    if picture:
        write_atomically(task.workspace.enhanced(task.image_id, ".png"), lambda s: write_png(s, result.pixels))
    mask = result.mask
    if mask is not None:
        write_atomically(task.workspace.enhanced(task.image_id, ".mask.png"), lambda s: write_png(s, mask))
    if kept[".json"]:
        facts = task.workspace.enhanced(task.image_id, ".json")
        write_json(facts, {"fingerprint": task.fingerprint, "picture": stays, **result.info})


def _remove(task: EnhanceTask, suffixes: Iterable[str]) -> None:
    for suffix in suffixes:
        task.workspace.enhanced(task.image_id, suffix).unlink(missing_ok=True)


def _run_task(task: EnhanceTask) -> str:
    _, _, result = enhanced(task)
    keep(task, result, picture=True)
    return task.image_id


def run(context: Context) -> StageReport:
    """Write enhanced/<id>.png for every image of the shard that is not up to date; none for images left as taken."""
    report = StageReport("enhance")
    tasks = [make_task(context, image) for image in context.images()]
    todo = [task for task in tasks if not task.as_taken and (context.overwrite or not is_done(task))]
    report.items, report.skipped = len(tasks), len(tasks) - len(todo)
    for task in tasks:
        if task.as_taken:
            _remove(task, (".png", ".mask.png", ".json"))
    run_stage(context, report, _run_task, todo, [task.image_id for task in todo])
    report.facts = sun_facts(tasks)
    if not context.settings.enhance.changes:
        report.facts["remark"] = f"enhance={context.settings.enhance.name} changes nothing: no pictures"
    report.fingerprint = fingerprint([task.fingerprint for task in tasks])
    return report.write(context.workspace, context.shard)


def sun_facts(tasks: Iterable[EnhanceTask]) -> dict[str, Any]:
    """How many of the images are spared; {} where the settings spare none."""
    asked = [task.spared for task in tasks if task.enhancer.beside and task.enhancer.one_sun_minutes > 0.0]
    return {SPARED: sum(asked)} if asked else {}


def is_done(task: EnhanceTask) -> bool:
    """Whether the picture on file is the one that the task would make, if it makes any."""
    return task.as_taken or _has_picture(task)


def _has_picture(task: EnhanceTask) -> bool:
    """Whether the picture on file is of these very settings and inputs."""
    picture, facts = (task.workspace.enhanced(task.image_id, suffix) for suffix in (".png", ".json"))
    if task.as_taken or not (picture.is_file() and facts.is_file()):
        return False
    found = read_json(facts)
    return found.get("fingerprint") == task.fingerprint and bool(found.get("picture"))
