"""Angles of the camera in DJI's maker notes, which remain where programs have dropped the XMP.

They are an IFD without a head: CameraPitch (9), CameraYaw (10) and CameraRoll (11), floats, in degrees as in XMP.
Source: ExifTool, DJI tags.
"""

from __future__ import annotations

import struct
from typing import Any

_PITCH, _YAW, _ROLL = 9, 10, 11
_FLOAT, _ENTRY_BYTES = 11, 12


def dji_camera_angles(note: Any) -> dict[str, str]:
    """The angles under the names that XMP has for them; none where one is missing."""
    if not isinstance(note, bytes):
        return {}
    for order in "<>":
        found: dict[int, float] = {}
        for start in range(2, len(note) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
            tag, kind, count, value = struct.unpack_from(f"{order}HHIf", note, start)
            if kind == _FLOAT and count == 1:
                found.setdefault(tag, value)
        if found.keys() >= {_PITCH, _YAW, _ROLL}:
            names = {"Yaw": _YAW, "Pitch": _PITCH, "Roll": _ROLL}
            return {f"drone-dji:Gimbal{name}Degree": f"{found[tag]:.2f}" for name, tag in names.items()}
    return {}
