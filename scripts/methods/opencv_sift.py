"""Peer `opencv-sift`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from methods.base import Described, Found, Options, Scene, strongest
from methods.matching import RATIO, match_described

CONTRAST_THRESHOLD = 0.01


class OpenCvSift:
    """OpenCV's SIFT on the source image, mutual nearest neighbours with ratio 0.8, MAGSAC++ on F.

    The B strongest responses are kept. The contrast threshold is lowered from 0.04 to 0.01, so that weak texture
    reaches the budget too; where it does anyway the strongest are the same. Precise upscaling is on: without it every
    keypoint of OpenCV 5 is off by a quarter pixel.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options
        self.detector: Any = make_sift(options.keypoints)

    def features(self, image: str) -> Described:
        keypoints, descriptors = self.detector.detectAndCompute(read_gray(self.scene, image), None)
        return described(keypoints, descriptors, self.options.keypoints)

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        cameras = self.scene.cameras
        return match_described(cameras[image0], cameras[image1], features0, features1, RATIO)


def make_sift(keypoints: int) -> Any:
    """cv2.SIFT that keeps the strongest `keypoints`, sometimes one more."""
    import cv2

    return cv2.SIFT.create(nfeatures=keypoints, contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True)


def read_gray(scene: Scene, image: str) -> Any:
    """(H, W) uint8 of the stored raster, EXIF orientation ignored."""
    import cv2

    pixels = cv2.imread(str(scene.images / image), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise SystemExit(f"cannot decode {scene.images / image}")
    return pixels


def described(keypoints: Sequence[Any], descriptors: FloatArray | None, budget: int) -> Described:
    """OpenCV's keypoints and descriptors, cut to exactly the budget."""
    table = np.array([(*k.pt, k.response) for k in keypoints], np.float64).reshape(-1, 3)
    rows = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
    return strongest(table[:, :2], table[:, 2], rows, budget)
