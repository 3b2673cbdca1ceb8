"""The LightGlue matcher's network: what it is given of two views, and its answers, pair by pair or in batches.

Conventions of the published SIFT weights: keypoints from the image corner (ours + 0.5), scale = size / 2, orientation
in radians in (-pi, pi], RootSIFT of unit length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.geometry.prediction import ground_places
from aeromatch_cli.nets.descriptor_bytes import from_bytes
from aeromatch_cli.nets.precision import Device, Precision, device_of, layer_type

# Around the keypoints that are left of a view; training takes it from here.
FRAME_PX = 4.0
# Keypoints of both sides that a GPU is given at once: 16 pairs of 2048.
_BATCH_KEYPOINTS = 2**16


@dataclass(frozen=True, eq=False)
class NetworkInput:
    """The keypoints of one view that are compared.

    rows: (N,) of the image's descriptors. points_px: (N, 2) from the corner; size_px: (2,) width, height.
    ground: (N, 2) expected places on the ground, as `nets.lightglue.Side` has them; None where nothing is expected.
    """

    rows: IntArray
    points_px: FloatArray
    scales_px: FloatArray
    orientations_rad: FloatArray
    descriptors: FloatArray
    size_px: FloatArray
    ground: FloatArray | None = None


def network_input(features: Features, view: int, kept: BoolArray, most: int, *, signed: bool = False) -> NetworkInput:
    """Of one view, such keypoints as are `kept` (K,), the strongest `most` of them.

    signed: their descriptors are bytes of values with a sign, as those of learned features.

    What is left of a view has a frame of its own, as in training.
    """
    rows = np.flatnonzero(features.view_idx == view)
    total = len(rows)
    rows = rows[kept[features.descriptor_keypoint_idx[rows]]]
    culled = len(rows) < total
    if len(rows) > most:
        strength = features.responses[features.descriptor_keypoint_idx[rows]]
        rows = np.sort(rows[np.argsort(-strength, kind="stable")[:most]])
    size_px = np.asarray(features.view_sizes_px[view], dtype=np.float32)
    # Sub-pixel refinement can push a point over the border.
    points = np.clip(features.view_keypoints_px[rows].astype(np.float32) + np.float32(COLMAP_OFFSET_PX), 0, size_px)
    if culled and len(rows):
        low = points.min(axis=0) - np.float32(FRAME_PX)
        size_px = points.max(axis=0) + np.float32(FRAME_PX) - low
        points = points - low
    return NetworkInput(
        rows=rows,
        points_px=points,
        scales_px=features.view_size_px[rows].astype(np.float32) / 2.0,
        orientations_rad=wrapped_rad(features.view_orientation_deg[rows]),
        descriptors=_as_float(features.descriptors[rows], signed=signed),
        size_px=size_px,
    )


@dataclass(frozen=True, eq=False)
class LoadedNetwork:
    """The network, ready to run. options: of `LightGlue.match`."""

    network: Any
    calibration: Any
    device: str
    options: dict[str, float]

    def run_network(self, inputs: Sequence[tuple[NetworkInput, NetworkInput]]) -> list[tuple[IntArray, FloatArray]]:
        """Of each pair of views row pairs (M, 2) and their probabilities (M,). On a GPU in batches of similar size."""
        sides = [(self._tensors(shown0), self._tensors(shown1)) for shown0, shown1 in inputs]
        found = self._in_batches(sides) if self.device == "cuda" else [self._alone(pair) for pair in sides]
        return [(pairs.cpu().numpy(), self.calibration.calibrated(scores.cpu().numpy())) for pairs, scores in found]

    def _alone(self, pair: tuple[Any, Any]) -> tuple[Any, Any]:
        found: tuple[Any, Any] = self.network.match(*pair, **self.options)
        return found

    def _in_batches(self, sides: Sequence[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        from aeromatch_cli.nets.lightglue_batch import batches, match_batch

        sizes = [(side0.places.shape[1], side1.places.shape[1]) for side0, side1 in sides]
        found: list[Any] = [None] * len(sides)
        for batch in batches(sizes, _BATCH_KEYPOINTS):
            sides0, sides1 = zip(*(sides[position] for position in batch), strict=True)
            answers = match_batch(self.network, sides0, sides1, **self.options)
            for position, answer in zip(batch, answers, strict=True):
                found[position] = answer
        return found

    def _tensors(self, shown: NetworkInput) -> Any:
        import torch

        from aeromatch_cli.nets.lightglue import Side, normalised

        dimensions = self.network.dimensions
        check_length(dimensions.input_dim, shown.descriptors.shape[1])
        places = normalised(torch.from_numpy(shown.points_px), torch.from_numpy(shown.size_px))
        if dimensions.add_scale_ori:
            more = np.stack([shown.scales_px, shown.orientations_rad], axis=1)
            places = torch.cat([places, torch.from_numpy(more)], dim=1)
        descriptors = torch.from_numpy(np.ascontiguousarray(shown.descriptors))
        ground = None if shown.ground is None else torch.from_numpy(shown.ground)[None]
        return Side(places[None], descriptors[None], ground).to(self.device)


@dataclass(frozen=True)
class NetworkOptions:
    """The matcher's settings that decide what the network returns. path: of the weights."""

    path: str
    precision: Precision
    device: Device
    threshold: float
    depth_confidence: float
    width_confidence: float


