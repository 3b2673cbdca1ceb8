"""What the report's pair viewer draws from: a small picture of each image and some matches of each pair."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, Image
from aeromatch_cli.files import write_text
from aeromatch_cli.report.figures import evenly_chosen
from aeromatch_cli.report.previews import error_classes, turned_points
from aeromatch_cli.report.rows import PairRow
from aeromatch_cli.report.thumbnails import Thumbnails
from aeromatch_cli.stages.context import Context

MAX_MATCHES = 80
# Places are stored as so many steps of a picture's width and height.
_STEPS = 255


@dataclass
class PairData:
    """names and pictures: of each image; a picture is a data URI or a file beside the page, with its width and height.
    pairs: of "i,j", numbers of images, the matches, how many are verified, how many were compared, and the state.
    Matches are five bytes each, x0 y0 x1 y1 in _STEPS of the picture's sides and the class of the error, as base64.
    Of "i,j" i is the smaller one. beside: the pairs of these first images are in files beside the page, pairs/<i>.js.
    """

    names: list[str] = field(default_factory=list)
    pictures: list[tuple[str, int, int]] = field(default_factory=list)
    pairs: dict[str, tuple[str, int, int, str]] = field(default_factory=dict)
    beside: list[int] = field(default_factory=list)

    def text(self) -> str:
        """For a script element: JSON in which no tag can begin."""
        return _json(vars(self) | ({"pairs": {}} if self.beside else {}))

    def write_beside(self, folder: Path) -> None:
        """pairs/<i>.js, which add the pairs to the page: a page that is a local file may load scripts, but no data.
        Those of an earlier report are replaced."""
        rows: dict[str, dict[str, tuple[str, int, int, str]]] = {}
        for key, pair in self.pairs.items() if self.beside else ():
            rows.setdefault(f"{key.partition(',')[0]}.js", {})[key] = pair
        for path in sorted(folder.glob("*.js")):
            if path.name not in rows:
                path.unlink(missing_ok=True)
        for name, row in rows.items():
            write_text(folder / name, f"addPairs({_json(row)});\n")


def _json(value: object) -> str:
    text = json.dumps(value, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def pair_data(
    context: Context, rows: Sequence[PairRow], pictures: Thumbnails, tables: Mapping[tuple[str, str], str]
) -> tuple[PairData, dict[tuple[str, str], str]]:
    """What can be drawn of the pairs, and under which key of PairData.pairs each is. tables: `pair_table` of pairs."""
    data = PairData()
    number_of = {image_id: number for number, image_id in enumerate(pictures)}
    for image_id in pictures:
        data.names.append(context.image_by_id[image_id].name)
        data.pictures.append(pictures.link(image_id))
    keys: dict[tuple[str, str], str] = {}
    for row in sorted(drawable(rows), key=lambda row: (row.image_id0, row.image_id1)):
        ids = row.image_id0, row.image_id1
        table = tables.get(ids)
        if table is not None and ids[0] in number_of and ids[1] in number_of:
            keys[ids] = f"{number_of[ids[0]]},{number_of[ids[1]]}"
            data.pairs[keys[ids]] = (table, int(row.verified), int(row.matches_in or 0), row.state)
    if pictures.beside:
        data.beside = sorted({int(key.partition(",")[0]) for key in data.pairs})
    return data, keys


def drawable(rows: Sequence[PairRow]) -> list[PairRow]:
    """Those of the pairs that have matches to draw."""
    return [row for row in rows if row.matches_in and row.state in ("verified", "rejected")]


def pair_table(images: tuple[Image, Image], places: tuple[FloatArray, FloatArray], errors_px: FloatArray | None) -> str:
    """Matches, stored pixels (M, 2) in either image, and their errors (M,) in pixels, as PairData.pairs has them."""
    chosen = evenly_chosen(len(places[0]), MAX_MATCHES)
    columns = [_steps(image, points[chosen]) for image, points in zip(images, places, strict=True)]
    classes = error_classes(errors_px, len(places[0]))[chosen]
    table = np.column_stack([*columns, classes]).astype(np.uint8)
    return base64.b64encode(table.tobytes()).decode("ascii")


def _steps(image: Image, points_px: FloatArray) -> NDArray[np.int64]:
    """Stored pixels (M, 2) as _STEPS of the displayed picture."""
    size, shown = np.array([image.width_px, image.height_px], np.float64), points_px
    if image.exif_orientation != 1:
        shown = turned_points(points_px, image.width_px, image.height_px, image.exif_orientation)
    across = size[::-1] if image.exif_orientation in (5, 6, 7, 8) else size
    return np.minimum(np.maximum(np.rint((shown + 0.5) * (_STEPS / across)), 0), _STEPS).astype(np.int64)
