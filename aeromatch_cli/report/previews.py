"""Match previews of the report: two images side by side with their matches, as inline SVG upon JPEG.

Colours are CSS classes of the page (e0-e3: small to large error, e9: none known).
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ItemError, WorkspaceError
from aeromatch_cli.formats.features import checked_final_keypoints, read_keypoints
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry, read_match_row, read_verified_row
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.files import JPEG_SUFFIXES, check_size, read_pixels
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.report.figures import evenly_chosen
from aeromatch_cli.report.rows import PairRow
from aeromatch_cli.stages.context import Context
from aeromatch_cli.store.matches import FinalEntries, check_features, match_points
from aeromatch_cli.workspace import Workspace

MAX_REJECTED_PREVIEWS = 2
MAX_PREVIEW_LINES = 150
MAX_PREVIEW_POINTS = 2000
ERROR_LIMITS_PX = (0.5, 1.0, 2.0)
NO_MODEL = 9  # the class of a match whose error is not known

_PREVIEW_SIDE_PX = 442
_PREVIEW_GAP_PX = 12


@dataclass(frozen=True)
class Preview:
    """A pair as a picture, with its caption. svg: "" where it could not be made, then `note` says why."""

    heading: str
    pair: PairRow
    svg: str
    note: str


def chosen_previews(pairs: Sequence[PairRow]) -> list[tuple[str, PairRow]]:
    """Best, median and worst verified pair by matches, and the rejected pairs that had most matches."""
    verified = sorted((row for row in pairs if row.state == "verified"), key=lambda row: row.verified)
    chosen: dict[int, str] = {}
    if verified:
        for index, words in ((len(verified) - 1, "Best"), (len(verified) // 2, "Median"), (0, "Worst")):
            chosen.setdefault(index, f"{words} verified pair")
    result = [(heading, verified[index]) for index, heading in chosen.items()]
    rejected = sorted((row for row in pairs if row.state == "rejected"), key=lambda row: -row.matches_in)
    return result + [("Rejected pair", row) for row in rejected[:MAX_REJECTED_PREVIEWS]]


# Fingerprint, and keypoints (K, 2), of an image's features; "" and None where they cannot be read.
Features = Callable[[str], tuple[str, FloatArray | None]]
# Files of images kept in memory.
_KEPT = 300


class DrawnMatches:
    """The matches of pairs as they are drawn; every file is read once, where pairs of an image follow each other."""

    def __init__(self, workspace: Workspace, features: Features | None = None) -> None:
        """features: of an image, by default from its file."""
        self._workspace = workspace
        self._features = features or lru_cache(_KEPT)(
            lambda i: checked_final_keypoints(workspace.features(i), workspace.refined(i))
        )
        self._verified = lru_cache(_KEPT)(lambda image_id: read_verified_row(workspace.verified(image_id)))
        self._matched = lru_cache(_KEPT)(lambda image_id: read_match_row(workspace.matches(image_id)))

    @cached_property
    def _final(self) -> FinalEntries:
        return FinalEntries(self._workspace)

    def of(self, row: PairRow) -> tuple[tuple[FloatArray, FloatArray], FloatArray | None]:
        """Stored pixels (M, 2) of either image, and errors (M,): verified matches with theirs, of a rejected pair those
        before verification, None for errors. Raises WorkspaceError where the files do not hold the pair."""
        ids = row.image_id0, row.image_id1
        entry: VerifiedEntry | MatchEntry | None
        if row.state == "verified":
            path, judged = self._workspace.verified(ids[0]), self._verified(ids[0]).get(ids[1])
            entry = judged = self._final.left(ids[0], judged) if judged else None
            errors = judged.verdict.errors_px if judged else None
        else:
            path, entry, errors = self._workspace.matches(ids[0]), self._matched(ids[0]).get(ids[1]), None
        if entry is None:
            raise WorkspaceError(f"{path} does not hold the pair; run the stage that makes it again")
        check_features(self._workspace, ids[0], entry, lambda image_id: self._features(image_id)[0])
        return match_points(entry.matches, *(self._keypoints(i) for i in ids)), errors

    def _keypoints(self, image_id: str) -> FloatArray:
        known = self._features(image_id)[1]
        # What cannot be read says so itself.
        return read_keypoints(self._workspace.features(image_id))[0] if known is None else known


def error_classes(errors_px: FloatArray | None, count: int) -> IntArray:
    """(count,) CSS classes of errors (count,): 0-3 from small to large, NO_MODEL where NaN or None."""
    errors = np.full(count, np.nan) if errors_px is None else errors_px
    return np.where(np.isnan(errors), NO_MODEL, np.searchsorted(ERROR_LIMITS_PX, errors))


def previews(context: Context, pairs: Sequence[PairRow]) -> list[Preview]:
    """Pictures of the chosen pairs."""
    found, drawn = [], DrawnMatches(context.workspace)
    for heading, row in chosen_previews(pairs):
        try:
            svg, note = _preview(context, row, drawn), ""
        except (ItemError, WorkspaceError) as error:
            svg, note = "", f"no preview: {error}"
        found.append(Preview(heading, row, svg, note))
    return found


def _preview(context: Context, row: PairRow, drawn: DrawnMatches) -> str:
    """Verified matches with their errors, or, of a rejected pair, the matches before verification."""
    points, errors = drawn.of(row)
    sides = []
    for image_id, points_px in zip((row.image_id0, row.image_id1), points, strict=True):
        image = context.image_by_id[image_id]
        pixels = small_raster(context.image_path(image), _PREVIEW_SIDE_PX)
        ratio = np.array(pixels.shape[1::-1]) / (image.width_px, image.height_px)
        sides.append(Side(pixels, image.exif_orientation, (points_px + 0.5) * ratio - 0.5))
    return preview(sides[0], sides[1], errors, f"Matches of {row.name0} and {row.name1}")


@dataclass(frozen=True, eq=False)
class Side:
    """One image of a preview: stored raster (H, W) or (H, W, 3) RGB, EXIF Orientation, matches (M, 2) in stored px."""

    pixels: NDArray[Any]
    exif_orientation: int
    points_px: FloatArray


def _turn(exif_orientation: int) -> tuple[bool, bool, bool]:
    """Transpose, mirror x, mirror y: what turns the stored raster upright (EXIF Orientation: TIFF 6.0, tag 274)."""
    return exif_orientation in (5, 6, 7, 8), exif_orientation in (2, 3, 6, 7), exif_orientation in (3, 4, 7, 8)


def turned(pixels: NDArray[Any], exif_orientation: int) -> NDArray[Any]:
    """The stored raster as a viewer shows it."""
    transpose, mirror_x, mirror_y = _turn(exif_orientation)
    if transpose:
        pixels = np.swapaxes(pixels, 0, 1)
    return pixels[:: -1 if mirror_y else 1, :: -1 if mirror_x else 1]


def turned_points(points_px: FloatArray, width_px: int, height_px: int, exif_orientation: int) -> FloatArray:
    """Where stored pixels (N, 2) of a width_px x height_px raster lie after `turned`."""
    transpose, mirror_x, mirror_y = _turn(exif_orientation)
    x, y = np.asarray(points_px, dtype=np.float64).T
    if transpose:
        x, y, width_px, height_px = y, x, height_px, width_px
    return np.stack([width_px - 1 - x if mirror_x else x, height_px - 1 - y if mirror_y else y], axis=1)


def preview(side0: Side, side1: Side, errors_px: FloatArray | None, label: str) -> str:
    """Both images side by side, upright, with match lines coloured by error (M,); None or NaN: no error known."""
    uri0, size0, points0 = _upright(side0)
    uri1, size1, points1 = _upright(side1)
    offset = size0[0] + _PREVIEW_GAP_PX
    width, height = offset + size1[0], max(size0[1], size1[1])
    points1 = points1 + np.array([float(offset), 0.0])
    classes = error_classes(errors_px, len(points0))
    chosen = _spread(points0, MAX_PREVIEW_LINES)
    dots = _spread(points0, MAX_PREVIEW_POINTS)
    parts = [
        f'<svg class="preview" viewBox="0 0 {width} {height}" style="max-width:{1.14 * width:.0f}px" role="img" '
        f'aria-label="{escape(label)}">',
        f'<image href="{uri0}" x="0" y="0" width="{size0[0]}" height="{size0[1]}"/>',
        f'<image href="{uri1}" x="{offset}" y="0" width="{size1[0]}" height="{size1[1]}"/>',
    ]
    for k in np.unique(classes):
        lines = "".join(f"M{_xy(points0[i])}L{_xy(points1[i])}" for i in chosen if classes[i] == k)
        spots = "".join(f"M{_xy(points0[i])}h0M{_xy(points1[i])}h0" for i in dots if classes[i] == k)
        parts.append(f'<path class="tie e{k}" d="{lines}"/><path class="spot e{k}" d="{spots}"/>')
    return "".join([*parts, "</svg>"])


def _xy(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _upright(side: Side) -> tuple[str, tuple[int, int], FloatArray]:
    """JPEG as data URI, its displayed (width, height), and the points (M, 2) in SVG units (corner origin)."""
    height, width = side.pixels.shape[:2]
    scale = min(1.0, _PREVIEW_SIDE_PX / max(width, height))
    small = to_colour8(shrink(side.pixels, scale))
    ratio = np.array([small.shape[1] / width, small.shape[0] / height])
    points = (np.asarray(side.points_px, dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
    points = turned_points(points, small.shape[1], small.shape[0], side.exif_orientation) + 0.5
    picture = turned(small, side.exif_orientation)
    return jpeg_uri(picture), (picture.shape[1], picture.shape[0]), points


def small_raster(path: Path, side_px: int) -> NDArray[np.uint8]:
    """The stored raster, reduced. A JPEG is decoded at reduced size: a tenth of the time."""
    if path.suffix.lower() in JPEG_SUFFIXES:
        from PIL import Image as PilImage

        check_size(path)
        try:
            with PilImage.open(path) as picture:
                if picture.mode in ("RGB", "L"):
                    picture.draft(picture.mode, (side_px, side_px))
                    picture.thumbnail((side_px, side_px), reducing_gap=2.0)
                    return np.asarray(picture)
        except (OSError, ValueError) as error:
            raise ItemError(f"{path}: {error}") from error
    pixels: NDArray[Any] = read_pixels(path, colour=True)
    return to_colour8(shrink(pixels, min(1.0, side_px / max(pixels.shape[:2]))))


def to_colour8(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits for display; other depths are stretched band by band."""
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.ndim == 2:
        return to_gray8(pixels)
    return np.stack([to_gray8(pixels[..., band]) for band in range(pixels.shape[2])], axis=-1)


def jpeg_uri(pixels: NDArray[np.uint8]) -> str:
    """data: URI of (H, W) gray or (H, W, 3) RGB."""
    return data_uri(jpeg(pixels))


def data_uri(content: bytes) -> str:
    """Of a JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(content).decode("ascii")


def jpeg(pixels: NDArray[np.uint8], quality: int = 80) -> bytes:
    """Of (H, W) gray or (H, W, 3) RGB."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "JPEG", quality=quality, optimize=True)
    return stream.getvalue()


def _spread(points_px: FloatArray, limit: int) -> IntArray:
    """Indices of at most `limit` points, evenly over the picture: every k-th along a raster of cells."""
    if len(points_px) <= limit:
        return np.arange(len(points_px))
    cells = np.floor(points_px / (_PREVIEW_SIDE_PX / 16)).astype(np.int64)
    return np.lexsort((cells[:, 0], cells[:, 1]))[evenly_chosen(len(points_px), limit)]
