"""LightGlue: an attention network that matches the keypoints of both images jointly.

Every view is matched in its own frame, because the network reads positions, scales and orientations as it saw them
in training (`matchers.inference`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.precision import DEVICE, Device, Precision, check_device, device_of
from aeromatch_cli.strategies.matchers.descriptors.assignment import one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import (
    Comparison,
    Found,
    joined,
    ratio_test,
    ratio_test_both_ways,
)
from aeromatch_cli.strategies.matchers.descriptors.evidence import most_evident
from aeromatch_cli.strategies.matchers.descriptors.guided import SecondSearch
from aeromatch_cli.strategies.matchers.descriptors.overlap import in_overlap
from aeromatch_cli.strategies.matchers.descriptors.search import Search, Steps, guide_below_field, guided_field
from aeromatch_cli.strategies.matchers.lightglue.inference import (
    NetworkInput,
    NetworkOptions,
    check_length,
    loaded_network,
    network_input,
)

# Smallest cost of matches that the network did not find; those of the network have 1 - probability.
_DOUBTFUL = 0.7
# More than a pair has: the network finds more in easy pairs as well.
_EVERY = 100_000
# The network's matches above these probabilities are tried as well: on unusual ground it is overconfident.
_SURER = (0.3, 0.5, 0.8)
_LEARNED_RATIO = 0.9


def network_below_field(default: int) -> Any:
    """The setting `network_below_matches` of one matcher."""
    return Field(
        default,
        ge=1,
        description="The network runs only for pairs with fewer matches than this after the ratio test and guided "
        "search (about half a second per pair). Larger: more pairs use it; above extract.keypoints, and "
        "guide_below_matches too: every pair.",
    )


def width_field(default: float) -> Any:
    """The setting `width_confidence` of one matcher."""
    return Field(
        default,
        ge=-1.0,
        le=1.0,
        description="Confidence (0-1) at which the network drops keypoints; -1 = never. Larger: fewer are dropped, "
        "more time.",
    )


class Attention(Search):
    """LightGlue (Lindenberger et al., ICCV 2023) for pairs in which the ratio test finds few matches.

    Without `weights`, those that ship with the package, trained on aerial images (nets/trained/*.md).
    shipped: their file. signed: descriptors are bytes of values with a sign (`nets.descriptor_bytes`).
    """

    network: ClassVar[bool] = True
    shipped: ClassVar[str]
    signed: ClassVar[bool] = False
    name: str
    network_below_matches: int = network_below_field(250)
    weights: str | None = Field(
        None,
        description="Path of a weights file, or its name in the weights folder (`aeromatch weights list`); null = the "
        "package's own.",
        json_schema_extra={"path": "or name"},
    )
    threshold: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="Smallest probability (0-1) of a match found by the network. Larger: fewer matches, fewer of them "
        "wrong. Matches of the other searches are not affected.",
    )
    only_overlap: bool = Field(
        True,
        description="Give the network only the keypoints within the predicted overlap of both images (from earlier "
        "matches, else from poses and ground).",
    )
    depth_confidence: float = Field(
        0.95,
        ge=-1.0,
        le=1.0,
        description="Confidence (0-1) at which the network stops early; -1 = never. Larger: more layers, more time.",
    )
    width_confidence: float = width_field(0.99)
    max_keypoints: int = Field(
        2048,
        ge=1,
        description="Number of strongest descriptors per view that the network compares; time grows with its square.",
    )
    precision: Precision = Field(
        "auto",
        description="Number type of the network's layers; auto is bfloat16 where the processor has it. Matches depend "
        "on it: set it explicitly for shards on different processors.",
    )
    device: Device = DEVICE

    def reads(self) -> frozenset[str]:
        """The cameras, in which a pair's matches are judged; more where guided or limited to the overlap."""
        return self.needs if self.guided or self.only_overlap else frozenset({"camera"})

    def fingerprint_files(self) -> tuple[str, ...]:
        """Path of the file whose SHA-256 belongs to the fingerprint. Raises ConfigError where it is missing."""
        from aeromatch_cli.nets.folder import resolve_weights

        return (str(self.usual_path() if self.weights is None else resolve_weights(self.weights)),)

    def usual_path(self) -> Path:
        """The file without the setting `weights`: one that ships."""
        from aeromatch_cli.nets.files import shipped_path

        return shipped_path(self.shipped)

    def check_files(self, descriptor_length: int) -> None:
        """Loads the user's own weights once. Those of the package are checked by `aeromatch weights verify`."""
        (path,) = self.fingerprint_files()
        check_device(self.device)
        if self.weights is not None:
            from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration, read_descriptors

            network = load_lightglue(Path(path))
            check_length(network.dimensions.input_dim, descriptor_length)
            read_calibration(Path(path))
            known = read_descriptors(Path(path)) or self.reads_descriptors
            if known != self.reads_descriptors:
                raise ConfigError(
                    f"match.weights {self.weights!r} was trained on {known} descriptors, and match={self.name} "
                    f"compares {self.reads_descriptors}: give weights trained on these, or leave match.weights out"
                )

    def own_weights(self) -> tuple[str, ...]:
        """The file named by `weights`."""
        return () if self.weights is None else self.fingerprint_files()

    def scan(self, comparison: Comparison) -> Found:
        """The mutual ratio test."""
        return ratio_test(comparison)

    def refined(self, comparison: Comparison, found: Found, again: SecondSearch | None) -> Steps[Found]:
        """With too few matches: those of the network and the earlier ones, and the guided search after them."""
        if len(found.rows) >= self.network_below_matches:
            return found
        shown = in_overlap(comparison, found, self.windows) if self.only_overlap else None
        closer = yield from self.by_network(comparison, shown, len(found.rows))
        doubtful = replace(found, costs=np.maximum(found.costs, _DOUBTFUL))
        surer = [joined([closer.take(closer.costs <= 1.0 - least), doubtful]) for least in self._least_probabilities()]
        closer = most_evident(comparison, [*surer, doubtful])
        return again(closer, keep=True) if again else closer

    def _least_probabilities(self) -> list[float]:
        return [self.threshold, *(least for least in _SURER if least > self.threshold)]

    def by_network(
        self, comparison: Comparison, shown: tuple[BoolArray, BoolArray] | None = None, known: int = 0
    ) -> Steps[Found]:
        """Matches of all view pairs that are comparable, each keypoint once, costs 1 - probability.

        shown: (K0,), (K1,) the keypoints that the other image may show. known: number of matches without the network.
        The network is symmetric up to rounding, and image_id0 < image_id1 fixes which image comes first, so that the
        order of the files changes nothing. Raises ConfigError where weights are missing or expect other descriptors.
        """
        del known
        if shown is None:
            shown = (
                np.ones(len(comparison.features0.keypoints_px), bool),
                np.ones(len(comparison.features1.keypoints_px), bool),
            )
        views = [
            self.inputs(comparison, int(view0), int(view1), shown)
            for view0, view1 in np.argwhere(comparison.comparable)
        ]
        views = [(side0, side1) for side0, side1 in views if len(side0.rows) and len(side1.rows)]
        outputs = yield views
        found = comparison.within(
            joined(
                [
                    Found(side0.rows[pairs[:, 0]], side1.rows[pairs[:, 1]], 1.0 - probabilities)
                    for (side0, side1), (pairs, probabilities) in zip(views, outputs, strict=True)
                ]
            )
        )
        return found.take(one_to_one(*comparison.keypoints(found), found.costs))

    def inputs(
        self, comparison: Comparison, view0: int, view1: int, shown: tuple[BoolArray, BoolArray]
    ) -> tuple[NetworkInput, NetworkInput]:
        """What the network is given of two views. shown: (K0,), (K1,) the keypoints that the other image may show."""
        sides = (comparison.features0, view0, shown[0]), (comparison.features1, view1, shown[1])
        side0, side1 = (network_input(*side, self.max_keypoints, signed=self.signed) for side in sides)
        return side0, side1

    @property
    def batches_pairs(self) -> bool:
        """A GPU takes many pairs in the time of one."""
        return device_of(self.device) == "cuda"

    def run_network(self, inputs: Sequence[tuple[NetworkInput, NetworkInput]]) -> list[tuple[IntArray, FloatArray]]:
        """Of each pair of views row pairs (M, 2) and their probabilities (M,)."""
        (path,) = self.fingerprint_files()
        wanted = NetworkOptions(
            path, self.precision, self.device, self.threshold, self.depth_confidence, self.width_confidence
        )
        return loaded_network(wanted).run_network(inputs)


class EveryPair(Attention):
    """LightGlue for learned descriptors, which are less alike than those of SIFT: it is shown every pair, and what it
    finds is searched once more, guided."""

    signed: ClassVar[bool] = True
    guided: bool = guided_field(default=True)
    guide_below_matches: int = guide_below_field(_EVERY)
    network_below_matches: int = network_below_field(_EVERY)

    def scan(self, comparison: Comparison) -> Found:
        """The ratio test from either image, as `Bidirectional` has it."""
        return ratio_test_both_ways(comparison, _LEARNED_RATIO)


class LightGlue(Attention):
    """LightGlue, a network that matches by attention between both images, for the features of `extract=sift`."""

    version: ClassVar[int] = 6
    reads_descriptors: ClassVar[str] = "RootSIFT"
    shipped: ClassVar[str] = "lightglue"
    name: Literal["lightglue"] = "lightglue"
