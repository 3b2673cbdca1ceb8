"""Where a picture shows ground: mask files by name, the horizon, frames of black."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.errors import ConfigError, ItemError
from aeromatch_cli.geometry.cameras import world_rays
from aeromatch_cli.geometry.footprints import sees_horizon
from aeromatch_cli.images.depth import strips
from aeromatch_cli.images.gdal import check_pixels

# Of masks without a name of their own.
_HEADER_BYTES, _MASK_BYTES = 2000, 0.15  # of a file, and for each of its pixels, at most
# What Pillow raises on pictures that are cut or scrambled: they are named where they are read.
_BROKEN = (
    *(ItemError, OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError, OverflowError),
    struct.error,
)
# Of masks, in both cases: file systems tell them apart.
_SUFFIXES = tuple(form for suffix in (".png", ".jpg", ".jpeg", ".tif", ".tiff") for form in (suffix, suffix.upper()))


def mask_path(masks: str, name: str) -> Path | None:
    """Mask of an image: COLMAP's naming (a/1.jpg.png), Metashape's and ODM's (a/1_mask.png, .jpg or .tif), the bare
    stem (a/1.png), black and white where it lies beside the image, or the one file for all.

    Raises ConfigError where that is no file (a pipe, a device), or a link that leads out of the folder.
    """
    if not masks:
        return None
    root = Path(masks)
    if root.is_file():
        return root
    picture = root / name
    candidates = [root / f"{name}.png", root / f"{name}.mask.png"]
    candidates += [picture.with_name(f"{picture.stem}_mask{suffix}") for suffix in _SUFFIXES]
    bare = picture.with_suffix(".png")
    # Beside an image of that name it may be another picture.
    if not picture.exists() or (bare != picture and compresses_like_a_mask(bare) and is_black_and_white(bare)):
        candidates.append(bare)
    for candidate in candidates:
        if not candidate.exists():
            continue
        if not candidate.is_file():
            raise ConfigError(f"mask {candidate} is no file: put a picture there, or remove it")
        if not candidate.resolve().is_relative_to(root.resolve()):
            raise ConfigError(
                f"mask {candidate} is a link that leads out of {root}, to {candidate.resolve()}: copy that file there; "
                "one mask for all images is given by --masks FILE"
            )
        return candidate
    return None


def compresses_like_a_mask(path: Path) -> bool:
    """Whether a picture is far smaller than photographs are; without decoding it."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # nothing is decoded here
    if not path.is_file():  # a pipe is not waited for
        return False
    try:
        with Image.open(path) as image:
            return path.stat().st_size <= _HEADER_BYTES + _MASK_BYTES * image.width * image.height
    except _BROKEN:
        return False


def is_black_and_white(path: Path) -> bool:
    """Whether a picture has no other values than 0 and the largest one, or 0 and 1."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            check_pixels(path, image.width, image.height)
            colours = image.getcolors(2) or []
    except _BROKEN:
        return False
    bands = [colour[:3] if isinstance(colour, tuple) else (colour,) for _, colour in colours]
    return bool(bands) and all(set(one) in ({0}, {1}, {255}) for one in bands)


def sees_sky(camera: Camera, pose: Pose | None) -> bool:
    """Whether some part of the image's border looks level or above the horizon."""
    return pose is not None and pose.world_rotation is not None and sees_horizon(camera, pose.world_rotation)


def below_horizon(camera: Camera, world_rotation: FloatArray) -> BoolArray:
    """(H, W) bool, False where the image looks above the horizon (sky)."""
    width, height = camera.width_px, camera.height_px
    xs, ys = np.arange(0.0, width + 15, 16), np.arange(0.0, height + 15, 16)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    up = np.nan_to_num(world_rays(camera, world_rotation, grid)[:, 2], nan=1.0).reshape(len(ys), len(xs))
    found = np.empty((height, width), bool)
    rows = np.array([np.interp(np.arange(width), xs, row) for row in up])
    t = np.interp(np.arange(height), ys, np.arange(len(ys), dtype=float))
    lower = np.minimum(t.astype(int), len(ys) - 2)
    for strip in strips(height, width):
        below, weight = lower[strip], (t[strip] - lower[strip])[:, None]
        found[strip] = rows[below] * (1 - weight) + rows[below + 1] * weight < 0.0
    return found


def without_frames(pixels: NDArray[Any]) -> BoolArray | None:
    """False in frames of exact zeros that touch the border, as orthorectified or rotated pictures have them.

    Black objects inside the picture stay valid; None when less than half of any border line is zero.
    """
    import cv2

    height, width = pixels.shape[:2]
    bands = pixels.reshape(height, width, -1)
    if all(2 * np.count_nonzero((line == 0).all(axis=1)) < len(line) for line in _border_lines(bands)):
        return None
    # With one more black pixel all around, all frames are what hangs together with the first corner.
    black = np.ones((height + 2, width + 2), np.uint8)
    np.equal(bands.max(axis=2), 0, out=black[1:-1, 1:-1], casting="unsafe")
    cv2.floodFill(black, None, (0, 0), 2, flags=4)
    return np.asarray(black[1:-1, 1:-1] != 2)


def _border_lines(bands: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """The pixels (L, C) of each border of a picture (H, W, C)."""
    return bands[0], bands[-1], bands[:, 0], bands[:, -1]


def both_valid(first: BoolArray | None, second: BoolArray | None) -> BoolArray | None:
    """Where two masks (H, W) are both valid; None = everywhere."""
    if first is None or second is None:
        return second if first is None else first
    return first & second
