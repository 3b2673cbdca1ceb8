"""Peer `superpoint`, for who has its weights: they may not be passed on, so that none are at hand here."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from aeromatch_cli.errors import ConfigError
from benchmarks.peers.base import Described, Options, Scene, read_gray, read_weights, strongest
from benchmarks.peers.matching import Peer

_WEIGHTS = "superpoint_v1.pth"
CELL_PX = 8  # of a picture that one score vector stands for
_RADIUS_PX = 4  # of non-maximum suppression, and the border without keypoints


class Network(nn.Module):
    """Scores and descriptors of cells of 8 x 8 pixels, by the names of the published weights.

    Source: DeTone, Malisiewicz and Rabinovich, SuperPoint, CVPR workshops 2018, section 3.
    """

    def __init__(self) -> None:
        super().__init__()
        channels = 1
        for number, width in enumerate((64, 64, 128, 128), start=1):
            self.add_module(f"conv{number}a", nn.Conv2d(channels, width, 3, padding=1))
            self.add_module(f"conv{number}b", nn.Conv2d(width, width, 3, padding=1))
            channels = width
        for head, out in (("P", CELL_PX**2 + 1), ("D", 256)):
            self.add_module(f"conv{head}a", nn.Conv2d(channels, 256, 3, padding=1))
            self.add_module(f"conv{head}b", nn.Conv2d(256, out, 1))

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(1, 1, H, W) in 0-1, sides multiples of 8, to (65, H / 8, W / 8) logits and (256, H / 8, W / 8)."""
        layers: Any = self
        x = gray
        for number in range(1, 5):
            for part in "ab":
                x = functional.relu(getattr(layers, f"conv{number}{part}")(x))
            if number < 4:
                x = functional.max_pool2d(x, 2)
        scores = layers.convPb(functional.relu(layers.convPa(x)))
        descriptors = layers.convDb(functional.relu(layers.convDa(x)))
        return scores[0], functional.normalize(descriptors[0], dim=0)


class SuperPoint(Peer):
    """SuperPoint.

    The B strongest maxima, whatever its threshold; no ratio: its users match by mutual neighbours. `superpoint_v1.pth`,
    as its authors published it, is looked for in --reference-weights.
    """

    ratio = None

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.network = Network().eval()
        try:
            self.network.load_state_dict(read_weights(options, _WEIGHTS))
        except RuntimeError as error:
            raise ConfigError(f"{_WEIGHTS} does not hold SuperPoint's published weights: {error}") from None

    def features(self, image: str) -> Described:
        pixels = torch.from_numpy(read_gray(self.scene, image))[None, None].float() / 255.0
        height, width = pixels.shape[2:]
        whole = functional.pad(pixels, (0, -width % CELL_PX, 0, -height % CELL_PX), mode="replicate")
        with torch.inference_mode():
            logits, coarse = self.network(whole)
            places, scores = maxima(logits, width, height)
            order = torch.argsort(scores, descending=True, stable=True)[: self.options.keypoints]
            descriptors = sampled(coarse, places[order])
        return strongest(
            places[order].numpy().astype(np.float64), scores[order].numpy(), descriptors.numpy(), self.options.keypoints
        )


def maxima(logits: torch.Tensor, width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(65, h, w) logits to places (N, 2), x and y of pixels, and probabilities (N,) of the maxima within 4 px.

    The last of the 65 stands for no keypoint in the cell, the others for its pixels row by row.
    """
    heat = functional.pixel_shuffle(logits.softmax(dim=0)[:-1], CELL_PX)
    largest = functional.max_pool2d(heat[None], 2 * _RADIUS_PX + 1, stride=1, padding=_RADIUS_PX)[0]
    inner = torch.zeros_like(heat, dtype=torch.bool)
    inner[:, _RADIUS_PX : height - _RADIUS_PX, _RADIUS_PX : width - _RADIUS_PX] = True
    _, y, x = torch.nonzero((heat == largest) & inner, as_tuple=True)
    return torch.stack([x, y], dim=1), heat[0, y, x]


def sampled(coarse: torch.Tensor, places_px: torch.Tensor) -> torch.Tensor:
    """Unit descriptors (N, C) at places (N, 2) px, bilinear between the centres of the cells of (C, h, w)."""
    sides = torch.tensor([coarse.shape[2], coarse.shape[1]]) * CELL_PX
    grid = (places_px.float() + 0.5) / sides * 2.0 - 1.0
    found = functional.grid_sample(coarse[None], grid[None, None], align_corners=False, padding_mode="border")
    return functional.normalize(found[0, :, 0].T, dim=1)
