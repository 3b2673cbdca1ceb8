"""The part of the points that an adjustment uses: spread over every image, and as good for the poses as all."""

from __future__ import annotations

import copy

import numpy as np
import pycolmap
import pytest
from make_networks import given_positions, values_of

from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.bundle.network import LENS
from aeromatch_cli.sfm.bundle.of_model import image_numbers, lens_of
from aeromatch_cli.sfm.model_adjustment import Work, adjust_in_place
from aeromatch_cli.sfm.thinning import chosen_points, take_poses, thinned

POINTS, IMAGES = 3000, 6


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    """Exact, but for half a pixel of noise in the measurements."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, IMAGES
    options.num_points3D = POINTS
    pycolmap.set_random_seed(3)
    found = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, found)
    return found


def cells(
    model: pycolmap.Reconstruction, image: pycolmap.Image, points: list[pycolmap.Point2D]
) -> set[tuple[int, ...]]:
    """Of 10 x 8, those that hold one of the points."""
    camera = model.cameras[image.camera_id]
    places = np.array([point.xy for point in points])
    return set(map(tuple, (places * (10, 8) // (camera.width, camera.height)).astype(int).tolist()))


def test_points_are_chosen_all_over_every_image(model: pycolmap.Reconstruction) -> None:
    chosen = chosen_points(model)
    numbers = np.array(sorted(model.points3D))[chosen]
    assert 0.02 * POINTS < len(numbers) < 0.5 * POINTS
    kept = set(numbers.tolist())
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        assert cells(model, image, [p for p in seen if p.point3D_id in kept]) == cells(model, image, seen)


@pytest.mark.slow
def test_poses_of_the_part_are_as_exact_as_those_of_all(model: pycolmap.Reconstruction) -> None:
    """Both adjusted from poses that are off: as near to the truth, and the model's own points stay."""
    truth = {i: model.images[i].projection_center() for i in image_numbers(model)}
    count = len(truth)
    given = np.array([truth[i] for i in sorted(truth)]) + np.random.default_rng(1).normal(0, 0.02, (count, 3))
    lenses = {int(n): lens_of(c) for n, c in model.cameras.items()}
    sigmas = {n: values_of(LENS, f=0.01 * values[0], k1=0.1) for n, values in lenses.items()}
    known = given_positions(given, np.full(count, 0.02))
    off = {}
    for name in ("all", "part"):
        own = copy.deepcopy(model)
        used = own if name == "all" else thinned(own)
        assert used is not None
        work = Work(pycolmap, lenses, sigmas, frozenset(), Options(1e-6, final=True))
        work.start(own)
        work.start(used)
        adjust_in_place(work, used, known, ())
        if name == "part":
            assert used.num_points3D() < 0.5 * own.num_points3D()
            take_poses(own, used)
            assert own.num_points3D() == model.num_points3D()
        off[name] = np.sqrt(np.mean([((own.images[i].projection_center() - truth[i]) ** 2).sum() for i in truth]))
    assert off["part"] < 1.5 * off["all"] + 0.002


def test_a_model_of_few_points_stays_whole(model: pycolmap.Reconstruction) -> None:
    small = copy.deepcopy(model)
    for number in sorted(small.points3D)[200:]:
        small.delete_point3D(number)
    assert thinned(small) is None
