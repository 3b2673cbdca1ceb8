"""Memory: what a worker needs for the images of a block, and how many workers a budget allows."""

from __future__ import annotations

import re
from collections.abc import Iterable

from aeromatch_cli.config import Settings
from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.images.scaling import scale_within

# Measured on SIFT in tiles of 4 megapixels: a worker's libraries, and bytes per pixel of the source or of its views
# together, whichever are more: a view of a turned or tilted image is larger than the image.
_BASE_MB = 350.0
_BYTES_PER_PIXEL = 12.0
# Of a picture while it is decoded: its colours twice, their gray, and where it is valid.
_DECODED_BYTES = 8.0
_TILE_MB = 700.0
_TILE_MEGAPIXELS = 4.0
# PyTorch and the layers of a network.
_NETWORK_MB = 900.0
# This process itself, with the block and the rows that it gathers.
_PARENT_MB = 400.0
_UNITS = {"MB": 1.0, "GB": 1e3, "MIB": 1.048576, "GIB": 1073.741824, "M": 1.0, "G": 1e3}


def worker_mb(megapixels: float, *, network: bool = False, stored: float = 0.0) -> float:
    """Estimate the peak memory of one worker, megabytes. megapixels: of the raster worked on, or of all its views,
    whichever are more. stored: of the picture in its file, where that is reduced."""
    tile = min(_TILE_MB, _TILE_MB * megapixels / _TILE_MEGAPIXELS)
    pixels = max(_BYTES_PER_PIXEL * megapixels + tile, _DECODED_BYTES * stored)
    return _BASE_MB + pixels + (_NETWORK_MB if network else 0.0)


def command_mb(jobs: int, megapixels: float, *, network: bool = False, stored: float = 0.0) -> float:
    """Estimate the peak memory of a command with its workers, megabytes, as for `worker_mb`; a single worker is the
    command's own process."""
    each = worker_mb(megapixels, network=network, stored=stored)
    return _PARENT_MB + (jobs * each if jobs > 1 else each - _BASE_MB)


def budget_mb(text: str) -> float | None:
    """Read a number of megabytes from "8GB", "512MB", "8 GiB"; None for no budget. Raises ConfigError."""
    if not text.strip():
        return None
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]+)\s*", text)
    unit = _UNITS.get(match[2].upper()) if match else None
    if match is None or unit is None or not float(match[1]) > 0.0:
        raise ConfigError(f"memory {text!r}: write a number with its unit, MB or GB, such as 8GB or 6000MB")
    return float(match[1]) * unit


def runs_network(settings: Settings) -> bool:
    """Whether some worker may run one."""
    return settings.extract.network or settings.match.network or any(step.own_features for step in settings.cascade)


def jobs_within(
    budget: float, jobs: int, images: Iterable[Image], *, network: bool, max_size_px: int = 0
) -> tuple[int, str]:
    """Return how many workers a budget in megabytes allows, one at least, and what is to be said where it allows fewer.

    max_size_px: longer side to which larger images are reduced, 0 for none. Raises ConfigError where the budget does
    not hold the largest image.
    """
    largest = max(images, key=lambda image: image.width_px * image.height_px, default=None)
    if largest is None:
        return jobs, ""
    stored = largest.width_px * largest.height_px / 1e6
    scale = scale_within(max_size_px, largest.width_px, largest.height_px)
    megapixels = stored * scale**2
    need = worker_mb(megapixels, network=network, stored=stored)
    most = int((budget - _PARENT_MB) / need)
    if most >= jobs:
        return jobs, ""
    each = f"each needs about {need:.0f} MB for images of {megapixels:.0f} megapixels"
    if most >= 1:
        return most, f"memory: {most} of {jobs} workers, as {each}"
    alone = command_mb(1, megapixels, stored=stored)
    if alone > budget:
        raise ConfigError(
            f"memory: {largest.name} has {stored:.1f} megapixels, and this program needs about {alone:.0f} MB for it; "
            f"{budget:.0f} MB do not hold it: give more --memory"
            + (", or reduce the images by --max-size" if budget > _PARENT_MB else "")
        )
    if network and alone + _NETWORK_MB > budget:
        return 1, f"memory: 1 of {jobs} workers, as {each}: with a network more than {budget:.0f} MB may be needed"
    return 1, f"memory: 1 of {jobs} workers, as {each}"
