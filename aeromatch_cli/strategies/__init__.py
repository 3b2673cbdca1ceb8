"""Strategies: what can be switched. Each is one class (schema, defaults, version, callable) and one line in its
family's table; it touches arrays only.

Calls, by family (table in the family's __init__):

  pairings    strategy(block) -> list[Pair]                          sorted by ids, image_id0 < image_id1
  enhancers   strategy(pixels, valid) -> Enhanced                    one image, before any view is made
  simulators  strategy(camera, pose, ground_z_m, gsd_m, neighbours) -> tuple[View, ...]
  extractors  strategy(camera, views) -> Features                    views: ViewPixels of one image
  matchers    strategy(features0, features1, geometry) -> Matches      those with reads_pixels: also rasters, of both
  filters     strategy(candidates, geometry, seed) -> Verdict            points in stored pixels
  refiners    strategy(first, second, second_from_first) -> shifts, held   patches around matched keypoints
  exporters   strategy(contents, folder) -> ExportSummary            the only family that writes: a foreign format
  orienters   no call: a recipe of the first pass and the orientation that `stages.orient` follows
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from aeromatch_cli.data import BoolArray, Camera, Features, Image, Matches, Neighbour, PairGeometry, Pose, Raster, View


class Strategy(BaseModel):
    """A frozen, hashable recipe.

    version: raised whenever the results change; part of the fingerprint.
    needs: what the call reads of an image's geometry, of "camera", "pose" (centre and attitude), "sigma", "ground" and
    "neighbours" (cameras, poses and ground of the images it is paired with); only that enters the fingerprint, so that
    a change re-does exactly the stages that depend on it. A filter that reads "colour" needs extract.colours.
    reads_pixels: True for a matcher that is also given both images' rasters.
    network: True for what runs a network, which a GPU makes faster.
    descriptors: what those of an extractor are called, "" where it makes none.
    reads_descriptors: the descriptors that a matcher was made for, "" where any will do.
    verifies: False for a filter that limits matches but is no evidence for them; a chain needs one that is.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset()
    reads_pixels: ClassVar[bool] = False
    network: ClassVar[bool] = False
    descriptors: ClassVar[str] = ""
    reads_descriptors: ClassVar[str] = ""
    verifies: ClassVar[bool] = True

    def reads(self) -> frozenset[str]:
        """Those of `needs` that this very recipe reads: fewer where an option leaves some out."""
        return self.needs

    def fingerprint_files(self) -> tuple[str, ...]:
        """Paths of files (weights) whose contents are part of the recipe; fields that name one carry "path" in their
        json_schema_extra. Raises ConfigError where one is missing.
        """
        return ()

    def check_files(self, descriptor_length: int) -> None:
        """Raises ConfigError where a file is missing, or is not what it is named for with this extractor."""
        self.fingerprint_files()

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError, before the start, where an exporter cannot write these images, or lacks a library."""

    def own_weights(self) -> tuple[str, ...]:
        """The user's own weights files, used instead of the package's. To be called after `check_files`."""
        return ()


@dataclass(frozen=True, eq=False)
class Enhanced:
    """pixels: like the input. mask: (H, W) uint8 of what was treated, or None. info: JSON-ready facts."""

    pixels: NDArray[Any]
    mask: NDArray[Any] | None = None
    info: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ViewPixels:
    """A view with its picture. gray: (H, W) uint8. valid: (H, W) bool, False where nothing was seen, or None = all."""

    view: View
    gray: NDArray[Any]
    valid: BoolArray | None


class Enhancer(Protocol):
    """needs_colour: False where the strategy takes gray pixels, which decode faster.
    changes: False where pictures always pass as they are, so that none of them is worth a file.
    keep_source: whether the picture as it was taken has views too, so that every pair can use what suits it.
    same_illumination_minutes: with keep_source, images whose partners were all taken within this time are not enhanced.
    """

    needs_colour: ClassVar[bool]
    changes: ClassVar[bool]

    @property
    def keep_source(self) -> bool: ...

    @property
    def same_illumination_minutes(self) -> float: ...

    def __call__(self, pixels: NDArray[Any], valid: BoolArray | None) -> Enhanced: ...


class Simulator(Protocol):
    def __call__(
        self,
        camera: Camera,
        pose: Pose | None,
        ground_z_m: float | None,
        gsd_m: float | None,
        neighbours: Sequence[Neighbour] = (),
    ) -> tuple[View, ...]: ...


class Extractor(Protocol):
    """descriptor_length: of every descriptor. descriptors: what they are called, "" where there are none.
    colours: whether the stage adds the colour around every keypoint to the features.
    north_up_only: whether descriptors of a north-up view are comparable with those of north-up views only.
    with_extra_views: the same extractor for images with additional views, needed where other images have no attitude.
    """

    descriptor_length: ClassVar[int]
    descriptors: ClassVar[str]
    network: ClassVar[bool]

    @property
    def colours(self) -> bool: ...

    @property
    def north_up_only(self) -> bool: ...

    def with_extra_views(self, views: int) -> Extractor: ...

    def __call__(self, camera: Camera, views: Sequence[ViewPixels]) -> Features: ...


class Matcher(Protocol):
    name: str
    reads_pixels: ClassVar[bool]
    network: ClassVar[bool]
    reads_descriptors: ClassVar[str]

    def reads(self) -> frozenset[str]: ...

    def __call__(
        self, features0: Features, features1: Features, geometry: PairGeometry, *rasters: tuple[Raster, Raster]
    ) -> Matches: ...


@runtime_checkable
class BatchedMatcher(Protocol):
    """A matcher with a network, which takes many pairs at once where `batches_pairs` says that this is faster.

    steps: the call as a generator: it yields inputs for the network, is sent as many outputs, and returns the matches.
    """

    @property
    def batches_pairs(self) -> bool: ...

    def steps(
        self, features0: Features, features1: Features, geometry: PairGeometry
    ) -> Generator[Sequence[Any], Sequence[Any], Matches]: ...

    def run_network(self, inputs: Sequence[Any]) -> Sequence[Any]: ...
