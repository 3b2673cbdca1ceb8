"""LightGlue: attention within and between the keypoints of two pictures, then one assignment. Architecture only.

Source: Lindenberger, Sarlin and Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023. Tensors have
the names of kornia.feature.LightGlue (the published checkpoints'), so that either reads the other's files; this forward
is there because kornia's computes in float32 only and keeps the whole assignment matrix.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

# Rows of the assignment that are scored at once: the matrix of 2048 points twice is 32 MB otherwise.
_ROWS = 512
# Rows of an attention matrix that are worked on at once: what belongs to them fits a processor's cache.
_QUERIES = 256
# Expected places are off by a hundredth to a fifth of the picture.
_FASTEST = 30.0


@dataclass(frozen=True)
class Dimensions:
    """What makes a network.

    input_dim: length of a descriptor. add_scale_ori: whether keypoints carry scale and orientation (SIFT).
    knows_ground: whether attention between the pictures knows where keypoints are expected on the ground.
    """

    input_dim: int
    descriptor_dim: int
    n_layers: int
    num_heads: int
    add_scale_ori: bool
    knows_ground: bool = False


@dataclass(frozen=True)
class Side:
    """One picture's keypoints, B pictures at once.

    places: (B, N, 2 or 4) float32, x and y from `normalised`, then scale (half the size in pixels) and orientation in
    radians where the network wants them. descriptors: (B, N, input_dim) float. ground: (B, N, 2) expected places on the
    ground, of both pictures in one frame, in the units of `places`; None where nothing is expected.
    """

    places: Tensor
    descriptors: Tensor
    ground: Tensor | None = None

    def to(self, device: str | torch.device) -> Side:
        ground = None if self.ground is None else self.ground.to(device)
        return Side(self.places.to(device), self.descriptors.to(device), ground)


def normalised(points_px: Tensor, size_px: Tensor) -> Tensor:
    """Points (..., N, 2), pixels from the picture's corner, with the middle at 0 and the longer half side at 1.

    size_px: (..., 2) width, height.
    """
    half = size_px / 2.0
    return (points_px - half.unsqueeze(-2)) / half.amax(dim=-1)[..., None, None]


Rotary = tuple[Tensor, Tensor]  # cosines and sines (B, 1, N, head_dim)


@dataclass(frozen=True, eq=False)
class Code:
    """Position codes of one side: within its picture, and on the ground (None: nothing is expected)."""

    picture: Rotary
    ground: Rotary | None

    def at(self, *index: slice | Tensor) -> Code:
        """Of such pairs, or of such keypoints: an index into (B, 1, N)."""
        picture, ground = self.picture, self.ground
        return Code(
            (picture[0][index], picture[1][index]), None if ground is None else (ground[0][index], ground[1][index])
        )


class FourierEncoding(nn.Module):
    """Rotary position code: every pair of channels is turned by an angle that is linear in the place."""

    def __init__(self, places_dim: int, head_dim: int, fastest: float = 1.0) -> None:
        """fastest: how much faster than the slowest channels the fastest ones turn, to begin with."""
        super().__init__()
        self.Wr = nn.Linear(places_dim, head_dim // 2, bias=False)
        nn.init.normal_(self.Wr.weight.data, mean=0.0, std=1.0)
        self.Wr.weight.data *= torch.logspace(0.0, math.log10(fastest), head_dim // 2)[:, None]

    def forward(self, places: Tensor) -> Rotary:
        """Cosines and sines (B, 1, N, head_dim) of places (B, N, P), in float32: angles of several turns need it."""
        with torch.autocast(places.device.type, enabled=False):
            angles = functional.linear(places.float(), self.Wr.weight.float()).unsqueeze(1)
        return angles.cos().repeat_interleave(2, dim=-1), angles.sin().repeat_interleave(2, dim=-1)


def _turned(x: Tensor, code: Rotary) -> Tensor:
    """x (B, H, N, head_dim) with its pairs of channels turned."""
    pairs = x.unflatten(-1, (-1, 2))
    crossed = torch.stack((-pairs[..., 1], pairs[..., 0]), dim=-1).flatten(-2)
    return x * code[0] + crossed * code[1]


def attended(query: Tensor, key: Tensor, value: Tensor, there: Tensor | None = None) -> Tensor:
    """Softmax of query . key / sqrt(head_dim), over the keys, of the values: (B, H, M, head_dim).

    there: (B, N) bool, which keys count; None for all. In bfloat16 a CPU is twice as fast this way as in torch's fused
    kernel, which does not use its matrix instructions.
    """
    if there is not None:
        return functional.scaled_dot_product_attention(query, key, value, attn_mask=there[:, None, None])
    if value.dtype is not torch.bfloat16 or value.device.type != "cpu":
        return functional.scaled_dot_product_attention(query, key, value)
    columns = key.to(value.dtype).transpose(-1, -2)
    scaled = (query * query.shape[-1] ** -0.5).to(value.dtype)
    with torch.autocast("cpu", enabled=False):
        parts = [torch.softmax(rows @ columns, dim=-1) @ value for rows in scaled.split(_QUERIES, dim=2)]
    return torch.cat(parts, dim=2) if len(parts) > 1 else parts[0]


def _mixer(dim: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(2 * dim, 2 * dim), nn.LayerNorm(2 * dim), nn.GELU(), nn.Linear(2 * dim, dim))


class SelfBlock(nn.Module):
    """Attention among the keypoints of one picture, aware of their relative places."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.Wqkv = nn.Linear(dim, 3 * dim)
        self.out_proj = nn.Linear(dim, dim)
        self.ffn = _mixer(dim)

    def forward(self, x: Tensor, code: Rotary, there: Tensor | None = None) -> Tensor:
        """x (B, N, dim) -> the same. there: (B, N) bool, which keypoints are there; None for all."""
        query, key, value = self.Wqkv(x).unflatten(-1, (self.heads, -1, 3)).transpose(1, 2).unbind(-1)
        query, key = _turned(query, code), _turned(key, code)
        message = attended(query, key, value.contiguous(), there)
        message = self.out_proj(message.transpose(1, 2).flatten(-2))
        return x + self.ffn(torch.cat([x, message], dim=-1))


