"""DJI's *_Timestamp.MRK: one line for every exposure, by its running number and time (see `captures`).

Columns: number, GPS seconds, [week], offsets in mm `dN,N dE,E dV,V`, `lat,Lat lon,Lon height,Ellh`, `sN, sE, sU` in
metres, `flag,Q` (the RTK status, see `accuracies`). Latitude, longitude and height are the camera's already. Angles
stand in the XMP of the images.
"""

from __future__ import annotations

import re
from collections import Counter

from aeromatch_cli.blocks.accuracies import RTK_NONE, believed_sigmas_m, completed_sigmas_m
from aeromatch_cli.blocks.crs import ELLIPSOID
from aeromatch_cli.blocks.pose_files.source import Source
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError

_WEEK_S = 604_800.0
_FLOAT = r"[-+]?\d+(?:\.\d+)?"
_LINE = re.compile(
    rf"\s*(\d+)\s+({_FLOAT})\s+(?:\[(\d+)\])?.*?({_FLOAT})\s*,\s*Lat\s+({_FLOAT})\s*,\s*Lon\s+({_FLOAT})\s*,\s*Ellh\s+"
    rf"({_FLOAT})\s*,\s*({_FLOAT})\s*,\s*({_FLOAT})\s+(\d+)\s*,\s*Q.*"
)


def is_mrk(source: Source) -> bool:
    first = next((line for _, line in source.records()), "")
    return ",Lat" in first.replace(" ", "") and ",Ellh" in first.replace(" ", "")


def read_mrk(source: Source) -> PoseList:
    """Raises ConfigError with the line."""
    rows, none, said = [], 0, Counter[str]()
    for line, record in source.records():
        match = _LINE.fullmatch(record.replace('"', " "))
        if match is None:
            raise ConfigError(f"{source.at(line)}: not a line of DJI's MRK: {record[:60]!r}")
        latitude, longitude, height, north_m, east_m, up_m = (float(cell) for cell in match.groups()[3:9])
        quality = int(match[10])
        none += quality == RTK_NONE
        sigmas_m, remark = believed_sigmas_m(completed_sigmas_m(east_m, north_m, up_m), quality)
        if remark and quality != RTK_NONE:
            said[remark] += 1
        rows.append(
            PoseRow(
                image=match[1], line=line, position=None if quality == RTK_NONE else (latitude, longitude, height),
                position_kind="geographic", attitude=None, attitude_kind="none", numbered=True,
                sigmas_m=sigmas_m, time_s=_WEEK_S * int(match[3] or 0) + float(match[2]),
            )
        )  # fmt: skip
    remarks = []
    if none:
        remarks.append(f"{source.path.name}: {none} exposures had no fix: treated as unposed")
    remarks += [f"{source.path.name}: {count} of {len(rows)} exposures had {what}" for what, count in said.items()]
    words = "DJI MRK, latitude, longitude, ellipsoidal height"
    return PoseList(tuple(rows), "geographic", tuple(remarks), words, heights=ELLIPSOID)
