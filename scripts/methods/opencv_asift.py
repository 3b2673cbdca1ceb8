"""Peer `opencv-asift`."""

from __future__ import annotations

from typing import Any

from methods.base import Described, Found, Options, Scene
from methods.matching import RATIO, match_described
from methods.opencv_sift import described, make_sift, read_gray

# OpenCV's defaults (tilts sqrt(2)^k up to 5, 72 degrees of rotation): 43 views. They only take effect by position.
_AFFINE = (5, 0, 1.4142135623730951, 72.0)
_VIEWS = 43


class OpenCvAsift:
    """OpenCV's AffineFeature (ASIFT) over the SIFT of `opencv-sift`, matched and verified like it.

    Each of its 43 simulated views keeps at most B descriptors; with the budget of an image, the B strongest responses
    over all views enter matching, with the budget of a view all of them.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        import cv2

        self.scene = scene
        self.budget = options.keypoints * (_VIEWS if options.budget == "view" else 1)
        self.detector: Any = cv2.AffineFeature.create(make_sift(options.keypoints), *_AFFINE)

    def features(self, image: str) -> Described:
        keypoints, descriptors = self.detector.detectAndCompute(read_gray(self.scene, image), None)
        return described(keypoints, descriptors, self.budget)

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        cameras = self.scene.cameras
        return match_described(cameras[image0], cameras[image1], features0, features1, RATIO)
