"""What matchers of descriptors share: comparable views, search windows, and the second, guided search."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, Matches, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.prediction import Windows, search_windows
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.descriptors.assignment import distinct, one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, Where
from aeromatch_cli.strategies.matchers.descriptors.guided import SecondSearch
from aeromatch_cli.strategies.matchers.descriptors.overlap import by_plane, strongest

# Of guide_below_matches: all pairs are searched again.
EVERY_PAIR = sys.maxsize
# Matches closer than this in both images are one.
_SAME_MATCH_PX = 1.0
# So many matches without windows predict places well: a scan within the windows would find hardly others.
_PREDICT = 100
# So many keypoints of either image, of so many and more, are compared first to learn what both images show.
_SCOUTS, _SCOUTS_OF = 2000, 4000

T = TypeVar("T")
# A search that yields inputs for a network, is sent as many outputs, and returns a result. The caller decides when the
# network runs, and for how many pairs at once.
Steps = Generator[Sequence[Any], Sequence[Any], T]


def finished(steps: Steps[T], run_network: Callable[[Sequence[Any]], Sequence[Any]]) -> T:
    """The result of steps, with the network run for each of their inputs as they come."""
    try:
        inputs = next(steps)
        while True:
            inputs = steps.send(run_network(inputs))
    except StopIteration as end:
        result: T = end.value
        return result


def guided_field(*, default: bool) -> Any:
    """The setting `guided` of one matcher."""
    return Field(
        default,
        description="Guided search: match again within the windows predicted by the poses, then around the places "
        "predicted by verified matches.",
    )


def guide_below_field(default: int) -> Any:
    """The setting `guide_below_matches` of one matcher."""
    return Field(
        default,
        ge=1,
        description="Guided search and enhanced pictures are used only for pairs with fewer matches than this. "
        "Larger: more pairs are searched again, more time.",
    )


class Search(Strategy):
    """A matcher that compares the views of similar direction of two images, with at most one match per keypoint.

    Source images are matched first. Pairs with fewer than guide_below_matches are matched again, with enhanced pictures
    and, if guided, in two searches. Where both attitudes and the ground are known, a keypoint of image 0 is compared
    with those of image 1 within the window that the poses and their sigma predict. Then, with or without poses, around
    the places that verified matches predict (`descriptors.guided`).
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma", "ground"})
    max_direction_deg: float = Field(
        5.0,
        ge=0.0,
        le=180.0,
        description="Largest angle between the directions of two simulated views that are compared, degrees. Larger: "
        "more view pairs, more time.",
    )
    guided: bool = guided_field(default=False)
    guide_below_matches: int = guide_below_field(500)
    sigmas: float = Field(
        3.0,
        gt=0.0,
        description="Guided search: half-width of the window in predicted standard deviations. Larger: allows for "
        "less accurate poses, more ambiguous matches.",
    )
    sigma_px: float = Field(
        1.5, gt=0.0, description="Guided search: standard deviation of a keypoint, pixels. Larger: wider windows."
    )
    relief: float = Field(
        0.3,
        gt=0.0,
        lt=1.0,
        description="Guided search: largest height above or below the ground, in flying heights. Larger: longer "
        "windows.",
    )

    def reads(self) -> frozenset[str]:
        """Nothing of the geometry, unless guided. What a first scan undistorts by is in the features' fingerprints."""
        return self.needs if self.guided else frozenset()

    def __call__(self, features0: Features, features1: Features, geometry: PairGeometry) -> Matches:
        """Matches of one pair, sorted by keypoint of image 0.

        Scores are the matcher's own, or 1 - cost where a model guided the search.
        """
        return finished(self.steps(features0, features1, geometry), self.run_network)

    def again(self, features0: Features, features1: Features, geometry: PairGeometry, scanned: Matches) -> Matches:
        """The call, where a cheaper search has already found the matches `scanned` of the same features."""
        return finished(self.steps(features0, features1, geometry, scanned), self.run_network)

    @property
    def batches_pairs(self) -> bool:
        """Whether the network is faster for many pairs at once."""
        return False

    def run_network(self, inputs: Sequence[Any]) -> Sequence[Any]:
        """One output for each input that `steps` yields. Raises TypeError in a matcher without a network."""
        raise TypeError(f"{type(self).__name__} has no network")

    def steps(
        self, features0: Features, features1: Features, geometry: PairGeometry, scanned: Matches | None = None
    ) -> Steps[Matches]:
        """The call as a generator: it yields inputs for the network. scanned: as in `again`."""
        comparable = comparable_views(features0, features1, self.max_direction_deg)
        source, *enhanced = (comparable & which for which in appearances(features0, features1))
        windows = self.windows(features0, geometry) if self.guided else None
        where = Where(windows, undistort(geometry.camera1, features1.keypoints_px)) if windows is not None else None
        comparison = Comparison(features0, features1, geometry, source)
        if scanned is None or enhanced:  # nobody knows in which of both pictures they were found
            found = self._first_scan(comparison)
        else:
            found = _as_found(scanned, features0, features1)
        comparison = replace(comparison, where=where)
        found = comparison.within(found)
        if len(found.rows) < self.guide_below_matches:
            comparison, found = yield from self._search_again(comparison, found, enhanced)
        return _matches(comparison, found)

    def _first_scan(self, comparison: Comparison) -> Found:
        """A scan of all keypoints. Where the strongest keypoints tell what both images show, it compares that alone:
        most of the time goes into the rest, and what is not there can only be mistaken."""
        if min(len(side.keypoints_px) for side in (comparison.features0, comparison.features1)) < _SCOUTS_OF:
            return self.scan(comparison)
        scouted = self.scan(replace(comparison, shown=strongest(comparison, _SCOUTS)))
        return self.scan(replace(comparison, shown=by_plane(comparison, scouted)))

    @abstractmethod
    def scan(self, comparison: Comparison) -> Found:
        """Matches of all comparable view pairs, within the search windows.

        A keypoint may occur several times. Costs lie in 0-1; the score of a match is 1 - cost.
        """

    def _search_again(
        self, comparison: Comparison, found: Found, enhanced: list[BoolArray]
    ) -> Steps[tuple[Comparison, Found]]:
        """The comparison with most matches (source or enhanced pictures) and its matches after the guided search.

        found: what a scan without windows has left within them. enhanced: comparable view pairs
        (V0, V1) of the enhanced pictures, if there are any.
        """
        enough = comparison.where is None or len(found.rows) >= _PREDICT
        first = found if enough else self._first_scan(comparison)
        others = [replace(comparison, comparable=comparable) for comparable in enhanced]
        scans = [(comparison, first), *((other, self.scan(other)) for other in others)]
        # Under the same sun the borders of shadows are texture, else they mislead: the number of matches decides.
        comparison, found = max(scans, key=lambda scan: len(scan[1].rows))
        again = SecondSearch(comparison) if self.guided else None
        return comparison, (yield from self.refined(comparison, again(found) if again else found, again))

    def refined(self, comparison: Comparison, found: Found, again: SecondSearch | None) -> Steps[Found]:
        """Matches after a more expensive search, none by default. again: the guided search, None if it is off."""
        yield from ()
        return found

    def windows(self, features0: Features, geometry: PairGeometry) -> Windows | None:
        """Search windows in image 1 for every keypoint of image 0, None where poses or ground are unknown."""
        pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
        if pose0 is None or pose1 is None or ground_z_m is None:
            return None
        heights_m = [float(pose.center_m[2]) - ground_z_m for pose in (pose0, pose1)]
        if pose0.world_rotation is None or pose1.world_rotation is None or min(heights_m) <= 0.0:
            return None
        return search_windows(
            features0.keypoints_px,
            geometry.camera0,
            pose0,
            geometry.camera1,
            pose1,
            ground_z_m,
            relief_m=self.relief * min(heights_m),
            sigmas=self.sigmas,
            sigma_px=self.sigma_px,
        )


