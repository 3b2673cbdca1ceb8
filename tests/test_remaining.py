"""Points of an adjusted block that are left once matches are dropped, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import AdjustedBlock
from aeromatch_cli.sfm.track_pruning import JudgedPair, without_dropped


def block(**tracks: list[tuple[int, int]]) -> AdjustedBlock:
    """Three points, errors 0.1, 0.2 and 0.3 px; tracks: (keypoint, point) of every image."""
    points = np.arange(9.0).reshape(3, 3)
    arrays = {i: np.array(track, np.int32).reshape(-1, 2) for i, track in tracks.items()}
    return AdjustedBlock({}, {}, points, np.array([0.1, 0.2, 0.3]), arrays)


def pair(id0: str, id1: str, *matches: tuple[int, int, bool]) -> JudgedPair:
    """Keypoint, keypoint, kept."""
    found = np.array(matches, np.int64).reshape(-1, 3)
    return id0, id1, found[:, :2].astype(np.int32), found[:, 2].astype(bool)


BLOCK = block(a=[(5, 0), (6, 1), (7, 2)], b=[(9, 1), (8, 0)], c=[(1, 0), (2, 1), (3, 2)], d=[(4, 1)])


def test_nothing_goes_where_no_match_of_a_point_is_dropped() -> None:
    outside = pair("a", "b", (5, 9, False), (99, 8, False), (5, 8, True))  # of two points; of no point
    assert without_dropped(BLOCK, [outside]) is BLOCK


def test_an_observation_without_kept_matches_goes_and_so_does_a_point_of_one() -> None:
    pairs = [
        pair("a", "b", (5, 8, True), (6, 9, True)),
        pair("a", "c", (5, 1, False), (6, 2, True), (7, 3, False)),  # point 2 has no other match
        pair("b", "c", (8, 1, False), (9, 2, True)),
        pair("c", "d", (2, 4, False)),
        pair("d", "e", (4, 4, True)),  # an image that the block has not
    ]
    left = without_dropped(BLOCK, pairs)
    assert left.points_m.tolist() == BLOCK.points_m[:2].tolist()
    assert left.errors_px.tolist() == [0.1, 0.2]
    tracks = {image_id: track.tolist() for image_id, track in left.tracks.items()}
    assert tracks == {"a": [[5, 0], [6, 1]], "b": [[9, 1], [8, 0]], "c": [[2, 1]], "d": []}


@pytest.mark.parametrize(("extra", "kept"), [((), "abc"), ((("d", "e"),), "de")])
def test_the_largest_part_of_a_point_stays(extra: tuple[tuple[str, str], ...], kept: str) -> None:
    """a, b and c tied to each other, and d to c by a dropped match alone; or d and e, where b and c have lost a's."""
    images = "abcde" if extra else "abcd"
    pairs = [pair("c", "d", (0, 0, False)), *(pair(i, j, (0, 0, True)) for i, j in extra)]
    pairs += [pair("a", "b", (0, 0, not extra)), pair("b", "c", (0, 0, not extra))]
    left = without_dropped(block(**{i: [(0, 1)] for i in images}), pairs)
    assert "".join(i for i, track in left.tracks.items() if len(track)) == kept
    assert left.points_m.tolist() == [[3.0, 4.0, 5.0]]


def test_numbers_of_points_follow_those_that_are_left() -> None:
    left = without_dropped(BLOCK, [pair("a", "b", (5, 8, False)), pair("b", "c", (8, 1, False), (9, 2, True))])
    assert left.points_m.tolist() == BLOCK.points_m[1:].tolist()
    assert left.tracks["a"].tolist() == [[6, 0], [7, 1]]
    assert left.tracks["b"].tolist() == [[9, 0]]
