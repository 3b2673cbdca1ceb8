"""Images that look alike: rankings to pairs, and descriptors with known places through pycolmap's visual index."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, Site
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from make_features import described

from aeromatch_cli.formats.features import write_features
from aeromatch_cli.formats.tables import read_pairs
from aeromatch_cli.sfm.retrieval import best_pairs, similar_pairs


@given(hnp.arrays(np.int64, (7, 5), elements=st.integers(-1, 6)), st.integers(0, 40))
def test_pairs_are_unique_ordered_and_no_more_than_asked(ranking: np.ndarray, count: int) -> None:
    pairs = best_pairs(ranking, count)
    assert len(pairs) <= count
    assert all(0 <= a < b < 7 for a, b in pairs)
    assert all(b in ranking[a] or a in ranking[b] for a, b in pairs)


def test_first_choices_come_before_second_ones() -> None:
    ranking = np.array([[1, 2], [0, 3], [3, 0], [2, 1]])
    assert best_pairs(ranking, 2) == {(0, 1), (2, 3)}
    assert best_pairs(ranking, 100) == {(0, 1), (2, 3), (0, 2), (1, 3)}


def test_images_of_one_strip_find_their_neighbours(tmp_path: Path) -> None:
    """Forty images along a strip of 4,200 places with random descriptors: neighbours share 80 % of 500 places."""
    rng = np.random.default_rng(0)
    places = rng.gamma(1.0, 30.0, (4400, 128)).clip(0, 255)
    files = {}
    for number in range(40):
        own = np.arange(100 * number, 100 * number + 500)
        noisy = (places[own] + rng.normal(0.0, 4.0, (500, 128))).clip(0, 255).astype(np.uint8)
        files[f"i{number:02d}"] = tmp_path / f"{number}.npz"
        with files[f"i{number:02d}"].open("wb") as stream:
            write_features(stream, described(rng.uniform(0, 1000, (500, 2)), noisy), "print")
    pairs = similar_pairs(files, 4)
    assert len(pairs) == 4 * 40
    assert pairs == sorted(set(pairs))
    overlapping = {(f"i{a:02d}", f"i{b:02d}") for a, b in combinations(range(40), 2) if b - a <= 3}
    assert len(overlapping & set(pairs)) >= 0.95 * len(overlapping)
    assert similar_pairs(files, 4) == pairs


def test_an_image_without_features_has_no_pairs(tmp_path: Path) -> None:
    assert similar_pairs({"a": tmp_path / "a.npz", "b": tmp_path / "b.npz"}, 5) == []


@pytest.mark.slow
def test_a_small_block_takes_all_pairs(site: Site) -> None:
    outcome = site("pairs", "--set", "pairs=similar", "--poses", "none")
    assert outcome.code == 0
    pairs = read_pairs(site.work / "pairs.csv")
    assert len(pairs) == IMAGES * (IMAGES - 1) // 2
    assert {pair.reason for pair in pairs} <= {"similar", "first pass"}


def test_it_needs_a_first_pass(site: Site) -> None:
    outcome = site("pairs", "--set", "pairs=similar", "--set", "orient=none")
    assert outcome.code == 2
    assert "pairs=similar compares the descriptors of the first pass, and orient=none makes none" in outcome.stderr
