"""GeoDesc: descriptors of 32 x 32 patches by the L2-Net architecture, or by a smaller one that answers alike.

Sources: Tian, Fan and Wu, L2-Net, CVPR 2017 (architecture); Mishchuk et al., HardNet, NeurIPS 2017 (training with the
hardest negatives of a batch); Luo et al., GeoDesc, ECCV 2018 (batches that know the geometry). The small one is trained
beside the large one, as in Hinton, Vinyals and Dean, Distilling the knowledge in a neural network, 2015.
scripts/train descriptor documents the recipe of the weights that ship.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.loading import load_network, once_per_file
from aeromatch_cli.nets.patches import Convolution, answers, convolutions, in_channels_last, standardised
from aeromatch_cli.nets.precision import Precision

LENGTH = 128
# Channels and stride of the 3 x 3 convolutions: 32 x 32 pixels become 8 x 8. Large is L2-Net with 39 million
# multiplications a patch. Small has half the channels and gives up resolution a layer earlier: 10 million.
Size = Literal["large", "small"]
_LAYERS: Mapping[Size, tuple[tuple[int, int], ...]] = MappingProxyType({
    "large": ((32, 1), (32, 1), (64, 2), (64, 1), (128, 2), (128, 1)),
    "small": ((16, 1), (32, 2), (32, 1), (64, 2), (64, 1), (64, 1)),
})  # fmt: skip
_LAST_SIDE = 8
# The tensor that tells them apart.
_FIRST = "layers.0.convolution.weight"


class GeoDesc(nn.Module):
    """Seven convolutions; folded: without batch norm, as it ships. The weights' type is the precision of the layers."""

    def __init__(self, size: Size, *, folded: bool = False) -> None:
        super().__init__()
        layers = _LAYERS[size]
        self.layers = convolutions(layers, folded=folded)
        self.last = Convolution(layers[-1][0], LENGTH, _LAST_SIDE, folded=folded)

    def forward(self, patches: Tensor) -> Tensor:
        """(N, 1, 32, 32) gray patches of any type and scale -> (N, 128) float32 of unit length."""
        x = standardised(patches).to(self.last.convolution.weight.dtype)
        for layer in self.layers:
            x = functional.relu(layer(x), inplace=True)
        return functional.normalize(self.last(x).flatten(1).float(), dim=1)


@once_per_file
def load_geodesc(path: Path | None = None, precision: Precision = "auto", device: str = "cpu") -> GeoDesc:
    """The folded network of a weights file, by default the one that ships, once per process; layers in `precision`.

    Of either size. Raises ConfigError where the file is missing or holds another.
    """
    return in_channels_last(load_network(_fitting, path or shipped_path("geodesc"), precision, device))


def _fitting(tensors: Mapping[str, Tensor]) -> GeoDesc:
    """A network of the size that the tensors have."""
    first = tensors.get(_FIRST)
    small = first is not None and len(first) == _LAYERS["small"][0][0]
    return GeoDesc("small" if small else "large", folded=True)


def describe(patches: NDArray[Any], network: GeoDesc | None = None) -> NDArray[np.float32]:
    """(N, 128) float32 of unit length for patches (N, 32, 32), uint8 or float, by the shipped network or another."""
    return answers(network or load_geodesc(), patches, LENGTH)
