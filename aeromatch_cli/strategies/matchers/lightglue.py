"""LightGlue: an attention network that matches the keypoints of both images jointly.

Every view is matched in its own frame, because the network reads positions, scales and orientations as it saw them
in training. Conventions of the published SIFT weights: keypoints from the image corner (ours + 0.5), scale = size / 2,
orientation in radians in (-pi, pi], RootSIFT of unit length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.nets.precision import Device, Precision, device_of, layer_type
from aeromatch_cli.strategies.matchers.assignment import one_to_one
from aeromatch_cli.strategies.matchers.comparison import Comparison, Found, joined
from aeromatch_cli.strategies.matchers.evidence import most_evident
from aeromatch_cli.strategies.matchers.guided import SecondSearch
from aeromatch_cli.strategies.matchers.nearest import Nearest
from aeromatch_cli.strategies.matchers.overlap import in_overlap
from aeromatch_cli.strategies.matchers.search import Search

# Cost at least of matches that are there without the network's having found them, beside those of 1 - probability.
_DOUBTFUL = 0.7
# Where the network sees more than there is, its surest matches alone, or none, support a model better: probabilities.
_SURER = (0.3, 0.5, 0.8)
# Around the keypoints that are left of a view; training takes it from here.
FRAME_PX = 4.0


class LightGlue(Search):
    """LightGlue (Lindenberger et al., ICCV 2023) for the pairs that the mutual ratio test leaves poor.

    Without `weights`, those that ship with the package, trained on aerial images (nets/trained/lightglue.md).
    """

    version: ClassVar[int] = 5
    reads_descriptors: ClassVar[str] = "RootSIFT"
    name: Literal["lightglue"] = "lightglue"
    enough: int = Field(
        250,
        ge=1,
        description="Where the ratio test, and the guided search after it, find so many matches, the network is not "
        "asked: it takes half a second a pair. For it everywhere, raise this and `ample` above `extract.keypoints`.",
    )
    weights: str | None = Field(
        None,
        description="Path of a weights file, or its name in the weights folder (`aeromatch weights list`).",
        json_schema_extra={"path": "or name"},
    )
    threshold: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="Smallest probability of a match of the network's, as far as the weights are calibrated. "
        "Matches of the other searches join whatever it is.",
    )
    overlap: bool = Field(
        True,
        description="Only keypoints that the other image may show are compared, as far as the plane of the matches "
        "found before, or else poses and ground, tell.",
    )
    depth_confidence: float = Field(0.95, ge=-1.0, le=1.0, description="Early stopping; -1 turns it off.")
    width_confidence: float = Field(0.99, ge=-1.0, le=1.0, description="Point pruning; -1 turns it off.")
    max_keypoints: int = Field(
        2048, ge=1, description="Strongest descriptors kept per view; time grows with its square."
    )
    precision: Precision = Field(
        "auto",
        description="Of the network's layers; auto is bfloat16 where the processor has it. Matches "
        "depend on it: name one for shards on different processors.",
    )
    device: Device = Field("cpu", description="`auto` takes CUDA where there is one.")

    def reads(self) -> frozenset[str]:
        """The cameras, in which a pair's matches are judged; more where guided or limited to the overlap."""
        return self.needs if self.guided or self.overlap else frozenset({"camera"})

    def fingerprint_files(self) -> tuple[str, ...]:
        """Path of the file whose SHA-256 belongs to the fingerprint. Raises ConfigError where it is missing."""
        from aeromatch_cli.nets.weights import SHIPPED_LIGHTGLUE, resolve_weights

        if self.weights is not None:
            return (str(resolve_weights(self.weights)),)
        if not SHIPPED_LIGHTGLUE.is_file():
            raise ConfigError(
                "matcher lightglue needs a weights file: set `match.weights` to its path, or add it with "
                "`aeromatch weights add PATH` and set `match.weights` to its name"
            )
        return (str(SHIPPED_LIGHTGLUE),)

    def check_files(self, descriptor_length: int) -> None:
        """Weights that a user names are loaded once; those that ship are `aeromatch weights verify`'s."""
        (path,) = self.fingerprint_files()
        if self.weights is not None:
            from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

            network = load_lightglue(Path(path))
            _check_length(network.dimensions.input_dim, descriptor_length)
            read_calibration(Path(path))

    def scan(self, asked: Comparison) -> Found:
        """The mutual ratio test."""
        return Nearest().scan(asked)

    def look_closer(self, asked: Comparison, found: Found, again: SecondSearch | None) -> Found:
        """Where there are too few: the network's matches and those found before; guided, they lead the search anew."""
        if len(found.rows) >= self.enough:
            return found
        shown = in_overlap(asked, found, self.windows) if self.overlap else None
        closer = self.by_network(asked, shown)
        doubtful = replace(found, costs=np.maximum(found.costs, _DOUBTFUL))
        surer = [joined([closer.take(closer.costs <= 1.0 - least), doubtful]) for least in self._least_probabilities()]
        closer = most_evident(asked, [*surer, doubtful])
        return again(closer, keep=True) if again else closer

    def _least_probabilities(self) -> list[float]:
        return [self.threshold, *(least for least in _SURER if least > self.threshold)]

    def by_network(self, asked: Comparison, shown: tuple[BoolArray, BoolArray] | None = None) -> Found:
        """Matches of all view pairs that are alike, each keypoint once, costs 1 - probability.

        shown: (K0,), (K1,) the keypoints that the other image may show.
        The network is symmetric up to rounding, and image_id0 < image_id1 fixes which image comes first, so that the
        order of the files changes nothing. Raises ConfigError where weights are missing or expect other descriptors.
        """
        (path,) = self.fingerprint_files()
        matcher = _matcher(path, _content_stamp(path), self)
        if shown is None:
            shown = np.ones(len(asked.features0.keypoints_px), bool), np.ones(len(asked.features1.keypoints_px), bool)
        shown0, shown1 = shown
        parts = []
        for view0, view1 in np.argwhere(asked.alike):
            side0 = self._view(asked.features0, int(view0), shown0)
            side1 = self._view(asked.features1, int(view1), shown1)
            if len(side0.rows) and len(side1.rows):
                pairs, scores = matcher.match(side0, side1)
                parts.append(Found(side0.rows[pairs[:, 0]], side1.rows[pairs[:, 1]], 1.0 - scores))
        found = asked.within(joined(parts))
        return found.take(one_to_one(*asked.keypoints(found), found.costs))

    def _view(self, features: Features, view: int, shown: BoolArray) -> _Side:
        rows = np.flatnonzero(features.view_idx == view)
        total = len(rows)
        rows = rows[shown[features.descriptor_keypoint_idx[rows]]]
        culled = len(rows) < total
        if len(rows) > self.max_keypoints:
            strength = features.responses[features.descriptor_keypoint_idx[rows]]
            rows = np.sort(rows[np.argsort(-strength, kind="stable")[: self.max_keypoints]])
        size_px = np.asarray(features.view_sizes_px[view], dtype=np.float32)
        # Sub-pixel refinement can push a point over the border.
        points = np.clip(features.view_keypoints_px[rows].astype(np.float32) + np.float32(COLMAP_OFFSET_PX), 0, size_px)
        if culled and len(rows):
            low = points.min(axis=0) - np.float32(FRAME_PX)
            size_px = points.max(axis=0) + np.float32(FRAME_PX) - low
            points = points - low
        return _Side(
            rows=rows,
            points_px=points,
            scales_px=features.view_size_px[rows].astype(np.float32) / 2.0,
            orientations_rad=wrapped_rad(features.view_orientation_deg[rows]),
            descriptors=_as_float(features.descriptors[rows]),
            size_px=size_px,
        )