def _as_found(matches: Matches, features0: Features, features1: Features) -> Found:
    """Of each match the first descriptors of its keypoints in its views."""
    sides = [
        _first_descriptors(features, matches.indices[:, side], matches.view_pairs[:, side])
        for side, features in enumerate((features0, features1))
    ]
    return Found(sides[0], sides[1], 1.0 - matches.scores.astype(np.float64))


def _first_descriptors(features: Features, keypoint_idx: IntArray, view_idx: IntArray) -> IntArray:
    """The first descriptor (N,) of keypoints (N,) in views (N,)."""
    views = len(features.view_angles_deg)
    codes = features.descriptor_keypoint_idx.astype(np.int64) * views + features.view_idx
    order = np.argsort(codes, kind="stable")
    return order[np.searchsorted(codes[order], keypoint_idx.astype(np.int64) * views + view_idx)]


def _matches(comparison: Comparison, found: Found) -> Matches:
    """The cheapest matches in which each keypoint occurs once, and no two lie together in both images."""
    features0, features1 = comparison.features0, comparison.features1
    idx0, idx1 = comparison.keypoints(found)
    kept = one_to_one(idx0, idx1, found.costs)
    places: FloatArray = np.concatenate(
        [features0.keypoints_px[idx0[kept]], features1.keypoints_px[idx1[kept]]], axis=1, dtype=np.float64
    )
    kept = kept[distinct(places, found.costs[kept], _SAME_MATCH_PX)]
    kept = kept[np.argsort(idx0[kept], kind="stable")]
    rows, columns = found.rows[kept], found.columns[kept]
    return Matches(
        indices=np.stack([idx0[kept], idx1[kept]], axis=1).astype(np.int32),
        scores=(1.0 - found.costs[kept]).astype(np.float32),
        view_pairs=np.stack([features0.view_idx[rows], features1.view_idx[columns]], axis=1).astype(np.int16),
    )


