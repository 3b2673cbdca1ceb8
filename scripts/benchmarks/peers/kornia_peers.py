"""Peers `aliked`, `keynet` and `keynet-tfeat`, and their networks, through kornia."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from benchmarks.peers.base import Described, Options, Scene, read_colour, read_gray, read_weights, strongest
from benchmarks.peers.matching import Peer

_WEIGHTS = "aliked-n16rot.pth"
_DERIVED = {"dkd.hw_grid"}  # a derived buffer that kornia does not keep


class Aliked(Peer):
    """ALIKED (n16rot, the rotation-trained weights) through kornia.

    Colour images; the B strongest maxima of its score map, whatever its threshold. No ratio: its users match by mutual
    neighbours. Source: Zhao et al., IEEE TIM 2023.
    """

    ratio = None

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self.network = aliked_network(options, options.keypoints)

    def features(self, image: str) -> Described:
        import torch

        with torch.inference_mode():
            one = self.network(read_colour(self.scene, image))[0]
        sides = (one.keypoints.numpy(), one.keypoint_scores.numpy(), one.descriptors.numpy())
        return strongest(*sides, self.options.keypoints)


def aliked_network(options: Options, most: int) -> Any:
    """ALIKED for `most` keypoints. Raises ConfigError where the weights are not its."""
    from kornia.feature import ALIKED

    network: Any = ALIKED("aliked-n16rot", max_num_keypoints=most, detection_threshold=0.0).eval()
    missing, unexpected = network.load_state_dict(read_weights(options, _WEIGHTS), strict=False)
    if unexpected or set(missing) - _DERIVED:
        raise ConfigError(f"{_WEIGHTS} does not fit kornia's ALIKED: missing {missing}, unexpected {unexpected}")
    return network


TFEAT, HARD_TFEAT = "tfeat-liberty.params", "HardTFeat.pth"
# HardTFeat's own names -> those of kornia's TFeat: the same layers, the last a convolution over the whole patch.
_LAYERS = {"features.0": "features.1", "features.3": "features.4", "classifier.1": "descr.0"}
_HARD_ONLY = "SIFT."  # a handcrafted descriptor that was saved along
_SPARE = 1.25  # slots asked for beyond the budget: some stay empty at the image's border
_BATCH = 256


class KeyNet(Peer):
    """Key.Net keypoints, OriNet orientations, HardTFeat (or TFeat) descriptors of 32 x 32 patches, through kornia.

    The B strongest responses, ratio 0.95 (kornia's own default; on rendered city and grass 1.8 times the correct
    matches of 0.8).
    Sources: Barroso-Laguna et al., ICCV 2019; Mishkin et al., ECCV 2018; Balntas et al., BMVC 2016.
    """

    ratio = 0.95

    def __init__(self, scene: Scene, options: Options, *, descriptor: str = HARD_TFEAT) -> None:
        from kornia.feature import LAFDescriptor, LAFOrienter

        super().__init__(scene, options)
        orienter = LAFOrienter(32, angle_detector=orinet(options))
        self.detector = keynet_detector(options, int(_SPARE * options.keypoints), orienter)
        self.describer: Any = LAFDescriptor(tfeat(options, descriptor), patch_size=32)

    def features(self, image: str) -> Described:
        import torch

        gray = read_gray(self.scene, image)
        frames, responses, places, _ = keynet_keypoints(self.detector, gray, self.options.keypoints)
        with torch.inference_mode():
            pixels = torch.from_numpy(gray)[None, None].float() / 255.0
            descriptors = torch.nn.functional.normalize(self.describer(pixels, frames)[0], dim=1).numpy()
        return strongest(places, responses, descriptors, self.options.keypoints)


def keynet_detector(options: Options, most: int, orienter: Any = None) -> Any:
    """Key.Net for `most` keypoints."""
    from kornia.feature import KeyNetDetector

    detector: Any = KeyNetDetector(pretrained=False, num_features=most, ori_module=orienter)
    detector.model.load_state_dict(read_weights(options, "keynet_pytorch.pth"))
    return detector.eval()


def keynet_keypoints(
    detector: Any, gray: NDArray[np.uint8], most: int
) -> tuple[Any, FloatArray, FloatArray, FloatArray]:
    """Local affine frames, responses, places (N, 2) px and scales of the strongest, at most so many.

    kornia reports a maximum of a pyramid level by its pixel times the level's scale s; half a pixel of (s - 1) is added
    here, which is where the level's pixel centre is.
    """
    import torch
    from kornia.feature import get_laf_scale

    with torch.inference_mode():
        frames, responses = detector(torch.from_numpy(gray)[None, None].float() / 255.0)
        filled = torch.nonzero(responses[0] > 0)[:most, 0]
        frames = frames[:, filled]
    scales = get_laf_scale(frames)[0, :, 0]
    places = (frames[0, :, :, 2] + 0.5 * (scales / detector.mr_size - 1.0)).numpy().astype(np.float64)
    return frames, responses[0, filled].numpy(), places, scales[:, 0].numpy().astype(np.float64)


def orinet(options: Options) -> Any:
    """OriNet, for evaluation."""
    from kornia.feature import OriNet

    network: Any = OriNet(pretrained=False)
    network.load_state_dict(read_weights(options, "OriNet.pth"))
    return network.eval()


def tfeat(options: Options, weights: str) -> Any:
    """TFeat, or HardTFeat, which has the same layers and other weights, for evaluation."""
    from kornia.feature import TFeat

    network: Any = TFeat(pretrained=False)
    network.load_state_dict(in_tfeat_words(read_weights(options, weights)))
    return network.eval()


def on_patches(network: Any, patches: NDArray[np.uint8], width: int) -> NDArray[np.float32]:
    """(N, width) of what a network says of patches (N, 32, 32)."""
    import torch

    found = [np.zeros((0, width), np.float32)]
    with torch.inference_mode():
        for start in range(0, len(patches), _BATCH):
            batch = torch.from_numpy(patches[start : start + _BATCH, None]).float() / 255.0
            found.append(network(batch).reshape(-1, width).numpy())
    return np.concatenate(found)


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
