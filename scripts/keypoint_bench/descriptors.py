"""Descriptors that are compared, all of the very same patches: one place, size and angle for each keypoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from methods.aliked import read_weights
from methods.base import Options
from methods.keynet import in_tfeat_words
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.strategies.extractors.detection import Raw
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of
from keypoint_bench.detectors import Keypoints, detect_sift
from keypoint_bench.pictures import Picture

_BATCH = 256


@dataclass(frozen=True, eq=False)
class Side:
    """One picture of a pair with its keypoints of the overlap, in the order of the descriptors.

    every: all keypoints that the picture offers, wherever; rows: (N,) those of the overlap among them. patches: (N, 32,
    32) uint8, cut along the keypoints' angles. own: OpenCV's keypoints (N) of the same place, size and angle, whose
    octaves SIFT needs.
    """

    picture: Picture
    every: Keypoints
    rows: IntArray
    patches: NDArray[np.uint8]
    own: tuple[Any, ...]

    @property
    def keypoints(self) -> Keypoints:
        return self.every.take(self.rows)


class Describer(Protocol):
    def __call__(self, side: Side) -> NDArray[np.float32]:
        """(N, C), compared by Euclidean distance."""
        ...


class Sift:
    """OpenCV's SIFT at the keypoints; root: square roots of the L1-normalised values (RootSIFT)."""

    def __init__(self, options: Options, *, root: bool = False) -> None:
        del options
        self.root = root

    def __call__(self, side: Side) -> NDArray[np.float32]:
        import cv2

        detector = cv2.SIFT.create(enable_precise_upscale=True)
        kept, values = detector.compute(side.picture.filled_gray, list(side.own))
        if len(kept) != len(side.own):
            raise RuntimeError(f"OpenCV described {len(kept)} of {len(side.own)} keypoints")
        found = np.asarray(values, np.float32).reshape(-1, 128)
        if not self.root:
            return found
        return np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1.0))


class TFeat:
    """TFeat through kornia, or HardTFeat, which has the same layers and other weights."""

    def __init__(self, options: Options, *, weights: str) -> None:
        from kornia.feature import TFeat as Network

        self.network: Any = Network(pretrained=False)
        self.network.load_state_dict(in_tfeat_words(read_weights(options, weights)))
        self.network.eval()

    def __call__(self, side: Side) -> NDArray[np.float32]:
        import torch

        found = []
        with torch.inference_mode():
            for start in range(0, len(side.patches), _BATCH):
                batch = torch.from_numpy(side.patches[start : start + _BATCH, None]).float() / 255.0
                found.append(torch.nn.functional.normalize(self.network(batch), dim=1).numpy())
        return np.concatenate(found) if found else np.zeros((0, 128), np.float32)


class Own:
    """This project's descriptor without context; weights: a file other than the shipped one."""

    def __init__(self, options: Options, weights: Path | None = None) -> None:
        from aeromatch_cli.nets.geodesc import load_geodesc

        del options
        self.network: Any = load_geodesc(weights) if weights else load_geodesc()

    def __call__(self, side: Side) -> NDArray[np.float32]:
        from aeromatch_cli.nets.geodesc import describe

        return describe(side.patches, self.network)


class OwnWithContext(Own):
    """The same with context: all keypoints of the picture, not only those that the other one shows, are around."""

    def __call__(self, side: Side) -> NDArray[np.float32]:
        from aeromatch_cli.nets.geodesc import describe
        from aeromatch_cli.strategies.extractors.context import with_context

        every, nothing = side.every, np.zeros(len(side.every.points_px))
        plain = describe(patches_of(side.picture, every), self.network)
        raw = Raw(
            source_px=every.points_px,
            source_sizes_px=every.sizes_px,
            points_px=every.points_px,
            sizes_px=every.sizes_px,
            orientations_deg=every.angles_deg,
            responses=nothing,
            octaves=nothing.astype(np.int32),
            view_idx=nothing.astype(np.int32),
        )
        return with_context(plain, raw, side.picture.gray)[side.rows]


def _tfeat(weights: str) -> Callable[..., Describer]:
    return lambda options: TFeat(options, weights=weights)


DESCRIBERS: Mapping[str, Callable[..., Describer]] = {
    "sift": Sift,
    "rootsift": lambda options: Sift(options, root=True),
    "tfeat": _tfeat("tfeat-liberty.params"),
    "hardtfeat": _tfeat("HardTFeat.pth"),
    "ours": Own,
    "ours+context": OwnWithContext,
}


def make_side(picture: Picture, table: FloatArray, own: Sequence[Any], rows: IntArray, *, upright: bool) -> Side:
    """A side of the rows x, y, size, angle of OpenCV's keypoints, `rows` of them in the overlap; upright: angles 0."""
    import cv2

    every = Keypoints(table[:, :2], table[:, 2], np.zeros(len(table)) if upright else table[:, 3])
    shown = every.take(rows)
    turned = tuple(
        cv2.KeyPoint(*own[row].pt, own[row].size, float(angle), own[row].response, own[row].octave)
        for row, angle in zip(rows, shown.angles_deg, strict=True)
    )
    return Side(picture, every, rows, patches_of(picture, shown), turned)


def patches_of(picture: Picture, keypoints: Keypoints) -> NDArray[np.uint8]:
    """(N, 32, 32), cut along the keypoints' angles."""
    return cut_patches(levels_of(picture.gray), keypoints.points_px, keypoints.sizes_px, keypoints.angles_deg)


def strongest_sift(picture: Picture, most: int, *, upright: bool) -> tuple[FloatArray, list[Any]]:
    """x, y, size, angle, response (N, 5) and OpenCV's keypoints: the strongest; upright: each place and size once."""
    table, own = detect_sift(picture)
    order = np.lexsort((table[:, 3], table[:, 2], table[:, 0], table[:, 1], -table[:, 4]))
    if upright:
        _, first = np.unique(table[order, :3], axis=0, return_index=True)
        order = order[np.sort(first)]
    order = order[:most]
    return table[order], [own[i] for i in order]
