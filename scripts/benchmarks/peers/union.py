"""Two peers for one pair: what both have verified together, as a user gets it who puts both into one database."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.peers.base import Described, Found, Method, Options, Scene


class Union:
    """Each has the budget, as the steps of `auto` have."""

    def __init__(
        self,
        scene: Scene,
        options: Options,
        *,
        first: Callable[[Scene, Options], Method],
        second: Callable[[Scene, Options], Method],
    ) -> None:
        self.peers = first(scene, options), second(scene, options)

    def features(self, image: str) -> tuple[Described, ...]:
        return tuple(peer.features(image) for peer in self.peers)

    def match(
        self, image0: str, image1: str, features0: tuple[Described, ...], features1: tuple[Described, ...]
    ) -> Found:
        found = [
            peer.match(image0, image1, *sides) for peer, *sides in zip(self.peers, features0, features1, strict=True)
        ]
        return Found(
            *(np.concatenate([getattr(one, name) for one in found]) for name in ("points0_px", "points1_px", "scores")),
            *(np.concatenate([getattr(one, name) for one in found]) for name in ("keypoints0_px", "keypoints1_px")),
            descriptors=sum(one.descriptors for one in found),
        )
