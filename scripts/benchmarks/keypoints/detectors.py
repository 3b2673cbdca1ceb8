"""Detectors that are compared, each on any picture, and their figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.rendered import RenderedTruth
from benchmarks.keypoints.correspondence import Keypoints, Picture, Pictures, in_overlap, partners
from benchmarks.keypoints.figures import Asked
from benchmarks.peers.base import Options
from benchmarks.peers.kornia_peers import aliked_network, keynet_detector, keynet_keypoints
from benchmarks.tables import Row
from benchmarks.views import away_from_unseen, filled

# Of a keypoint's patch of 6.4 sizes, as the project's own descriptors see it.
_KEYNET_SIZE = 2.0 / 6.4
_CONTRAST_THRESHOLD = 0.004  # lower than any user's: 1,000 keypoints in a small overlap on dull ground
_MARGIN_PX = 5.0
# Asked of a detector: enough that 1,000 lie in an overlap of a tenth of the picture.
MOST = 10_000


class Detector(Protocol):
    def __call__(self, picture: Picture, most: int) -> Keypoints:
        """At most so many keypoints of a picture, the strongest, none in what it has not seen; angles may be 0."""
        ...


class Sift:
    """OpenCV's SIFT with precise upscaling: every place once, whatever its sizes and angles."""

    def __init__(self, options: Options) -> None:
        del options

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        table, _ = strongest_sift(picture, most, once=2)
        return Keypoints(table[:, :2], table[:, 2], table[:, 3])


class KeyNet:
    """Key.Net through kornia, places in pixel centres as in the peer `keynet`."""

    def __init__(self, options: Options) -> None:
        self.detector = keynet_detector(options, MOST)

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        _, _, places, scales = keynet_keypoints(self.detector, picture.filled_gray, most)
        return _kept(picture, Keypoints(places, _KEYNET_SIZE * scales, np.zeros(len(places))))


class Aliked:
    """ALIKED (n16rot) through kornia: the strongest maxima of its score map."""

    def __init__(self, options: Options) -> None:
        self.network = aliked_network(options, MOST)

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        import torch

        planes = np.ascontiguousarray(filled(picture.colours, picture.seen).transpose(2, 0, 1))
        with torch.inference_mode():
            # As its forward does, descriptors left out: they cost most of the time.
            _, heat = self.network.extract_dense_map(torch.from_numpy(planes)[None].float() / 255.0)
            places, strengths, _ = self.network.dkd(heat)
        last = np.array([planes.shape[2] - 1, planes.shape[1] - 1])
        points, scores = last * (places[0].numpy().astype(np.float64) + 1.0) / 2.0, strengths[0].numpy()
        points = points[np.lexsort((points[:, 0], points[:, 1], -scores))[:most]]
        return _kept(picture, Keypoints(points, np.full(len(points), 5.0), np.zeros(len(points))))


class Heat:
    """This project's detector; weights: a file other than the shipped one."""

    def __init__(self, options: Options, weights: Path | None = None) -> None:
        from aeromatch_cli.nets.detector import load_detector

        del options
        self.network: Any = load_detector(weights) if weights else None

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        from aeromatch_cli.strategies.extractors.heat import heat_keypoints

        points, sizes, _ = heat_keypoints(picture.gray, most, picture.seen, self.network)
        return Keypoints(points, sizes, np.zeros(len(points)))


DETECTORS: Mapping[str, Callable[..., Detector]] = {"sift": Sift, "keynet": KeyNet, "aliked": Aliked, "ours": Heat}


def detect_sift(picture: Picture) -> tuple[FloatArray, tuple[Any, ...]]:
    """x, y, size, angle, response (N, 5) of every SIFT keypoint away from what was not seen, and OpenCV's own."""
    import cv2

    detector = cv2.SIFT.create(contrastThreshold=_CONTRAST_THRESHOLD, enable_precise_upscale=True)
    found = detector.detect(picture.filled_gray, None)
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in found], np.float64).reshape(-1, 5)
    kept = np.flatnonzero(away_from_unseen(table[:, :2], picture.seen, _MARGIN_PX))
    return table[kept], tuple(found[i] for i in kept)


def strongest_sift(picture: Picture, most: int, *, once: int) -> tuple[FloatArray, list[Any]]:
    """x, y, size, angle, response (N, 5) and OpenCV's keypoints: the strongest, in an order that does not depend on
    OpenCV's. once: of keypoints that are alike in so many columns one is kept; 0: all are.
    """
    table, own = detect_sift(picture)
    order = np.lexsort((table[:, 3], table[:, 2], table[:, 0], table[:, 1], -table[:, 4]))
    if once:
        _, first = np.unique(table[order, :once], axis=0, return_index=True)
        order = order[np.sort(first)]
    order = order[:most]
    return table[order], [own[i] for i in order]


def _kept(picture: Picture, keypoints: Keypoints) -> Keypoints:
    return keypoints.take(np.flatnonzero(away_from_unseen(keypoints.points_px, picture.seen, _MARGIN_PX)))


def detector_figures(truth: RenderedTruth, pictures: Pictures, asked: Asked) -> Callable[..., Row]:
    """How many keypoints of a pair each detector finds again, and how exactly."""

    @cache
    def found(detector: Detector, image: str, frame: str) -> Keypoints:
        return detector(pictures(image, frame), MOST)

    def figures(images: tuple[str, str], frame: str, detector: Detector) -> Row:
        both = pictures(images[0], frame), pictures(images[1], frame)
        sides = found(detector, images[0], frame), found(detector, images[1], frame)
        return detector_row(truth, sides, both, asked.keypoints)

    return figures


def detector_row(
    truth: RenderedTruth, found: tuple[Keypoints, Keypoints], pictures: tuple[Picture, Picture], count: int
) -> Row:
    """Of the strongest `count` of either side that the other picture shows, too."""
    sides = [
        side.take(np.flatnonzero(in_overlap(truth, picture, side.points_px, other))[:count])
        for side, picture, other in zip(found, pictures, pictures[::-1], strict=True)
    ]
    stored = [picture.stored_px(side.points_px) for picture, side in zip(pictures, sides, strict=True)]
    again = partners(truth, pictures[0].image, stored[0], pictures[1].image, stored[1])
    return {
        "keypoints0": len(stored[0]),
        "keypoints1": len(stored[1]),
        "repeated_3px": len(again.errors_px),
        "repeated_1px": int((again.errors_px <= 1.0).sum()),
        "error_px": float(np.median(again.errors_px)) if len(again.errors_px) else None,
    }
