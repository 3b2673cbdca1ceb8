"""MicMac: Homol (text or binary), and the orientation as Ori-aeromatch.

Homol/Pastis<image0>/<image1>: rows x0 y0 x1 y1, in both directions (src/util/files.cpp, phgr_basic.cpp). Orientations:
camera to world in OpenCV's axes; coordinates are those of the CRS. MicMac does not say where a pixel's zero lies; whole
numbers are middles of pixels here, as in its own image functions.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import parameters
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Solution,
    called,
    keypoints_of,
    matched,
    summary_of,
    write,
)

_ORI = "Ori-aeromatch"


class MicMac(Strategy):
    """Writes Homol/ (tie points of every pair, both ways) and Ori-aeromatch/ (orientations and calibrations)."""

    version: ClassVar[int] = 4
    name: Literal["micmac"] = "micmac"
    binary: bool = Field(
        False, description="Write Homol as .dat, MicMac's default, instead of .txt (ExpTxt=1 in its commands)."
    )

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ItemError where two names are one in it."""
        solution = Solution.of(contents)
        names = called(solution.images, lambda name: name.replace("/", "_"), "MicMac's names of images have _ for /")
        with whole_folder(folder) as partial:
            found, keypoints = matched(contents), keypoints_of(contents)
            for id0, id1, rows in found.pairs:
                points = [keypoints[i][rows[:, k]] for k, i in enumerate((id0, id1))]
                for first, second, places in ((id0, id1, points), (id1, id0, points[::-1])):
                    self._write_pair(partial / "Homol" / f"Pastis{names[first]}", names[second], np.hstack(places))
            for image in solution.images:
                if image.image_id in solution.poses:
                    rotation, center_m = solution.poses[image.image_id]
                    text = _orientation(rotation, center_m + np.array(contents.block.origin_m), image.camera_id)
                    write(partial / _ORI / f"Orientation-{names[image.image_id]}.xml", text)
            for camera_id, camera in solution.cameras.items():
                write(partial / _ORI / f"AutoCal_{camera_id}.xml", _calibration(camera))
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts)

    def _write_pair(self, folder: Path, name: str, rows: FloatArray) -> None:
        """rows: (N, 4)."""
        folder.mkdir(parents=True, exist_ok=True)
        if not self.binary:
            (folder / f"{name}.txt").write_text("".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows))
            return
        record = np.dtype([("two", "<i4"), ("weight", "<f8"), ("places", "<f8", 4)])
        table = np.zeros(len(rows), record)
        table["two"], table["weight"], table["places"] = 2, 1.0, rows
        (folder / f"{name}.dat").write_bytes(struct.pack("<ii", 2, len(rows)) + table.tobytes())


def _orientation(rotation: FloatArray, center_m: FloatArray, camera_id: str) -> str:
    rows = "\n".join(
        f"    <L{k}>{' '.join(f'{v:.15g}' for v in row)}</L{k}>" for k, row in enumerate(rotation.T, start=1)
    )
    center = " ".join(f"{value:.6f}" for value in center_m)
    return f"""<?xml version="1.0" ?>
<ExportAPERO>
 <OrientationConique>
  <OrIntImaM2C><I00>0 0</I00><V10>1 0</V10><V01>0 1</V01></OrIntImaM2C>
  <TypeProj>eProjStenope</TypeProj>
  <ZoneUtileInPixel>true</ZoneUtileInPixel>
  <FileInterne>{_ORI}/AutoCal_{camera_id}.xml</FileInterne>
  <RelativeNameFI>true</RelativeNameFI>
  <Externe>
   <Centre>{center}</Centre>
   <ParamRotation><CodageMatr>
{rows}
   </CodageMatr></ParamRotation>
  </Externe>
  <ConvOri><KnownConv>eConvApero_DistM2C</KnownConv></ConvOri>
 </OrientationConique>
</ExportAPERO>
"""


def _calibration(camera: Camera) -> str:
    """Distortion in powers of pixels from the principal point, from the undistorted to the measured place: radial, or
    Fraser's model (P1 is OpenCV's p2) where there is more."""
    values = parameters(camera)
    f = values["fy"]
    middle = f"{values['cx']:.6f} {values['cy']:.6f}"
    radial = (
        f"<CDist>{middle}</CDist><CoeffDist>{values['k1'] / f**2:.12g}</CoeffDist>"
        f"<CoeffDist>{values['k2'] / f**4:.12g}</CoeffDist>"
    )
    model = f"<ModRad>{radial}</ModRad>"
    if values["p1"] or values["p2"] or values["fx"] != f:
        more = (values["p2"] / f, values["p1"] / f, values["fx"] / f - 1.0, 0.0)
        terms = "".join(
            f"<{key}>{value:.12g}</{key}>" for key, value in zip(("P1", "P2", "b1", "b2"), more, strict=True)
        )
        model = f"<ModPhgrStd><RadialePart>{radial}</RadialePart>{terms}</ModPhgrStd>"
    return f"""<?xml version="1.0" ?>
<ExportAPERO>
 <CalibrationInternConique>
  <KnownConv>eConvApero_DistM2C</KnownConv>
  <PP>{middle}</PP>
  <F>{f:.6f}</F>
  <SzIm>{camera.width_px} {camera.height_px}</SzIm>
  <CalibDistortion>{model}</CalibDistortion>
 </CalibrationInternConique>
</ExportAPERO>
"""
