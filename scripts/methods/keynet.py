"""Peers `keynet` and `keynet-tfeat`."""

from __future__ import annotations

from typing import Any

import numpy as np

from methods.aliked import read_weights
from methods.base import Described, Found, Options, Scene, strongest
from methods.matching import match_described
from methods.opencv_sift import read_gray

# HardTFeat's own names -> those of kornia's TFeat: the same layers, the last a convolution over the whole patch.
_LAYERS = {"features.0": "features.1", "features.3": "features.4", "classifier.1": "descr.0"}
_HARD_ONLY = "SIFT."  # a handcrafted descriptor that was saved along
_RATIO = 0.95
_SPARE = 1.25  # slots asked for beyond the budget: some stay empty at the image's border


class KeyNet:
    """Key.Net keypoints, OriNet orientations, HardTFeat (or TFeat) descriptors of 32 x 32 patches, through kornia.

    The B strongest responses; mutual nearest neighbours with ratio 0.95 (kornia's own default; on rendered city and
    grass 1.8 times the correct matches of 0.8), MAGSAC++ on F. kornia reports a maximum of a pyramid level by its pixel
    times the level's scale s; half a pixel of (s - 1) is added here, which is where the level's pixel centre is.
    Sources: Barroso-Laguna et al., ICCV 2019; Mishkin et al., ECCV 2018; Balntas et al., BMVC 2016.
    """

    def __init__(self, scene: Scene, options: Options, *, descriptor: str = "HardTFeat.pth") -> None:
        from kornia.feature import KeyNetDetector, LAFDescriptor, LAFOrienter, OriNet, TFeat

        self.scene, self.options = scene, options
        orienter: Any = OriNet(pretrained=False)
        orienter.load_state_dict(read_weights(options, "OriNet.pth"))
        self.detector: Any = KeyNetDetector(
            pretrained=False,
            num_features=int(_SPARE * options.keypoints),
            ori_module=LAFOrienter(32, angle_detector=orienter.eval()),
        )
        self.detector.model.load_state_dict(read_weights(options, "keynet_pytorch.pth"))
        network: Any = TFeat(pretrained=False)
        network.load_state_dict(in_tfeat_words(read_weights(options, descriptor)))
        self.describer: Any = LAFDescriptor(network.eval(), patch_size=32)
        self.detector.eval()

    def features(self, image: str) -> Described:
        import torch
        from kornia.feature import get_laf_scale

        pixels = torch.from_numpy(read_gray(self.scene, image))[None, None].float() / 255.0
        with torch.inference_mode():
            frames, responses = self.detector(pixels)
            filled = torch.nonzero(responses[0] > 0)[: self.options.keypoints, 0]
            frames = frames[:, filled]
            descriptors = torch.nn.functional.normalize(self.describer(pixels, frames)[0], dim=1).numpy()
        level_scales = get_laf_scale(frames)[0, :, 0] / self.detector.mr_size
        places = (frames[0, :, :, 2] + 0.5 * (level_scales - 1.0)).numpy().astype(np.float64)
        return strongest(places, responses[0, filled].numpy(), descriptors, self.options.keypoints)

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        cameras = self.scene.cameras
        return match_described(cameras[image0], cameras[image1], features0, features1, _RATIO)


def in_tfeat_words(tensors: dict[str, Any]) -> dict[str, Any]:
    """Weights of TFeat or HardTFeat by kornia's names."""
    if "descr.0.weight" in tensors:
        return tensors
    renamed = {}
    for key, tensor in tensors.items():
        layer, _, kind = key.rpartition(".")
        if not key.startswith(_HARD_ONLY):
            is_last = layer == "classifier.1" and kind == "weight"
            renamed[f"{_LAYERS[layer]}.{kind}"] = tensor.flatten(1) if is_last else tensor
    return renamed
