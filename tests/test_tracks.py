"""Grid points and their measurements as keypoints and multi-view tracks."""

import numpy as np

from aeromatch_cli.data import Camera, Matches, Pair, Verdict
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.stages.tracks import MatchedPair, tracks_of

CAMERA = Camera("PINHOLE", 1000, 1000, (1000.0, 1000.0, 499.5, 499.5))
# Pure shifts along x: rows are epipolar lines.
ALONG_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
LATTICE = {
    "a": np.array([[100.0, 100.0], [300.0, 120.0], [500.0, 700.0]]),
    "b": np.array([[80.0, 100.2], [600.0, 600.0]]),
    "c": np.array([[900.0, 900.0]]),
}


def measured(id0, id1, rows, places, kept=None, state="verified"):
    """A pair in which grid points `rows` of id0 were measured at `places`, of which `kept` passed the filters."""

    def matches(which):
        indices = np.column_stack([np.array(rows)[which], np.full(len(which), -1)]).astype(np.int32)
        points0 = LATTICE[id0][np.array(rows)[which]]
        return Matches(indices, np.ones(len(which), np.float32), np.zeros((len(which), 2), np.int16), points0,
                       np.array(places, float)[which])  # fmt: skip

    everything = np.arange(len(rows))
    some = everything if kept is None else np.array(kept, int)
    verdict = Verdict(np.ones(len(some), bool), state, model_kind="F", model=ALONG_X)
    pair = Pair(id0, id1, float("nan"), float("nan"), "name")
    return MatchedPair(pair, matches(everything), VerifiedEntry(id1, "", len(rows), matches(some), verdict))


def tracks(*pairs):
    return tracks_of(pairs, LATTICE.__getitem__, lambda _: CAMERA)


def places_of(found, pair):
    """What the verified matches of a pair join."""
    numbers = found.verified[pair]
    return [found.keypoints_px[name][numbers[:, side]].tolist() for side, name in enumerate(pair)]


def test_measurements_follow_the_lattice_of_their_image():
    found = tracks(measured("a", "b", [0, 2], [[250.0, 100.0], [650.0, 700.0]]))
    assert found.keypoints_px["a"].tolist() == LATTICE["a"].tolist()
    assert found.keypoints_px["b"].tolist() == [
        *LATTICE["b"].astype(np.float32).tolist(),
        [250.0, 100.0],
        [650.0, 700.0],
    ]
    assert found.verified["a", "b"].tolist() == [[0, 2], [2, 3]]
    assert found.raw["a", "b"].tolist() == [[0, 2], [2, 3]]


def test_two_measurements_of_one_point_are_a_match_of_their_images():
    found = tracks(
        measured("a", "b", [0, 1], [[250.0, 100.0], [450.0, 120.0]]),
        measured("a", "c", [0, 1], [[400.0, 100.5], [590.0, 140.0]]),
        measured("b", "c", [1], [[750.0, 600.0]]),
    )
    # Of the second the model of the pair b, c says otherwise: 20 px off its line.
    assert places_of(found, ("b", "c")) == [[[600.0, 600.0], [250.0, 100.0]], [[750.0, 600.0], [400.0, 100.5]]]


def test_points_of_either_image_are_measured_in_the_other():
    item = measured("a", "b", [0, 2], [[250.0, 100.0], [650.0, 700.0]])
    raw = item.raw
    indices = np.concatenate([raw.indices, [[-1, 1]]]).astype(np.int32)
    places = [np.concatenate([raw.points0_px, [[450.0, 600.0]]]), np.concatenate([raw.points1_px, LATTICE["b"][1:]])]
    both = Matches(indices, np.ones(3, np.float32), np.zeros((3, 2), np.int16), *places)
    verified = VerifiedEntry("b", "", 3, both, Verdict(np.ones(3, bool), "verified", model_kind="F", model=ALONG_X))
    found = tracks(MatchedPair(item.pair, both, verified))
    joined = [[[100.0, 100.0], [500.0, 700.0], [450.0, 600.0]], [[250.0, 100.0], [650.0, 700.0], [600.0, 600.0]]]
    assert places_of(found, ("a", "b")) == joined
    # b's point is seen in a and in c: one track, which makes a match of a and c too.
    more = tracks(
        MatchedPair(item.pair, both, verified),
        measured("b", "c", [1], [[30.0, 600.0]]),
        measured("a", "c", [0], [[70.0, 100.0]]),
    )
    assert [[600.0, 600.0], [30.0, 600.0]] in [list(both) for both in zip(*places_of(more, ("b", "c")), strict=True)]
    assert [[450.0, 600.0], [30.0, 600.0]] in [list(both) for both in zip(*places_of(more, ("a", "c")), strict=True)]


def test_a_measurement_on_a_lattice_point_is_that_point():
    found = tracks(
        measured("a", "b", [0], [[80.1, 100.0]]),
        measured("b", "c", [0], [[30.0, 100.0]]),
    )
    assert found.verified["a", "b"].tolist() == [[0, 0]]
    assert places_of(found, ("b", "c")) == [[LATTICE["b"].astype(np.float32)[0].tolist()], [[30.0, 100.0]]]


def test_tracks_that_disagree_elsewhere_stay_apart():
    found = tracks(
        measured("a", "b", [0], [[80.1, 100.0]]),
        measured("a", "c", [0], [[40.0, 100.0]]),
        measured("b", "c", [0], [[30.0, 100.2]]),
    )
    assert found.verified["a", "b"].tolist() == [[0, 2]]


def test_what_the_filters_left_out_is_a_raw_match_alone():
    found = tracks(
        measured("a", "b", [0, 1], [[250.0, 100.0], [450.0, 333.0]], kept=[0]),
        measured("a", "c", [1], [[30.0, 120.0]], kept=[], state="rejected"),
    )
    assert found.verified["a", "b"].tolist() == [[0, 2]]
    assert found.raw["a", "b"].tolist() == [[0, 2], [1, 3]]
    assert found.verified["a", "c"].shape == (0, 2)
    assert found.raw["a", "c"].tolist() == [[1, 1]]
