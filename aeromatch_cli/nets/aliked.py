"""ALIKED's network, affordable on a CPU: keypoints and descriptors of a picture in colour.

The layers and their weights are those that its authors published; kornia's ALIKED gives the same numbers from the same
file. What differs is what is computed. Its 128 feature maps, three of four parts of which are enlarged from a half, an
eighth and a thirty-second of the size, are never laid out in full: the score map's first layer is linear and is
computed before the enlarging, and descriptors read them only at the pixels that they sample. Wide layers go through in
pieces that stay in a core's cache.

Weights are no part of this project: the network takes those of a published file.

Source: Zhao et al., ALIKED: a lighter keypoint and descriptor extraction network via deformable transformation, IEEE
Transactions on Instrumentation and Measurement 72, 2023; deformable convolutions after Dai et al., ICCV 2017.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.files import read_tensors
from aeromatch_cli.nets.loading import once_per_file

# Pictures are filled up to multiples of this: the coarsest maps have one value for so many pixels.
MULTIPLE_PX = 32
# Layers at full and half size work on such squares.
PIECE_PX = 256
# What one of the score map's pixels depends on in the maps that are summed, to every side.
_SCORE_REACH_PX = 3
# Descriptors at once.
_BATCH = 256
_BATCH_NORM_EPS = 1e-5
# A keypoint is the largest score of 5 x 5 pixels, moved to their mean weighed by exp(score / temperature).
_RADIUS_PX, _TEMPERATURE = 2, 0.1
# Layers of which a file must have the weights.
_LAYERS = (
    *(f"block{block}.conv{n}" for block in (1, 2) for n in (1, 2)),
    *(f"block{block}.conv{n}.{kind}_conv" for block in (3, 4) for n in (1, 2) for kind in ("offset", "regular")),
    *(f"block{block}.bn{n}" for block in (1, 2, 3, 4) for n in (1, 2)),
    *(f"block{block}.downsample" for block in (2, 3, 4)),
    *(f"conv{n}" for n in (1, 2, 3, 4)),
    *(f"score_head.{n}" for n in (0, 2, 4, 6)),
    *(f"desc_head.{name}" for name in ("offset_conv.0", "offset_conv.2", "sf_conv")),
)


@dataclass(frozen=True, eq=False)
class Maps:
    """What the network sees of a picture (H, W). full: (H', W', 16), the picture filled up to multiples of MULTIPLE_PX;
    parts: (h, w, 32) each, a half, an eighth and a thirty-second of that. left, top: of the picture in them, pixels.
    scores: (H, W) 0-1."""

    full: Tensor
    parts: tuple[Tensor, ...]
    left: int
    top: int
    scores: Tensor


def is_aliked(tensors: Mapping[str, Tensor]) -> bool:
    """Whether a file of weights is one of ALIKED's, going by a name that no other network has."""
    return "desc_head.agg_weights" in tensors


