"""LightGlue: an attention network that matches the keypoints of both images jointly.

Every view is matched in its own frame, because the network reads positions, scales and orientations as it saw them
in training (`matchers.inference`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.precision import DEVICE, Device, Precision, device_of
from aeromatch_cli.strategies.matchers.descriptors.assignment import one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, joined, ratio_test
from aeromatch_cli.strategies.matchers.descriptors.evidence import most_evident
from aeromatch_cli.strategies.matchers.descriptors.guided import SecondSearch
from aeromatch_cli.strategies.matchers.descriptors.search import Search, Steps
from aeromatch_cli.strategies.matchers.lightglue.inference import Shown, Wanted, check_length, ready, shown_of
from aeromatch_cli.strategies.matchers.lightglue.overlap import in_overlap

# Cost at least of matches that are there without the network's having found them, beside those of 1 - probability.
_DOUBTFUL = 0.7
# Where the network sees more than there is, its surest matches alone, or none, support a model better: probabilities.
_SURER = (0.3, 0.5, 0.8)


class LightGlue(Search):
    """LightGlue (Lindenberger et al., ICCV 2023) for the pairs that the mutual ratio test leaves poor.

    Without `weights`, those that ship with the package, trained on aerial images (nets/trained/lightglue.md).
    """

    version: ClassVar[int] = 5
    reads_descriptors: ClassVar[str] = "RootSIFT"
    name: Literal["lightglue"] = "lightglue"
    network_below_matches: int = Field(
        250,
        ge=1,
        description="Where the ratio test, and the guided search after it, find so many matches, the network is not "
        "asked: it takes half a second a pair. For it everywhere, raise this and `ample` above `extract.keypoints`.",
    )
    weights: str | None = Field(
        None,
        description="Path of a weights file, or its name in the weights folder (`aeromatch weights list`).",
        json_schema_extra={"path": "or name"},
    )
    threshold: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="Smallest probability of a match of the network's, as far as the weights are calibrated. "
        "Matches of the other searches join whatever it is.",
    )
    only_overlap: bool = Field(
        True,
        description="Only keypoints that the other image may show are compared, as far as the plane of the matches "
        "found before, or else poses and ground, tell.",
    )
    depth_confidence: float = Field(0.95, ge=-1.0, le=1.0, description="Early stopping; -1 turns it off.")
    width_confidence: float = Field(0.99, ge=-1.0, le=1.0, description="Point pruning; -1 turns it off.")
    max_keypoints: int = Field(
        2048, ge=1, description="Strongest descriptors kept per view; time grows with its square."
    )
    precision: Precision = Field(
        "auto",
        description="Of the network's layers; auto is bfloat16 where the processor has it. Matches "
        "depend on it: name one for shards on different processors.",
    )
    device: Device = DEVICE

    def reads(self) -> frozenset[str]:
        """The cameras, in which a pair's matches are judged; more where guided or limited to the overlap."""
        return self.needs if self.guided or self.only_overlap else frozenset({"camera"})

    def fingerprint_files(self) -> tuple[str, ...]:
        """Path of the file whose SHA-256 belongs to the fingerprint. Raises ConfigError where it is missing."""
        from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
        from aeromatch_cli.nets.folder import resolve_weights

        if self.weights is not None:
            return (str(resolve_weights(self.weights)),)
        if not SHIPPED_LIGHTGLUE.is_file():
            raise ConfigError(
                "matcher lightglue needs a weights file: set `match.weights` to its path, or add it with "
                "`aeromatch weights add PATH` and set `match.weights` to its name"
            )
        return (str(SHIPPED_LIGHTGLUE),)

    def check_files(self, descriptor_length: int) -> None:
        """Weights that a user names are loaded once; those that ship are `aeromatch weights verify`'s."""
        (path,) = self.fingerprint_files()
        device_of(self.device)
        if self.weights is not None:
            from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

            network = load_lightglue(Path(path))
            check_length(network.dimensions.input_dim, descriptor_length)
            read_calibration(Path(path))

    def own_weights(self) -> tuple[str, ...]:
        """The file that `weights` stands for."""
        return () if self.weights is None else self.fingerprint_files()

    def scan(self, asked: Comparison) -> Found:
        """The mutual ratio test."""
        return ratio_test(asked)

    def look_closer(self, asked: Comparison, found: Found, again: SecondSearch | None) -> Steps[Found]:
        """Where there are too few: the network's matches and those found before; guided, they lead the search anew."""
        if len(found.rows) >= self.network_below_matches:
            return found
        shown = in_overlap(asked, found, self.windows) if self.only_overlap else None
        closer = yield from self.by_network(asked, shown)
        doubtful = replace(found, costs=np.maximum(found.costs, _DOUBTFUL))
        surer = [joined([closer.take(closer.costs <= 1.0 - least), doubtful]) for least in self._least_probabilities()]
        closer = most_evident(asked, [*surer, doubtful])
        return again(closer, keep=True) if again else closer

    def _least_probabilities(self) -> list[float]:
        return [self.threshold, *(least for least in _SURER if least > self.threshold)]

    def by_network(self, asked: Comparison, shown: tuple[BoolArray, BoolArray] | None = None) -> Steps[Found]:
        """Matches of all view pairs that are alike, each keypoint once, costs 1 - probability.

        shown: (K0,), (K1,) the keypoints that the other image may show.
        The network is symmetric up to rounding, and image_id0 < image_id1 fixes which image comes first, so that the
        order of the files changes nothing. Raises ConfigError where weights are missing or expect other descriptors.
        """
        if shown is None:
            shown = np.ones(len(asked.features0.keypoints_px), bool), np.ones(len(asked.features1.keypoints_px), bool)
        views = [
            (
                shown_of(asked.features0, int(view0), shown[0], self.max_keypoints),
                shown_of(asked.features1, int(view1), shown[1], self.max_keypoints),
            )
            for view0, view1 in np.argwhere(asked.alike)
        ]
        views = [(side0, side1) for side0, side1 in views if len(side0.rows) and len(side1.rows)]
        answers = yield views
        found = asked.within(
            joined(
                [
                    Found(side0.rows[pairs[:, 0]], side1.rows[pairs[:, 1]], 1.0 - probabilities)
                    for (side0, side1), (pairs, probabilities) in zip(views, answers, strict=True)
                ]
            )
        )
        return found.take(one_to_one(*asked.keypoints(found), found.costs))

    @property
    def asks_together(self) -> bool:
        """A GPU answers many pairs in the time of one."""
        return device_of(self.device) == "cuda"

    def answers(self, questions: Sequence[tuple[Shown, Shown]]) -> list[tuple[IntArray, FloatArray]]:
        """Of each pair of views row pairs (M, 2) and their probabilities (M,)."""
        (path,) = self.fingerprint_files()
        wanted = Wanted(path, self.precision, self.device, self.threshold, self.depth_confidence, self.width_confidence)
        return ready(wanted).answers(questions)
