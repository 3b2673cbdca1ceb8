"""The keypoint detector: a small fully convolutional network that turns a level of a pyramid into a heat map.

It is applied to every level of `strategies.extractors.pyramid.levels_of`, so it needs no scales of its own. Seven
convolutions at the level's full resolution, because places count: 5 x 5 from the gray to CHANNELS, five of 3 x 3 (two
of them with gaps of one pixel) and 3 x 3 to the heat; 6,153 parameters, each used twice, the second time turned by
half. What a pixel answers depends on the 2 REACH_PX + 1 pixels squared around it, and through local brightness and
contrast on FIELD_PX to every side. scripts/train detector documents the training, trained/detector.md the weights.

Source: heat maps, trained on shapes and then by homographies, after DeTone, Malisiewicz and Rabinovich, SuperPoint,
CVPR workshops 2018; maxima at several scales after the paper of method 3 (J. Geo-inf. Sci. 2021(10), 1823-1837).
"""

from __future__ import annotations

from collections.abc import Iterator
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
# Log odds where none are wanted: below all others.
UNSHOWN = -50.0
# Contrast below which a picture is taken for flat, of the gray range 0-1: one gray level of 8 bit.
_FLAT = 1.0 / 255.0


class TurnedConvolution(nn.Module):
    """A convolution whose answers to a picture turned by half are those to the picture, turned by half.

    Channels come in twos, the second half of them what the first would say of the turned picture: kernels are turned
    by half and read the halves of their input exchanged. Only the kernels of the first half are parameters. `inside` or
    `outside` of 1 is the picture or the heat, which is its own half turn's.

    Source: group convolution, Cohen and Welling, Group equivariant convolutional networks, ICML 2016, with the group of
    half turns.
    """

    def __init__(self, inside: int, outside: int, side: int, gap: int = 1) -> None:
        super().__init__()
        self.inside, self.outside, self.gap, self.padding = inside, outside, gap, gap * (side // 2)
        own = nn.Conv2d(inside, max(1, outside // 2), side)
        self.weight, self.bias = own.weight, own.get_parameter("bias")

    def kernels(self) -> tuple[Tensor, Tensor]:
        """Weights (outside, inside, side, side) and biases (outside,) of an ordinary convolution that does the same."""
        turned = self.weight.flip(2, 3).roll(self.inside // 2, 1)
        if self.outside == 1:
            return (self.weight + turned) / 2.0, self.bias
        return torch.cat([self.weight, turned]), torch.cat([self.bias, self.bias])

    def forward(self, x: Tensor) -> Tensor:
        """(N, inside, H, W) -> (N, outside, H, W) of the weights' type."""
        weights, biases = self.kernels()
        # As the pictures between the layers lie in memory: another order costs several times the seconds.
        if self.inside > 1:
            weights = weights.contiguous(memory_format=torch.channels_last)
        return F.conv2d(x, weights, biases, padding=self.padding, dilation=self.gap)


class Detector(nn.Module):
    """Heat of gray pictures; layers may run in bfloat16, but the entrance and the last layer's sums are float32 always.

    The heat of a picture turned by half is the heat, turned by half: layers that are free to differ put keypoints
    beside their places, to one and the same side.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = TurnedConvolution(1, CHANNELS, 5)
        self.layers = nn.ModuleList(TurnedConvolution(CHANNELS, CHANNELS, 3, gap) for gap in _GAPS)
        self.last = TurnedConvolution(CHANNELS, 1, 3)

    def forward(self, gray: Tensor, shown: Tensor | None = None) -> Tensor:
        """Logits (N, 1, H, W) float32 of the heat (confidence 0-1 by a sigmoid) for gray (N, 1, H, W), 0-1.

        Pixels beyond the picture are as bright as its local mean. Pieces of a picture give the numbers of the whole
        where they start at multiples of CELL_PX, FIELD_PX away from their edges.

        shown: (H, W) bool, where the heat is wanted. On a CPU it is UNSHOWN farther away: a turned ground view shows
        nothing in its corners, up to half of it.
        """
        if gray.ndim != 4 or gray.shape[1] != 1:
            raise ValueError(f"gray has shape {tuple(gray.shape)} instead of (N, 1, H, W)")
        x = evened(gray.float())
        if x.device.type != "cpu" or self.training:
            return self._layered(x)
        out = torch.full_like(x, UNSHOWN)
        for own_y, own_x in _pieces(x.shape[2], x.shape[3], shown):
            (needed_y, kept_y), (needed_x, kept_x) = _reached(own_y, x.shape[2]), _reached(own_x, x.shape[3])
            out[..., own_y, own_x] = self._layered(x[..., needed_y, needed_x])[..., kept_y, kept_x]
        return out

    def _layered(self, x: Tensor) -> Tensor:
        """Logits (N, 1, H, W) float32 of an evened picture (N, 1, H, W)."""
        # Only now: a picture of one channel in that order takes the first layer five times as long.
        x = self.first(x.to(self.first.weight.dtype)).contiguous(memory_format=torch.channels_last)
        x = F.relu_(x)
        for layer in self.layers:
            x = F.relu_(layer(x))
        with torch.autocast(x.device.type, enabled=False):
            weights, biases = self.last.kernels()
            return F.conv2d(x.float(), weights.float(), biases.float(), padding=self.last.padding)


def _pieces(height_px: int, width_px: int, shown: Tensor | None) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of pieces of PIECE_PX squared of a picture, or less: of each the part around what is shown."""
    for rows in _parts(height_px):
        for columns in _parts(width_px):
            if shown is None:
                yield rows, columns
            elif (inside := shown[rows, columns]).any():
                yield _around(inside.any(1), rows.start), _around(inside.any(0), columns.start)


def _parts(length_px: int) -> list[slice]:
    count = -(-length_px // PIECE_PX)
    return [slice(*ends) for ends in pairwise(length_px * k // count for k in range(count + 1))]


def _around(flags: Tensor, start_px: int) -> slice:
    """From the first to the last that is set, counted from `start_px`."""
    places = flags.nonzero()
    return slice(start_px + int(places[0]), start_px + int(places[-1]) + 1)


def _reached(own: slice, length_px: int) -> tuple[slice, slice]:
    """The pixels of an axis that the heat of some depends on, and where these lie among them."""
    first, last = max(0, own.start - REACH_PX), min(length_px, own.stop + REACH_PX)
    return slice(first, last), slice(own.start - first, own.stop - first)


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
    return load_network(lambda _: Detector(), path or shipped_path("detector"), precision, device)
