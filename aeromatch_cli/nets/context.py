"""Descriptor augmentation: visual and geometric context of a keypoint, added to its descriptor.

Visual context is what a convolutional network sees in a wide, coarse window around the keypoint; geometric context is
how the neighbouring keypoints lie around it, how large they are and what they look like. Both correct the descriptor of
the patch by a residual, so that places that look alike (windows, trees) differ where their surroundings do.

Source: Luo et al., ContextDesc, CVPR 2019, in small: its visual context comes from a large network for image retrieval,
its geometric one from a PointNet over all keypoints of a picture, here from the nearest ones.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.loading import load_network, once_per_file

DESCRIPTOR, VISUAL, GEOMETRIC = 128, 64, 64
NEIGHBOURS = 12
REDUCED = 4  # view pixels along each side of a pixel of the coarse picture
_LOCAL_PX = 31  # of the coarse picture: within it, brightness and contrast are made even
STRIDE = 4  # coarse pixels between two values of the visual context
_LOOKS = 32


class VisualContext(nn.Module):
    """Coarse picture (1, 1, h, w) -> (1, VISUAL, ceil(h / STRIDE), ceil(w / STRIDE)).

    Value (i, j) is centred on coarse pixel (STRIDE i, STRIDE j); it sees 28 of them to every side, and 15 more through
    local brightness and contrast.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(1, 16, 3, padding=1), nn.ReLU(),
            nn.Conv2d(16, 32, 3, padding=1, stride=2), nn.ReLU(),
            nn.Conv2d(32, 48, 3, padding=1, stride=2), nn.ReLU(),
            nn.Conv2d(48, 64, 3, padding=2, dilation=2), nn.ReLU(),
            nn.Conv2d(64, VISUAL, 3, padding=4, dilation=4),
        )  # fmt: skip

    def forward(self, picture: Tensor) -> Tensor:
        """Of a gray picture (1, 1, h, w), 0-1; shapes as the class has them."""
        out: Tensor = self.layers(evened(picture))
        return out


class GeometricContext(nn.Module):
    """Layout (N, K, 4) and looks of the neighbours (N, K), of descriptors (N, DESCRIPTOR) -> (N, GEOMETRIC)."""

    def __init__(self) -> None:
        super().__init__()
        self.looks = nn.Linear(DESCRIPTOR, _LOOKS)
        self.each = nn.Sequential(nn.Linear(4 + _LOOKS, 96), nn.ReLU(), nn.Linear(96, 96), nn.ReLU())
        self.weight = nn.Linear(96, 1)
        self.all = nn.Linear(2 * 96, GEOMETRIC)

    def forward(self, layout: Tensor, descriptors: Tensor, neighbours: Tensor) -> Tensor:
        """layout: (N, K, 4) float. descriptors: (N, DESCRIPTOR). neighbours: (N, K) int64, rows of both."""
        looks = self.looks(descriptors)[neighbours]
        each = self.each(torch.cat([layout.to(looks.dtype), looks], dim=2))
        mean = (self.weight(each).softmax(dim=1) * each).sum(dim=1)
        out: Tensor = self.all(torch.cat([mean, each.amax(dim=1)], dim=1))
        return out


class Context(nn.Module):
    """Descriptors (N, 128) of one view with what is around them, (N, 128) of unit length."""

    def __init__(self) -> None:
        super().__init__()
        self.visual, self.geometric = VisualContext(), GeometricContext()
        width = DESCRIPTOR + VISUAL + GEOMETRIC
        last = nn.Linear(192, DESCRIPTOR)
        self.fusion = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 192), nn.ReLU(), last)
        # In the beginning, a descriptor is its own.
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(
        self, descriptors: Tensor, places: Tensor, layout: Tensor, neighbours: Tensor, picture: Tensor
    ) -> Tensor:
        """descriptors: (N, 128) of unit length. places: (N, 2) x and y, pixels of the coarse picture (1, 1, h, w) in
        0-1. neighbours: (N, K) int64 into the same keypoints; layout: (N, K, 4), see `layout_of`.
        """
        around = self.geometric(layout, descriptors, neighbours)
        change = self.fusion(torch.cat([descriptors, self.seen(picture, places), around], dim=1))
        return nnf.normalize(descriptors + change, dim=1)

    def seen(self, picture: Tensor, places: Tensor) -> Tensor:
        """Visual context (N, VISUAL) of a coarse picture (1, 1, h, w) at places (N, 2), interpolated, float32."""
        visual = self.visual(picture).float()  # bfloat16 would round the places, too
        last = places.new_tensor(visual.shape[:1:-1]) - 1.0
        grid = 2.0 / STRIDE * places / last.clamp_min(1.0) - 1.0
        found = nnf.grid_sample(visual, grid[None, :, None], align_corners=True, padding_mode="border")
        return found[0, :, :, 0].T


def evened(picture: Tensor) -> Tensor:
    """(1, 1, h, w) without brightness and contrast of the square of _LOCAL_PX around each pixel, cut at the edge.

    The detector's are smoothed means of cells, edges repeated; the weights of each depend on its own.
    """
    mean = _blurred(picture)
    spread = (_blurred(picture**2) - mean**2).clamp_min(0.0).sqrt()
    return (picture - mean) / (spread + 0.02)


def _blurred(picture: Tensor) -> Tensor:
    """Means (1, 1, h, w) of squares of _LOCAL_PX around each pixel, fewer at the edges."""
    for side, around in (((_LOCAL_PX, 1), (_LOCAL_PX // 2, 0)), ((1, _LOCAL_PX), (0, _LOCAL_PX // 2))):
        picture = nnf.avg_pool2d(picture, side, 1, around, count_include_pad=False)
    return picture


def layout_of(points: Tensor, sizes: Tensor, angles: Tensor, neighbours: Tensor) -> Tensor:
    """Where the neighbours (N, K) of each keypoint lie, (N, K, 4): direction turned back by the keypoint's own angle
    and divided by the mean distance (2), logarithm of that distance in own sizes, logarithm of the ratio of sizes.

    points (N, 2) and sizes (N,) px of one view, angles (N,) radians.
    """
    apart = points[neighbours] - points[:, None]
    cosine, sine = angles.cos()[:, None], angles.sin()[:, None]
    x, y = cosine * apart[..., 0] + sine * apart[..., 1], cosine * apart[..., 1] - sine * apart[..., 0]
    mean = apart.norm(dim=2).mean(dim=1, keepdim=True).clamp_min(1e-3)
    distance = (mean / sizes[:, None]).log().expand_as(x)
    return torch.stack([x / mean, y / mean, distance, (sizes[neighbours] / sizes[:, None]).log()], dim=2)


@once_per_file
def load_context(path: Path | None = None, device: str = "cpu") -> Context:
    """The network of a weights file, by default the one that ships, once per process, in float32.

    Raises ConfigError where the file is missing or holds another.
    """
    return load_network(lambda _: Context(), path or shipped_path("context"), "float32", device)
