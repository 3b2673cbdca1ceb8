"""Descriptors with context."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.nets.precision import Precision
from aeromatch_cli.strategies.extractors.detection import Raw


def with_context(
    descriptors: NDArray[np.float32],
    raw: Raw,
    gray: NDArray[np.uint8],
    network: Any = None,
    precision: Precision = "auto",
) -> NDArray[np.float32]:
    """The descriptors (N, 128) of one view (H, W), those of features `raw`, with what is around them.

    network: a Context, by default the one that ships; computed where it is.
    """
    import torch

    from aeromatch_cli.nets.context import load_context
    from aeromatch_cli.nets.precision import layer_type

    network = network or load_context()
    device = next(network.parameters()).device.type
    half = layer_type(precision, device) == torch.bfloat16
    inputs = [values.to(device) for values in context_inputs(descriptors, raw, gray)]
    with torch.inference_mode(), torch.autocast(device, torch.bfloat16, enabled=half):
        found = network(*inputs)
    return np.asarray(found.float().cpu().numpy())


def coarse_of(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A view (H, W) as the context network sees it: area means, REDUCED times smaller, no side below 8 pixels."""
    import cv2

    from aeromatch_cli.nets.context import REDUCED

    height, width = gray.shape
    small = max(8, width // REDUCED), max(8, height // REDUCED)
    return np.asarray(cv2.resize(gray, small, interpolation=cv2.INTER_AREA), np.uint8)


def context_inputs(descriptors: NDArray[np.float32], raw: Raw, gray: NDArray[np.uint8]) -> tuple[Any, ...]:
    """Inputs of `nets.context.Context` for features (N,) of one view (H, W): tensors in its order."""
    height, width = gray.shape
    return context_inputs_of_coarse(descriptors, raw, coarse_of(gray), (width, height))


def context_inputs_of_coarse(
    descriptors: NDArray[np.float32], raw: Raw, coarse: NDArray[np.uint8], size_px: tuple[int, int]
) -> tuple[Any, ...]:
    """The same of a view of this width and height whose coarse picture is there."""
    import torch
    from scipy.spatial import cKDTree

    from aeromatch_cli.nets.context import NEIGHBOURS, layout_of

    points = raw.points_px.astype(np.float32)
    count = min(NEIGHBOURS + 1, len(points))
    near = np.asarray(cKDTree(points).query(points, k=count)[1]).reshape(len(points), count)[:, 1:]
    # Few keypoints: the last neighbour again, or the keypoint itself.
    near = near if near.shape[1] else np.arange(len(points))[:, None]
    near = np.pad(near, ((0, 0), (0, NEIGHBOURS - near.shape[1])), mode="edge")
    shrunk = np.array(coarse.shape[::-1], np.float32) / np.array(size_px, np.float32)
    places = (points + np.float32(0.5)) * shrunk - np.float32(0.5)
    neighbours = torch.from_numpy(near.astype(np.int64))
    angles = torch.from_numpy(np.deg2rad(raw.orientations_deg).astype(np.float32))
    sizes = torch.from_numpy(raw.sizes_px.astype(np.float32))
    layout = layout_of(torch.from_numpy(points), sizes, angles, neighbours)
    picture = torch.from_numpy(coarse.astype(np.float32) / np.float32(255.0))[None, None]
    places_there = torch.from_numpy(places.astype(np.float32))
    return torch.from_numpy(descriptors.astype(np.float32)), places_there, layout, neighbours, picture