class AlikedNetwork:
    """The network with its weights, for evaluation on a CPU. tensors: of a published file, by their names there.

    Raises ConfigError where one is missing.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        if missing := sorted(name for name in _LAYERS if f"{name}.weight" not in tensors):
            raise ConfigError(f"these are no weights of ALIKED: {missing[0]}.weight is missing")
        self.tensors = dict(tensors)
        self.wide = [_pixelwise(_folded(tensors, f"block1.conv{n}", f"block1.bn{n}")) for n in (1, 2)]
        self.half = [_pixelwise(_folded(tensors, f"block2.conv{n}", f"block2.bn{n}")) for n in (1, 2)]
        self.deformed = {
            f"block{block}.{n}": _folded(tensors, f"block{block}.conv{n}.regular_conv", f"block{block}.bn{n}")
            for block in (3, 4)
            for n in (1, 2)
        }
        self.head = [_of_eight(tensors[f"score_head.{n}.weight"]) for n in (2, 4, 6)]
        own, *self.coarse = tensors["score_head.0.weight"].split(32, dim=1)
        self.mixed = [weight[:, :, 0, 0].T.contiguous() for weight in (tensors["conv1.weight"], own)]
        self.positions = len(tensors["desc_head.agg_weights"])

    @torch.inference_mode()
    def maps(self, colour: Tensor) -> Maps:
        """colour: (3, H, W) float, red, green, blue 0-1."""
        height, width = colour.shape[1:]
        fill_y, fill_x = -height % MULTIPLE_PX, -width % MULTIPLE_PX
        sides = (fill_x // 2, fill_x - fill_x // 2, fill_y // 2, fill_y - fill_y // 2)
        x = F.pad(colour[None], sides, mode="replicate")
        full = _in_pieces(x, 2, self._first)
        half = _in_pieces(F.avg_pool2d(full, 2), 2, self._second)
        eighth = self._residual(F.avg_pool2d(half, 4), "block3")
        last = self._residual(F.avg_pool2d(eighth, 4), "block4")
        parts = [
            F.selu(F.conv2d(one, self.tensors[f"conv{n}.weight"])) for n, one in ((2, half), (3, eighth), (4, last))
        ]
        scores = self._scores(full, parts)[0, 0, sides[2] : sides[2] + height, sides[0] : sides[0] + width]
        return Maps(_rows(full), tuple(_rows(part) for part in parts), sides[0], sides[2], scores)

    def _first(self, x: Tensor) -> Tensor:
        for weight, bias in self.wide:
            x = F.selu_(F.conv2d(x, weight, bias, padding=1))
        return x

    def _second(self, x: Tensor) -> Tensor:
        (weight0, bias0), (weight1, bias1) = self.half
        y = F.conv2d(F.selu_(F.conv2d(x, weight0, bias0, padding=1)), weight1, bias1, padding=1)
        return F.selu_(y + F.conv2d(x, *self._pair("block2.downsample")))

    def _residual(self, x: Tensor, block: str) -> Tensor:
        """A block of two deformable convolutions (1, C, h, w) -> (1, 2 C, h, w)."""
        y = x
        for n in (1, 2):
            offsets = F.conv2d(y, *self._pair(f"{block}.conv{n}.offset_conv"), padding=1)
            weight, bias = self.deformed[f"{block}.{n}"]
            y = _deformed(y, offsets, weight, bias)
            y = F.selu_(y) if n == 1 else y
        return F.selu_(y + F.conv2d(x, *self._pair(f"{block}.downsample")))

    def _pair(self, name: str) -> tuple[Tensor, Tensor]:
        return self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"]

    def _scores(self, full: Tensor, parts: list[Tensor]) -> Tensor:
        """(1, 1, H', W') 0-1."""
        size = tuple(full.shape[2:])
        coarse = [_rows(F.conv2d(part, weight)) for part, weight in zip(parts, self.coarse, strict=True)]

        def scored(x: Tensor, rows: slice, columns: slice) -> Tensor:
            # Products of matrices: convolutions of 1 x 1 are many times slower.
            mixed = F.selu_(x[0].permute(1, 2, 0) @ self.mixed[0]) @ self.mixed[1]
            for part in coarse:
                mixed += _enlarged(part, size, rows, columns)
            found = F.selu_(mixed).permute(2, 0, 1)[None]
            for weight in self.head[:-1]:
                found = F.selu_(F.conv2d(found, weight, padding=1))
            return F.conv2d(found, self.head[-1], padding=1)[:, :1].sigmoid()

        return _in_placed_pieces(full, _SCORE_REACH_PX, scored)

    @torch.inference_mode()
    def keypoints(self, maps: Maps, most: int) -> tuple[Tensor, Tensor]:
        """Points (N, 2), x and y in pixels, of the `most` largest maxima at most, and their scores (N,) 0-1."""
        scores = maps.scores
        width, reach = scores.shape[1], _RADIUS_PX
        ring = torch.ones(2 * reach + 1, 2 * reach + 1, dtype=torch.uint8)
        ring[reach, reach] = 0
        values = scores.numpy()
        peaks = torch.from_numpy(values > cv2.dilate(values, ring.numpy()))
        for side in (peaks[:reach], peaks[-reach:], peaks[:, :reach], peaks[:, -reach:]):
            side[:] = False
        flat = peaks.flatten().nonzero()[:, 0]
        flat = flat[torch.argsort(-scores.flatten()[flat], stable=True)[:most]]
        pixels = torch.stack([flat % width, flat // width], 1)
        steps = _square(-reach, reach + 1)
        around = pixels[:, None] + steps
        near = scores[around[..., 1], around[..., 0]]
        weights = torch.softmax(near / _TEMPERATURE, dim=1)
        points = pixels + weights @ steps.float()
        at = 2.0 * points / torch.tensor([width - 1, len(scores) - 1]) - 1.0
        return points, F.grid_sample(scores[None, None], at[None, None], align_corners=True)[0, 0, 0]

    @torch.inference_mode()
    def descriptors(self, maps: Maps, points_px: Tensor) -> Tensor:
        """(N, 128) float32 of unit length at points (N, 2), x and y in the picture's pixels."""
        height, width = maps.scores.shape
        size = torch.tensor([width, height])
        most = max(height, width) / 4.0
        weight0, bias0 = self._pair("desc_head.offset_conv.0")
        weight1, bias1 = self._pair("desc_head.offset_conv.2")
        side = weight0.shape[-1]
        steps = _square(0, side)
        mix, sums = self.tensors["desc_head.sf_conv.weight"][:, :, 0, 0], self.tensors["desc_head.agg_weights"]
        found = []
        for points in points_px.split(_BATCH):
            corner = (points.long() - side / 2 + 1).long().clamp(min=0)
            corner = torch.minimum(corner, size - 1 - side)
            around = self._features(maps, (corner[:, None] + steps).reshape(-1, 2))
            patches = around.reshape(len(points), side, side, -1).permute(0, 3, 1, 2)
            offsets = F.conv2d(F.selu_(F.conv2d(patches, weight0, bias0)), weight1, bias1)[:, :, 0, 0].clamp(
                -most, most
            )
            places = points[:, None] + offsets.reshape(len(points), 2, self.positions).transpose(1, 2)
            sampled = self._sampled(maps, places.reshape(-1, 2)).reshape(len(points), self.positions, -1)
            sampled = F.selu_(sampled @ mix.T)
            found.append(F.normalize(sampled.flatten(1) @ sums.flatten(0, 1), dim=1))
        return torch.cat(found) if found else torch.zeros(0, sums.shape[2])

    def _sampled(self, maps: Maps, places: Tensor) -> Tensor:
        """Features (M, 128) between pixels; zero beyond the picture."""
        height, width = maps.scores.shape
        low = places.floor()
        share = places - low
        corners = low.long()[:, None] + torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
        weights = torch.stack([1.0 - share, share], 1)  # (M, 2, 2): lower and upper, of x and y
        weights = (weights[:, None, :, 0] * weights[:, :, None, 1]).flatten(1)
        shown = (corners >= 0).all(-1) & (corners[..., 0] < width) & (corners[..., 1] < height)
        weights = weights * shown
        corners = torch.minimum(corners.clamp(min=0), torch.tensor([width - 1, height - 1]))
        found = self._features(maps, corners.reshape(-1, 2)).reshape(len(places), 4, -1)
        return (found * weights[..., None]).sum(1)

    def _features(self, maps: Maps, pixels: Tensor) -> Tensor:
        """Features (M, 128) of unit length at pixels (M, 2), x and y in the picture."""
        x, y = pixels[:, 0] + maps.left, pixels[:, 1] + maps.top
        own = F.selu_(maps.full[y, x] @ self.tensors["conv1.weight"][:, :, 0, 0].T)
        return F.normalize(torch.cat([own, *(_between(part, maps.full, x, y) for part in maps.parts)], 1), dim=1)


