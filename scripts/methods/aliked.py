"""Peer `aliked`."""

from __future__ import annotations

from typing import Any

import numpy as np

from aeromatch_cli.errors import ConfigError
from methods.base import Described, Found, Options, Scene, strongest
from methods.matching import match_described

_WEIGHTS = "aliked-n16rot.pth"
_DERIVED = {"dkd.hw_grid"}  # a derived buffer that kornia does not keep


class Aliked:
    """ALIKED (n16rot, the rotation-trained weights) through kornia, mutual nearest neighbours, MAGSAC++ on F.

    Colour images; the B strongest maxima of its score map, whatever its threshold. No ratio: its users match by mutual
    neighbours. Source: Zhao et al., IEEE TIM 2023.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        from kornia.feature import ALIKED

        self.scene, self.options = scene, options
        self.network: Any = ALIKED("aliked-n16rot", max_num_keypoints=options.keypoints, detection_threshold=0.0).eval()
        missing, unexpected = self.network.load_state_dict(read_weights(options, _WEIGHTS), strict=False)
        if unexpected or set(missing) - _DERIVED:
            raise ConfigError(f"{_WEIGHTS} does not fit kornia's ALIKED: missing {missing}, unexpected {unexpected}")

    def features(self, image: str) -> Described:
        import torch

        with torch.inference_mode():
            one = self.network(read_colour(self.scene, image))[0]
        sides = (one.keypoints.numpy(), one.keypoint_scores.numpy(), one.descriptors.numpy())
        return strongest(*sides, self.options.keypoints)

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        cameras = self.scene.cameras
        return match_described(cameras[image0], cameras[image1], features0, features1, None)


def read_weights(options: Options, name: str) -> dict[str, Any]:
    """Tensors of one reference file by name; files that keep them under `state_dict` are unwrapped."""
    import torch

    if options.weights is None or not (options.weights / name).is_file():
        raise ConfigError(f"weights {name} not found in {options.weights}; give their folder by --reference-weights")
    content = torch.load(options.weights / name, map_location="cpu", weights_only=True)
    tensors: dict[str, Any] = content.get("state_dict", content)
    return tensors


def read_colour(scene: Scene, image: str) -> Any:
    """(1, 3, H, W) float32 tensor, RGB in 0-1."""
    import cv2
    import torch

    pixels = cv2.imread(str(scene.images / image), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise SystemExit(f"cannot decode {scene.images / image}")
    planes = np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1))
    return torch.from_numpy(planes)[None].float() / 255.0
