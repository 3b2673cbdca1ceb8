"""What extractors of described keypoints share: every view's features, a budget that is exact and spread evenly."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import Camera, Features, FloatArray, IntArray
from aeromatch_cli.strategies import Strategy, ViewPixels
from aeromatch_cli.strategies.extractors.detection import Raw, concatenate, in_source
from aeromatch_cli.strategies.extractors.reduction import factor_for, in_reduced_views, in_whole_views, reduced
from aeromatch_cli.strategies.extractors.selection import distinct, even_selection, merge_keypoints

# Answers this close, at sizes within a factor of two, are one blob.
_SAME_BLOB_PX = 2.0


def keypoints_field(default: int) -> Any:
    """The setting `keypoints` of one strategy: those that are fast to make have more."""
    return Field(
        default,
        ge=1,
        description="Number of descriptors per image over all its views; fewer only where fewer are found, in the "
        "halved image where it is halved. A keypoint with two orientations counts twice, as in OpenCV and COLMAP. With "
        "enhance.keep_source the source image and the enhanced one have this number each; distant ground "
        "(simulate.far_ground) has as many more for each pixel, this number at most. Larger: more matches, more time.",
    )


def pixels_field(default: float) -> Any:
    """The setting `pixels_per_keypoint` of one strategy."""
    return Field(
        default,
        ge=0.0,
        description="Views are halved before keypoints are looked for, while the image has more pixels per wanted "
        "keypoint than this. SIFT goes back to a larger size where it finds too few keypoints in the halved view, or "
        "mostly very small ones. 0: never halved. Smaller: less time, keypoints less accurate.",
    )


class Described(Strategy):
    """Keypoints and descriptors of all views of one image: detect, select, describe.

    Describing every point of a forest costs more than detecting it.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    descriptor_length: ClassVar[int] = 128
    name: str  # a strategy's own, first in every listing
    keypoints: int = keypoints_field(4000)
    budget: Literal["image", "view"] = Field(
        "image", description="Whether keypoints is the number per image, over all its views, or per view."
    )
    per_cell: int = Field(
        200,
        ge=1,
        description="Number of keypoints per cell of the grid by which they are spread. Larger: fewer cells, less "
        "even.",
    )
    pixels_per_keypoint: float = pixels_field(0.0)
    colours: bool = Field(False, description="Keep the colour around every keypoint; filter=colour needs it.")

    @abstractmethod
    def detected(self, view: ViewPixels, view_idx: int) -> Raw:
        """All features of one view, away from its mask, those of one point side by side; places in the view's frame."""

    def turned(self, raw: Raw, views: Sequence[ViewPixels]) -> Raw:
        """With orientations, where detection left them to be found for the chosen ones alone."""
        del views
        return raw

    def suffice(self, raw: Raw, factor: int) -> bool:
        """Whether features (N,) that were found in views reduced by a factor, in the frames of the whole ones, make
        finer views needless."""
        del factor
        return len(raw.view_idx) >= self.keypoints

    @abstractmethod
    def described(self, raw: Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
        """Descriptors (N, descriptor_length) of the features."""

    @abstractmethod
    def strengths(self, raw: Raw) -> FloatArray:
        """What a cell of the even spread gives first, (N,)."""

    @property
    @abstractmethod
    def north_up_only(self) -> bool:
        """Whether descriptors of views with north up match no others."""

    def with_extra_views(self, views: int) -> Described:
        """With as many descriptors more for further views of an image, which are reduced as those of other images."""
        more = {
            "keypoints": self.keypoints * (1 + views),
            "pixels_per_keypoint": self.pixels_per_keypoint / (1 + views),
        }
        return self.model_copy(update=more) if self.budget == "image" else self

    def __call__(self, camera: Camera, views: Sequence[ViewPixels]) -> Features:
        """Features of one image, merged over its views; empty arrays of the right shapes where nothing was found."""
        found, small, factors = self._looked_for(camera, views)
        raw = concatenate([
            self._cut(found, views, part, self._wanted(camera, views, part))
            for group in self._groups(views)
            for part in _near_and_far(views, group)
        ])  # fmt: skip
        turned = self.turned(in_reduced_views(raw, factors[raw.view_idx]), small)
        raw = replace(raw, orientations_deg=turned.orientations_deg)
        keypoint_idx, standing = merge_keypoints(raw.source_px, raw.source_sizes_px, raw.view_idx, int(factors.max()))
        points = raw.take(standing)
        order = np.argsort(keypoint_idx, kind="stable")  # descriptors of one keypoint side by side
        raw, numbers = raw.take(order), keypoint_idx[order].astype(np.int32)
        descriptors = self.described(in_reduced_views(raw, factors[raw.view_idx]), small)
        return _features(points, raw, numbers, descriptors, views)

    def _looked_for(self, camera: Camera, views: Sequence[ViewPixels]) -> tuple[list[Raw], list[ViewPixels], IntArray]:
        """All features of every view, the reduced views that they were found in, and by how much each was reduced (V,):
        less where the features of the reduced views of a budget do not `suffice`."""
        found, small, factors = dict[int, Raw](), list(views), np.ones(len(views), np.int64)
        for group in self._groups(views):
            # Distant ground does not tell, or images would be reduced by how much of it they show.
            nearest = _near_and_far(views, group)[-1]
            factor = factor_for(camera, [views[i] for i in group], self.keypoints, self.pixels_per_keypoint)
            while True:
                for index in group:
                    small[index] = reduced(views[index], factor)
                    found[index] = in_source(camera, views[index], self._found(small[index], factor, index))
                if factor == 1 or self.suffice(concatenate([found[index] for index in nearest]), factor):
                    break
                factor //= 2
            factors[group] = factor
        return [found[index] for index in range(len(views))], small, factors

    def _found(self, view: ViewPixels, factor: int, view_idx: int) -> Raw:
        """All features of one view, which is reduced by a factor, each blob once, in the frame of the whole view."""
        raw = self.detected(view, view_idx)
        raw = in_whole_views(raw, np.full(len(raw.view_idx), factor))
        starts = raw.starts()
        points = raw.take(starts)
        keep = distinct(points.points_px, points.sizes_px, self.strengths(points), _SAME_BLOB_PX * factor)
        return raw.take(keep[np.cumsum(starts) - 1])

    def _groups(self, views: Sequence[ViewPixels]) -> list[list[int]]:
        """Indices of the views that share a budget: those of the picture as taken, and of the enhanced one, if any."""
        if self.budget == "view":
            return [[index] for index in range(len(views))]
        taken = [i for i, item in enumerate(views) if not item.view.enhanced]
        enhanced = [i for i, item in enumerate(views) if item.view.enhanced]
        return [group for group in (taken, enhanced) if group]

    def _wanted(self, camera: Camera, views: Sequence[ViewPixels], group: Sequence[int]) -> int:
        """The budget of a group of views: distant ground has its own, as large as the others' for each pixel."""
        far = views[group[0]]
        if self.budget == "view" or far.view.beyond is None or far.valid is None:
            return self.keypoints
        far_px = far.valid.sum() * far.view.undistorted_from_view[0, 0] ** 2
        return round(self.keypoints * min(far_px / max(camera.width_px * camera.height_px - far_px, 1), 1.0))

    def _cut(self, found: Sequence[Raw], views: Sequence[ViewPixels], group: Sequence[int], budget: int) -> Raw:
        """The features of a group of views that the budget buys."""
        raw = concatenate([found[index] for index in group])
        within = np.searchsorted(group, raw.view_idx)
        shown, strengths = [views[index] for index in group], self.strengths(raw)
        return raw.take(even_selection(shown, within, raw.points_px, strengths, budget, self.per_cell))


def _near_and_far(views: Sequence[ViewPixels], group: Sequence[int]) -> list[list[int]]:
    """A group of views in two, that of distant ground first."""
    far = [i for i in group if views[i].view.beyond is not None]
    near = [i for i in group if views[i].view.beyond is None]
    return [part for part in (far, near) if part]


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
