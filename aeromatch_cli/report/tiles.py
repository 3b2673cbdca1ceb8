"""Pictures of what becomes of one image (enhanced, masks, views) and of a pair laid on each other, and how several are
shown: a sheet (PNG), a page (HTML), a picture that changes (GIF)."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.files import write_atomically, write_text
from aeromatch_cli.report.pictures import small, write_picture
from aeromatch_cli.report.previews import jpeg_uri
from aeromatch_cli.stages.inspect_image import ImageSteps

SUFFIXES = (".png", ".html", ".gif")
# Longest side of a tile of a sheet, pixels; tiles in a row.
_TILE_PX, _IN_A_ROW = 700, 3
_CAPTION_PX = 30
_SHOWN_MS = 700
# What the masks paint over, and how strongly.
_SHADOW, _LEFT_OUT = (255, 90, 40), (230, 40, 200)
_STRENGTH = 0.45
_STYLE = """body{font:14px system-ui,sans-serif;margin:2em;max-width:1500px}pre{white-space:pre-wrap}
figure{display:inline-block;margin:0 1em 1em 0;vertical-align:top}img{max-width:100%;display:block}
.flicker{position:relative}.flicker img+img{position:absolute;top:0;left:0;animation:f 1.4s steps(1) infinite}
@keyframes f{50%{opacity:0}}"""


@dataclass(frozen=True)
class Tile:
    """A picture (H, W, 3) RGB and what it shows. other: a second one of the same size that takes turns with it."""

    title: str
    picture: NDArray[np.uint8]
    other: NDArray[np.uint8] | None = None


def tiles_of_image(steps: ImageSteps) -> list[Tile]:
    """The enhanced picture, masks and views of an image, as features are found in them."""
    tiles, enhanced = [], steps.enhanced
    if enhanced is not None:
        tiles.append(Tile("enhanced", small(enhanced.pixels)[0]))
        if enhanced.mask is not None and enhanced.mask.any():
            tiles.append(Tile("shadow mask", _painted(steps.pixels, enhanced.mask > 0, _SHADOW)))
    if steps.valid is not None and not steps.valid.all():
        tiles.append(Tile("left out: mask, sky, border", _painted(steps.pixels, ~steps.valid, _LEFT_OUT)))
    for item in steps.views:
        gray = item.gray if item.valid is None else np.where(item.valid, item.gray, 0).astype(np.uint8)
        tiles.append(Tile(f"view {item.view.name}, {item.view.angle_deg:.0f} degrees", small(gray)[0]))
    return tiles


def _painted(pixels: NDArray[Any], where: NDArray[Any], colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    picture = small(pixels)[0]
    inside = small(where.astype(np.uint8) * 255)[0][..., :1].astype(np.float32) / 255.0 * _STRENGTH
    return np.rint(picture * (1.0 - inside) + np.array(colour) * inside).astype(np.uint8)


def aligned(pixels: Sequence[NDArray[Any]], points_px: tuple[FloatArray, FloatArray]) -> Tile | None:
    """Image 0, and image 1 laid on it by the plane (homography) of their matches (M, 2) each; None for too few.

    What lies off the plane (roofs, trees) moves when they take turns; what is wrong moves elsewhere than around it.
    """
    import cv2

    first, ratio0 = small(pixels[0])
    second, ratio1 = small(pixels[1])
    places = [
        ((np.asarray(points, np.float64) + 0.5) * ratio - 0.5).reshape(-1, 1, 2)
        for points, ratio in zip(points_px, (ratio0, ratio1), strict=True)
    ]
    if len(places[0]) < 4:
        return None
    plane, _ = cv2.findHomography(places[1], places[0], cv2.RANSAC, 5.0)
    if plane is None:
        return None
    size = first.shape[1], first.shape[0]
    moved = cv2.warpPerspective(second, plane, size, flags=cv2.INTER_AREA)
    seen = cv2.warpPerspective(np.full(second.shape[:2], 255, np.uint8), plane, size)
    # Where only one image sees, both show it darkened: what takes turns is what both see.
    dark = first // 3
    inside = (seen > 0)[..., None]
    return Tile("laid on each other by a plane", np.where(inside, first, dark), np.where(inside, moved, dark))


def write_tiles(path: Path, tiles: Sequence[Tile], lines: Sequence[str], title: str) -> None:
    """By the suffix of the path. Raises WorkspaceError where it cannot be written."""
    suffix = path.suffix.lower()
    if suffix == ".html":
        figures = "".join(_figure(tile) for tile in tiles)
        text = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title><style>'
            f"{_STYLE}</style></head><body><h1>{html.escape(title)}</h1><pre>{html.escape(chr(10).join(lines))}</pre>"
            f"{figures}</body></html>\n"
        )
        write_text(path, text)
    elif suffix == ".gif":
        _write_gif(path, next(tile for tile in tiles if tile.other is not None))
    elif len(tiles) == 1:
        write_picture(path, tiles[0].picture)
    else:
        write_picture(path, _sheet(tiles))


def _figure(tile: Tile) -> str:
    pictures = [tile.picture, *([] if tile.other is None else [tile.other])]
    images = "".join(f'<img src="{jpeg_uri(picture)}" alt="{html.escape(tile.title)}">' for picture in pictures)
    kind = ' class="flicker"' if tile.other is not None else ""
    return f"<figure><div{kind}>{images}</div><figcaption>{html.escape(tile.title)}</figcaption></figure>\n"


def _write_gif(path: Path, tile: Tile) -> None:
    from PIL import Image

    frames = [Image.fromarray(picture) for picture in (tile.picture, tile.other) if picture is not None]
    write_atomically(
        path,
        lambda stream: frames[0].save(
            stream, "GIF", save_all=True, append_images=frames[1:], duration=_SHOWN_MS, loop=0
        ),
    )


def _sheet(tiles: Sequence[Tile]) -> NDArray[np.uint8]:
    """All tiles in rows, each below its title."""
    import cv2

    drawn = []
    for tile in tiles:
        height, width = tile.picture.shape[:2]
        scale = min(1.0, _TILE_PX / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        one = np.full((_CAPTION_PX + size[1], size[0], 3), 255, np.uint8)
        cv2.putText(one, tile.title, (4, _CAPTION_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
        one[_CAPTION_PX:] = cv2.resize(tile.picture, size, interpolation=cv2.INTER_AREA)
        drawn.append(one)
    rows = [drawn[start : start + _IN_A_ROW] for start in range(0, len(drawn), _IN_A_ROW)]
    gap = 8
    whole = np.full(
        (
            sum(max(one.shape[0] for one in row) + gap for row in rows),
            max(sum(one.shape[1] + gap for one in row) for row in rows),
            3,
        ),
        255,
        np.uint8,
    )
    top = 0
    for row in rows:
        left = 0
        for one in row:
            whole[top : top + one.shape[0], left : left + one.shape[1]] = one
            left += one.shape[1] + gap
        top += max(one.shape[0] for one in row) + gap
    return whole