class CrossBlock(nn.Module):
    """Attention of each picture's keypoints to the other's, both ways."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qk = nn.Linear(dim, dim)
        self.to_v = nn.Linear(dim, dim)
        self.to_out = nn.Linear(dim, dim)
        self.ffn = _mixer(dim)

    def forward(
        self,
        x0: Tensor,
        x1: Tensor,
        there0: Tensor | None = None,
        there1: Tensor | None = None,
        *,
        ground: tuple[Rotary, Rotary] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """x0 (B, M, dim), x1 (B, N, dim) -> the same. there: (B, M), (B, N) bool; None for all. ground: codes of
        expected places, used as those within a picture by `SelfBlock`.
        """
        key0, key1, value0, value1 = (self._by_head(of(x)) for of in (self.to_qk, self.to_v) for x in (x0, x1))
        if ground is not None:
            key0, key1 = _turned(key0, ground[0]), _turned(key1, ground[1])
        return self._mixed(x0, key0, key1, value1, there1), self._mixed(x1, key1, key0, value0, there0)

    def _by_head(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2).contiguous()

    def _mixed(self, x: Tensor, query: Tensor, key: Tensor, value: Tensor, there: Tensor | None) -> Tensor:
        message = attended(query, key, value, there)
        message = self.to_out(message.transpose(1, 2).flatten(-2))
        return x + self.ffn(torch.cat([x, message], dim=-1))


class Layer(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.self_attn = SelfBlock(dim, heads)
        self.cross_attn = CrossBlock(dim, heads)

    def through(
        self,
        x0: Tensor,
        x1: Tensor,
        codes: tuple[Code, Code],
        there0: Tensor | None = None,
        there1: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """States (B, M, dim), (B, N, dim) after this layer. there: (B, M), (B, N) bool; None for all."""
        one, other = codes
        x0, x1 = self.self_attn(x0, one.picture, there0), self.self_attn(x1, other.picture, there1)
        ground = None if one.ground is None or other.ground is None else (one.ground, other.ground)
        found: tuple[Tensor, Tensor] = self.cross_attn(x0, x1, there0, there1, ground=ground)
        return found


class Assignment(nn.Module):
    """Which keypoints have a partner, and which one."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.matchability = nn.Linear(dim, 1)
        self.final_proj = nn.Linear(dim, dim)

    def logits(self, x: Tensor) -> Tensor:
        """Log odds (B, N) that a keypoint has a partner."""
        return self.matchability(x).squeeze(-1)

    def similarity(self, x0: Tensor, x1: Tensor) -> Tensor:
        """(B, M, N) of x0 (B, M, dim) and x1 (B, N, dim)."""
        scale = x0.shape[-1] ** -0.25
        return (self.final_proj(x0) * scale) @ (self.final_proj(x1) * scale).transpose(-1, -2)


