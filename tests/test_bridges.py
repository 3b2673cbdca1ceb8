"""Probable matches, and pairs that images hang together by."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.sfm.probability import probable_enough

# Two flights, a b and c d, and two pairs between them.
ENDS = [("a", "b"), ("c", "d"), ("a", "c"), ("b", "d")]


def test_only_probable_matches_stay_where_images_hang_together_without_others() -> None:
    likely = [np.full(100, 0.95), np.full(100, 0.95), np.linspace(0.0, 1.0, 101), np.linspace(0.0, 1.0, 101)]
    kept = probable_enough(ENDS, likely, 0.8, 15)
    assert [int(mask.sum()) for mask in kept] == [100, 100, 21, 21]


def test_flights_that_would_fall_apart_keep_the_best_of_the_pairs_between_them() -> None:
    loose = np.linspace(0.0, 0.7, 100)
    kept = probable_enough(ENDS, [np.full(100, 0.95), np.full(100, 0.95), loose, loose[:10]], 0.8, 15)
    assert [int(mask.sum()) for mask in kept] == [100, 100, 30, 0]
    assert kept[2][-30:].all()


def test_a_pair_of_which_nothing_is_known_ties_its_images() -> None:
    kept = probable_enough([*ENDS, ("b", "c")], [np.ones(20), np.ones(20), np.full(50, 0.5), None, None], 0.8, 15)
    assert kept[2] is not None
    assert not kept[2].any()
    assert kept[3] is None
