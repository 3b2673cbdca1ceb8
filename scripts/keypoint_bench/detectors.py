"""Detectors that are compared, each on any picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from methods.aliked import read_weights
from methods.base import Options
from methods.ground import away_from_unseen, filled

from aeromatch_cli.data import FloatArray, IntArray
from keypoint_bench.pictures import Picture

# Of a keypoint's patch of 6.4 sizes, as the project's own descriptors see it.
_KEYNET_SIZE = 2.0 / 6.4
_CONTRAST_THRESHOLD = 0.004  # lower than any user's: 1,000 keypoints in a small overlap on dull ground
_MARGIN_PX = 5.0


@dataclass(frozen=True, eq=False)
class Keypoints:
    """points_px: (N, 2) of the picture, strongest first. sizes_px: (N,) diameters. angles_deg: (N,), x towards y."""

    points_px: FloatArray
    sizes_px: FloatArray
    angles_deg: FloatArray

    def take(self, rows: IntArray) -> Keypoints:
        return Keypoints(self.points_px[rows], self.sizes_px[rows], self.angles_deg[rows])


class Detector(Protocol):
    def __call__(self, picture: Picture, most: int) -> Keypoints:
        """At most so many keypoints of a picture, the strongest, none in what it has not seen; angles may be 0."""
        ...


class Sift:
    """OpenCV's SIFT with precise upscaling; angles are the first of each place's."""

    def __init__(self, options: Options) -> None:
        del options

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        return self.strongest_places(picture, most)

    @staticmethod
    def strongest_places(picture: Picture, most: int) -> Keypoints:
        """Every place once, whatever its sizes and orientations."""
        table, _ = detect_sift(picture)
        # The fixed order of the benchmark's peers: by response, then place.
        table = table[np.lexsort((table[:, 3], table[:, 0], table[:, 1], -table[:, 4]))]
        _, first = np.unique(table[:, :2], axis=0, return_index=True)
        table = table[np.sort(first)[:most]]
        return Keypoints(table[:, :2], table[:, 2], table[:, 3])


class KeyNet:
    """Key.Net through kornia, places in pixel centres as in the peer `keynet`."""

    def __init__(self, options: Options) -> None:
        from kornia.feature import KeyNetDetector

        self.make: Callable[[int], Any] = lambda most: KeyNetDetector(pretrained=False, num_features=most)
        self.tensors = read_weights(options, "keynet_pytorch.pth")

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        import torch
        from kornia.feature import get_laf_scale

        detector = self.make(most)
        detector.model.load_state_dict(self.tensors)
        pixels = torch.from_numpy(picture.filled_gray)[None, None].float() / 255.0
        with torch.inference_mode():
            frames, responses = detector.eval()(pixels)
            frames = frames[:, torch.nonzero(responses[0] > 0)[:, 0]]
        scales = get_laf_scale(frames)[0, :, 0, 0].numpy().astype(np.float64)
        centres = frames[0, :, :, 2].numpy().astype(np.float64) + 0.5 * (scales[:, None] / detector.mr_size - 1.0)
        return _kept(picture, Keypoints(centres, _KEYNET_SIZE * scales, np.zeros(len(centres))))


class Aliked:
    """ALIKED (n16rot) through kornia: the strongest maxima of its score map."""

    def __init__(self, options: Options) -> None:
        self.tensors = read_weights(options, "aliked-n16rot.pth")

    def __call__(self, picture: Picture, most: int) -> Keypoints:
        import torch
        from kornia.feature import ALIKED

        network: Any = ALIKED("aliked-n16rot", max_num_keypoints=most, detection_threshold=0.0).eval()
        network.load_state_dict(self.tensors, strict=False)  # the peer `aliked` checks the file
        planes = np.ascontiguousarray(filled(picture.colours, picture.seen).transpose(2, 0, 1))
        with torch.inference_mode():
            # As its forward does, descriptors left out: they cost most of the time.
            _, heat = network.extract_dense_map(torch.from_numpy(planes)[None].float() / 255.0)
            places, strengths, _ = network.dkd(heat)
        last = np.array([planes.shape[2] - 1, planes.shape[1] - 1])
        points, scores = last * (places[0].numpy().astype(np.float64) + 1.0) / 2.0, strengths[0].numpy()
        points = points[np.lexsort((points[:, 0], points[:, 1], -scores))]
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


def _kept(picture: Picture, keypoints: Keypoints) -> Keypoints:
    return keypoints.take(np.flatnonzero(away_from_unseen(keypoints.points_px, picture.seen, _MARGIN_PX)))
