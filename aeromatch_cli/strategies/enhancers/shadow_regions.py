"""Shadow regions, how dark each is, and how much light each lacks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.strategies.enhancers.shadow_mask import Overview, log_colours

MAX_LISTED_REGIONS = 64
# Lit ground and shadow are compared over this distance, as a share of the longer side, from this many pairs on.
_APART_SHARE, _LEAST_PAIRS = 0.008, 30
# A share below this is surely lit, one above its complement surely shadow.
_SURE = 0.2
# What is darker than this light is noise: a mean is never taken below it.
_LEAST_LIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class Regions:
    """labels: (h, w) int32, 0 = lit, regions from 1 by area, largest first. log_gain: (R + 1,) float32, natural
    logarithm of each region's gain on light, [0] the start factor's. start: the picture's lit / shadow ratio of light.
    area_px: (R + 1,) at the overview; light: (R + 1,) mean linear light; boxes_px: (R + 1, 4) x, y, width, height.
    tint: (2,) logarithms of by how much red over green, and blue over green, of light are larger where it is lit.
    """

    labels: IntArray
    log_gain: FloatArray
    start: float
    area_px: IntArray
    light: FloatArray
    boxes_px: IntArray
    tint: FloatArray


def find_regions(
    overview: Overview, share: FloatArray, *, exponent: float, max_gain: float, min_area_px: int
) -> Regions | None:
    """Connected regions of share (h, w) >= 0.5 with their gains; None where there is none.

    The start factor is the light of the lit area over that of the shadowed area, on both sides of their borders. A
    region whose own mean is m, where that of all shadow is M, gets start * (M / m) ** exponent, between 1 and max_gain.
    Both means are geometric: a white roof is not to count for ten lawns.
    """
    import cv2

    dark = ((share >= 0.5) & overview.valid).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(dark, connectivity=8)
    kept = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= min_area_px) + 1
    if not len(kept):
        return None
    kept = kept[np.argsort(-stats[kept, cv2.CC_STAT_AREA], kind="stable")]
    renumbered = np.zeros(count, dtype=np.int32)
    renumbered[kept] = np.arange(1, len(kept) + 1)
    labels = renumbered[labels]
    log_light = np.log(np.maximum(overview.light, np.float32(_LEAST_LIGHT))).astype(np.float64)
    areas = np.bincount(labels.ravel(), minlength=len(kept) + 1)
    means = np.bincount(labels.ravel(), weights=log_light.ravel(), minlength=len(kept) + 1) / np.maximum(areas, 1)
    start, tint = _log_ratio(overview, log_light, share)
    log_gain = start + exponent * (log_light[labels > 0].mean() - means)
    log_gain[0] = start
    bounded = np.clip(log_gain, 0.0, np.log(max_gain)).astype(np.float32)
    boxes = np.asarray(stats, dtype=np.int64)[np.concatenate([[0], kept]), : cv2.CC_STAT_AREA]
    return Regions(labels, bounded, float(np.exp(start)), areas, np.exp(means), boxes, tint)


def _log_ratio(overview: Overview, log_light: FloatArray, share: FloatArray) -> tuple[float, FloatArray]:
    """Logarithm of lit over shadowed light, of the same ground; and (2,) of the change of colour, `Regions.tint`.

    Compared are pairs of pixels a few apart, one surely lit and one surely in shadow, so that the penumbra is left out;
    of these the half whose difference in colour is nearest to the usual one, since a pair of two materials differs in
    colour as well; and of those the median. Without pairs: of the means over all lit and all shadowed area.
    """
    lit, dark = (share < _SURE) & overview.valid, (share > 1.0 - _SURE) & overview.valid
    colours = log_colours(overview)
    apart = max(2, round(_APART_SHARE * max(share.shape)))
    ratios, shifts = [], []
    for first, second in ((np.s_[:, :-apart], np.s_[:, apart:]), (np.s_[:-apart], np.s_[apart:])):
        for sunny, shady in ((first, second), (second, first)):
            pairs = lit[sunny] & dark[shady]
            ratios.append(log_light[sunny][pairs] - log_light[shady][pairs])
            shifts.append(colours[sunny][pairs] - colours[shady][pairs])
    ratio, shift = np.concatenate(ratios), np.concatenate(shifts)
    if len(ratio) < _LEAST_PAIRS:
        return float(log_light[lit].mean() - log_light[dark].mean()) if lit.any() and dark.any() else 0.0, np.zeros(2)
    usual = np.median(shift, axis=0)
    distance = np.abs(shift - usual).sum(axis=1)
    return float(np.median(ratio[distance <= np.median(distance)])), usual


def gain_field(regions: Regions) -> FloatArray:
    """(h, w) float32 log gain, carried beyond each region's border so that a penumbra has its region's gain."""
    import cv2

    field = regions.log_gain[regions.labels]
    shadow = (regions.labels > 0).astype(np.float32)
    side = 2 * max(2, round(0.006 * max(shadow.shape))) + 1
    weight = cv2.blur(shadow, (side, side))
    carried = cv2.blur(field * shadow, (side, side)) / np.maximum(weight, np.float32(1e-6))
    carried = np.where(weight > 1e-4, carried, regions.log_gain[0])
    return np.where(regions.labels > 0, field, carried).astype(np.float32)


def region_table(regions: Regions, scale: float) -> list[dict[str, Any]]:
    """The largest regions, JSON-ready: box and area in px of the full picture (scale: full / overview), mean light
    (0-1, linear) and gain on light."""
    return [
        {
            "box_px": [round(float(edge) * scale) for edge in regions.boxes_px[idx]],
            "area_px": round(float(regions.area_px[idx]) * scale * scale),
            "light": round(float(regions.light[idx]), 5),
            "gain": round(float(np.exp(regions.log_gain[idx])), 3),
        }
        for idx in range(1, min(len(regions.area_px), MAX_LISTED_REGIONS + 1))
    ]
