"""The ground of a block as it is stated: a height, a DEM, the camera file, or relative altitudes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.ground import ConstantGround, open_dem
from aeromatch_cli.blocks.read import BlockInputs
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Ground
from aeromatch_cli.workspace import image_fingerprint


def ground_fingerprint(settings: Settings) -> str:
    """The ground setting; of a DEM also its content, since it may be replaced in place."""
    text = settings.block.ground
    return f"{text} {image_fingerprint(Path(text))}" if Path(text).is_file() else text


def given_ground(settings: Settings, inputs: BlockInputs) -> tuple[Ground | None, str, tuple[str, ...]]:
    """The ground that settings or the camera file state, where it comes from in words, and remarks; else None."""
    text = settings.block.ground
    try:
        return ConstantGround(float(text) - inputs.origin_m[2]), f"given: {float(text):g} m", ()
    except ValueError:
        pass
    if text != "auto":
        positions = np.array([pose.center_m for pose in inputs.poses.values()]).reshape(-1, 3)
        dem, remarks = open_dem(Path(text), inputs.crs, inputs.origin_m, positions)
        return dem, f"DEM {text}", remarks
    if inputs.ground_hint_z_m is not None and inputs.ground_is_stated:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    return None, "", ()
