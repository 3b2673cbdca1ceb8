"""Lenses as other programs' files state them, where several kinds of file do, and what is said of those that are read
as the nearest ones of ours. docs/cameras.md has the formulas.
"""

from __future__ import annotations

from typing import Any

from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.geometry.lenses import Nearest, brown, fisheye


def remark(lens: Nearest, what: str) -> str:
    """For a person, "" where there is nothing to say. what: names the camera."""
    if lens.camera is None:
        return f"{what}: no camera model here comes near its lens model: it is not used"
    if lens.differs:
        return f"{what}: its lens model is read as the nearest {lens.camera.model} camera, {lens.misfit}"
    return ""


def of_opensfm(entry: Any) -> Nearest | None:
    """A camera of OpenSfM's and ODM's JSON: lengths are shares of the longer side, the principal point counts
    from the middle; without camera for models that are not known here (spherical), None for incomplete ones."""
    try:
        width, height = int(entry["width"]), int(entry["height"])
        longer = max(width, height)
        model = entry["projection_type"]
        radial = [float(entry.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4")]
        if model in ("perspective", "fisheye"):
            f, middle = float(entry["focal"]) * longer, (width / 2.0, height / 2.0)
            if model == "fisheye":
                return fisheye((width, height), (f, f), middle, radial[:2])
            return Nearest(from_colmap("RADIAL", width, height, (f, *middle, *radial[:2])))
        if model in ("brown", "simple_radial", "radial", "fisheye_opencv"):
            focal = float(entry["focal_x"]) * longer, float(entry["focal_y"]) * longer
            middle = width / 2.0 + float(entry["c_x"]) * longer, height / 2.0 + float(entry["c_y"]) * longer
            if model == "fisheye_opencv":
                return fisheye((width, height), focal, middle, radial)
            tangential = float(entry.get("p1", 0.0)), float(entry.get("p2", 0.0))
            return brown((width, height), focal, middle, radial[:3], tangential)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        return None
    return Nearest(None)


def of_metashape(calibration: Any, kind: str, width_px: int, height_px: int) -> Nearest | None:
    """A `calibration` element of Metashape's XML; without camera for kinds other than frame and fisheye, None for an
    incomplete one. cx and cy count from the middle of the picture; p1 and p2 are exchanged against OpenCV's; a fisheye
    is equidistant before its distortion, as OpenCV's is."""
    if kind not in ("frame", "fisheye"):
        return Nearest(None)
    try:
        facts = {child.tag: float(child.text) for child in calibration if child.tag in _METASHAPE and child.text}
        f = facts["f"]
        middle = width_px / 2.0 + facts.get("cx", 0.0), height_px / 2.0 + facts.get("cy", 0.0)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    focal = f + facts.get("b1", 0.0), f
    radial = [facts.get(f"k{k}", 0.0) for k in (1, 2, 3, 4)]
    tangential = facts.get("p2", 0.0), facts.get("p1", 0.0)
    read = fisheye if kind == "fisheye" else brown
    return read((width_px, height_px), focal, middle, radial, tangential, facts.get("b2", 0.0))


_METASHAPE = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
