"""The report's figures of the ground, against footprints and points whose counts are known by construction."""

from __future__ import annotations

import re

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose
from aeromatch_cli.report.places import Ground, ground_figures, point_figures

SQUARE = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
EAST, NORTH = np.array([50.0, 0.0]), np.array([0.0, 60.0])


def block(points_m: np.ndarray, tracks: dict[str, np.ndarray], errors_px: np.ndarray) -> AdjustedBlock:
    return AdjustedBlock({}, {}, points_m, errors_px, tracks)


def test_overlap_counts_are_those_of_the_footprints() -> None:
    """Three squares of 100 m, each 50 m further east: one, two, two and one of them see a column of 50 m."""
    footprints = [SQUARE, SQUARE + EAST, SQUARE + 2.0 * EAST]
    ground = Ground(np.array([0.0, 0.0]), np.array([200.0, 100.0]))
    count = ground.shown_by(footprints, 40)
    assert count.shape == (20, 40)
    middles = count[10, [5, 15, 25, 35]]
    assert middles.tolist() == [1, 2, 2, 1]
    whole = ground.shown_by([SQUARE, SQUARE, SQUARE + NORTH], 40)
    assert (whole[2, 10], whole[18, 10]) == (2, 3)  # row 0 lies in the south


def test_whole_footprints_are_drawn_but_for_views_far_beyond_the_cameras() -> None:
    centers = np.array([[0.0, 0.0], [100.0, 0.0]])
    forward = SQUARE + 0.8 * EAST  # all that it shows lies north of the cameras
    ground = Ground.of(centers, [forward, SQUARE + EAST + 0.5 * NORTH])
    assert (*ground.low_m, *ground.high_m, ground.cut) == (0.0, 0.0, 150.0, 130.0, False)
    horizon = np.array([[0.0, 0.0], [900.0, 0.0], [900.0, 5000.0]])
    ground = Ground.of(centers, [SQUARE, SQUARE, SQUARE, horizon])
    assert (*ground.low_m, *ground.high_m, ground.cut) == (0.0, 0.0, 250.0, 150.0, True)  # 1.5 times 100 m beyond
    points = np.concatenate([np.full((40, 3), 50.0), [[50.0, 4000.0, 0.0]]])
    found = ground_figures(centers, [SQUARE, SQUARE, SQUARE, horizon], block(points, {}, np.zeros(41)))
    assert all("Ground more than 1.5 footprints beyond the cameras is not drawn." in words for _, words in found)
    assert "1 of 41 points lies beyond the drawing." in found[1][1]


def test_places_that_lack_points_are_counted() -> None:
    """Three footprints show the same square; points lie in its western half alone."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0, 50, 20000), rng.uniform(0, 100, 20000), np.zeros(20000)])
    centers = np.array([[40.0, 50.0], [50.0, 50.0], [60.0, 50.0]])
    found = ground_figures(centers, [SQUARE] * 3, block(points, {}, np.zeros(20000)))
    assert len(found) == 2
    assert found[0][1] == "Three images and more show 100 % of the ground."
    share = re.search(r"\((\d+) %\)", found[1][1])
    assert share is not None
    assert 45 <= int(share[1]) <= 55
    assert all(svg.startswith("<svg") and "<image" in svg for svg, _ in found)
    assert ground_figures(centers, [], None) == []
    assert len(ground_figures(centers, [SQUARE], None)) == 1


def test_points_of_other_groups_are_not_counted_beside_the_first() -> None:
    """The points of the large group fill the western half; those of the small one would fill the eastern half."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0, 50, 20000), rng.uniform(0, 100, 20000), np.zeros(20000)])
    both = np.concatenate([points, points + np.array([50.0, 0.0, 0.0])])
    rows = np.arange(20000)
    tracks = {name: np.column_stack([rows, rows + 20000 * (name > "c")]) for name in "abcde"}
    pose = AdjustedPose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    frames = {name: 1 + (name > "c") for name in "abcde"}
    adjusted = AdjustedBlock({}, dict.fromkeys("abcde", pose), both, np.zeros(40000), tracks, frames)
    centers = np.array([[40.0, 50.0], [50.0, 50.0], [60.0, 50.0]])
    with_others = ground_figures(centers, [SQUARE] * 3, adjusted)
    alone = ground_figures(centers, [SQUARE] * 3, adjusted.parts()[0])
    assert [figure for figure, _ in with_others] == [figure for figure, _ in alone]
    assert [words.removesuffix(" The other groups of images are left out.") for _, words in with_others] == [
        words for _, words in alone
    ]
    share = re.search(r"\((\d+) %\)", alone[1][1])
    assert share is not None
    assert 45 <= int(share[1]) <= 55


def test_points_are_counted_by_the_images_that_see_them_and_by_their_error() -> None:
    tracks = {name: np.array([[0, 0], [1, 1]]) for name in "abc"} | {"d": np.array([[0, 0]])}
    found = point_figures(block(np.zeros((2, 3)), tracks, np.array([0.2, 0.4])))
    assert "4 images: 1 point<" in found[1]
    assert "3 images: 1 point<" in found[1]
    assert sum(int(n) for n in re.findall(r"px: (\d+) points?", found[0])) == 2
    assert point_figures(None) == []
