"""Least-squares matching of tie points: shifts of exact pictures, trees of matches, the stage on a rendered block."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Site
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray, Pair, PairGeometry, Pose
from aeromatch_cli.fingerprints import picture_fingerprint
from aeromatch_cli.formats.features import checked_final_keypoints, read_final_keypoints, read_keypoints
from aeromatch_cli.formats.rows import read_verified_row
from aeromatch_cli.formats.tables import read_images
from aeromatch_cli.geometry.level import level_affinities
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.images.source import Source
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.sfm.spanning_trees import Trees, shifts_through, trees_of
from aeromatch_cli.stages import measuring
from aeromatch_cli.stages.measuring import _far_inside
from aeromatch_cli.strategies.refiners.least_squares import PATCH_HALF_PX, LeastSquares, Patches
from aeromatch_cli.workspace import Workspace

SIDE = 2 * PATCH_HALF_PX + 1
COUNT = 40


def surface(x: FloatArray, y: FloatArray, seed: int) -> FloatArray:
    """Grey levels of a smooth random surface, anywhere."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0.0, 0.35, (24, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, 24)
    return 128.0 + 14.0 * np.cos(x[..., None] * waves[:, 0] + y[..., None] * waves[:, 1] + phases).sum(axis=-1)


def patches(matrix: FloatArray, offsets_px: FloatArray, gain: float = 1.0, level: float = 0.0) -> Patches:
    """Of one surface each, seen through pixels = matrix @ surface + offset; the places that count are the middles."""
    side = np.arange(SIDE) - PATCH_HALF_PX
    x, y = np.meshgrid(side, side)
    inverse = np.linalg.inv(matrix)
    made = []
    for seed, offset in enumerate(offsets_px):
        there = np.stack([x - offset[0], y - offset[1]], axis=-1) @ inverse.T
        made.append(gain * surface(there[..., 0], there[..., 1], seed) + level)
    return Patches(np.clip(np.rint(made), 0, 255).astype(np.uint8), np.zeros((len(made), 2)))


def many(matrix: FloatArray) -> FloatArray:
    return np.broadcast_to(matrix, (COUNT, 2, 2))


@pytest.mark.parametrize(
    "matrix", [np.eye(2), 1.2 * np.array([[0.8, -0.6], [0.6, 0.8]]), np.array([[1.0, 0.3], [0.0, 0.75]])]
)
def test_shifts_of_exact_pictures_are_found(matrix: FloatArray) -> None:
    """Turned, scaled and sheared; twice as dark, and brighter by a level."""
    wanted = np.random.default_rng(4).uniform(-1.1, 1.1, (COUNT, 2))
    first, second = patches(np.eye(2), np.zeros((COUNT, 2))), patches(matrix, wanted, 0.5, 40.0)
    shifts, held = LeastSquares()(first, second, many(matrix))
    assert held.mean() > 0.9
    errors = np.linalg.norm(shifts - wanted, axis=1)[held]
    assert np.median(errors) < 0.02
    assert errors.max() < 0.15
    assert not shifts[~held].any()


def test_what_shows_something_else_is_not_moved() -> None:
    first = patches(np.eye(2), np.zeros((COUNT, 2)))
    other = Patches(np.roll(first.pixels, 1, axis=0), first.places_px)
    _, held = LeastSquares(min_correlation=0.7)(first, other, many(np.eye(2)))
    assert held.mean() < 0.1
    flat = Patches(np.full_like(first.pixels, 90), first.places_px)
    steep = np.where(np.arange(SIDE) < PATCH_HALF_PX, 50, 200).astype(np.uint8)
    edge = Patches(np.broadcast_to(steep, first.pixels.shape), first.places_px)
    for nothing in (flat, edge):
        assert not LeastSquares()(nothing, nothing, many(np.eye(2)))[1].any()


@pytest.mark.parametrize("matrix", [4.0 * np.eye(2), 0.3 * np.eye(2), np.full((2, 2), np.nan), np.zeros((2, 2))])
def test_pictures_too_different_are_not_compared(matrix: FloatArray) -> None:
    first = patches(np.eye(2), np.zeros((COUNT, 2)))
    assert not LeastSquares()(first, first, many(matrix))[1].any()


def test_a_shift_beyond_the_largest_does_not_hold() -> None:
    first, second = patches(np.eye(2), np.zeros((COUNT, 2))), patches(np.eye(2), np.full((COUNT, 2), 0.5))
    assert LeastSquares()(first, second, many(np.eye(2)))[1].mean() > 0.9
    assert not LeastSquares(max_shift_px=0.6)(first, second, many(np.eye(2)))[1].any()


def test_keypoints_of_a_point_hang_on_the_one_with_most_matches() -> None:
    """Point 1: 0-1, 1-2, 1-3, 3-4. Point 2: 5-6 alone. 7 has no match. 4 by 3, as nothing is nearer."""
    ends, scores = np.array([[0, 1], [1, 2], [1, 3], [3, 4], [5, 6]]), np.array([0.5, 0.9, 0.1, 0.8, 0.3])
    trees = trees_of(8, ends, scores)
    np.testing.assert_array_equal(trees.parent, [1, -1, 1, 1, 3, -1, 5, -1])
    np.testing.assert_array_equal(trees.depth, [1, 0, 1, 1, 2, 0, 1, -1])


