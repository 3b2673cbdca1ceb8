"""GeoPackage in the block's CRS: layers cameras, footprints and pairs, which QGIS and others open.

The table layer_styles holds their styles, as QGIS keeps them in a database.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.links import Links, camera_fields, footprint_fields
from aeromatch_cli.strategies.exporters.solution import Solution, matched, summary_of
from aeromatch_cli.strategies.exporters.styles import qml

_LOCAL = "local"
# In place of the hour of writing, so that the same block gives the same file.
_MADE = "2000-01-01T00:00:00.000Z"


class GeoPackage(Strategy):
    """Writes block.gpkg: camera positions with angles, standard deviations, residuals and times, footprints and pairs
    with their verified matches, and styles for QGIS; needs pyogrio."""

    version: ClassVar[int] = 7
    name: Literal["geopackage"] = "geopackage"

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError without pyogrio."""
        _writer()

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ConfigError without pyogrio."""
        write_layer = _writer()
        from shapely import LineString, Point, Polygon

        solution, block = Solution.of(contents), contents.block
        names = {image.image_id: image.name for image in solution.images}
        origin_m = np.array(block.origin_m)
        crs = None if block.crs == _LOCAL else block.crs
        with whole_folder(folder) as partial:
            found = matched(contents)
            links = Links.of(contents, solution, found)
            path = partial / "block.gpkg"
            cameras = camera_fields(contents, solution, links)
            write_layer(
                path, "cameras", [Point(links.positions[i] + origin_m) for i, _ in cameras], "Point Z", crs,
                _columns([fields for _, fields in cameras]),
            )  # fmt: skip
            areas = footprint_fields(contents, solution, links)
            write_layer(
                path, "footprints", [Polygon(f.polygon_m[:, :2] + origin_m[:2]) for f, _ in areas], "Polygon", crs,
                _columns([fields for _, fields in areas]),
            )  # fmt: skip
            write_layer(
                path, "pairs",
                [LineString([(links.positions[i] + origin_m)[:2] for i in ends]) for ends, _ in links.lines],
                "LineString", crs,
                {"image0": [names[a] for (a, _), _ in links.lines], "image1": [names[b] for (_, b), _ in links.lines],
                 "matches": [count for _, count in links.lines]},
            )  # fmt: skip
            layers = ["cameras"]
            if areas:
                layers.append("footprints")
            if links.lines:
                layers.append("pairs")
            write_styles(path, layers)
            count = sum(len(contents.keypoints_px(image.image_id)) for image in solution.images)
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts)


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Of the same attributes of all features."""
    return {key: [row[key] for row in rows] for key in rows[0]} if rows else {}


def write_styles(path: Path, layers: Sequence[str]) -> None:
    """The table by which QGIS finds the default style of each layer."""
    from pyogrio import raw

    fields: dict[str, list[Any]] = {
        "f_table_catalog": [""] * len(layers), "f_table_schema": [""] * len(layers), "f_table_name": [*layers],
        "f_geometry_column": ["geom"] * len(layers), "styleName": [*layers], "styleQML": [qml(one) for one in layers],
        "styleSLD": [""] * len(layers), "useAsDefault": [True] * len(layers),
        "description": ["aeromatch"] * len(layers), "owner": [""] * len(layers), "ui": [""] * len(layers),
        "update_time": [_MADE] * len(layers),
    }  # fmt: skip
    columns = [np.array(values, dtype=None if isinstance(values[0], bool) else object) for values in fields.values()]
    raw.write(
        str(path), None, columns, list(fields), layer="layer_styles", driver="GPKG", geometry_type=None,
        append=path.exists(), layer_options={"FID": "id"},
    )  # fmt: skip


def _typed(name: str, values: Sequence[Any]) -> NDArray[Any]:
    """Texts as objects; times as such, by which QGIS animates a layer: as the camera's clock showed them."""
    if name == "time":
        times = [datetime.fromisoformat(text).replace(tzinfo=None) if text else None for text in values]
        return np.array(times, dtype="datetime64[ms]")
    return np.array(values, dtype=object if isinstance(values[0], str) else None)


def _writer() -> Any:
    try:
        from pyogrio import raw, set_gdal_config_options
    except ImportError:
        raise ConfigError("export=geopackage needs pyogrio: pip install 'aeromatch[gis]'") from None
    from shapely import to_wkb

    set_gdal_config_options({"OGR_CURRENT_DATE": _MADE})

    def write_layer(
        path: Path, layer: str, geometries: list[Any], kind: str, crs: str | None, fields: dict[str, list[Any]]
    ) -> None:
        if not geometries:  # without ground there are no footprints
            return
        columns = [_typed(name, values) for name, values in fields.items()]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*crs.*was not provided", UserWarning)  # a local block has none
            raw.write(
                str(path), np.array([to_wkb(one) for one in geometries], dtype=object), columns, list(fields),
                layer=layer, driver="GPKG", geometry_type=kind, crs=crs, append=path.exists(),
            )  # fmt: skip

    return write_layer
