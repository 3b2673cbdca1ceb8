"""Peer `aliked`."""

from __future__ import annotations

from benchmarks.peers.base import Described, Options, Scene, read_colour, read_weights, size_of, strongest
from benchmarks.peers.matching import Peer

ALIKED_ROTATED, ALIKED = "aliked-n16rot", "aliked-n16"


class Aliked(Peer):
    """ALIKED, by default n16rot, the rotation-trained weights.

    Colour images; the B strongest maxima of its score map, whatever its threshold. No ratio: its users match by mutual
    neighbours. Source: Zhao et al., IEEE TIM 2023.
    """

    ratio = None

    def __init__(self, scene: Scene, options: Options, *, model: str = ALIKED_ROTATED) -> None:
        from aeromatch_cli.nets.aliked import AlikedNetwork

        super().__init__(scene, options)
        self.network = AlikedNetwork(read_weights(options, f"{model}.pth"))

    def features(self, image: str) -> Described:
        pixels = read_colour(self.scene, image)
        maps = self.network.maps(pixels[0])
        points, scores = self.network.keypoints(maps, self.options.keypoints)
        sides = (points.numpy(), scores.numpy(), self.network.descriptors(maps, points).numpy())
        return strongest(*sides, self.options.keypoints, size_px=size_of(pixels))
