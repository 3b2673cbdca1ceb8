"""Orientation of a patch: a small network that was trained only to follow the rotation of the patch.

Supervised by nothing except the known turn between two patches of one place, as histograms over directions: Lee, Jeong
and Cho, Self-supervised learning of image scale and orientation, BMVC 2021. Against a direction that is regressed (Yi
et al., CVPR 2016; Mishkin et al., OriNet, ECCV 2018) a histogram can hold several and settle for one.
scripts/train orientation documents the recipe of the weights that ship.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.loading import load_network, once_per_file
from aeromatch_cli.nets.patches import Convolution, answers, convolutions, in_channels_last, standardised
from aeromatch_cli.nets.precision import Precision

BINS = 36
_QUARTERS = 4
# Channels and stride of the 3 x 3 convolutions: 32 x 32 pixels become 8 x 8.
_LAYERS = ((12, 1), (16, 2), (24, 1), (32, 2), (32, 1))
_LAST_SIDE, _HIDDEN = 8, 48
# Bins on either side of the highest one that its direction is the mean of.
_AROUND = 2


class OrientationNet(nn.Module):
    """Six convolutions and a linear layer that score the directions within 45 degrees of a patch's rows, laid on the
    patch and on its three turns by right angles: a patch turned by a right angle has its scores shifted by a quarter.
    Folded: without batch norm, as it ships. The weights' type is the precision of the layers."""

    def __init__(self, *, folded: bool = False) -> None:
        super().__init__()
        self.layers = convolutions(_LAYERS, folded=folded)
        self.hidden = Convolution(_LAYERS[-1][0], _HIDDEN, _LAST_SIDE, folded=folded)
        self.out = nn.Linear(_HIDDEN, BINS // _QUARTERS)

    def scores(self, patches: Tensor) -> Tensor:
        """(N, 1, 32, 32) gray patches of any type and scale -> (N, 36) float32: logarithms of the probability that the
        patch is to be cut along the direction of each bin, `bin_angles`."""
        x = standardised(patches).to(self.hidden.convolution.weight.dtype)
        # Turned by a right angle against x towards y, contents along 90 degrees lie along the rows.
        quarters = [self._quarter(torch.rot90(x, turns, (2, 3))) for turns in range(_QUARTERS)]
        return functional.log_softmax(torch.cat(quarters, dim=1).float(), dim=1)

    def _quarter(self, x: Tensor) -> Tensor:
        """(N, 1, 32, 32) -> (N, 9)."""
        for layer in self.layers:
            x = functional.relu(layer(x), inplace=True)
        found: Tensor = self.out(functional.relu(self.hidden(x)).flatten(1))
        return found

    def forward(self, patches: Tensor) -> Tensor:
        """(N, 1, 32, 32) gray patches of any type and scale -> (N, 2) float32: cosine and sine of the direction, x
        (rightwards) towards y (downwards), that the patch is to be cut along to be upright: the mean of the bins around
        the highest one."""
        chances = self.scores(patches).exp()
        around = torch.arange(-_AROUND, _AROUND + 1, device=chances.device)
        near = (chances.argmax(dim=1, keepdim=True) + around) % BINS
        angles = torch.deg2rad(bin_angles().to(chances.device)[near])
        weights = chances.gather(1, near)
        mean = torch.stack([(weights * angles.cos()).sum(dim=1), (weights * angles.sin()).sum(dim=1)], dim=1)
        return functional.normalize(mean, dim=1)


def bin_angles() -> Tensor:
    """(36,) degrees of the directions that are scored, x towards y: -40 to 310 in steps of 10."""
    per_quarter = BINS // _QUARTERS
    return (torch.arange(BINS) - per_quarter // 2) * (360.0 / BINS)


@once_per_file
def load_orientation(path: Path | None = None, precision: Precision = "auto", device: str = "cpu") -> OrientationNet:
    """The folded network of a weights file, by default the one that ships, once per process; layers in `precision`.

    Raises ConfigError where the file is missing or holds another.
    """
    path = path or shipped_path("orientation")
    return in_channels_last(load_network(lambda _: OrientationNet(folded=True), path, precision, device))


def directions(patches: NDArray[Any], network: OrientationNet | None = None) -> NDArray[np.float32]:
    """(N, 2) float32 cosine and sine for patches (N, 32, 32), by the shipped network or another.

    A patch cut anew along that direction (`angles_deg` of extractors.pyramid.cut_patches, added to the angle of the
    first cut) looks the same however its place was turned.
    """
    return answers(network or load_orientation(), patches, 2)
