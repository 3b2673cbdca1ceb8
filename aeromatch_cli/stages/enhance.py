"""enhance: pictures whose shadows, or whatever the strategy treats, are readable."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Image
from aeromatch_cli.errors import ItemError
from aeromatch_cli.files import changed_files, digests, read_json, write_atomically, write_json
from aeromatch_cli.fingerprints import fingerprint, mask_fingerprint, picture_fingerprint
from aeromatch_cli.images.files import write_png
from aeromatch_cli.images.masks import mask_path, sees_sky
from aeromatch_cli.images.scaling import scale_within
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.results.stages import EnhanceResult
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import run_images
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.versions import PIPELINE_VERSION, library_version
from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.strategies import Enhanced, Enhancer
from aeromatch_cli.workspace import Workspace


@dataclass(frozen=True, eq=False)
class EnhanceTask:
    """One image to enhance.

    colour: whether a later stage reads the picture's colours. skipped: no pair needs this image enhanced, so that later
    stages take it as it is.
    """

    image_id: str
    source: Source
    colour: bool
    enhancer: Enhancer
    skipped: bool
    workspace: Workspace
    fingerprint: str

    @property
    def as_taken(self) -> bool:
        """Whether later stages take the image as it is, so that no picture of it is worth a file."""
        return self.skipped or not self.enhancer.changes


def make_task(context: Context, image: Image) -> EnhanceTask:
    """Return the task of one image, with the fingerprint of everything that its result depends on."""
    settings = context.settings
    source = source_of(context, image)
    colour = settings.enhance.needs_colour or settings.extract.colours
    return EnhanceTask(
        image_id=image.image_id,
        source=source,
        colour=colour,
        enhancer=settings.enhance,
        skipped=_is_skipped(context, image),
        workspace=context.workspace,
        fingerprint=fingerprint(source.fingerprint, settings.enhance, colour),
    )


def source_of(context: Context, image: Image) -> Source:
    """Return the picture of one image, with the fingerprint of everything that its pixels depend on."""
    block = context.settings.block
    camera = context.block.camera(image)
    scale = scale_within(block.max_size_px, image.width_px, image.height_px)
    mask = mask_path(block.masks, image.name)
    pose = context.pose(image.image_id)
    sky = sees_sky(camera, pose)
    parts = [
        PIPELINE_VERSION,
        library_version("opencv-python-headless"),
        context.given.image_fingerprints[image.image_id],
        mask_fingerprint(mask) if mask else "",
        scale,
        context.geometry_fingerprint(image.image_id, frozenset({"camera", "pose"})) if sky else "",
    ]
    return Source(
        picture=context.picture(image),
        mask=mask,
        camera=camera,
        sky_rotation=pose.world_rotation if sky and pose else None,
        scale=scale,
        fingerprint=fingerprint(*parts),
        taken=context.given.touched.get(image.image_id, context.given.image_fingerprints[image.image_id]),
    )


def _is_skipped(context: Context, image: Image) -> bool:
    enhancer = context.settings.enhance
    return enhancer.keep_source and context.same_illumination(image.image_id, enhancer.same_illumination_minutes)


def check_unchanged(source: Source) -> None:
    """Raise ItemError where the picture is no longer the one that the command found when it began: what is made of
    another one must not be taken for its result."""
    path = source.path
    try:
        same = picture_fingerprint(path) == source.taken
    except OSError as error:
        raise ItemError(f"{path} is gone since the command began ({error.strerror}): put it back, run again") from None
    if not same:
        raise ItemError(f"{path} has changed since the command began: run the same command again")


def enhanced(task: EnhanceTask) -> tuple[NDArray[Any], BoolArray | None, Enhanced]:
    """Return pixels as taken, their validity, and what the strategy made of them; always made anew: a PNG costs
    more."""
    pixels, valid = _read(task)
    return pixels, valid, task.enhancer(pixels, valid)


def for_views(task: EnhanceTask) -> tuple[NDArray[Any], BoolArray | None, Enhanced]:
    """Enhance an image for the stages that make views of it; an image that is skipped is returned as it was taken."""
    if not task.skipped:
        return enhanced(task)
    pixels, valid = _read(task)
    return pixels, valid, Enhanced(pixels)


def _read(task: EnhanceTask) -> tuple[NDArray[Any], BoolArray | None]:
    found = read_source(task.source, colour=task.colour)
    check_unchanged(task.source)
    return found


def keep(task: EnhanceTask, result: Enhanced, *, picture: bool) -> None:
    """Write mask and record, and with `picture` the enhanced pixels; an image left as it was taken leaves nothing.

    What other settings left goes: a mask of theirs would be taken for this one's. A picture of these very settings
    stays in any case.
    """
    picture = picture and not task.as_taken
    stays = picture or _has_picture(task, _read_record(task))
    kept = {".png": stays, ".mask.png": result.mask is not None, ".json": not task.as_taken}
    _remove(task, [suffix for suffix, wanted in kept.items() if not wanted])
    if picture:
        write_atomically(task.workspace.enhanced(task.image_id, ".png"), lambda s: write_png(s, result.pixels))
    mask = result.mask
    if mask is not None:
        write_atomically(task.workspace.enhanced(task.image_id, ".mask.png"), lambda s: write_png(s, mask))
    if kept.pop(".json"):
        names = [f"{task.image_id}{suffix}" for suffix, wanted in kept.items() if wanted]
        path = _record_path(task)
        head = {"fingerprint": task.fingerprint, "picture": stays, **result.info}
        write_json(path, {**head, "files": digests(path.parent, names)})


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
    as_taken = [task for task in tasks if task.as_taken]
    for task in as_taken:
        _remove(task, (".png", ".mask.png", ".json"))
    report.items = report.skipped = len(as_taken)
    others = [task for task in tasks if not task.as_taken]
    run_images(context, report, _run_task, others, lambda task: is_done(context.store, task))
    nothing = f"enhance={context.settings.enhance.name} changes nothing: no pictures"
    report.result = EnhanceResult(
        images_skipped_same_illumination=skipped_images(tasks),
        remark="" if context.settings.enhance.changes else nothing,
    )
    return report.write(context.workspace, context.scope.shard)


def skipped_images(tasks: Iterable[EnhanceTask]) -> int | None:
    """Count the images that are left as taken, since they and those they are paired with were taken in the same light;
    None where the settings skip none."""
    asked = [
        task.skipped for task in tasks if task.enhancer.keep_source and task.enhancer.same_illumination_minutes > 0.0
    ]
    return sum(asked) if asked else None


def is_done(store: BlockStore, task: EnhanceTask) -> bool:
    """Whether the picture on file is the one that the task would make, if it makes any."""
    return task.as_taken or _has_picture(task, store.record(_record_path(task)))


def is_kept(store: BlockStore, task: EnhanceTask) -> bool:
    """Whether what `keep` leaves in any case is on file."""
    return task.as_taken or store.record(_record_path(task)).get("fingerprint") == task.fingerprint


def _has_picture(task: EnhanceTask, record: Mapping[str, Any]) -> bool:
    """Whether the picture on file is of these very settings and inputs."""
    return not task.as_taken and record.get("fingerprint") == task.fingerprint and bool(record["picture"])


def _record_path(task: EnhanceTask) -> Path:
    return task.workspace.enhanced(task.image_id, ".json")


def _read_record(task: EnhanceTask) -> dict[str, Any]:
    """Return the record of an image where its files are as they were written; else nothing."""
    path = _record_path(task)
    record = read_json(path) if path.is_file() else {}
    return {} if changed_files(path.parent, record.get("files", {})) else record
