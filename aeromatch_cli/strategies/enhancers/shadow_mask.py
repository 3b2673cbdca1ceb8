"""Where a picture lies in shadow, found from the picture alone at reduced size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.nets.shadow import MULTIPLE_PX, network_weights, shadow_logits
from aeromatch_cli.strategies.enhancers.tone import Tone, tone_of

# Light below this is taken for this: the noise of a dark pixel is no colour.
_DARKEST_LIGHT = 0.004
_LOG_LIMIT, _COLOUR_LIMIT, _COLOUR_SCALE = 4.0, 3.0, 2.0
# A dark roof called shadow is worse than a shadow left alone: what is no likelier than this counts half. Of a gray
# picture the network is never as sure.
_LIKELY, _LIKELY_GRAY = 0.7, 0.5
# Probabilities are this much steeper around it as shares of shadow: what is likely shadow is wholly so.
_STEEPNESS = 4.0
# Borders follow the picture's own edges over this many pixels of the overview, where they are this clear.
_GUIDE_RADIUS_PX, _GUIDE_EPSILON = 5, 0.01**2


@dataclass(frozen=True, eq=False)
class Overview:
    """A picture reduced for detection.

    levels: (h, w, 3) float32, stored value / white; gray pictures thrice. valid: (h, w) bool. light: (h, w) float32
    linear light, mean of the bands.
    """

    levels: FloatArray
    valid: BoolArray
    light: FloatArray
    tone: Tone

    @property
    def has_colour(self) -> bool:
        """Whether its bands differ anywhere."""
        return bool((self.levels != self.levels[..., :1]).any())


@dataclass(frozen=True, eq=False)
class SoftMask:
    """Share of shadow of every pixel, as a line over the picture's own level: share = slope * level + offset.

    slope, offset: (h, w) float32 at the overview's size; smooth, so that they may be enlarged and then follow the
    edges of the full picture (fast guided filter, He and Sun 2015). share: (h, w) float32, 0-1, at the overview.
    """

    slope: FloatArray
    offset: FloatArray
    share: FloatArray


def make_overview(pixels: NDArray[Any], valid: BoolArray | None, longest_px: int) -> Overview:
    """The picture (H, W) or (H, W, C) with its longer side reduced to longest_px; never enlarged."""
    import cv2

    height, width = pixels.shape[:2]
    scale = min(1.0, longest_px / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    seen = None if valid is None else cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
    tone = tone_of(pixels, small, seen)
    levels = np.minimum(small.astype(np.float32) / np.float32(tone.white), np.float32(1.0))
    if levels.ndim == 2 or levels.shape[2] != 3:
        levels = np.repeat(levels.reshape(*levels.shape[:2], -1).mean(axis=2, keepdims=True), 3, axis=2)
    seen = np.ones(levels.shape[:2], dtype=bool) if seen is None else seen
    return Overview(levels, seen, tone.light(levels).mean(axis=2), tone)


def network_inputs(overview: Overview) -> FloatArray:
    """Log light and two log colour ratios (h, w, 3) float32, each against the picture's median and bounded.

    Free of exposure and white balance; a gray picture has no colour ratios.
    """
    valid = overview.valid if overview.valid.any() else np.ones_like(overview.valid)
    light = np.log(overview.light + np.float32(_DARKEST_LIGHT))
    colours = log_colours(overview)
    light, red, blue = (plane - np.median(plane[valid]) for plane in (light, colours[..., 0], colours[..., 1]))
    bounded = [np.clip(_COLOUR_SCALE * plane, -_COLOUR_LIMIT, _COLOUR_LIMIT) for plane in (red, blue)]
    inputs = np.stack([np.clip(light, -_LOG_LIMIT, _LOG_LIMIT), *bounded], axis=2).astype(np.float32)
    inputs[~valid] = 0.0
    return inputs


def log_colours(overview: Overview) -> FloatArray:
    """(h, w, 2) logarithms of red over green and of blue over green light."""
    logs = np.log(overview.tone.light(overview.levels) + np.float32(_DARKEST_LIGHT))
    return np.stack([logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1]], axis=2)


def shadow_share(overview: Overview) -> FloatArray:
    """Share (h, w) float32 of shadow, 0-1, 0 where the picture is not valid.

    The network looks twice, at the overview and at half its size: finer borders, and a wider look around.
    """
    import cv2

    height, width = overview.light.shape
    inputs = network_inputs(overview)
    half = max(1, width // 2), max(1, height // 2)
    coarse = _logits(np.asarray(cv2.resize(inputs, half, interpolation=cv2.INTER_AREA)))
    logits = 0.5 * (_logits(inputs) + cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))
    probability = 1.0 / (1.0 + np.exp(-np.clip(logits, -30.0, 30.0)))
    likely = _LIKELY if overview.has_colour else _LIKELY_GRAY
    share = np.clip(_STEEPNESS * (probability - likely) + 0.5, 0.0, 1.0)
    return np.asarray(np.where(overview.valid, share, 0.0), dtype=np.float32)


def _logits(inputs: NDArray[Any]) -> NDArray[np.float32]:
    """The network's answer (h, w) to inputs (h, w, 3) of any size."""
    import cv2

    height, width = inputs.shape[:2]
    padded = cv2.copyMakeBorder(inputs, 0, -height % MULTIPLE_PX, 0, -width % MULTIPLE_PX, cv2.BORDER_REFLECT)
    return shadow_logits(np.asarray(padded, dtype=np.float32), network_weights())[:height, :width]


def soft_mask(overview: Overview, share: FloatArray) -> SoftMask:
    """The share (h, w) made to follow the picture's edges, at the overview and, enlarged, at full size."""
    import cv2

    guide = np.ascontiguousarray(guide_of(overview.levels))
    side = 2 * _GUIDE_RADIUS_PX + 1

    def mean(plane: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(plane, (side, side), borderType=cv2.BORDER_REFLECT))

    mean_guide, mean_share = mean(guide), mean(share)
    variance: FloatArray = np.maximum(mean(guide * guide) - mean_guide**2, 0.0)
    slope: FloatArray = (mean(guide * share) - mean_guide * mean_share) / (variance + np.float32(_GUIDE_EPSILON))
    offset = mean(mean_share - slope * mean_guide)
    slope = mean(slope)
    return SoftMask(slope, offset, np.clip(slope * guide + offset, 0.0, 1.0))


def guide_of(levels: NDArray[Any]) -> NDArray[Any]:
    """(H, W) level that mask borders follow: the brightest band, of levels (H, W) or (H, W, C)."""
    if levels.ndim == 2:
        return levels
    brightest = levels[..., 0]
    for band in range(1, levels.shape[2]):  # far faster than a maximum along the last axis
        brightest = np.maximum(brightest, levels[..., band])
    return brightest
