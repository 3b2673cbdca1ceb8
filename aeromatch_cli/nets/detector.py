"""The keypoint detector: a small fully convolutional network that turns a level of a pyramid into a heat map.

It is applied to every level of `strategies.extractors.pyramid.levels_of`, so it needs no scales of its own. Seven
convolutions at the level's full resolution, because places count: 5 x 5 from the gray to CHANNELS, five of 3 x 3 (two
of them with gaps of one pixel) and 3 x 3 to the heat; 12,161 parameters. What a pixel answers depends on the
2 REACH_PX + 1 pixels squared around it, and through local brightness and contrast on FIELD_PX to every side.
scripts/train detector documents the training, trained/detector.md the weights.

Source: heat maps, trained on shapes and then by homographies, after DeTone, Malisiewicz and Rabinovich, SuperPoint,
CVPR workshops 2018; their maxima over scale after the paper of method 3 (J. Geo-inf. Sci. 2021(10), 1823-1837).
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.loading import load_network, once_per_file
from aeromatch_cli.nets.precision import Precision

CHANNELS = 16
_GAPS = (1, 1, 2, 2, 1)
REACH_PX = 2 + sum(_GAPS) + 1
# Local brightness and contrast: means of CELL_PX x CELL_PX pixels, smoothed over 5 x 5 of them.
CELL_PX = 4
FIELD_PX = REACH_PX + 8 * CELL_PX
# On a CPU the layers work on such squares, with what these depend on. Answers of 32 MB and more would take twice the
# seconds, because the system hands out their memory anew for every layer.
PIECE_PX = 384
# Contrast below which a picture is taken for flat, of the gray range 0-1: one gray level of 8 bit.
_FLAT = 1.0 / 255.0


class Detector(nn.Module):
    """Heat of gray pictures; layers may run in bfloat16, but the entrance and the last layer's sums are float32 always.

    The heat is the mean of what the layers say of the picture and of the picture turned by half: alone, they put it
    beside its place, to one and the same side.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, CHANNELS, 5, padding=2)
        self.layers = nn.ModuleList(nn.Conv2d(CHANNELS, CHANNELS, 3, padding=gap, dilation=gap) for gap in _GAPS)
        self.last = nn.Conv2d(CHANNELS, 1, 3, padding=1)

    def forward(self, gray: Tensor) -> Tensor:
        """Logits (N, 1, H, W) float32 of the heat (confidence 0-1 by a sigmoid) for gray (N, 1, H, W), 0-1.

        Pixels beyond the picture are as bright as its local mean. Pieces of a picture give the numbers of the whole
        where they start at multiples of CELL_PX, FIELD_PX away from their edges.
        """
        if gray.ndim != 4 or gray.shape[1] != 1:
            raise ValueError(f"gray has shape {tuple(gray.shape)} instead of (N, 1, H, W)")
        x = evened(gray.float())
        if x.device.type != "cpu":
            return self._both_ways(x)
        out = torch.empty_like(x)
        for own_y, needed_y, kept_y in _pieces(x.shape[2]):
            for own_x, needed_x, kept_x in _pieces(x.shape[3]):
                out[..., own_y, own_x] = self._both_ways(x[..., needed_y, needed_x])[..., kept_y, kept_x]
        return out

    def one_way(self, gray: Tensor) -> Tensor:
        """What the layers say of the picture as it is, (N, 1, H, W) as `forward`, in half the time: for training."""
        return self._layered(evened(gray.float()))

    def _both_ways(self, x: Tensor) -> Tensor:
        """Mean logits (N, 1, H, W) float32 of an evened picture (N, 1, H, W) and of it turned by half."""
        return (self._layered(x) + self._layered(x.flip(2, 3)).flip(2, 3)) / 2.0

    def _layered(self, x: Tensor) -> Tensor:
        """Logits (N, 1, H, W) float32 of an evened picture (N, 1, H, W)."""
        # Only now: a picture of one channel in that order takes the first layer five times as long.
        x = self.first(x.to(self.first.weight.dtype)).contiguous(memory_format=torch.channels_last)
        x = F.relu_(x)
        for layer in self.layers:
            x = F.relu_(layer(x))
        with torch.autocast(x.device.type, enabled=False):
            bias = self.last.bias
            return F.conv2d(x.float(), self.last.weight.float(), None if bias is None else bias.float(), padding=1)


def _pieces(length_px: int) -> list[tuple[slice, slice, slice]]:
    """Pieces of PIECE_PX of an axis, or less: each, the pixels that its heat depends on, and where it lies in these."""
    count = -(-length_px // PIECE_PX)
    cuts = [length_px * k // count for k in range(count + 1)]
    found = []
    for start, end in pairwise(cuts):
        first, last = max(0, start - REACH_PX), min(length_px, end + REACH_PX)
        found.append((slice(start, end), slice(first, last), slice(start - first, end - first)))
    return found


def evened(gray: Tensor) -> Tensor:
    """Gray (N, 1, H, W) free of local brightness and contrast: gain and offset of the light change nothing.

    Both are smoothed means of cells, edges repeated; the context network's are of squares around each pixel. The
    weights of each depend on its own.
    """
    height, width = gray.shape[-2:]
    padded = F.pad(gray, (0, -width % CELL_PX, 0, -height % CELL_PX), mode="replicate")
    # Less a mean: the difference of large squares would lose the contrast of faint pictures.
    cells = F.avg_pool2d(padded, CELL_PX)
    mean = _smooth(cells)
    moved = padded - _enlarged(mean)
    spread = _enlarged(_smooth(F.avg_pool2d(moved.square(), CELL_PX)))
    return (moved / (spread + _FLAT**2).sqrt())[..., :height, :width]


def _smooth(cells: Tensor) -> Tensor:
    """Means (N, 1, h, w) over 3 x 3 twice, edges repeated."""
    for _ in range(2):
        cells = F.avg_pool2d(F.pad(cells, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return cells


def _enlarged(cells: Tensor) -> Tensor:
    """Cells (N, 1, h, w) as pixels (N, 1, CELL_PX h, CELL_PX w)."""
    return F.interpolate(cells, scale_factor=CELL_PX, mode="bilinear", align_corners=False)


@once_per_file
def load_detector(path: Path | None = None, precision: Precision = "auto", device: str = "cpu") -> Detector:
    """The network of a weights file, by default the one that ships, once per process; layers in `precision`.

    Raises ConfigError where the file is missing or holds another.
    """
    network = load_network(Detector, path or shipped_path("detector"), precision, device)
    # As the pictures between the layers lie in memory: another order costs several times the seconds. Unlike
    # `.to(memory_format=...)`, this leaves the one-channel weights as they are: float32 sums differ in the last digit.
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network
