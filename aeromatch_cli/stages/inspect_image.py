"""This module shows what becomes of one image before features are found in it, made anew for somebody who wants to
look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from aeromatch_cli.config import Settings
from aeromatch_cli.data import BoolArray
from aeromatch_cli.executor import Executor
from aeromatch_cli.images.source import read_source
from aeromatch_cli.stages import pairs, simulate
from aeromatch_cli.strategies import Enhanced, ViewPixels


@dataclass(frozen=True, eq=False)
class ImageSteps:
    """pixels: at the working scale. valid: (H, W) bool, None for everywhere. enhanced: None where it is taken as it is.
    views: in which features are found."""

    pixels: NDArray[Any]
    valid: BoolArray | None
    enhanced: Enhanced | None
    views: Sequence[ViewPixels]


def steps_of_image(settings: Settings, image_id: str) -> ImageSteps:
    """Raises InputError or ItemError where the images are gone, ConfigError where their block is not read any more."""
    context, *_ = pairs.prepare(settings, Executor("serial", 1), dry=True)
    task = simulate.make_task(context, context.image_by_id[image_id])
    pixels, valid = read_source(task.enhance.source, colour=True)
    views, enhanced = simulate.render(task)
    return ImageSteps(pixels, valid, None if task.enhance.as_taken else enhanced, views)
