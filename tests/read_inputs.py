"""Reads the inputs of a block in this process, step by step as the stages do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from aeromatch_cli.blocks.crs import AUTO, world_crs
from aeromatch_cli.blocks.exif import ExifFacts, exif_or_reason
from aeromatch_cli.blocks.read import BlockInputs, block_inputs, read_lists
from aeromatch_cli.blocks.scan import scan_images


def read_inputs(
    images: Path,
    poses: Path | str | None = None,
    cameras: str = "exif",
    angles: Any = "auto",
    exclude: tuple[Path, ...] = (),
    read_header: Callable[[Path], ExifFacts | str] = exif_or_reason,
    **options: Any,
) -> BlockInputs:
    settings = {"sigma_position_m": 2.0, "sigma_angle_deg": 3.0} | options
    crs = str(settings.get("crs", AUTO))
    lists = read_lists(None if poses is None else str(poses), cameras, angles, crs=crs)
    settings["crs"] = world_crs(crs)
    names, passed_over = scan_images(images, exclude)
    headers = {name: read_header(images / name) for name in names}
    return block_inputs(str(images), lists, headers, passed_over, **settings)