def test_of_two_ways_as_short_the_better_match_is_taken() -> None:
    ends, scores = np.array([[0, 1], [0, 2], [0, 4], [1, 3], [2, 3]]), np.array([0.5, 0.5, 0.5, 0.2, 0.7])
    assert trees_of(5, ends, scores).parent[3] == 2


@given(st.permutations(range(12)), st.integers(0, 1000))
def test_trees_do_not_depend_on_the_order_of_matches(order: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = np.array([rng.choice(9, 2, replace=False) for _ in range(12)])
    scores = np.round(rng.uniform(0, 1, 12), 1)
    trees, again = trees_of(9, ends, scores), trees_of(9, ends[order][:, ::-1], scores[order])
    np.testing.assert_array_equal(trees.parent, again.parent)
    children = np.flatnonzero(trees.parent >= 0)
    np.testing.assert_array_equal(trees.depth[children], trees.depth[trees.parent[children]] + 1)
    assert set(np.unique(ends)) == set(np.flatnonzero(trees.depth >= 0))


def test_no_matches_no_trees() -> None:
    trees = trees_of(3, np.zeros((0, 2), np.int64), np.zeros(0))
    assert (trees.parent == -1).all()
    assert (trees.depth == -1).all()


def test_a_shift_is_carried_on_in_the_pixels_of_the_next_image() -> None:
    """2 by 1 by 0: what moves 1 by one pixel moves 2 by two, turned by a right angle, besides its own shift."""
    trees = Trees(np.array([-1, 0, 1]), np.array([0, 1, 2]))
    matrices = np.stack([np.eye(2), np.eye(2), np.array([[0.0, -2.0], [2.0, 0.0]])])
    shifts = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.5]])
    np.testing.assert_allclose(shifts_through(trees, matrices, shifts), [[0, 0], [1, 0], [0.25, 2.5]])


def test_affinities_of_level_ground() -> None:
    """Straight down from 100 and from 200 m, the second turned by 90 degrees: half as large, turned."""
    camera = Camera("SIMPLE_PINHOLE", 800, 600, (800.0, 399.5, 299.5))
    poses = [
        Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(0.0, 0.0, 0.0), 0.1, 0.1),
        Pose(np.array([10.0, 5.0, 200.0]), from_omega_phi_kappa(0.0, 0.0, 90.0), 0.1, 0.1),
    ]
    pair = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), camera, camera, *poses, 0.0)
    ground = np.array([[5.0, 5.0], [-20.0, 10.0]])
    first = 399.5 + 8.0 * ground[:, 0], 299.5 - 8.0 * ground[:, 1]
    away = ground - [10.0, 5.0]
    second = 399.5 + 4.0 * away[:, 1], 299.5 + 4.0 * away[:, 0]
    found = level_affinities(pair, np.column_stack(first), np.column_stack(second))
    np.testing.assert_allclose(found, np.broadcast_to([[0.0, -0.5], [0.5, 0.0]], (2, 2, 2)), atol=1e-6)


@pytest.mark.slow
def test_tie_points_are_nearer_to_their_exact_places(done_site: Site, rendered: Path) -> None:
    work = Workspace(done_site.work)
    truth = open_truth(rendered)
    images = {image.image_id: image for image in read_images(work.images)}
    errors: dict[str, list[FloatArray]] = {"detected": [], "measured": []}
    for image_id in images:
        for entry in read_verified_row(work.verified(image_id)).values():
            ids, indices = (image_id, entry.image_id1), entry.matches.indices
            for name, read in (("detected", lambda i: read_keypoints(work.features(i))[0]), ("measured", final(work))):
                points = [read(i)[indices[:, side]].astype(float) for side, i in enumerate(ids)]
                errors[name].append(truth.errors(*(images[i].name for i in ids), *points)[0])
    medians = {name: float(np.nanmedian(np.concatenate(found))) for name, found in errors.items()}
    assert medians["measured"] < 0.7 * medians["detected"], medians
    facts = json.loads(work.stage_report("refine").read_text())["result"]
    assert facts["measured"] > 0.8 * facts["keypoints"] > 0
    with sqlite3.connect(work.export("colmap") / "database.db") as database:
        query = "SELECT images.name, rows, cols, data FROM keypoints JOIN images USING (image_id)"
        found = database.execute(query).fetchall()
    exported = {name: np.frombuffer(data, np.float32).reshape(r, c)[:, :2] for name, r, c, data in found}
    for image_id, image in images.items():
        np.testing.assert_allclose(exported[image.name], final(work)(image_id) + 0.5, atol=1e-3)


