"""Adaptive shadow enhancement: cast shadow is detected and brightened region by region; nothing else is changed.

Method 1, step 1 of J. Geo-inf. Sci. 2025(6), 1401-1419, where its abstract leaves a choice open: detection by a small
network (nets.shadow), gains on linear light, borders by a guided filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.strategies import Enhanced
from aeromatch_cli.strategies.enhancers.kept_source import KeepsSource
from aeromatch_cli.strategies.enhancers.relight import relit
from aeromatch_cli.strategies.enhancers.shadow_mask import Overview, log_colours, make_overview, shadow_share, soft_mask

MAX_LISTED_REGIONS = 64
# Lit ground and shadow are compared over this distance, as a share of the longer side, from this many pairs on.
_APART_SHARE, _LEAST_PAIRS = 0.008, 30
# A share below this is surely lit, one above its complement surely shadow.
_SURE = 0.2
# What is darker than this light is noise: a mean is never taken below it.
_LEAST_LIGHT = 1e-3


class ShadowEnhancement(KeepsSource):
    """Cast shadow brightened region by region to the light around it; an image without shadow stays unchanged."""

    version: ClassVar[int] = 3
    needs_colour: ClassVar[bool] = True
    name: Literal["shadow"] = "shadow"
    keep_source: bool = Field(True, description=KeepsSource.model_fields["keep_source"].description)
    detection_px: int = Field(
        768,
        ge=64,
        le=4096,
        description="Longer side of the reduced picture in which shadow is detected, pixels. Larger: smaller shadows "
        "are found, more time.",
    )
    max_gain: float = Field(
        6.0,
        ge=1.0,
        le=64.0,
        description="Largest factor by which a shadow region is brightened. Larger: darker shadows become readable, "
        "with more noise.",
    )
    region_exponent: float = Field(
        0.25,
        ge=0.0,
        le=1.0,
        description="Weight (0-1) of a region's own darkness in its gain: 0 = one gain for all regions, 1 = each "
        "region is brought to the mean of all shadows.",
    )
    min_share: float = Field(
        0.02,
        ge=0.0,
        le=1.0,
        description="Smallest share (0-1) of shadow in the image; with less, nothing is changed. Larger: fewer images "
        "are enhanced.",
    )
    min_ratio: float = Field(
        1.3,
        ge=1.0,
        description="Smallest ratio of lit to shadowed light; below it, nothing is changed. Larger: only deep shadow "
        "is enhanced.",
    )
    min_region_share: float = Field(
        3e-5,
        ge=0.0,
        le=1.0,
        description="Smallest region that is enhanced, as a share (0-1) of the image. Larger: small shadows stay as "
        "they are.",
    )

    def fingerprint_files(self) -> tuple[str, ...]:
        """The network's weights, which ship with the package. Raises ConfigError where they are missing."""
        return (str(shipped_path("shadow")),)

    def __call__(self, pixels: NDArray[Any], valid: BoolArray | None) -> Enhanced:
        """pixels (H, W) or (H, W, C) uint8 or uint16 -> the same with shadow lifted; mask 255 = shadow.

        info: shadow_share, start_gain (mean lit / shadow light), region_count, and of the largest regions box_px
        (x, y, width, height), area_px, light, gain.
        """
        overview = make_overview(pixels, valid, self.detection_px)
        soft = soft_mask(overview, shadow_share(overview))
        regions = find_regions(
            overview,
            soft.share,
            exponent=self.region_exponent,
            max_gain=self.max_gain,
            min_area_px=max(4, round(self.min_region_share * soft.share.size)),
        )
        if regions is None or not self._is_shadow(regions, overview.valid):
            mask = np.zeros(pixels.shape[:2], dtype=np.uint8)
            return Enhanced(pixels, mask, {"shadow_share": 0.0, "start_gain": 1.0, "region_count": 0, "regions": []})
        lifted, mask = relit(pixels, valid, soft, regions.labels > 0, gain_field(regions), overview.tone, regions.tint)
        scale = pixels.shape[1] / soft.share.shape[1]
        facts = {
            "shadow_share": round(float(np.count_nonzero(mask)) / mask.size, 5),
            "start_gain": round(regions.start, 3),
            "region_count": len(regions.area_px) - 1,
            "regions": region_table(regions, scale),
        }
        return Enhanced(lifted, mask, facts)

    def _is_shadow(self, regions: Regions, valid: BoolArray) -> bool:
        covered = regions.area_px[1:].sum() / max(1, np.count_nonzero(valid))
        return bool(covered >= self.min_share and regions.start >= self.min_ratio)


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
