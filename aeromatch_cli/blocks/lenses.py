"""What is said of cameras of other programs whose lens models are read as the nearest ones of ours."""

from __future__ import annotations

from aeromatch_cli.geometry.lenses import Nearest


def remark(lens: Nearest, what: str) -> str:
    """For a person, "" where there is nothing to say. what: names the camera."""
    if lens.camera is None:
        return f"{what}: no camera model here comes near its lens model: it is not used"
    if lens.differs:
        return f"{what}: its lens model is read as the nearest {lens.camera.model} camera, {lens.misfit}"
    return ""
