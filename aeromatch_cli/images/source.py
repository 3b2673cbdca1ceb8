"""A picture of the block as it was taken: its file, and everything that says where it is valid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.files import read_mask, read_raster
from aeromatch_cli.images.masks import below_horizon, both_valid
from aeromatch_cli.images.remote import RemoteFile, on_disk
from aeromatch_cli.images.scaling import shrink, shrink_camera


@dataclass(frozen=True, eq=False)
class Source:
    """A stored picture, and the scale at which it is used.

    picture: its file, here or elsewhere. mask: file or None. camera: of the stored raster. sky_rotation: world_rotation
    (3, 3) of the pose where the image sees above the horizon, else None. scale: stored raster to the raster worked on,
    at most 1 (--max-size). fingerprint: of all that its pixels depend on. taken: of the file alone.
    """

    picture: Path | RemoteFile
    mask: Path | None
    camera: Camera
    sky_rotation: FloatArray | None
    scale: float
    fingerprint: str
    taken: str = ""

    @property
    def path(self) -> Path:
        """The file on this machine, fetched where it lies elsewhere. Raises ItemError where that fails."""
        return on_disk(self.picture)

    @property
    def working_camera(self) -> Camera:
        """The camera of the raster worked on."""
        return shrink_camera(self.camera, self.scale)


def read_source(source: Source, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None]:
    """Pixels at the working scale and where they are valid (mask, nodata, frames, sky); None = everywhere.

    Raises ItemError where the file cannot be decoded, or has another size than its camera.
    """
    pixels, recorded = read_raster(source.path, colour=colour)
    height, width = pixels.shape[:2]
    if (width, height) != (source.camera.width_px, source.camera.height_px):
        # The header and the decoded raster disagree: geometry would be wrong everywhere.
        raise ItemError(
            f"image {source.path} decodes to {width}x{height}, its camera is "
            f"{source.camera.width_px}x{source.camera.height_px}; give the right --cameras"
        )
    valid = read_mask(source.mask, width, height) if source.mask else None
    valid = both_valid(valid, recorded)
    pixels = shrink(pixels, source.scale)
    if valid is not None:
        valid = shrink(valid.astype(np.uint8) * 255, source.scale) > 254
    if source.sky_rotation is not None:
        valid = both_valid(valid, below_horizon(source.working_camera, source.sky_rotation))
    return pixels, valid