@once_per_file
def load_aliked(path: Path) -> AlikedNetwork:
    """The network of a weights file. Raises ConfigError where that is none of ALIKED's."""
    return AlikedNetwork(read_tensors(path))


def _folded(tensors: Mapping[str, Tensor], layer: str, norm: str) -> tuple[Tensor, Tensor]:
    """Weights and biases of a convolution with the batch norm that follows it."""
    scale = tensors[f"{norm}.weight"] * (tensors[f"{norm}.running_var"] + _BATCH_NORM_EPS).rsqrt()
    return tensors[f"{layer}.weight"] * scale[:, None, None, None], tensors[f"{norm}.bias"] - scale * tensors[
        f"{norm}.running_mean"
    ]


def _pixelwise(layer: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """A layer for maps whose channels lie side by side: it would else be laid out anew for every piece."""
    weight, bias = layer
    return weight.contiguous(memory_format=torch.channels_last), bias


def _of_eight(weight: Tensor) -> Tensor:
    """A layer of 3 x 3 with zeros for channels that it lacks: vector units take eight at a time."""
    filled = F.pad(weight, (0, 0, 0, 0, 0, -weight.shape[1] % 8, 0, -len(weight) % 8))
    return filled.contiguous(memory_format=torch.channels_last)


def _square(first: int, stop: int) -> Tensor:
    """(N, 2) x and y of the pixels of a square, row by row."""
    along = torch.arange(first, stop)
    return torch.stack(torch.meshgrid(along, along, indexing="ij")[::-1], -1).reshape(-1, 2)


def _rows(x: Tensor) -> Tensor:
    """(1, C, H, W) as (H, W, C), the channels of a pixel side by side."""
    return x[0].permute(1, 2, 0).contiguous()


def _pieces(length_px: int) -> Iterator[slice]:
    count = -(-length_px // PIECE_PX)
    for start, stop in pairwise(length_px * k // count for k in range(count + 1)):
        yield slice(start, stop)


def _in_pieces(x: Tensor, reach_px: int, layers: Callable[[Tensor], Tensor]) -> Tensor:
    """What layers of 3 x 3 say of a picture (1, C, H, W), piece by piece."""
    return _in_placed_pieces(x, reach_px, lambda piece, _rows, _columns: layers(piece))


def _in_placed_pieces(x: Tensor, reach_px: int, layers: Callable[[Tensor, slice, slice], Tensor]) -> Tensor:
    height, width = x.shape[2:]
    out = None
    for rows in _pieces(height):
        for columns in _pieces(width):
            wide_y = slice(max(0, rows.start - reach_px), min(height, rows.stop + reach_px))
            wide_x = slice(max(0, columns.start - reach_px), min(width, columns.stop + reach_px))
            piece = x[..., wide_y, wide_x].contiguous(memory_format=torch.channels_last)
            found = layers(piece, wide_y, wide_x)
            if out is None:
                out = found.new_empty((1, found.shape[1], height, width)).contiguous(memory_format=torch.channels_last)
            inner_y = slice(rows.start - wide_y.start, rows.stop - wide_y.start)
            inner_x = slice(columns.start - wide_x.start, columns.stop - wide_x.start)
            out[..., rows, columns] = found[..., inner_y, inner_x]
    assert out is not None
    return out


def _positions(coarse: int, fine: int, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Lower pixel and share of the next one where a fine map's pixels lie in a coarse one, corners on corners."""
    at = pixels * ((coarse - 1) / max(fine - 1, 1))
    low = at.floor().clamp(max=max(coarse - 2, 0))
    return low.long(), (at - low).float()


def _enlarged(part: Tensor, size: tuple[int, ...], rows: slice, columns: slice) -> Tensor:
    """A map (h, w, C) at some rows and columns of a picture of `size`."""
    low_y, high_y, share_y = _neighbours(part.shape[0], size[0], rows)
    low_x, high_x, share_x = _neighbours(part.shape[1], size[1], columns)
    first = int(low_x[0])
    near = part[:, first : int(high_x[-1]) + 1]
    wide = torch.lerp(near[low_y], near[high_y], share_y[:, None, None])
    return torch.lerp(wide.index_select(1, low_x - first), wide.index_select(1, high_x - first), share_x[:, None])


def _neighbours(coarse: int, fine: int, chosen: slice) -> tuple[Tensor, Tensor, Tensor]:
    """Lower and upper pixel of a coarse map between which chosen ones of a fine map lie, and the upper one's share."""
    low, share = _positions(coarse, fine, torch.arange(chosen.start, chosen.stop, dtype=torch.float64))
    return low, (low + 1).clamp(max=coarse - 1), share


def _between(part: Tensor, full: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Features (M, C) of a coarse map (h, w, C) at pixels (M,) of the full one."""
    height, width = part.shape[:2]
    low_x, share_x = _positions(width, full.shape[1], x.double())
    low_y, share_y = _positions(height, full.shape[0], y.double())
    high_x, high_y = (low_x + 1).clamp(max=width - 1), (low_y + 1).clamp(max=height - 1)
    flat = part.reshape(height * width, -1)
    upper = torch.lerp(flat[low_y * width + low_x], flat[low_y * width + high_x], share_x[:, None])
    lower = torch.lerp(flat[high_y * width + low_x], flat[high_y * width + high_x], share_x[:, None])
    return torch.lerp(upper, lower, share_y[:, None])


def _deformed(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A deformable convolution of 3 x 3: x (1, C, h, w) read at 9 places around each pixel, each moved by its offset, y
    and x (1, 18, h, w). Beyond the map there are zeros."""
    channels, height, width = x.shape[1:]
    offsets = offsets.clamp(-max(height, width) / 4.0, max(height, width) / 4.0)[0].reshape(9, 2, height, width)
    steps = torch.arange(-1.0, 2.0)
    at_y = offsets[:, 0] + steps.repeat_interleave(3)[:, None, None] + torch.arange(float(height))[:, None]
    at_x = offsets[:, 1] + steps.repeat(3)[:, None, None] + torch.arange(float(width))
    grid = torch.stack([2.0 * at_x / max(width - 1, 1) - 1.0, 2.0 * at_y / max(height - 1, 1) - 1.0], -1)
    grid = grid.reshape(1, 9 * height, width, 2)
    sampled = F.grid_sample(x, grid, mode="bilinear", padding_mode="zeros", align_corners=True)
    sampled = sampled.reshape(channels * 9, height * width)
    out = weight.reshape(len(weight), channels * 9) @ sampled + bias[:, None]
    return out.reshape(1, len(weight), height, width)
