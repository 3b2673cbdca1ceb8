"""Blur and exposure of every picture, measured once, and the pictures that differ from the others by far."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from aeromatch_cli.data import PictureQuality
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.fingerprints import contents_digest
from aeromatch_cli.formats.tables import read_picture_quality
from aeromatch_cli.images.remote import RemoteFile, on_disk
from aeromatch_cli.images.sharpness import read_quality, shows_nothing, unsharp
from aeromatch_cli.stages.context import Context
from aeromatch_cli.words import of_images

_REMEDY = "look at them; --exclude leaves images out"


def measured(context: Context, *, dry: bool = False) -> dict[str, PictureQuality]:
    """Return image_id -> what is known of its picture: as images.csv has it of the same file, else measured now. Of a
    shard, and dry, what is on file. A picture that cannot be read is absent: the stages that need it say so."""
    try:
        before = read_picture_quality(context.workspace.images) if context.workspace.images.is_file() else {}
    except BrokenFileError:
        before = {}
    prints = context.given.image_fingerprints
    found = {
        i.image_id: before[key] for i in context.block.images if (key := (i.image_id, prints[i.image_id])) in before
    }
    rest = [image for image in context.block.images if image.image_id not in found]
    if rest and context.scope.shard is None and not dry:
        pictures = [context.picture(image) for image in rest]
        for image, outcome in zip(rest, context.executor.run(_measure, pictures, "image quality"), strict=True):
            if outcome.value is not None:
                found[image.image_id] = outcome.value
    return found


def _measure(picture: Path | RemoteFile) -> PictureQuality:
    path = on_disk(picture)
    return read_quality(path)._replace(sha256=contents_digest(path))


def remarks(context: Context, found: Mapping[str, PictureQuality]) -> list[str]:
    """Say what a person should know of the images, one sentence for each kind."""
    images = sorted((image for image in context.block.images if image.image_id in found), key=lambda image: image.name)
    kinds: dict[str, list[str]] = defaultdict(list)
    cameras: dict[str, list[str]] = defaultdict(list)
    names = {image.image_id: image.name for image in images}
    for image in images:
        if complaint := found[image.image_id].damage:
            kinds["damaged, and partly gray or noise perhaps"].append(f"{image.name}: {complaint}")
        nothing = shows_nothing(found[image.image_id])
        if nothing:
            kinds[f"almost {nothing}"].append(image.name)
        else:
            cameras[image.camera_id].append(image.image_id)
    for ids in cameras.values():
        kinds["far more blurred than others of the same camera"] += [
            f"{names[ids[k]]}: {found[ids[k]].blur:.2f}" for k in unsharp([found[i].blur for i in ids])
        ]
    return [
        f"{of_images(some, context.block.images, 'is', 'are')} {what}: {_REMEDY}"
        for what, some in kinds.items()
        if some
    ]