def comparable_views(features0: Features, features1: Features, max_direction_deg: float) -> BoolArray:
    """View pairs (V0, V1) worth comparing: pictures as taken, of distant ground too, with each other, and simulated
    views whose directions differ by at most max_direction_deg. A view of unknown direction is compared with every view.
    """
    directions0, directions1 = (np.asarray(f.view_directions, np.float64) for f in (features0, features1))
    return comparable(directions0, directions1, _is_source(features0), _is_source(features1), max_direction_deg)


def comparable(
    directions0: FloatArray, directions1: FloatArray, source0: BoolArray, source1: BoolArray, max_direction_deg: float
) -> BoolArray:
    """(V0, V1) as in `comparable_views`. directions: (V, 3) unit vectors, NaN where unknown. source: (V,) bool."""
    known0, known1 = (np.asarray(np.isfinite(directions).all(axis=1)) for directions in (directions0, directions1))
    with np.errstate(invalid="ignore"):
        found = directions0 @ directions1.T >= np.cos(np.deg2rad(max_direction_deg)) - 1e-6
    found &= source0[:, None] == source1
    found |= source0[:, None] & source1
    found |= ~known0[:, None] | ~known1
    return np.asarray(found)


def appearances(features0: Features, features1: Features) -> list[BoolArray]:
    """View pairs (V0, V1) of the pictures as taken, and of the enhanced ones where either image has any.

    A picture in which nothing was enhanced is its own enhanced one.
    """
    found = [~features0.view_enhanced[:, None] & ~features1.view_enhanced]
    if features0.view_enhanced.any() or features1.view_enhanced.any():
        sides = [f.view_enhanced if f.view_enhanced.any() else ~f.view_enhanced for f in (features0, features1)]
        found.append(sides[0][:, None] & sides[1])
    return found


def _is_source(features: Features) -> BoolArray:
    """The source, or its part with distant ground, is the first view of its picture where there is one, without a
    ground sampling distance and not turned from its own axis."""
    flags = np.isnan(features.view_gsd_m) & (features.view_angles_deg == 0.0)
    first = np.ones(len(flags), dtype=bool)
    first[1:] = features.view_enhanced[1:] != features.view_enhanced[:-1]
    return np.asarray(flags & first)
