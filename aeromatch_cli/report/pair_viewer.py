"""What the report's pair viewer draws from: a small picture of each image and some matches of each pair."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, Image
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.report.figures import evenly_chosen
from aeromatch_cli.report.previews import DrawnMatches, error_classes, jpeg_uri, turned, turned_points
from aeromatch_cli.report.rows import PairRow
from aeromatch_cli.stages.context import Context

MAX_MATCHES = 80
# Places are stored as so many steps of a picture's width and height.
_STEPS = 255


@dataclass
class PairData:
    """pictures: one of each image, a data URI with its width and height. pairs: of "i,j", numbers of pictures, the
    matches: five bytes each, x0 y0 x1 y1 in _STEPS of the picture's sides and the class of the error, as base64."""

    pictures: list[tuple[str, int, int]] = field(default_factory=list)
    pairs: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """For a script element: JSON in which no tag can begin."""
        return json.dumps(vars(self), separators=(",", ":")).replace("<", "\\u003c")


def pair_data(
    context: Context, rows: Sequence[PairRow], pictures: Mapping[str, NDArray[np.uint8]]
) -> tuple[PairData, dict[tuple[str, str], str]]:
    """What can be drawn of the pairs, in their order, and under which key of PairData.pairs each is.

    pictures: image_id -> reduced picture as stored.
    """
    data, number_of = PairData(), {}
    for image_id, stored in pictures.items():
        number_of[image_id] = len(data.pictures)
        picture = turned(stored, context.image_by_id[image_id].exif_orientation)
        data.pictures.append((jpeg_uri(picture, quality=70), picture.shape[1], picture.shape[0]))
    drawn = DrawnMatches(context.workspace)
    keys: dict[tuple[str, str], str] = {}
    for row in drawable(rows):
        ids = row.image_id0, row.image_id1
        if ids[0] in number_of and ids[1] in number_of:
            try:
                places, errors_px = drawn.of(row)
            except WorkspaceError:
                continue  # its files have gone: the row stays, without a picture
            keys[ids] = f"{number_of[ids[0]]},{number_of[ids[1]]}"
            data.pairs[keys[ids]] = _table(context, ids, places, errors_px)
    return data, keys


def drawable(rows: Sequence[PairRow]) -> list[PairRow]:
    """Those of the pairs that have matches to draw."""
    return [row for row in rows if row.matches_in and row.state in ("verified", "rejected")]


def _table(
    context: Context, ids: tuple[str, str], places: tuple[FloatArray, FloatArray], errors_px: FloatArray | None
) -> str:
    """Matches (M, 2) of either image as PairData.pairs has them."""
    chosen = evenly_chosen(len(places[0]), MAX_MATCHES)
    columns = [_steps(context.image_by_id[i], points[chosen]) for i, points in zip(ids, places, strict=True)]
    classes = error_classes(errors_px, len(places[0]))[chosen]
    table = np.column_stack([*columns, classes]).astype(np.uint8)
    return base64.b64encode(table.tobytes()).decode("ascii")


def _steps(image: Image, points_px: FloatArray) -> NDArray[np.int64]:
    """Stored pixels (M, 2) as _STEPS of the displayed picture."""
    size = np.array([image.width_px, image.height_px], np.float64)
    shown = turned_points(points_px, image.width_px, image.height_px, image.exif_orientation) + 0.5
    across = size[::-1] if image.exif_orientation in (5, 6, 7, 8) else size
    return np.clip(np.rint(shown / across * _STEPS), 0, _STEPS).astype(np.int64)
