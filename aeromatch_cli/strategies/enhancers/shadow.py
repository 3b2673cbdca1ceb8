"""Adaptive shadow enhancement: shadow is found, region by region given the light it lacks, and nothing else changed.

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
    """Shadows lifted to the light around them; a picture without shadow passes unchanged."""

    version: ClassVar[int] = 2
    needs_colour: ClassVar[bool] = True
    name: Literal["shadow"] = "shadow"
    keep_source: bool = Field(True, description=KeepsSource.model_fields["keep_source"].description)
    detection_px: int = Field(768, ge=64, le=4096, description="Longer side at which shadow is looked for.")
    max_gain: float = Field(
        6.0, ge=1.0, le=64.0, description="Most light given to a region, as a factor; a clear sky lacks this much sun."
    )
    region_exponent: float = Field(
        0.25,
        ge=0.0,
        le=1.0,
        description="How far a region's darkness against the other shadows changes its gain: 0 not, 1 to their mean.",
    )
    min_share: float = Field(
        0.02,
        ge=0.0,
        le=1.0,
        description="Share of the picture from which shadow counts; below, nothing is changed: it could add no more.",
    )
    min_ratio: float = Field(
        1.3, ge=1.0, description="Lit over shadowed light from which shadow counts; below, nothing is changed."
    )
    min_region_share: float = Field(
        3e-5, ge=0.0, le=1.0, description="Regions smaller than this share of the picture are left alone."
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
        lifted, mask = relit(pixels, valid, soft, regions.labels > 0, gain_field(regions), overview.tone)
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
