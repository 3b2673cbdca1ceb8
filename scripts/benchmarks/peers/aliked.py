"""Peer `aliked`."""

from __future__ import annotations

from typing import Any

from aeromatch_cli.errors import ConfigError
from benchmarks.peers.base import Described, Options, Scene, read_colour, read_weights, strongest
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
