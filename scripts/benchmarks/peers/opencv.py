"""Peers `opencv-sift` and `opencv-asift`."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.peers.base import Described, Options, Scene, read_gray, strongest
from benchmarks.peers.matching import Peer

CONTRAST_THRESHOLD = 0.01
# OpenCV's defaults (tilts sqrt(2)^k up to 5, 72 degrees of rotation): 43 views. They only take effect by position.
_AFFINE = (5, 0, 1.4142135623730951, 72.0)
_VIEWS = 43


class OpenCvSift(Peer):
    """OpenCV's SIFT on the source image.

    The B strongest responses are kept. The contrast threshold is lowered from 0.04 to 0.01, so that weak texture
    reaches the budget too; where it does anyway the strongest are the same. Precise upscaling is on: without it every
    keypoint of OpenCV 5 is off by a quarter pixel.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        import cv2

        super().__init__(scene, options)
        self.budget = options.keypoints
        # Keeps the strongest, sometimes one more.
        self.detector: Any = cv2.SIFT.create(
            nfeatures=options.keypoints, contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True
        )

    def features(self, image: str) -> Described:
        keypoints, descriptors = self.detector.detectAndCompute(read_gray(self.scene, image), None)
        table = np.array([(*k.pt, k.response) for k in keypoints], np.float64).reshape(-1, 3)
        rows = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
        return strongest(table[:, :2], table[:, 2], rows, self.budget)


class OpenCvAsift(OpenCvSift):
    """OpenCV's AffineFeature (ASIFT) over the SIFT of `opencv-sift`, matched and verified like it.

    Each of its 43 simulated views keeps at most B descriptors; with the budget of an image, the B strongest responses
    over all views enter matching, with the budget of a view all of them.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        import cv2

        super().__init__(scene, options)
        self.budget *= _VIEWS if options.budget == "view" else 1
        self.detector = cv2.AffineFeature.create(self.detector, *_AFFINE)
