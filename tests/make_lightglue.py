"""Small LightGlue networks of seeded random weights, a stand-in for one, and SIFT-like features for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from aeromatch_cli.data import Features
from aeromatch_cli.nets.lightglue import Dimensions, LightGlue, Side
from aeromatch_cli.nets.lightglue_file import Calibration
from aeromatch_cli.strategies.matchers.lightglue import inference
from aeromatch_cli.strategies.matchers.lightglue import matcher as lightglue

SIFT = Dimensions(input_dim=128, descriptor_dim=64, n_layers=3, num_heads=2, add_scale_ori=True)


def seeded_tensors(dimensions: Dimensions) -> dict[str, Tensor]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        state = LightGlue(dimensions).state_dict()
        random = {key: torch.randn_like(value) * 0.1 for key, value in state.items()}
    # Close to the identity, so that similar descriptors match; attention that heeds positions.
    for key, value in random.items():
        if "final_proj.weight" in key or key == "input_proj.weight":
            value += 5.0 * torch.eye(*value.shape)
        if "matchability.bias" in key:
            value += 4.0
        if key == "posenc.Wr.weight" or "Wqkv.weight" in key:
            value *= 5.0
    return random | {"confidence_thresholds": torch.full((dimensions.n_layers,), 0.9)}


def write(path: Path, tensors: dict[str, Tensor]) -> Path:
    torch.save(tensors, path)
    return path


def features(count: int, seed: int = 0) -> Features:
    """SIFT-like features of one view, one descriptor per keypoint. Same seed, same features."""
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(0, [639, 479], (count, 2)).astype(np.float32)
    descriptors = np.minimum(rng.gamma(0.4, 60.0, (count, 128)), 255).astype(np.uint8)
    sizes = rng.uniform(2, 12, count).astype(np.float32)
    return Features(
        keypoints_px=keypoints,
        sizes_px=sizes,
        responses=rng.uniform(0, 1, count).astype(np.float32),
        descriptors=descriptors,
        descriptor_keypoint_idx=np.arange(count, dtype=np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=keypoints,
        view_size_px=sizes,
        view_orientation_deg=rng.uniform(0, 360, count).astype(np.float32),
        view_sizes_px=np.array([[640, 480]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )


class Answers:
    """Stands for the network: keeps what it is given, and answers the first keypoints with each other."""

    def __init__(self, scores: tuple[float, ...] = (), dimensions: Dimensions = SIFT) -> None:
        self.scores, self.dimensions = scores, dimensions
        self.given: list[tuple[Side, Side, dict[str, float]]] = []

    def match(self, side0: Side, side1: Side, **options: float) -> tuple[Tensor, Tensor]:
        self.given.append((side0, side1, options))
        rows = torch.arange(len(self.scores))
        return torch.stack([rows, rows], dim=1), torch.tensor(self.scores)


def stand_in(monkeypatch: pytest.MonkeyPatch, network: Answers) -> None:
    """The matcher asks this instead of its weights."""
    monkeypatch.setattr(
        lightglue, "loaded_network", lambda _: inference.LoadedNetwork(network, Calibration(), "cpu", {})
    )