def loaded_network(wanted: NetworkOptions) -> LoadedNetwork:
    """The network, built once per process and read anew where the file was replaced."""
    from aeromatch_cli.nets.files import content_stamp

    return _loaded(wanted, content_stamp(Path(wanted.path)))


def check_length(expected: int, given: int) -> None:
    """Raises ConfigError where the weights are for other descriptors."""
    if given != expected:
        raise ConfigError(
            f"these LightGlue weights expect descriptors of length {expected}, the extractor makes {given}; use "
            "weights trained for it"
        )


@lru_cache(maxsize=2)
def _loaded(wanted: NetworkOptions, stamp: tuple[int, int] | None) -> LoadedNetwork:
    from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

    del stamp
    device, path = device_of(wanted.device), Path(wanted.path)
    network = load_lightglue(path, device=device).with_layers_in(layer_type(wanted.precision, device))
    calibration = read_calibration(path)
    options = {name: getattr(wanted, name) for name in ("depth_confidence", "width_confidence")}
    options["threshold"] = calibration.score_of(wanted.threshold)
    return LoadedNetwork(network, calibration, device, options)


def wrapped_rad(angles_deg: FloatArray) -> FloatArray:
    """Radians in (-pi, pi]."""
    degrees = np.asarray(angles_deg, dtype=np.float64)
    return np.deg2rad(180.0 - np.mod(180.0 - degrees, 360.0)).astype(np.float32)


def _as_float(descriptors: NDArray[Any], *, signed: bool) -> FloatArray:
    """float32 descriptors; those stored as bytes (RootSIFT x 512, or signed) regain unit length."""
    if descriptors.dtype != np.uint8:
        return descriptors.astype(np.float32)
    values = from_bytes(descriptors) if signed else descriptors.astype(np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6))


def with_expected_places(
    side0: NetworkInput, side1: NetworkInput, features: tuple[Features, Features], geometry: PairGeometry
) -> tuple[NetworkInput, NetworkInput]:
    """Two views with the places where the poses expect their keypoints on the ground plane: east and south of the first
    one's middle, half of its longer side is 1. Without both attitudes and the ground, or above the horizon, nothing is
    expected.
    """
    pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
    if pose0 is None or pose1 is None or ground_z_m is None:
        return side0, side1
    if pose0.world_rotation is None or pose1.world_rotation is None:
        return side0, side1
    points0_px, points1_px = (
        one.keypoints_px[one.descriptor_keypoint_idx[side.rows]]
        for one, side in zip(features, (side0, side1), strict=True)
    )
    places_m = [
        ground_places(geometry.camera0, pose0, points0_px, ground_z_m),
        ground_places(geometry.camera1, pose1, points1_px, ground_z_m),
    ]
    if not all(len(places) and np.isfinite(places).all() for places in places_m):
        return side0, side1
    middle, half = (places_m[0].max(axis=0) + places_m[0].min(axis=0)) / 2.0, np.ptp(places_m[0], axis=0).max() / 2.0
    if half <= 0.0:
        return side0, side1
    grounds = [((places - middle) * [1.0, -1.0] / half).astype(np.float32) for places in places_m]
    return replace(side0, ground=grounds[0]), replace(side1, ground=grounds[1])