class Confidence(nn.Module):
    """Whether a keypoint's assignment will not change in later layers."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.token = nn.Sequential(nn.Linear(dim, 1), nn.Sigmoid())

    def logits(self, x: Tensor) -> Tensor:
        """(B, N); no gradient reaches the keypoints' states."""
        return self.token[0](x.detach()).squeeze(-1)


class LightGlue(nn.Module):
    """The whole network. The type of the layers' parameters decides in which precision they compute (`with_layers_in`);
    places and their code stay float32.
    """

    def __init__(self, dimensions: Dimensions) -> None:
        super().__init__()
        self.dimensions = dimensions
        dim, heads, count = dimensions.descriptor_dim, dimensions.num_heads, dimensions.n_layers
        same = dimensions.input_dim == dim
        self.input_proj = nn.Identity() if same else nn.Linear(dimensions.input_dim, dim)
        self.posenc = FourierEncoding(4 if dimensions.add_scale_ori else 2, dim // heads)
        self.groundenc = FourierEncoding(2, dim // heads, _FASTEST) if dimensions.knows_ground else None
        self.transformers = nn.ModuleList([Layer(dim, heads) for _ in range(count)])
        self.log_assignment = nn.ModuleList([Assignment(dim) for _ in range(count)])
        self.token_confidence = nn.ModuleList([Confidence(dim) for _ in range(count - 1)])

    @property
    def layers(self) -> list[Layer]:
        return [cast(Layer, module) for module in self.transformers]

    def assignment(self, index: int) -> Assignment:
        """The head after layer `index`."""
        return cast(Assignment, self.log_assignment[index])

    def confidence(self, index: int) -> Confidence:
        """The head after layer `index`; the last layer has none."""
        return cast(Confidence, self.token_confidence[index])

    def with_layers_in(self, kind: torch.dtype) -> LightGlue:
        """This network, everything but the position code in another precision."""
        for name, part in self.named_children():
            if name not in ("posenc", "groundenc"):
                part.to(dtype=kind)
        return self

    def begin(self, side: Side) -> tuple[Tensor, Code]:
        """States (B, N, dim) and position codes of one side."""
        kind = self.layers[0].self_attn.Wqkv.weight.dtype

        def code(encoding: nn.Module, places: Tensor) -> Rotary:
            cosines, sines = encoding(places)
            return cosines.to(kind), sines.to(kind)

        on_ground = None if self.groundenc is None or side.ground is None else code(self.groundenc, side.ground)
        return self.input_proj(side.descriptors.to(kind)), Code(code(self.posenc, side.places), on_ground)

    def states(self, side0: Side, side1: Side) -> Iterator[tuple[Tensor, Tensor]]:
        """States (B, M, dim), (B, N, dim) of both sides after each layer: what training looks at."""
        (x0, code0), (x1, code1) = self.begin(side0), self.begin(side1)
        for layer in self.layers:
            x0, x1 = layer.through(x0, x1, (code0, code1))
            yield x0, x1

    def certain(self, index: int, x: Tensor) -> Tensor:
        """Which keypoints (B, N) of the states x (B, N, dim) after layer `index` count as certain."""
        least = 0.8 + 0.1 * math.exp(-4.0 * index / len(self.transformers))
        return torch.sigmoid(self.confidence(index).logits(x).float()) >= least

    def staying(self, index: int, x: Tensor, certain: Tensor, width_confidence: float) -> Tensor:
        """Which keypoints (B, N) are worth a further layer after layer `index`; certain: (B, N)."""
        partnered = torch.sigmoid(self.assignment(index).logits(x).float())
        return (partnered > 1.0 - width_confidence) | ~certain

    @torch.inference_mode()
    def match(
        self, side0: Side, side1: Side, *, threshold: float, depth_confidence: float, width_confidence: float
    ) -> tuple[Tensor, Tensor]:
        """Index pairs (K, 2) int64, sorted by the first, and scores (K,) float32 of one pair of pictures (B = 1).

        depth_confidence: share of keypoints that must be certain to stop before the last layer, -1 never.
        width_confidence: a certain keypoint goes where its probability of having no partner is larger, -1 never.
        """
        (x0, code0), (x1, code1) = self.begin(side0), self.begin(side1)
        total = x0.shape[1] + x1.shape[1]
        kept = [torch.arange(x.shape[1], device=x.device) for x in (x0, x1)]
        last = len(self.transformers) - 1
        for index, layer in enumerate(self.layers):
            if min(len(kept[0]), len(kept[1])) == 0:
                return torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0)
            x0, x1 = layer.through(x0, x1, (code0, code1))
            if index == last:
                break
            certain = [torch.ones(x.shape[:2], dtype=torch.bool, device=x.device) for x in (x0, x1)]
            if depth_confidence > 0.0:
                certain = [self.certain(index, x) for x in (x0, x1)]
                uncertain = sum(int((~flags).sum()) for flags in certain)
                if 1.0 - uncertain / total > depth_confidence:
                    break
            if width_confidence > 0.0:
                x0, code0, kept[0] = self._pruned(index, x0, code0, kept[0], certain[0], width_confidence)
                x1, code1, kept[1] = self._pruned(index, x1, code1, kept[1], certain[1], width_confidence)
        if min(len(kept[0]), len(kept[1])) == 0:
            return torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0)
        rows, columns, scores = mutual_best(self.assignment(index), x0, x1)
        good = scores > threshold
        pairs = torch.stack([kept[0][rows[good]], kept[1][columns[good]]], dim=1)
        return pairs, scores[good]

    def _pruned(
        self, index: int, x: Tensor, code: Code, kept: Tensor, certain: Tensor, confidence: float
    ) -> tuple[Tensor, Code, Tensor]:
        stays = torch.nonzero(self.staying(index, x, certain, confidence)[0]).squeeze(1)
        if len(stays) == x.shape[1]:
            return x, code, kept
        return x[:, stays], code.at(slice(None), slice(None), stays), kept[stays]


