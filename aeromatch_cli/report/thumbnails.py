"""Small pictures of the images, for the pair viewer and the sketch of the ground; each image is read once."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Image
from aeromatch_cli.errors import ItemError
from aeromatch_cli.files import write_atomically
from aeromatch_cli.images.remote import RemoteFile, on_disk
from aeromatch_cli.report.previews import data_uri, jpeg, small_raster, turned
from aeromatch_cli.report.stretches import made_of, stretches
from aeromatch_cli.stages.context import Context

# The page holds the pictures of at most so many images; those of a larger block are files beside it.
MAX_IMAGES = 300
FOLDER = "pictures"
# Longest side of a picture, for at most so many images, and for more.
_SIDES_PX = ((40, 480), (120, 320))
_SIDE_PX = 240
_QUALITY = 70
_THREADS = 2
# EXIF Orientation that takes a turned picture back; the others are their own inverse.
_INVERSE = {6: 8, 8: 6}


@dataclass(frozen=True)
class _Thumbnail:
    """A JPEG as viewers show it. place: its bytes, or its file."""

    place: bytes | Path
    width_px: int
    height_px: int
    exif_orientation: int


class Thumbnails(Mapping[str, NDArray[np.uint8]]):
    """image_id -> reduced raster (h, w, 3) as stored, of the images that can be read. beside: they are files beside the
    page."""

    def __init__(self, pictures: Mapping[str, _Thumbnail], *, beside: bool) -> None:
        self._pictures, self.beside = pictures, beside

    def __getitem__(self, image_id: str) -> NDArray[np.uint8]:
        from PIL import Image as PilImage

        found = self._pictures[image_id]
        with PilImage.open(io.BytesIO(found.place) if isinstance(found.place, bytes) else found.place) as picture:
            shown = np.asarray(picture.convert("RGB"))
        return turned(shown, _INVERSE.get(found.exif_orientation, found.exif_orientation))

    def __iter__(self) -> Iterator[str]:
        return iter(self._pictures)

    def __len__(self) -> int:
        return len(self._pictures)

    def link(self, image_id: str) -> tuple[str, int, int]:
        """For the page: a data URI or the file relative to it, and width and height in pixels, as viewers show it."""
        found = self._pictures[image_id]
        uri = data_uri(found.place) if isinstance(found.place, bytes) else f"{FOLDER}/{found.place.name}"
        return uri, found.width_px, found.height_px


def thumbnails(context: Context) -> Thumbnails:
    """Of every image of the block, by id, but those that cannot be read. More than MAX_IMAGES are kept in files
    beside the page, and made again where their images have changed."""
    images = sorted(context.block.images, key=lambda image: image.image_id)
    beside = len(images) > MAX_IMAGES
    side_px = next((side for most, side in _SIDES_PX if len(images) <= most), _SIDE_PX)
    folder = context.workspace.report.parent / FOLDER
    tasks = _stretches(context, images, side_px, folder if beside else None)
    if len(tasks) == 1:
        made = [_thumbnails(tasks[0], _THREADS)]
    else:
        made = made_of(context.executor, _thumbnails, tasks, [len(task.images) for task in tasks])
    found = (thumbnail for some in made for thumbnail in some)
    pictures = {image.image_id: one for image, one in zip(images, found, strict=True) if one is not None}
    current = {found.place for found in pictures.values()}
    for path in sorted(folder.glob("*.jpg")):
        if path not in current:
            path.unlink(missing_ok=True)
    return Thumbnails(pictures, beside=beside)


@dataclass(frozen=True)
class _Stretch:
    """Some of a block's images, where they are, and where pictures beside the page lie."""

    images: tuple[Image, ...]
    places: tuple[Path | RemoteFile, ...]
    side_px: int
    folder: Path | None


def _stretches(context: Context, images: Sequence[Image], side_px: int, folder: Path | None) -> list[_Stretch]:
    """Few images are read faster than several processes take to begin."""
    jobs = context.executor.jobs
    parts = 4 * jobs if folder is not None and jobs > 1 else 1
    places = [context.picture(image) for image in images]
    return [
        _Stretch(tuple(images[part]), tuple(places[part]), side_px, folder) for part in stretches(len(images), parts)
    ]


def _thumbnails(stretch: _Stretch, threads: int = 1) -> list[_Thumbnail | None]:
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(partial(_thumbnail, stretch.side_px, stretch.folder), stretch.places, stretch.images))


def _thumbnail(side_px: int, folder: Path | None, place: Path | RemoteFile, image: Image) -> _Thumbnail | None:
    """None where the image cannot be read."""
    try:
        path = on_disk(place)
        if folder is None:
            return _encoded(path, side_px, image.exif_orientation)
        file = folder / _name(path, side_px, image.exif_orientation)
        known = _known(file, image.exif_orientation)
        if known is not None:
            return known
        made = _encoded(path, side_px, image.exif_orientation)
    except ItemError:
        return None
    write_atomically(file, lambda stream: stream.write(made.place))  # type: ignore[arg-type]
    return _Thumbnail(file, made.width_px, made.height_px, made.exif_orientation)


def _name(path: Path, side_px: int, exif_orientation: int) -> str:
    """Another one when the image is another one."""
    try:
        state = path.stat()
    except OSError as error:
        raise ItemError(f"{path}: {error.strerror or error}") from error
    facts = f"{path.as_posix()} {state.st_size} {state.st_mtime_ns} {side_px} {exif_orientation}"
    return hashlib.sha256(facts.encode()).hexdigest()[:16] + ".jpg"


def _known(file: Path, exif_orientation: int) -> _Thumbnail | None:
    from PIL import Image as PilImage

    try:
        with PilImage.open(file) as picture:
            return _Thumbnail(file, *picture.size, exif_orientation)
    except (OSError, ValueError):
        return None


def _encoded(path: Path, side_px: int, exif_orientation: int) -> _Thumbnail:
    shown = turned(small_raster(path, side_px), exif_orientation)
    return _Thumbnail(jpeg(shown, _QUALITY), shown.shape[1], shown.shape[0], exif_orientation)
