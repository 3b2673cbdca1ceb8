"""SIFT on every view of an image, with a budget that is exact and spread evenly.

Source: Lowe, IJCV 2004 (SIFT, here OpenCV's); Arandjelovic and Zisserman, CVPR 2012 (RootSIFT).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import Camera, Features, FloatArray, IntArray
from aeromatch_cli.strategies import Strategy, ViewPixels
from aeromatch_cli.strategies.extractors.detection import Raw, concatenate, describe, detect, in_source
from aeromatch_cli.strategies.extractors.merging import merge_keypoints
from aeromatch_cli.strategies.extractors.selection import distinct, even_selection

# Answers this close, at sizes within a factor of two, are one blob.
_SAME_BLOB_PX = 2.0
# Up to this size a larger blob is found again more surely, because noise averages out over it; beyond, relief and
# perspective cost as much as that gains (share of keypoints found again in rendered pairs, by size).
_STABLE_SIZE_PX = 6.0


class Sift(Strategy):
    """SIFT keypoints and RootSIFT descriptors of all views of one image."""

    version: ClassVar[int] = 3
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    descriptor_length: ClassVar[int] = 128
    name: Literal["sift"] = "sift"
    keypoints: int = Field(
        4000,
        ge=1,
        description="Descriptors per image over all its views: exactly so many, fewer only where fewer exist. "
        "As in OpenCV and COLMAP, a point with two orientations counts twice. Where an enhancement "
        "works beside the source, so many in each.",
    )
    budget: Literal["image", "view"] = Field(
        "image", description="What `keypoints` is for: the whole image over all its views, or each view by itself."
    )
    orientation: Literal["auto", "gradient", "upright"] = Field(
        "auto",
        description="Turn descriptors to their gradients, or never (upright: one descriptor per point, orientation 0); "
        "auto is upright in views whose axes follow the world's.",
    )
    contrast_threshold: float = Field(
        0.004,
        gt=0.0,
        description="Smallest contrast, divided by octave_layers inside; so low that dull ground fills its budget too.",
    )
    edge_threshold: float = Field(10.0, gt=1.0, description="Largest ratio of the two curvatures.")
    octave_layers: int = Field(3, ge=1, description="Scales per octave.")
    sigma: float = Field(1.6, gt=0.5, description="Blur of the first scale, pixels of the doubled image.")
    selection: Literal["balanced", "scale", "response"] = Field(
        "balanced",
        description="What a cell gives first: the largest, the most contrasted, or response x size^2, sizes up to 6 "
        "view pixels (balanced).",
    )
    colours: bool = Field(False, description="Keep the colour around every keypoint; the filter `colour` reads it.")
    per_cell: int = Field(200, ge=1, description="Keypoints per cell of the even spread; larger is less even.")

    @property
    def follows_north(self) -> bool:
        """Upright descriptors of views with north up match no others."""
        return self.orientation == "auto"

    def with_room_for(self, views: int) -> Sift:
        """With as many descriptors more for further views of an image."""
        return self.model_copy(update={"keypoints": self.keypoints * (1 + views)}) if self.budget == "image" else self

    def __call__(self, camera: Camera, views: Sequence[ViewPixels]) -> Features:
        """Features of one image, merged over its views; empty arrays of the right shapes where nothing was found."""
        # Detect, select, describe: describing every point of a forest costs more than detecting it.
        detector = self._detector()
        found = [in_source(camera, view, self._found(detector, view, index)) for index, view in enumerate(views)]
        raw = concatenate([self._cut(found, views, group) for group in self._groups(views)])
        keypoint_idx, standing = merge_keypoints(raw.source_px, raw.source_sizes_px, raw.view_idx)
        points = raw.take(standing)
        order = np.argsort(keypoint_idx, kind="stable")  # descriptors of one keypoint side by side
        raw, numbers = raw.take(order), keypoint_idx[order].astype(np.int32)
        return _features(points, raw, numbers, describe(detector, raw, views), views)

    def _found(self, detector: Any, view: ViewPixels, view_idx: int) -> Raw:
        """All features of one view, each blob once."""
        raw = detect(detector, view, view_idx)
        if self.orientation == "upright" or (self.orientation == "auto" and view.view.north_up):
            raw = raw.upright()
        starts = raw.starts()
        points = raw.take(starts)
        keep = distinct(points.points_px, points.sizes_px, self._strengths(points), _SAME_BLOB_PX)
        return raw.take(keep[np.cumsum(starts) - 1])

    def _groups(self, views: Sequence[ViewPixels]) -> list[list[int]]:
        """Indices of the views that share a budget: those of the picture as taken, and of the enhanced one, if any."""
        if self.budget == "view":
            return [[index] for index in range(len(views))]
        groups = [[i for i, item in enumerate(views) if item.view.enhanced is enhanced] for enhanced in (False, True)]
        return [group for group in groups if group]

    def _cut(self, found: Sequence[Raw], views: Sequence[ViewPixels], group: Sequence[int]) -> Raw:
        """The features of a group of views that the budget buys."""
        raw = concatenate([found[index] for index in group])
        within = np.searchsorted(group, raw.view_idx)
        shown, strengths = [views[index] for index in group], self._strengths(raw)
        return raw.take(even_selection(shown, within, raw.points_px, strengths, self.keypoints, self.per_cell))

    def _strengths(self, raw: Raw) -> FloatArray:
        if self.selection == "scale":
            return raw.sizes_px
        if self.selection == "response":
            return raw.responses
        return raw.responses * np.minimum(raw.sizes_px, _STABLE_SIZE_PX) ** 2

    def _detector(self) -> Any:
        import cv2

        return cv2.SIFT.create(
            nfeatures=0,
            nOctaveLayers=self.octave_layers,
            contrastThreshold=self.contrast_threshold,
            edgeThreshold=self.edge_threshold,
            sigma=self.sigma,
            descriptorType=cv2.CV_8U,
            enable_precise_upscale=True,  # without it every keypoint is off by a quarter pixel
        )


def _features(
    points: Raw, described: Raw, numbers: IntArray, descriptors: NDArray[np.uint8], views: Sequence[ViewPixels]
) -> Features:
    return Features(
        keypoints_px=points.source_px.astype(np.float32),
        sizes_px=points.source_sizes_px,
        responses=points.responses,
        descriptors=descriptors,
        descriptor_keypoint_idx=numbers,
        view_idx=described.view_idx,
        view_keypoints_px=described.points_px,
        view_size_px=described.sizes_px,
        view_orientation_deg=described.orientations_deg,
        view_sizes_px=np.array([(v.view.width_px, v.view.height_px) for v in views], np.int32).reshape(-1, 2),
        view_angles_deg=np.array([v.view.angle_deg for v in views], np.float32),
        view_directions=np.array([_or_nan(v.view.world_direction, 3) for v in views], np.float32).reshape(-1, 3),
        view_gsd_m=np.array([_or_nan(v.view.gsd_m) for v in views], np.float32).reshape(-1),
        view_enhanced=np.array([v.view.enhanced for v in views], bool),
    )


def _or_nan(value: FloatArray | float | None, length: int = 1) -> FloatArray:
    return np.full(length, np.nan) if value is None else np.asarray(value, np.float64).reshape(length)
