"""GeoJSON for maps (QGIS and others): camera positions, footprints, and pairs with their matches.

RFC 7946: longitude and latitude, WGS84, rings counter-clockwise. A local block has none: its files hold metres, or
units of an arbitrary scale, of its own frame and say so in the member `crs` of GeoJSON 2008, by which GDAL and QGIS
take them for what they are.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.links import Links, camera_fields, footprint_fields
from aeromatch_cli.strategies.exporters.solution import Solution, matched, summary_of, write
from aeromatch_cli.strategies.exporters.styles import qml

_LOCAL_FRAMES = {
    True: 'LOCAL_CS["local frame of the block",UNIT["metre",1]]',
    False: 'LOCAL_CS["frame of the block, of arbitrary scale",UNIT["unknown",1]]',
}


class GeoJson(Strategy):
    """Writes cameras.geojson (angles, standard deviations and residuals of every image, times, counts of verified
    matches), footprints.geojson and pairs.geojson, and beside each its style for QGIS."""

    version: ClassVar[int] = 7
    name: Literal["geojson"] = "geojson"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        names = {image.image_id: image.name for image in solution.images}
        with whole_folder(folder) as partial:
            found = matched(contents)
            graph = Links.of(contents, solution, found)
            positions = graph.positions
            links = [
                _feature(
                    "LineString", _places(contents, np.array([positions[a], positions[b]]))[:, :2].tolist(),
                    {"image0": names[a], "image1": names[b], "matches": count},
                )
                for (a, b), count in graph.lines
            ]  # fmt: skip
            cameras = [
                _feature("Point", _places(contents, positions[i][None])[0].tolist(), fields)
                for i, fields in camera_fields(contents, solution, graph)
            ]
            areas = [
                _feature("Polygon", [_ring(contents, footprint.polygon_m)], fields)
                for footprint, fields in footprint_fields(contents, solution, graph)
            ]
            head: dict[str, Any] = {"type": "FeatureCollection"}
            if contents.geographic is None:
                head["crs"] = {"type": "name", "properties": {"name": _LOCAL_FRAMES[contents.block.metric]}}
            for name, features in (("cameras", cameras), ("footprints", areas), ("pairs", links)):
                write(partial / f"{name}.geojson", json.dumps({**head, "features": features}))
                write(partial / f"{name}.qml", qml(name))
            count = sum(len(contents.keypoints_px(image.image_id)) for image in solution.images)
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts)


def _places(contents: ExportContents, world_m: FloatArray) -> FloatArray:
    """(N, 3) longitude, latitude, height; in a local frame x, y, z."""
    if contents.geographic is None:
        return np.asarray(np.round(world_m, 4))
    latitude, longitude, height = contents.geographic(world_m).T
    return np.column_stack([np.round(longitude, 9), np.round(latitude, 9), np.round(height, 4)])


def _ring(contents: ExportContents, polygon_m: FloatArray) -> list[list[float]]:
    """Closed and counter-clockwise."""
    x, y = polygon_m[:, 0], polygon_m[:, 1]
    turned = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) < 0.0
    corners = polygon_m[::-1] if turned else polygon_m
    flat = _places(contents, np.column_stack([corners[:, :2], np.zeros(len(corners))]))[:, :2].tolist()
    return [*flat, flat[0]]


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    # JSON has no NaN.
    known = {key: None if isinstance(value, float) and np.isnan(value) else value for key, value in properties.items()}
    return {"type": "Feature", "geometry": geometry, "properties": known}
