"""ALIKED's keypoints and descriptors on every view of an image, with the weights that its authors have published.

Source: Zhao et al., ALIKED: a lighter keypoint and descriptor extraction network via deformable transformation, IEEE
Transactions on Instrumentation and Measurement 72, 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import FloatArray
from aeromatch_cli.nets.descriptor_bytes import as_bytes
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.described import Described, pixels_field
from aeromatch_cli.strategies.extractors.detection import Raw
from aeromatch_cli.strategies.extractors.heat import SIZE_PX, inside_shown

# Keypoints of a view that the even spread chooses from, for each that it may keep.
_CHOICE = 8
# Pixels of pictures whose maps are held, about 100 bytes each.
_HELD_PX = 4_000_000


class _Looks:
    """What the network saw of the pictures at hand: found for their keypoints, read again for the descriptors."""

    def __init__(self) -> None:
        self._held: list[tuple[Any, NDArray[Any], Any]] = []

    def of(self, network: Any, gray: NDArray[Any]) -> Any:
        """Of a picture (H, W), gray as all views are, for the three colours."""
        import torch

        for asked, known, maps in self._held:
            if asked is network and known is gray:
                return maps
        values = torch.from_numpy(np.ascontiguousarray(gray)).float() / 255.0
        self._held.append((network, gray, network.maps(values.expand(3, -1, -1))))
        while len(self._held) > 1 and sum(known.size for _, known, _ in self._held) > _HELD_PX:
            self._held.pop(0)
        return self._held[-1][2]


_LOOKS = _Looks()


class Aliked(Described):
    """ALIKED, a network that others have published. Its weights are found in an installed package or in the weights
    folder (`aeromatch weights list`); without them the strategy is refused."""

    version: ClassVar[int] = 1
    network: ClassVar[bool] = True
    descriptors: ClassVar[str] = "ALIKED"
    name: Literal["aliked"] = "aliked"
    pixels_per_keypoint: float = pixels_field(1500.0)
    # Twelve real pairs on north-up views: 5,443 correct matches with n16, 5,106 with n16rot.
    model: Literal["n16", "n16rot"] = Field(
        "n16",
        description="Which of the published networks. n16rot was trained with pictures that are turned: for images "
        "that are matched as they were taken (simulate=none).",
    )

    @property
    def north_up_only(self) -> bool:
        """Descriptors follow the picture's rows: views with north up match no others."""
        return True

    def fingerprint_files(self) -> tuple[str, ...]:
        """The published file. Raises ConfigError where it is not there."""
        return (str(self._path()),)

    def _path(self) -> Path:
        from aeromatch_cli.nets.published import published_path

        return published_path(f"aliked-{self.model}")

    def _network(self) -> Any:
        from aeromatch_cli.nets.aliked import load_aliked

        return load_aliked(self._path())

    def detected(self, view: ViewPixels, view_idx: int) -> Raw:
        """The strongest maxima of the score map."""
        network = self._network()
        points, scores = network.keypoints(_LOOKS.of(network, view.gray), _CHOICE * self.keypoints)
        # The network looks at pictures of one scale: all keypoints are as large as the finest of `learned`.
        found = Raw.of_points(
            points.numpy().astype(np.float64), np.full(len(points), SIZE_PX), scores.numpy(), view_idx
        )
        return found.take(inside_shown(view.valid, found.source_px, found.sizes_px))

    def suffice(self, raw: Raw, factor: int) -> bool:
        """Always, as of `learned`: the surest keypoints of finer views match none of the other images."""
        del raw, factor
        return True

    def strengths(self, raw: Raw) -> FloatArray:
        """The network's scores."""
        return raw.responses

    def described(self, raw: Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
        """Descriptor bytes (N, 128), see `as_bytes`."""
        import torch

        network = self._network()
        found = np.zeros((len(raw.view_idx), self.descriptor_length), np.float32)
        for view_idx, view in enumerate(views):
            of_view = np.flatnonzero(raw.view_idx == view_idx)
            if len(of_view):
                points = torch.from_numpy(raw.points_px[of_view].astype(np.float32))
                found[of_view] = network.descriptors(_LOOKS.of(network, view.gray), points).numpy()
        return as_bytes(found)
