"""GeoDesc: descriptors of 32 x 32 patches by the L2-Net architecture.

Sources: Tian, Fan and Wu, L2-Net, CVPR 2017 (architecture); Mishchuk et al., HardNet, NeurIPS 2017 (training with the
hardest negatives of a batch); Luo et al., GeoDesc, ECCV 2018 (batches that know the geometry).
scripts/train descriptor documents the recipe of the weights that ship.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.loading import load_network, once_per_file
from aeromatch_cli.nets.patches import Convolution, answers, convolutions, in_channels_last, standardised
from aeromatch_cli.nets.precision import Precision

LENGTH = 128
# Channels and stride of the 3 x 3 convolutions: 32 x 32 pixels become 8 x 8.
_LAYERS = ((32, 1), (32, 1), (64, 2), (64, 1), (128, 2), (128, 1))
_LAST_SIDE = 8


class GeoDesc(nn.Module):
    """Seven convolutions; folded: without batch norm, as it ships. The weights' type is the precision of the layers."""

    def __init__(self, *, folded: bool = False) -> None:
        super().__init__()
        self.layers = convolutions(_LAYERS, folded=folded)
        self.last = Convolution(_LAYERS[-1][0], LENGTH, _LAST_SIDE, folded=folded)

    def forward(self, patches: Tensor) -> Tensor:
        """(N, 1, 32, 32) gray patches of any type and scale -> (N, 128) float32 of unit length."""
        x = standardised(patches).to(self.last.convolution.weight.dtype)
        for layer in self.layers:
            x = functional.relu(layer(x), inplace=True)
        return functional.normalize(self.last(x).flatten(1).float(), dim=1)


@once_per_file
def load_geodesc(path: Path | None = None, precision: Precision = "auto", device: str = "cpu") -> GeoDesc:
    """The folded network of a weights file, by default the one that ships, once per process; layers in `precision`.

    Raises ConfigError where the file is missing or holds another.
    """
    make = partial(GeoDesc, folded=True)
    return in_channels_last(load_network(make, path or shipped_path("geodesc"), precision, device))


def describe(patches: NDArray[Any], network: GeoDesc | None = None) -> NDArray[np.float32]:
    """(N, 128) float32 of unit length for patches (N, 32, 32), uint8 or float, by the shipped network or another."""
    return answers(network or load_geodesc(), patches, LENGTH)