def log_assignment(head: Assignment, x0: Tensor, x1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Log probability (B, M, N) of each pair, and (B, M), (B, N) that a keypoint has no partner, in float32."""
    similarity = head.similarity(x0, x1).float()
    logits0, logits1 = head.logits(x0).float(), head.logits(x1).float()
    both = functional.logsigmoid(logits0)[:, :, None] + functional.logsigmoid(logits1)[:, None]
    pairs = 2.0 * similarity - similarity.logsumexp(2, keepdim=True) - similarity.logsumexp(1, keepdim=True) + both
    return pairs, functional.logsigmoid(-logits0), functional.logsigmoid(-logits1)


def mutual_best(head: Assignment, x0: Tensor, x1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows, columns (K,) and scores (K,) float32 of the pairs that are each other's best, of one pair of pictures.

    The same as the mutual maxima of exp(log_assignment), rows in blocks.
    """
    similarity = head.similarity(x0, x1)[0].float()
    by_row, by_column = similarity.logsumexp(1), similarity.logsumexp(0)
    weight0 = functional.logsigmoid(head.logits(x0)[0].float()) - by_row
    weight1 = functional.logsigmoid(head.logits(x1)[0].float()) - by_column
    best0 = torch.empty(len(weight0), dtype=torch.int64, device=x0.device)
    value1 = torch.full((len(weight1),), -math.inf, device=x0.device)
    best1 = torch.zeros(len(weight1), dtype=torch.int64, device=x0.device)
    value0 = torch.empty(len(weight0), device=x0.device)
    for start in range(0, len(weight0), _ROWS):
        scores = 2.0 * similarity[start : start + _ROWS] + weight0[start : start + _ROWS, None] + weight1
        value0[start : start + _ROWS], best0[start : start + _ROWS] = scores.max(1)
        value, row = scores.max(0)
        better = value > value1
        value1 = torch.where(better, value, value1)
        best1 = torch.where(better, row + start, best1)
    rows = torch.nonzero(best1[best0] == torch.arange(len(best0), device=best0.device)).squeeze(1)
    return rows, best0[rows], value0[rows].exp()
