"""What the report's pair viewer draws from: a small picture of each image and some matches of each pair."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import read_match_row, read_verified_row
from aeromatch_cli.report.figures import evenly_chosen
from aeromatch_cli.report.previews import ERROR_LIMITS_PX, jpeg_uri, turned, turned_points
from aeromatch_cli.report.rows import PairRow
from aeromatch_cli.stages.consistency import FinalEntries
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import match_points

MAX_MATCHES = 80
# Places are stored as so many steps of a picture's width and height.
_STEPS = 255
_NO_MODEL = 9


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
    points = _Points(context)
    keys: dict[tuple[str, str], str] = {}
    for row in drawable(rows):
        ids = row.image_id0, row.image_id1
        if ids[0] in number_of and ids[1] in number_of:
            key = f"{number_of[ids[0]]},{number_of[ids[1]]}"
            found = points.of(row)
            if found is not None:
                data.pairs[key], keys[ids] = found, key
    return data, keys


def drawable(rows: Sequence[PairRow]) -> list[PairRow]:
    """Those of the pairs that have matches to draw."""
    return [row for row in rows if row.matches_in and row.state in ("verified", "rejected")]


class _Points:
    """Matches of pairs as they are displayed; files are read once."""

    def __init__(self, context: Context) -> None:
        workspace = context.workspace
        self.context, self.final = context, FinalEntries(workspace)
        self.keypoints = cache(lambda image_id: read_keypoints(workspace.features(image_id))[0])
        self.verified = cache(lambda image_id: read_verified_row(workspace.verified(image_id)))
        self.matched = cache(lambda image_id: read_match_row(workspace.matches(image_id)))

    def of(self, row: PairRow) -> str | None:
        """Verified matches by their errors, of a rejected pair those before; None where the files do not hold it."""
        ids = row.image_id0, row.image_id1
        entry: Any
        try:
            if row.state == "verified":
                judged = self.verified(ids[0]).get(ids[1])
                entry = judged = self.final(ids[0], judged) if judged else None
                errors = judged.verdict.errors_px if judged else None
            else:
                entry, errors = self.matched(ids[0]).get(ids[1]), None
            if entry is None:
                return None
            places = match_points(entry.matches, *(self.keypoints(i) for i in ids))
        except WorkspaceError:
            return None
        chosen = evenly_chosen(len(places[0]), MAX_MATCHES) if len(places[0]) > MAX_MATCHES else slice(None)
        columns = [self._steps(image_id, points[chosen]) for image_id, points in zip(ids, places, strict=True)]
        classes = np.full(len(columns[0]), _NO_MODEL)
        if errors is not None:
            known = np.asarray(errors)[chosen]
            classes = np.where(np.isnan(known), _NO_MODEL, np.searchsorted(ERROR_LIMITS_PX, known))
        table = np.column_stack([*columns, classes]).astype(np.uint8)
        return base64.b64encode(table.tobytes()).decode("ascii")

    def _steps(self, image_id: str, points_px: FloatArray) -> NDArray[np.int64]:
        """Stored pixels (M, 2) as _STEPS of the displayed picture."""
        image = self.context.image_by_id[image_id]
        size = np.array([image.width_px, image.height_px], np.float64)
        shown = turned_points(points_px, image.width_px, image.height_px, image.exif_orientation) + 0.5
        across = size[::-1] if image.exif_orientation in (5, 6, 7, 8) else size
        return np.clip(np.rint(shown / across * _STEPS), 0, _STEPS).astype(np.int64)