@dataclass(frozen=True, eq=False)
class _Side:
    """The keypoints of one view that are compared.

    rows: (N,) of the image's descriptors. points_px: (N, 2) from the corner; size_px: (2,) width, height.
    """

    rows: IntArray
    points_px: FloatArray
    scales_px: FloatArray
    orientations_rad: FloatArray
    descriptors: FloatArray
    size_px: FloatArray


@dataclass(frozen=True, eq=False)
class _Matcher:
    network: Any
    calibration: Any
    device: str
    options: dict[str, float]

    def match(self, side0: _Side, side1: _Side) -> tuple[IntArray, FloatArray]:
        """Row pairs (M, 2) and their probabilities (M,)."""
        pairs, scores = self.network.match(self._tensors(side0), self._tensors(side1), **self.options)
        return pairs.cpu().numpy(), self.calibration.calibrated(scores.cpu().numpy())

    def _tensors(self, side: _Side) -> Any:
        import torch

        from aeromatch_cli.nets.lightglue import Side, normalised

        dimensions = self.network.dimensions
        _check_length(dimensions.input_dim, side.descriptors.shape[1])
        places = normalised(torch.from_numpy(side.points_px), torch.from_numpy(side.size_px))
        if dimensions.add_scale_ori:
            more = np.stack([side.scales_px, side.orientations_rad], axis=1)
            places = torch.cat([places, torch.from_numpy(more)], dim=1)
        descriptors = torch.from_numpy(np.ascontiguousarray(side.descriptors))
        return Side(places[None].to(self.device), descriptors[None].to(self.device))


def _check_length(expected: int, given: int) -> None:
    if given != expected:
        raise ConfigError(
            f"these LightGlue weights expect descriptors of length {expected}, the extractor makes {given}; use "
            "weights trained for it"
        )


def _content_stamp(path: str) -> tuple[int, int]:
    status = Path(path).stat()
    return status.st_size, status.st_mtime_ns


@lru_cache(maxsize=2)
def _matcher(path: str, content_stamp: tuple[int, int], recipe: LightGlue) -> _Matcher:
    """The network, built once per process; the stamp makes a replaced file load again."""
    from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

    device = device_of(recipe.device)
    network = load_lightglue(Path(path), device=device).with_layers_in(layer_type(recipe.precision, device))
    calibration = read_calibration(Path(path))
    options = {name: getattr(recipe, name) for name in ("depth_confidence", "width_confidence")}
    options["threshold"] = calibration.score_of(recipe.threshold)
    return _Matcher(network, calibration, device, options)


def wrapped_rad(angles_deg: FloatArray) -> FloatArray:
    """Radians in (-pi, pi]."""
    degrees = np.asarray(angles_deg, dtype=np.float64)
    return np.deg2rad(180.0 - np.mod(180.0 - degrees, 360.0)).astype(np.float32)


def _as_float(descriptors: NDArray[Any]) -> FloatArray:
    """float32 descriptors; stored RootSIFT (uint8, x 512) regains unit length."""
    if descriptors.dtype != np.uint8:
        return descriptors.astype(np.float32)
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1.0)
