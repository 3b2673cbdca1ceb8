"""Adaptive shadow enhancement: cast shadow is detected and brightened region by region; nothing else is changed.

Method 1, step 1 of J. Geo-inf. Sci. 2025(6), 1401-1419, where its abstract leaves a choice open: detection by a small
network (nets.shadow), gains on linear light, borders by a guided filter.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.strategies import Enhanced
from aeromatch_cli.strategies.enhancers.kept_source import KeepsSource
from aeromatch_cli.strategies.enhancers.relight import relit
from aeromatch_cli.strategies.enhancers.shadow_mask import make_overview, shadow_share, soft_mask
from aeromatch_cli.strategies.enhancers.shadow_regions import Regions, find_regions, gain_field, region_table


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
