"""What aircraft write into XMP of the camera's calibration and of the position's accuracy.

DJI's namespace `drone-dji`: DewarpData ("date;fx,fy,cx,cy,k1,k2,p1,p2,k3", pixels, cx and cy from the picture's centre,
distortion as in OpenCV), CalibratedFocalLength (pixels), CalibratedOpticalCenterX (pixels, of the picture that both
were measured in), DewarpFlag (1: the picture is free of distortion already), RtkStdLon, RtkStdLat, RtkStdHgt (metres),
RtkFlag (status of the RTK solution, see `accuracies`).
Source: DJI, Phantom 4 RTK and Zenmuse P1 user manuals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from aeromatch_cli.blocks.accuracies import Sigmas, believed_sigmas_m, completed_sigmas_m
from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import brown_camera, focal_px, resized

# Antenna and shutter add to what the receiver states.
_LEAST_SIGMA_M = 0.02
# A calibration further from the picture's size than this speaks of something else.
_LEAST_FOCAL, _LARGEST_FOCAL = 0.3, 20.0


def calibrated_camera(xmp: Mapping[str, str], width_px: int, height_px: int) -> Camera | None:
    """The camera of a picture by its own calibration, resized with it; None where XMP states none, or an absurd one.

    xmp: properties as "prefix:Name" -> text.
    """
    dewarp = _numbers(xmp.get("drone-dji:DewarpData", "").rpartition(";")[2])
    focal = _numbers(xmp.get("drone-dji:CalibratedFocalLength", ""))
    centre = _numbers(xmp.get("drone-dji:CalibratedOpticalCenterX", ""))
    # The calibrated picture is about twice as wide as its centre is far from its left side.
    scale = 0.5 * width_px / centre[0] if centre and centre[0] > 0.0 else 1.0
    full_width, full_height = round(width_px / scale), round(height_px / scale)
    if abs(full_width - width_px) < 0.05 * width_px:
        full_width, full_height = width_px, height_px
    if len(dewarp) == 9:
        camera = _of_dewarp(dewarp, full_width, full_height, xmp.get("drone-dji:DewarpFlag", "").strip() == "1")
    elif len(focal) == 1:
        middle = ((full_width - 1) / 2.0, (full_height - 1) / 2.0)
        camera = Camera("SIMPLE_RADIAL", full_width, full_height, (focal[0], *middle, 0.0))
    else:
        return None
    if not _LEAST_FOCAL < focal_px(camera) / max(full_width, full_height) < _LARGEST_FOCAL:
        return None
    if (full_width, full_height) == (width_px, height_px):
        return camera
    return resized(camera, width_px / full_width, width_px, height_px)


def position_sigmas_m(xmp: Mapping[str, str]) -> tuple[Sigmas | None, str]:
    """Standard deviations of a position to the east, to the north and of the height, as the RTK receiver (DJI) or
    GPSXYAccuracy and GPSZAccuracy (senseFly, Pix4D) state them; None where XMP states none that can be believed. And
    what is said of that."""
    rtk = _positive(xmp, [f"drone-dji:RtkStd{name}" for name in ("Lon", "Lat", "Hgt")])
    flag = _numbers(xmp.get("drone-dji:RtkFlag", ""))
    if rtk:
        x_m, y_m, z_m = (max(_LEAST_SIGMA_M, value) for value in rtk)
        return believed_sigmas_m((x_m, y_m, z_m), flag[0] if len(flag) == 1 else None)
    stated = _positive(xmp, ["Camera:GPSXYAccuracy", "Camera:GPSZAccuracy"])
    if not stated:
        return None, ""
    across_m, up_m = (max(_LEAST_SIGMA_M, value) for value in stated)
    return completed_sigmas_m(z_m=up_m, across_m=across_m), ""


def angle_sigma_deg(xmp: Mapping[str, str]) -> float | None:
    """Standard deviation of an angle, the largest of IMUYawAccuracy, IMUPitchAccuracy, IMURollAccuracy; None where XMP
    does not state all."""
    return max(_positive(xmp, [f"Camera:IMU{name}Accuracy" for name in ("Yaw", "Pitch", "Roll")]), default=None)


def _positive(xmp: Mapping[str, str], names: Sequence[str]) -> list[float]:
    """Return all of these numbers; none where one is missing or not positive."""
    values = []
    for name in names:
        found = _numbers(xmp.get(name, ""))
        if len(found) != 1 or not found[0] > 0.0:
            return []
        values.append(found[0])
    return values


def _of_dewarp(values: tuple[float, ...], width_px: int, height_px: int, dewarped: bool) -> Camera:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    cx, cy = (width_px - 1) / 2.0 + cx, (height_px - 1) / 2.0 + cy
    if dewarped:
        return Camera("PINHOLE", width_px, height_px, (fx, fy, cx, cy))
    lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    return brown_camera((width_px, height_px), lens)


def _numbers(text: str) -> tuple[float, ...]:
    """Finite numbers of a comma-separated text; none where one part is no number."""
    try:
        values = tuple(float(part) for part in text.split(",")) if text.strip() else ()
    except ValueError:
        return ()
    return values if all(math.isfinite(value) for value in values) else ()
