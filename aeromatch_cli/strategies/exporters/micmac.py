"""MicMac: Homol (text or binary), and the orientation as Ori-aeromatch.

Homol/Pastis<image0>/<image1>: rows x0 y0 x1 y1, in both directions (src/util/files.cpp, phgr_basic.cpp). Orientations:
camera to world in OpenCV's axes; coordinates are those of the CRS. MicMac does not say where a pixel's zero lies; whole
numbers are middles of pixels here, as in its own image functions.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import focal_px, is_fisheye, parameters
from aeromatch_cli.geometry.lenses import Nearest, fitted
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Solution,
    called,
    keypoints_of,
    matched,
    misfit_remark,
    summary_of,
    write,
)

_ORI = "Ori-aeromatch"


class MicMac(Strategy):
    """Writes Homol/ (tie points of every pair, both ways) and Ori-aeromatch/ (orientations and calibrations)."""

    version: ClassVar[int] = 6
    name: Literal["micmac"] = "micmac"
    binary: bool = Field(
        False, description="Write Homol as .dat, MicMac's default, instead of .txt (ExpTxt=1 in its commands)."
    )

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError where two names are one in MicMac's."""
        self._called(images)

    def _called(self, images: Sequence[Image]) -> dict[str, str]:
        return called(images, lambda name: name.replace("/", "_"), self.name, "MicMac's names of images have _ for /")

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ConfigError as `check_images`."""
        solution = Solution.of(contents)
        names = self._called(solution.images)
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
            remarks = []
            for camera_id, camera in sorted(solution.cameras.items()):
                lens, found_lens = _fraser(camera)
                remarks += misfit_remark(camera_id, "MicMac", found_lens)
                write(partial / _ORI / f"AutoCal_{camera_id}.xml", _calibration(camera, lens))
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts, remarks)

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


@dataclass(frozen=True)
class _Fraser:
    """MicMac's parameters, with lengths of the distortion in units of the focal length."""

    f: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0


def _fraser(camera: Camera) -> tuple[_Fraser, Nearest]:
    """Fraser's model as MicMac has it, and how far it is off. P1 is OpenCV's p2 and P2 its p1.

    Exact without affinity. b1 and b2 turn the undistorted place there and the distorted one in ours, so that with them,
    and for fisheye lenses, the nearest parameters are found.
    """
    p = parameters(camera)
    start = _Fraser(
        p["fy"], p["cx"], p["cy"], p["k1"], p["k2"], p["k3"], p["p2"], p["p1"], p["fx"] / p["fy"] - 1.0,
        p["skew"] / p["fy"],
    )  # fmt: skip
    if not is_fisheye(camera) and not start.b1 and not start.b2:
        return start, Nearest(camera)
    if is_fisheye(camera):
        start = _Fraser(focal_px(camera), p["cx"], p["cy"], p["k1"] - 1.0 / 3.0)
    longer = float(max(camera.width_px, camera.height_px))
    scale = np.array([longer] * 3 + [1.0] * 7)
    values, whole_px, worst_px = fitted(_fraser_pixels, np.array(astuple(start)), scale, camera)
    return _Fraser(*map(float, values)), Nearest(camera, whole_px, worst_px)


def _fraser_pixels(values: FloatArray, rays: FloatArray) -> FloatArray:
    """(N, 2) of normalised coordinates (N, 2) by the fields of _Fraser (10,)."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = values
    u, v = rays.T
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = u * radial + p1 * (r2 + 2.0 * u * u) + 2.0 * p2 * u * v + b1 * u + b2 * v
    y = v * radial + p2 * (r2 + 2.0 * v * v) + 2.0 * p1 * u * v
    return np.column_stack([cx + f * x, cy + f * y])


def _calibration(camera: Camera, lens: _Fraser) -> str:
    """Distortion in powers of pixels from the principal point, from the undistorted to the measured place: radial, or
    Fraser's model where there is more."""
    f = lens.f
    middle = f"{lens.cx:.6f} {lens.cy:.6f}"
    terms = [lens.k1 / f**2, lens.k2 / f**4, lens.k3 / f**6]
    coefficients = "".join(f"<CoeffDist>{term:.12g}</CoeffDist>" for term in (terms if lens.k3 else terms[:2]))
    radial = f"<CDist>{middle}</CDist>{coefficients}"
    model = f"<ModRad>{radial}</ModRad>"
    if lens.p1 or lens.p2 or lens.b1 or lens.b2:
        more = {"P1": lens.p1 / f, "P2": lens.p2 / f, "b1": lens.b1, "b2": lens.b2}
        tags = "".join(f"<{key}>{value:.12g}</{key}>" for key, value in more.items())
        model = f"<ModPhgrStd><RadialePart>{radial}</RadialePart>{tags}</ModPhgrStd>"
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
