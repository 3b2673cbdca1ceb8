"""DJI's *_Timestamp.MRK: one line for every exposure, by its running number.

Columns: number, GPS seconds, [week], offsets in mm `dN,N dE,E dV,V`, `lat,Lat lon,Lon height,Ellh`, `sN, sE, sU` in
metres, `flag,Q`. Latitude, longitude and height are the camera's already. Angles stand in the XMP of the images.
"""

from __future__ import annotations

import re

from aeromatch_cli.blocks.pose_files.source import Source
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError

_FLOAT = r"[-+]?\d+(?:\.\d+)?"
_LINE = re.compile(
    rf"\s*(\d+)\s.*?({_FLOAT})\s*,\s*Lat\s+({_FLOAT})\s*,\s*Lon\s+({_FLOAT})\s*,\s*Ellh\s+"
    rf"({_FLOAT})\s*,\s*({_FLOAT})\s*,\s*({_FLOAT})\s+(\d+)\s*,\s*Q.*"
)
_NO_FIX = 0
_FIXED = 50


def is_mrk(source: Source) -> bool:
    first = next((line for _, line in source.records()), "")
    return ",Lat" in first.replace(" ", "") and ",Ellh" in first.replace(" ", "")


def read_mrk(source: Source) -> PoseList:
    """Raises ConfigError with the line."""
    rows, unfixed, none = [], 0, 0
    for line, record in source.records():
        match = _LINE.fullmatch(record.replace('"', " "))
        if match is None:
            raise ConfigError(f"{source.at(line)}: not a line of DJI's MRK: {record[:60]!r}")
        latitude, longitude, height, *sigmas = (float(cell) for cell in match.groups()[1:7])
        quality = int(match[8])
        none += quality == _NO_FIX
        unfixed += _NO_FIX < quality < _FIXED
        rows.append(
            PoseRow(
                image=match[1], line=line, position=None if quality == _NO_FIX else (latitude, longitude, height),
                position_kind="geographic", attitude=None, attitude_kind="none", numbered=True,
                sigma_position_m=max(sigmas) if max(sigmas) > 0.0 else None,
            )
        )  # fmt: skip
    remarks = []
    if none:
        remarks.append(f"{source.path.name}: {none} exposures had no fix: treated as unposed")
    if unfixed:
        remarks.append(f"{source.path.name}: {unfixed} of {len(rows)} exposures had no fixed RTK solution")
    return PoseList(tuple(rows), "geographic", tuple(remarks), "DJI MRK, latitude, longitude, ellipsoidal height")
