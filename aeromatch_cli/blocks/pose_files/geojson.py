"""GeoJSON of points, as GIS programs export a layer of images: properties are columns of a pose list.

The geometry is the position (longitude or easting first), before columns of coordinates. WGS84, unless the member `crs`
names another system, as older files have it.
"""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

from aeromatch_cli.blocks.pose_columns import is_position
from aeromatch_cli.blocks.pose_files.geodesy import described_crs
from aeromatch_cli.blocks.pose_files.source import Source
from aeromatch_cli.blocks.poses import PoseList, read_poses
from aeromatch_cli.errors import ConfigError


def is_points(source: Source) -> bool:
    features = source.tree.get("features") if isinstance(source.tree, dict) else None
    return isinstance(features, list) and bool(features) and all(map(_is_point, features))


def _is_point(feature: Any) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("properties"), dict):
        return False
    geometry = feature.get("geometry")
    return isinstance(geometry, dict) and geometry.get("type") == "Point"


def read_points(source: Source) -> PoseList:
    """Raises ConfigError naming the feature, which counts as a line."""
    stated = described_crs(str(source.path), _crs(source.tree))
    features = source.tree["features"]
    points = [_coordinates(source, count, feature) for count, feature in enumerate(features, start=1)]
    heights = any(len(point) > 2 for point in points)
    properties = dict.fromkeys(name for feature in features for name in feature["properties"])
    names = [name for name in properties if not is_position(name, height=heights)]
    places = ("lat", "lon", "alt") if stated.kind == "geographic" else ("x", "y", "z")
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow([*places[: 3 if heights else 2], *names])
    for count, (feature, point) in enumerate(zip(features, points, strict=True), start=1):
        x, y, height = (*point, float("nan"))[:3]
        position = stated.position(f"{source.path}, feature {count}", x, y, height)
        values = (feature["properties"].get(name) for name in names)
        cells = ("" if value is None else str(value) for value in values)
        writer.writerow([*map(repr, position[: 3 if heights else 2]), *cells])
    found = read_poses(source.path, text=table.getvalue())
    rows = tuple(replace(row, line=row.line - 1) for row in found.rows)
    words = (*stated.remarks, *found.warnings)
    title = f"GeoJSON, {stated.name}"
    zero = stated.heights or found.heights
    return replace(found, rows=rows, crs=stated.crs, heights=zero, warnings=words, format=title)


def _coordinates(source: Source, count: int, feature: Any) -> list[float]:
    """Two, or three with a height."""
    try:
        values = [float(cell) for cell in feature["geometry"].get("coordinates")][:3]
        if len(values) < 2:
            raise ValueError("too few")
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{source.path}, feature {count}: its coordinates are not two or three numbers") from error
    return values


def _crs(tree: Any) -> str:
    named = tree.get("crs")
    properties = named.get("properties") if isinstance(named, dict) else None
    text = str(properties.get("name", "")) if isinstance(properties, dict) else ""
    return text if text and "CRS84" not in text else "EPSG:4326"
