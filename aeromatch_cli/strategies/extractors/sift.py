"""SIFT on every view of an image, with a budget that is exact and spread evenly.

Source: Lowe, IJCV 2004 (SIFT, here OpenCV's); Arandjelovic and Zisserman, CVPR 2012 (RootSIFT).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.described import Described, keypoints_field, pixels_field
from aeromatch_cli.strategies.extractors.detection import (
    SIFT,
    Raw,
    SiftSettings,
    balanced,
    describe,
    detect,
    sift_detector,
)

# Median diameter of the strongest blobs, in pixels of the reduced view over sigma, below which reducing costs too much:
# most are then near the smallest that it shows, 1.1. Rendered grass and farmland have 1.6 and 1.4, and halved views
# cost 11 and 3 % of their correct matches; hills, suburb and desert have 2.1, 2.4 and 3, photographs (ochota,
# caliterra, brighton) 1.7 to 2.9.
_LEAST_BLOB = 1.7


class Sift(Described):
    """SIFT keypoints and RootSIFT descriptors of all views of one image."""

    version: ClassVar[int] = 6
    descriptors: ClassVar[str] = "RootSIFT"
    name: Literal["sift"] = "sift"
    # As many as COLMAP has (8192). Twice as many as before cost 1.1 to 1.4 x the seconds of whole runs (seneca,
    # sheffield, every 3rd image) and give 1.7 to 1.9 x the points.
    keypoints: int = keypoints_field(8000)
    # What halving does to images with so many pixels per keypoint: 1,500 (rendered suburb and hills): 1 and 2 % fewer
    # correct matches in a third of the seconds, errors of 0.25 and 0.27 -> 0.30 and 0.28 px; 1,000 (ochota): 2 % more
    # within 3 px of the reference; 750 (lewis): 4 % fewer; 600 (seneca): 9 % fewer.
    pixels_per_keypoint: float = pixels_field(900.0)
    orientation: Literal["auto", "gradient", "upright"] = Field(
        "auto",
        description="Rotate descriptors to the dominant gradient (gradient), or not at all (upright: one descriptor "
        "per keypoint, orientation 0). auto: upright in views that have north up.",
    )
    contrast_threshold: float = Field(
        SIFT.contrast_threshold,
        gt=0.0,
        description="Smallest contrast of a keypoint, as in OpenCV (divided by octave_layers). Larger: fewer "
        "keypoints on dull ground.",
    )
    edge_threshold: float = Field(
        SIFT.edge_threshold,
        gt=1.0,
        description="Largest ratio of the principal curvatures. Larger: more keypoints along edges.",
    )
    octave_layers: int = Field(
        SIFT.octave_layers, ge=1, description="Number of scales per octave. Larger: more keypoints, more time."
    )
    sigma: float = Field(
        SIFT.sigma,
        gt=0.5,
        description="Blur of the first scale, pixels of the doubled image. Larger: fewer small keypoints.",
    )
    selection: Literal["balanced", "scale", "response"] = Field(
        "balanced",
        description="Which keypoints of a cell are kept first: the largest (scale), those of most contrast "
        "(response), or response x size^2 with sizes up to 6 view pixels (balanced).",
    )

    @property
    def north_up_only(self) -> bool:
        """Upright descriptors of views with north up match no others."""
        return self.orientation == "auto"

    def detected(self, view: ViewPixels, view_idx: int) -> Raw:
        """OpenCV's, one for every orientation of a point unless upright."""
        raw = detect(self._detector(), view, view_idx)
        upright = self.orientation == "upright" or (self.orientation == "auto" and view.view.north_up)
        return raw.upright() if upright else raw

    def suffice(self, raw: Raw, factor: int) -> bool:
        """Enough of them, and most of the strongest larger than the smallest that the reduced views show."""
        if not super().suffice(raw, factor):
            return False
        strongest = np.argsort(-balanced(raw), kind="stable")[: self.keypoints]
        return bool(np.median(raw.sizes_px[strongest]) >= _LEAST_BLOB * self.sigma * factor)

    def described(self, raw: Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
        """RootSIFT bytes (N, 128)."""
        return describe(self._detector(), raw, views)

    def strengths(self, raw: Raw) -> FloatArray:
        """As `selection` says."""
        if self.selection == "scale":
            return raw.sizes_px
        if self.selection == "response":
            return raw.responses
        return balanced(raw)

    def _detector(self) -> Any:
        return sift_detector(SiftSettings(self.contrast_threshold, self.edge_threshold, self.octave_layers, self.sigma))
