"""What the networks that look at patches share: standardised input, convolutions that fold, batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from aeromatch_cli.nets.loading import Network

SIDE_PX = 32
# Patches at once: what a layer answers to so many stays in a core's cache.
BATCH = 64


class Convolution(nn.Module):
    """A square convolution, then batch norm without scale and shift of its own; folded: one convolution with a bias.

    Odd sides keep the picture's size (over the stride), even ones are laid on where they fit.
    """

    def __init__(self, inside: int, outside: int, side: int, *, stride: int = 1, folded: bool = False) -> None:
        super().__init__()
        padding = side // 2 if side % 2 else 0
        self.convolution = nn.Conv2d(inside, outside, side, stride, padding, bias=folded)
        self.norm: nn.Module = nn.Identity() if folded else nn.BatchNorm2d(outside, affine=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inside, H, W) of the weights' type -> (N, outside, H', W')."""
        answer: Tensor = self.norm(self.convolution(x))
        return answer

    def fold_into(self, other: Convolution) -> None:
        """Gives a folded one of the same shape the weights that make it answer as this one does in evaluation."""
        norm = self.norm
        if not isinstance(norm, nn.BatchNorm2d) or norm.running_mean is None or norm.running_var is None:
            raise TypeError("this convolution is folded already")
        scale = (norm.running_var + norm.eps).rsqrt()
        bias = -norm.running_mean * scale
        if self.convolution.bias is not None:
            bias = bias + self.convolution.bias * scale
        with torch.no_grad():
            other.convolution.weight.copy_(self.convolution.weight * scale[:, None, None, None])
            other.convolution.get_parameter("bias").copy_(bias)


def convolutions(layers: Sequence[tuple[int, int]], *, folded: bool) -> nn.ModuleList:
    """3 x 3 convolutions one after the other, from one channel; layers: channels and stride of each."""
    inside = [1, *(channels for channels, _ in layers)]
    return nn.ModuleList(
        Convolution(before, channels, 3, stride=stride, folded=folded)
        for before, (channels, stride) in zip(inside, layers, strict=False)
    )


def fold(trained: nn.Module, folded: Network) -> Network:
    """`folded`, a network of the same architecture, with the weights of the trained one; for evaluation."""
    shared = {name: value for name, value in trained.state_dict().items() if name in folded.state_dict()}
    folded.load_state_dict(shared, strict=False)
    for name, part in trained.named_modules():
        if isinstance(part, Convolution):
            target = folded.get_submodule(name)
            if not isinstance(target, Convolution):
                raise TypeError(f"{name} is no convolution in the folded network")
            part.fold_into(target)
    return folded.eval().requires_grad_(False)


def standardised(patches: Tensor) -> Tensor:
    """Patches (N, 1, S, S) of any type as float32, each of mean 0 and standard deviation 1; flat ones are all 0."""
    values = patches.float()
    values = values - values.mean(dim=(1, 2, 3), keepdim=True)
    deviation = values.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
    return values / deviation.clamp(min=1e-4)


def in_channels_last(network: Network) -> Network:
    """Itself, with weights in the memory order that is fastest with BATCH patches."""
    moved: Network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


@torch.inference_mode()
def answers(network: nn.Module, patches: NDArray[Any], length: int) -> NDArray[np.float32]:
    """(N, length) float32 that a network says of patches (N, SIDE_PX, SIDE_PX).

    Always BATCH at a time, the last filled up with zeros: a patch has the same answer whatever goes with it. Computed
    where the network is.
    """
    if patches.shape[1:] != (SIDE_PX, SIDE_PX):
        raise ValueError(f"patches are of shape {patches.shape}, must be (N, {SIDE_PX}, {SIDE_PX})")
    device = next(network.parameters()).device
    out = np.empty((len(patches), length), np.float32)
    batch = np.zeros((BATCH, 1, SIDE_PX, SIDE_PX), patches.dtype)
    for start in range(0, len(patches), BATCH):
        count = len(patches[start : start + BATCH])
        batch[:count, 0] = patches[start : start + BATCH]
        batch[count:] = 0
        out[start : start + count] = network(torch.from_numpy(batch).to(device))[:count].cpu().numpy()
    return out
