"""LightGlue: an attention network that matches the keypoints of both images jointly, from a weights file.

Every view is matched in its own frame, because the network reads positions, scales and orientations as it saw them
in training. Conventions of the published SIFT weights: keypoints from the image corner (ours + 0.5), scale = size / 2,
orientation in radians in (-pi, pi], RootSIFT of unit length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import Features, FloatArray, IntArray, Matches, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.assignment import one_to_one
from aeromatch_cli.strategies.matchers.views import appearances

if TYPE_CHECKING:
    from aeromatch_cli.nets.lightglue import Dimensions


class LightGlue(Strategy):
    """LightGlue with own weights (Lindenberger et al., ICCV 2023)."""

    name: Literal["lightglue"] = "lightglue"
    weights: str | None = Field(
        None,
        description="Path of a weights file, or its name in the weights folder (`aeromatch weights list`).",
        json_schema_extra={"path": "or name"},
    )
    threshold: float = Field(0.1, ge=0.0, le=1.0, description="Smallest score of a match.")
    depth_confidence: float = Field(0.95, ge=-1.0, le=1.0, description="Early stopping; -1 turns it off.")
    width_confidence: float = Field(0.99, ge=-1.0, le=1.0, description="Point pruning; -1 turns it off.")
    max_keypoints: int = Field(
        4096,
        ge=1,
        description="Strongest descriptors kept per view; memory grows with its square (1.2 GB at 4096).",
    )
    device: Literal["cpu", "auto"] = Field("cpu", description="`auto` takes CUDA where there is one.")

    def fingerprint_files(self) -> tuple[str, ...]:
        """Paths of the files whose SHA-256 belongs to the fingerprint. Raises ConfigError without weights."""
        from aeromatch_cli.nets.weights import resolve_weights

        if self.weights is None:
            raise ConfigError(
                "matcher lightglue needs a weights file: set `match.weights` to its path, or add it with "
                "`aeromatch weights add PATH` and set `match.weights` to its name"
            )
        return (str(resolve_weights(self.weights)),)

    def __call__(self, features0: Features, features1: Features, geometry: PairGeometry) -> Matches:
        """Match every view of image 0 with every view of image 1; one-to-one by best score over all of them.

        The network is symmetric up to rounding, and image_id0 < image_id1 fixes which image comes first, so that the
        order of the files changes nothing. Raises ConfigError where weights are missing or expect other descriptors.
        """
        (path,) = self.fingerprint_files()
        matcher = _matcher(path, _content_stamp(path), self)
        views0 = [self._view(features0, idx) for idx in range(len(features0.view_sizes_px))]
        views1 = [self._view(features1, idx) for idx in range(len(features1.view_sizes_px))]
        found = [_Found.empty()]
        compared = np.any(appearances(features0, features1), axis=0)
        for idx0, view0 in enumerate(views0):
            for idx1, view1 in enumerate(views1):
                if compared[idx0, idx1] and len(view0.points_px) and len(view1.points_px):
                    pairs, scores = matcher.match(view0, view1)
                    indices = np.stack([view0.keypoint_idx[pairs[:, 0]], view1.keypoint_idx[pairs[:, 1]]], axis=1)
                    found.append(_Found(indices, scores, np.full_like(indices, (idx0, idx1))))
        return _merged(found)

    def _view(self, features: Features, view: int) -> _ViewInput:
        rows = np.flatnonzero(features.view_idx == view)
        if len(rows) > self.max_keypoints:
            strength = features.responses[features.descriptor_keypoint_idx[rows]]
            rows = np.sort(rows[np.argsort(-strength, kind="stable")[: self.max_keypoints]])
        size_px = np.asarray(features.view_sizes_px[view], dtype=np.float32)
        points = features.view_keypoints_px[rows].astype(np.float32) + np.float32(COLMAP_OFFSET_PX)
        return _ViewInput(
            keypoint_idx=features.descriptor_keypoint_idx[rows],
            # The network refuses points outside; sub-pixel refinement can push one over the border.
            points_px=np.clip(points, 0.0, size_px),
            scales_px=features.view_size_px[rows].astype(np.float32) / 2.0,
            orientations_rad=_wrapped_rad(features.view_orientation_deg[rows]),
            descriptors=_as_float(features.descriptors[rows]),
            size_px=size_px,
        )


@dataclass(frozen=True, eq=False)
class _ViewInput:
    """One view as the network wants it. points_px: (N, 2) from the corner; size_px: (2,) width, height."""

    keypoint_idx: IntArray
    points_px: FloatArray
    scales_px: FloatArray
    orientations_rad: FloatArray
    descriptors: FloatArray
    size_px: FloatArray


@dataclass(frozen=True, eq=False)
class _Found:
    """Matches of one view pair. indices: (M, 2) keypoints; scores: (M,); views: (M, 2)."""

    indices: IntArray
    scores: FloatArray
    views: IntArray

    @classmethod
    def empty(cls) -> _Found:
        return cls(np.zeros((0, 2), np.int32), np.zeros(0, np.float32), np.zeros((0, 2), np.int32))


@dataclass(frozen=True, eq=False)
class _Matcher:
    network: Any
    dimensions: Dimensions
    device: str

    def match(self, view0: _ViewInput, view1: _ViewInput) -> tuple[IntArray, FloatArray]:
        """Row pairs (M, 2) and scores (M,)."""
        import torch

        with torch.inference_mode():
            result = self.network({"image0": self._tensors(view0), "image1": self._tensors(view1)})
        return result["matches"][0].cpu().numpy(), result["scores"][0].float().cpu().numpy()

    def _tensors(self, view: _ViewInput) -> dict[str, Any]:
        import torch

        length = view.descriptors.shape[1]
        if length != self.dimensions.input_dim:
            raise ConfigError(
                f"these LightGlue weights expect descriptors of length {self.dimensions.input_dim}, the extractor "
                f"makes {length}; use weights trained for it"
            )
        arrays = {"keypoints": view.points_px, "descriptors": view.descriptors, "image_size": view.size_px}
        if self.dimensions.add_scale_ori:
            arrays |= {"scales": view.scales_px, "oris": view.orientations_rad}
        return {key: torch.from_numpy(np.ascontiguousarray(a))[None].to(self.device) for key, a in arrays.items()}


def _content_stamp(path: str) -> tuple[int, int]:
    from pathlib import Path

    status = Path(path).stat()
    return status.st_size, status.st_mtime_ns


@lru_cache(maxsize=2)
def _matcher(path: str, content_stamp: tuple[int, int], recipe: LightGlue) -> _Matcher:
    """The network, built once per process; the stamp makes a replaced file load again."""
    from pathlib import Path

    import torch

    from aeromatch_cli.nets.lightglue import load_lightglue

    device = "cuda" if recipe.device == "auto" and torch.cuda.is_available() else "cpu"
    network, dimensions = load_lightglue(
        Path(path),
        device=device,
        filter_threshold=recipe.threshold,
        depth_confidence=recipe.depth_confidence,
        width_confidence=recipe.width_confidence,
    )
    return _Matcher(network, dimensions, device)


def _wrapped_rad(angles_deg: FloatArray) -> FloatArray:
    """Radians in (-pi, pi]."""
    degrees = np.asarray(angles_deg, dtype=np.float64)
    return np.deg2rad(180.0 - np.mod(180.0 - degrees, 360.0)).astype(np.float32)


def _as_float(descriptors: NDArray[Any]) -> FloatArray:
    """float32 descriptors; stored RootSIFT (uint8, x 512) regains unit length."""
    if descriptors.dtype != np.uint8:
        return descriptors.astype(np.float32)
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1.0)


def _merged(found: list[_Found]) -> Matches:
    """The best-scored matches in which each keypoint occurs once, sorted by keypoint of image 0."""
    indices = np.concatenate([item.indices for item in found])
    scores = np.concatenate([item.scores for item in found])
    views = np.concatenate([item.views for item in found])
    # Equal scores fall to the lower indices, whatever the order in which the network listed them.
    order = np.lexsort((views[:, 1], views[:, 0], indices[:, 1], indices[:, 0]))
    rows = order[one_to_one(indices[order, 0], indices[order, 1], -scores[order])]
    rows = rows[np.argsort(indices[rows, 0], kind="stable")]
    return Matches(
        indices=indices[rows].astype(np.int32),
        scores=scores[rows].astype(np.float32),
        view_pairs=views[rows].astype(np.int16),
    )
