"""OpenDroneMap: geo.txt, and the shots.geojson that ODM and WebODM export.

geo.txt (opendm/geo.py): the CRS in the first line, then `name x y [z] [yaw pitch roll] [h_acc v_acc] ...`, between
blanks or any other separator; x is the easting or longitude in every CRS; angles where the line has seven fields and
more, accuracies from nine on; yaw, pitch, roll are zero for a camera that looks straight down with the image's top to
the north.

shots.geojson (opendm/shots.py): Point [lon, lat, alt]; `rotation` is the angle-axis vector of cam_from_world relative
to the grid of the UTM zone.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.crs import convergence_deg, utm_crs
from aeromatch_cli.blocks.fields import fields_of, with_name
from aeromatch_cli.blocks.pose_files.geodesy import StatedCrs, described_crs, like_utm
from aeromatch_cli.blocks.pose_files.source import (
    Source,
    Units,
    coordinate,
    image_name,
    rotation_row,
    units_of_comments,
)
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.rotations import rotation_z

# What names a CRS, and what no line of a list begins with.
_CRS = re.compile(
    r"((EPSG|ESRI|IGNF|OGC)\s*:\s*\S.*|.*\+(proj|init)=.*|(PROJ|GEOG|COMPD|GEOD|BOUND)(CS|CRS)\[.*"
    r"|UTM[\s_-]*(zone)?[\s_-]*\d{1,2}\s*[A-Z]?|(WGS|NAD|ETRS|GDA|NZGD|SIRGAS|RGF|JGD|ED|OSGB|CH)[\s_]*\d{2,4}\+?([\s/(].*)?)",
    re.IGNORECASE,
)
_WITH_ANGLES, _WITH_ACCURACIES = 7, 9
# Angles of all lines that are positive and below this, in degrees, may be standard deviations.
_LIKE_SIGMAS = 1.0


def is_geo_txt(source: Source) -> bool:
    first = next((record for _, record in source.records()), "")
    return bool(_CRS.fullmatch(first))


def read_geo_txt(source: Source) -> PoseList:
    """Raises ConfigError with file, line and column."""
    (head, text), *records = source.records()
    stated, said = described_crs(source.at(head), text), units_of_comments(source)
    stated = replace(stated, across_m=said.across_m or stated.across_m, up_m=said.up_m or stated.up_m)
    rows: list[PoseRow] = []
    as_written: list[tuple[float, float]] = []
    for line, record in records:
        row, place = _geo_row(source, line, record, stated, said)
        rows.append(row)
        as_written.append(place)
    given = [row.attitude for row in rows if row.attitude is not None]
    words = "yaw, pitch, roll" if given else "positions"
    remarks = (*stated.remarks, *like_utm(stated, as_written), *said.remarks(source))
    if given and len(rows) >= 3 and all(0.0 < angle < _LIKE_SIGMAS for three in given for angle in three):
        remarks += (f"{source.path.name}: columns 5 to 7 are angles in ODM's geo.txt, and look like accuracies here",)
    title = f"ODM geo.txt, {text}, {words}"
    return PoseList(tuple(rows), stated.kind, remarks, title, stated.crs, heights=stated.heights or said.said.zero)


def _geo_row(
    source: Source, line: int, record: str, stated: StatedCrs, said: Units
) -> tuple[PoseRow, tuple[float, float]]:
    """Return what a line of geo.txt says, and its first two coordinates as they stand there."""
    cells, comma = fields_of(record)
    fields = with_name(cells, 0)
    if len(fields) < 3:
        raise ConfigError(f"{source.at(line)}: {len(fields)} values: write `name x y [z] [yaw pitch roll] [h v]`")
    values = [_value(source.at(line, f"{column}"), cell, comma) for column, cell in enumerate(fields[1:9], start=2)]
    x, y, z = [*values, np.nan, np.nan][:3]
    attitude = None
    if len(fields) >= _WITH_ANGLES and np.isfinite(values[3:6]).all():
        attitude = tuple((said.angle_deg or 1.0) * angle for angle in values[3:6])
    across_m = up_m = None
    if len(fields) >= _WITH_ACCURACIES:
        across_m, up_m = ((said.accuracy_m or 1.0) * one for one in values[6:8])
    place = stated.position(source.at(line), x, y, z)
    row = PoseRow(
        image=image_name(fields[0]), line=line, position=place if np.isfinite(place[:2]).all() else None,
        position_kind=stated.kind, attitude=attitude, attitude_kind="none" if attitude is None else "yaw_pitch_roll",
        forward=False, true_north=True, sigmas_m=completed_sigmas_m(z_m=up_m, across_m=across_m),
    )  # fmt: skip
    return row, (x, y)


def _value(where: str, cell: str, comma: bool) -> float:
    return float("nan") if cell.lower() in ("nan", "") else coordinate(where, cell, decimal_comma=comma)


def is_shots(source: Source) -> bool:
    features = source.tree.get("features") if isinstance(source.tree, dict) else None
    return bool(features) and isinstance(features, list) and {"filename", "rotation"} <= _properties(features[0]).keys()


def read_shots(source: Source) -> PoseList:
    """Raises ConfigError naming the shot."""
    rows = []
    for count, feature in enumerate(source.tree["features"], start=1):
        where = f"{source.path}, shot {count}"
        facts = _properties(feature)
        try:
            longitude, latitude, height = (float(v) for v in feature["geometry"]["coordinates"][:3])
            if not (-90.0 <= latitude <= 90.0 and -360.0 <= longitude <= 360.0):
                raise ValueError(f"{latitude:g}, {longitude:g} is no place on Earth")
            rotation = rotation_of_vector(facts["rotation"]) if "rotation" in facts else None
            name = str(facts["filename"])
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise ConfigError(f"{where}: not a shot with filename and coordinates ({error!r})") from error
        if rotation is not None:
            place = np.array([latitude]), np.array([longitude])
            # From the zone's grid to true north.
            rotation = rotation @ rotation_z(float(convergence_deg(utm_crs(*place), *place)[0]))
        center = latitude, longitude, height
        rows.append(rotation_row(name, count, center, rotation, "geographic", true_north=True))
    return PoseList(tuple(rows), "geographic", (), "ODM shots.geojson")


def _properties(feature: Any) -> dict[str, Any]:
    facts = feature.get("properties") if isinstance(feature, dict) else None
    return facts if isinstance(facts, dict) else {}


def rotation_of_vector(vector: Any) -> FloatArray:
    """(3, 3) of an angle-axis vector in radians. Raises ValueError or TypeError where it is none."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.array([float(v) for v in vector]).reshape(3)).as_matrix())
