"""What matchers of described keypoints share: views to compare, where matches may lie, and the second search."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Features, FloatArray, Matches, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.prediction import Windows, search_windows
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.descriptors.assignment import distinct, one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, Where
from aeromatch_cli.strategies.matchers.descriptors.guided import SecondSearch
from aeromatch_cli.strategies.matchers.descriptors.views import appearances, like_views

# Matches closer than this in both images are one.
_SAME_MATCH_PX = 1.0

T = TypeVar("T")
# A search that puts questions to a network, is sent as many answers and ends with a result. Whoever runs it decides
# when the network is asked, and for how many pairs at once.
Steps = Generator[Sequence[Any], Sequence[Any], T]


def finished(steps: Steps[T], answers: Callable[[Sequence[Any]], Sequence[Any]]) -> T:
    """The result of steps whose questions are answered as they come."""
    try:
        questions = next(steps)
        while True:
            questions = steps.send(answers(questions))
    except StopIteration as end:
        result: T = end.value
        return result


class Search(Strategy):
    """A matcher that compares the views of like direction of two images, at most one match per keypoint.

    Most pairs of an ordinary block are settled by the pictures as they were taken (`ample`); the others are searched
    harder. guided: where both attitudes and the ground are known, a keypoint of image 0 is only compared with those of
    image 1 that lie where the poses and their sigma put it; then, whatever is known, around the places that the
    verified matches predict (`matchers.guided`).
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma", "ground"})
    max_direction_deg: float = Field(
        5.0, ge=0.0, le=180.0, description="Simulated views whose directions are farther apart are not compared."
    )
    guided: bool = Field(
        False, description="Search where the poses say, then once more around what verified matches predict."
    )
    guide_below_matches: int = Field(
        500,
        ge=1,
        description="Where so many matches are found at once, enhanced pictures and guided search are left out: they "
        "cost more than they add.",
    )
    sigmas: float = Field(3.0, gt=0.0, description="Guided: half-width of the window in predicted standard deviations.")
    sigma_px: float = Field(1.5, gt=0.0, description="Guided: standard deviation of a keypoint, pixels.")
    relief: float = Field(
        0.3, gt=0.0, lt=1.0, description="Guided: how far things rise over or fall below the ground, in flying heights."
    )

    def reads(self) -> frozenset[str]:
        """Nothing of the geometry, unless guided."""
        return self.needs if self.guided else frozenset()

    def __call__(self, features0: Features, features1: Features, geometry: PairGeometry) -> Matches:
        """Matches of one pair, sorted by keypoint of image 0.

        Scores are the matcher's own, or 1 - cost where a model guided the search.
        """
        return finished(self.steps(features0, features1, geometry), self.answers)

    @property
    def asks_together(self) -> bool:
        """Whether it is faster to put the questions of many pairs to the network together."""
        return False

    def answers(self, questions: Sequence[Any]) -> Sequence[Any]:
        """Of a network, one for each question of `steps`. Raises TypeError where a matcher that asks none is asked."""
        raise TypeError(f"{type(self).__name__} asks no network")

    def steps(self, features0: Features, features1: Features, geometry: PairGeometry) -> Steps[Matches]:
        """The call, which stops where a network is asked."""
        alike = like_views(features0, features1, self.max_direction_deg)
        taken, *enhanced = (alike & which for which in appearances(features0, features1))
        windows = self.windows(features0, geometry) if self.guided else None
        where = Where(windows, undistort(geometry.camera1, features1.keypoints_px)) if windows is not None else None
        asked = Comparison(features0, features1, geometry, taken)
        found = self.scan(asked)
        asked = replace(asked, where=where)
        found = asked.within(found)
        if len(found.rows) < self.guide_below_matches:
            asked, found = yield from self._searched_harder(asked, found, enhanced)
        return _matches(asked, found)

    @abstractmethod
    def scan(self, asked: Comparison) -> Found:
        """Matches of all view pairs that are alike, only such as lie where they may.

        A keypoint may occur several times. Costs lie in 0-1; the score of a match is 1 - cost.
        """

    def _searched_harder(
        self, asked: Comparison, found: Found, enhanced: list[BoolArray]
    ) -> Steps[tuple[Comparison, Found]]:
        """The pictures that say most and their matches, where those of the pictures as taken are few.

        enhanced: view pairs (V0, V1) of the enhanced pictures, where there are any.
        """
        first = found if asked.where is None else self.scan(asked)
        others = [replace(asked, alike=alike) for alike in enhanced]
        scans = [(asked, first), *((other, self.scan(other)) for other in others)]
        # Under one sun the borders of shadows are texture, under two they are not: the number of matches tells.
        asked, found = max(scans, key=lambda scan: len(scan[1].rows))
        again = SecondSearch(asked) if self.guided else None
        return asked, (yield from self.look_closer(asked, again(found) if again else found, again))

    def look_closer(self, asked: Comparison, found: Found, again: SecondSearch | None) -> Steps[Found]:
        """What a dearer search makes of the matches found so far. again: the second search, where it is wanted."""
        yield from ()
        return found

    def windows(self, features0: Features, geometry: PairGeometry) -> Windows | None:
        """Where every keypoint of image 0 may lie in image 1, None where that is unknown."""
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


def _matches(asked: Comparison, found: Found) -> Matches:
    """The cheapest matches in which each keypoint occurs once, and no two lie together in both images."""
    features0, features1 = asked.features0, asked.features1
    idx0, idx1 = asked.keypoints(found)
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