@pytest.mark.slow
def test_without_refinement_tie_points_stay_where_the_detector_put_them(done_site: Site) -> None:
    work = Workspace(done_site.work)
    assert work.stage_report("refine").is_file()
    assert not list(work.refined("").parent.glob("*.npy"))
    outcome = done_site("run", "--set", "refine=none")
    assert outcome.code == 0, outcome.stderr
    assert outcome.facts["stages"]["refine"]["result"]["measured"] is None
    assert not work.refined("").parent.exists()
    for image in read_images(work.images):
        np.testing.assert_array_equal(final(work)(image.image_id), read_keypoints(work.features(image.image_id))[0])


@pytest.mark.slow
def test_a_damaged_file_is_made_again(done_site: Site) -> None:
    work = Workspace(done_site.work)
    path = work.refined(read_images(work.images)[0].image_id)
    before = path.read_bytes()
    path.write_bytes(before[:-30])
    assert done_site("run").code == 0
    assert path.read_bytes() == before


@pytest.mark.slow
def test_what_is_drawn_lies_where_it_was_measured_or_where_it_was_detected(
    done_site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    work = Workspace(done_site.work)
    image_id = read_images(work.images)[0].image_id
    features, refined = work.features(image_id), work.refined(image_id)
    detected = read_keypoints(features)[0]
    fingerprint, drawn = checked_final_keypoints(features, refined)
    assert drawn is not None
    np.testing.assert_array_equal(drawn, final(work)(image_id))
    assert 0.0 < np.abs(drawn - detected).max() < 10.0
    assert not caplog.records
    refined.write_bytes(refined.read_bytes()[:-30])
    same, drawn = checked_final_keypoints(features, refined)
    assert same == fingerprint
    np.testing.assert_array_equal(drawn, detected)
    assert str(refined) in caplog.text
    features.unlink()
    assert checked_final_keypoints(features, refined) == ("", None)


def test_near_the_edge_of_a_picture_or_of_a_mask_nothing_is_measured() -> None:
    valid = np.ones((80, 100), dtype=bool)
    valid[30, 70] = False
    places = np.array([[50, 40], [12, 40], [13, 40], [86, 40], [87, 40], [50, 66], [50, 67], [70, 43], [70, 44]])
    everywhere = [True, False, True, True, False, True, False, True, True]
    assert _far_inside((80, 100), None, places).tolist() == everywhere
    assert _far_inside((80, 100), valid, places).tolist() == [*everywhere[:7], False, True]


def cut(folder: Path, pixels: NDArray[Any], places_px: FloatArray, scale: float = 1.0) -> NDArray[np.uint8]:
    """Patches of a picture that is written and read again."""
    import cv2

    cv2.imwrite(str(folder / "a.tif"), pixels)
    camera = Camera("SIMPLE_PINHOLE", pixels.shape[1], pixels.shape[0], (500.0, 0.0, 0.0))
    source = Source(folder / "a.tif", None, camera, None, scale, "", picture_fingerprint(folder / "a.tif"))
    assert measuring.cut_patches(measuring.CutTask(source, places_px, folder / "patches.npy")) == len(places_px)
    return np.asarray(np.load(folder / "patches.npy"))


def test_pictures_of_16_bits_are_measured_like_those_of_8(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(200.0), np.arange(90.0))
    places = np.array([[50.0, 45.0], [150.0, 45.0]])
    wanted = np.array([0.6, -0.4])
    made = []
    for dx, dy in ([0, 0], wanted):
        pixels = 4000.0 + 20.0 * surface(x - dx, y - dy, 5)
        made.append(Patches(cut(tmp_path, pixels.round().astype(np.uint16), places), np.zeros((2, 2))))
    shifts, held = LeastSquares()(made[0], made[1], many(np.eye(2))[:2])
    assert held.all()
    np.testing.assert_allclose(shifts, [wanted] * 2, atol=0.05)


def test_reduced_images_are_measured_in_reduced_pixels(tmp_path: Path) -> None:
    """Both at half their size: shifts of stored pixels come out, to the same share of the pixels worked on."""
    x, y = np.meshgrid(np.arange(400.0), np.arange(300.0))
    wanted = np.array([0.9, -0.7])
    grid = np.stack(np.meshgrid(np.arange(80.0, 340.0, 40.0), np.arange(80.0, 240.0, 40.0)), axis=-1).reshape(-1, 2)
    made = []
    for dx, dy in ([0, 0], wanted):
        pixels = 64.0 + 0.5 * surface((x - dx) * 0.5, (y - dy) * 0.5, 9)
        made.append(Patches(cut(tmp_path, pixels.round().astype(np.uint8), grid, 0.5), off_middle(grid)))
    shifts, held = LeastSquares()(made[0], made[1], np.broadcast_to(np.eye(2), (len(grid), 2, 2)))
    assert held.all()
    np.testing.assert_allclose(shifts / 0.5, np.broadcast_to(wanted, shifts.shape), atol=0.1)


def off_middle(grid: FloatArray) -> FloatArray:
    places = measuring.in_working_frame(grid, 0.5)
    return places - np.rint(places)


def final(work: Workspace) -> Callable[[str], FloatArray]:
    return lambda image_id: read_final_keypoints(work.features(image_id), work.refined(image_id))
