"""Images that are turned over: seen from afar over ground that is about level, and turned back."""

from __future__ import annotations

import copy
from functools import partial

import numpy as np
import pycolmap
import pytest
from make_networks import given_positions, values_of
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.bundle.network import LENS
from aeromatch_cli.sfm.georeferencing import Placement
from aeromatch_cli.sfm.model_adjustment import Work, adjusted
from aeromatch_cli.sfm.planar_ambiguity import Upright, _Other, other_pose, turned_back

# Straight down from 100 m; the last two, with a long lens, from 400 m away and 25 degrees off the vertical.
NEAR_M = np.array([[-30, 0, 100], [0, 5, 105], [30, -5, 95], [-15, 20, 100], [15, -25, 102]], float)
AFAR_M = np.array([[175, 0, 370], [-175, 10, 370]], float)
AFAR_DEG = (25.3, -25.3)
FOCAL_PX = (600.0, 3000.0)


def built(near: int = 5, seen_from_afar: int = 150, relief_m: float = 2.0) -> pycolmap.Reconstruction:
    """Ground with some relief, places in images to 0.3 px. The last two images see only the first points."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-25, 25, (2, 150))
    points_m = np.column_stack([x, y, relief_m * (np.sin(x / 7.0) + np.cos(y / 9.0))])
    more_m = np.column_stack([rng.uniform(-30, 30, (max(near - 5, 0), 2)), rng.uniform(95, 105, max(near - 5, 0))])
    centers_m = np.concatenate([NEAR_M[:near], more_m, AFAR_M])
    model = pycolmap.Reconstruction()
    for number, focal_px in enumerate(FOCAL_PX, 1):
        camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=800, height=600)
        camera.params = [focal_px, 400.0, 300.0]
        model.add_camera_with_trivial_rig(camera)
    for number, center_m in enumerate(centers_m, 1):
        afar = number - near - 1
        rotation = from_omega_phi_kappa(0.0, 0.0 if afar < 0 else AFAR_DEG[afar], 0.0)
        pose = pycolmap.Rigid3d(np.column_stack([rotation, -rotation @ center_m]))
        camera = model.cameras[1 if afar < 0 else 2]
        seen_m = points_m if afar < 0 else points_m[:seen_from_afar]
        pixels = camera.img_from_cam(pose * seen_m) + rng.normal(0.0, 0.3, (len(seen_m), 2))
        image = pycolmap.Image(f"{number}.jpg", pixels, camera_id=camera.camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    for row, point_m in enumerate(points_m):
        images = range(1, near + (3 if row < seen_from_afar else 1))
        model.add_point3D(point_m, pycolmap.Track([pycolmap.TrackElement(number, row) for number in images]))
    return model


@pytest.fixture(scope="module")
def exact() -> pycolmap.Reconstruction:
    return built()


def centers_of(model: pycolmap.Reconstruction) -> FloatArray:
    return np.array([model.images[number].projection_center() for number in sorted(model.images)])


def adjust_with(positions_m: FloatArray, sigmas_m: FloatArray, model: pycolmap.Reconstruction) -> Placement:
    """With focal lengths known to a hundredth, all else of the lenses held."""
    lenses = {number: values_of(LENS, f=focal_px, cx=399.5, cy=299.5) for number, focal_px in enumerate(FOCAL_PX, 1)}
    sigmas = {number: values_of(LENS, f=0.01 * focal_px) for number, focal_px in enumerate(FOCAL_PX, 1)}
    work = Work(pycolmap, lenses, sigmas, frozenset(), Options(1e-6, final=False))
    work.start(model)
    placement = adjusted(work, model, given_positions(positions_m, sigmas_m)).placement
    assert placement is not None
    return placement


def turned(exact: pycolmap.Reconstruction, over: tuple[int, ...], positions_m: FloatArray) -> Upright:
    """What becomes of a model some of whose images are turned over."""
    model = copy.deepcopy(exact)
    for number in over:
        other = _Other.of(pycolmap, model, number)
        assert other is not None
        other.take(model)
    sigmas_m = np.where(np.isfinite(positions_m[:, 0]), 5.0, np.nan)
    adjust = partial(adjust_with, positions_m, sigmas_m)
    placement = adjust(model)
    assert all(off_deg(exact, model, number) > 40.0 for number in over)
    return turned_back(pycolmap, model, placement, positions_m, sigmas_m, adjust)


def off_deg(exact: pycolmap.Reconstruction, model: pycolmap.Reconstruction, number: int) -> float:
    """Error of an image's attitude, as the second image sees it."""
    first, second = (one.images[number].cam_from_world() * one.images[2].cam_from_world().inverse()
                     for one in (exact, model))  # fmt: skip
    return angle_between_deg(first.rotation.matrix(), second.rotation.matrix())


def given(exact: pycolmap.Reconstruction, case: str) -> NDArray[np.float64]:
    """Positions of all images, off by two metres; of none; of all but the last two."""
    positions_m = centers_of(exact) + np.array([1.0, -2.0, 1.5])
    unknown = {"positions": 0, "some": 2, "nothing": len(positions_m)}[case]
    positions_m[len(positions_m) - unknown :] = np.nan
    return positions_m


def test_level_ground_looks_nearly_the_same_from_the_other_pose(exact: pycolmap.Reconstruction) -> None:
    image, camera = exact.images[6], exact.cameras[2]
    points_m = np.array([exact.points3D[number].xyz for number in sorted(exact.points3D)])
    level_m = np.column_stack([points_m[:, :2], np.zeros(len(points_m))])
    pose = image.cam_from_world()
    other = pycolmap.Rigid3d(other_pose(pose.matrix(), level_m))
    assert np.linalg.det(other.rotation.matrix()) == pytest.approx(1.0)
    off_px = np.linalg.norm(camera.img_from_cam(pose * level_m) - camera.img_from_cam(other * level_m), axis=1)
    assert np.median(off_px) < 12.0  # where the same tilt to another side moves them by hundreds
    mirrored = -other.rotation.matrix().T @ other.translation
    np.testing.assert_allclose(mirrored, [-175.0, 0.0, 370.0], atol=4.0)
    back = other_pose(other.matrix(), level_m)
    np.testing.assert_allclose(back, pose.matrix(), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["positions", "some", "nothing"])
@pytest.mark.parametrize("over", [(6,), (6, 7)])
def test_images_that_are_turned_over_are_turned_back(
    exact: pycolmap.Reconstruction, case: str, over: tuple[int, ...]
) -> None:
    found = turned(exact, over, given(exact, case))
    assert sorted(found.turned) == list(over)
    assert max(off_deg(exact, found.model, number) for number in (6, 7)) < 1.0


@pytest.mark.parametrize("case", ["positions", "nothing"])
def test_a_point_behind_the_camera_does_not_keep_an_image_turned_over(
    exact: pycolmap.Reconstruction, case: str
) -> None:
    model = copy.deepcopy(exact)
    model.points3D[min(model.points3D)].xyz = AFAR_M[0] + [40.0, 0.0, 80.0]
    found = turned(model, (6,), given(exact, case))
    assert off_deg(exact, found.model, 6) < 1.0


@pytest.mark.parametrize("case", ["positions", "nothing"])
def test_images_in_their_places_stay(exact: pycolmap.Reconstruction, case: str) -> None:
    assert turned(exact, (), given(exact, case)).turned == ()


def test_an_image_without_points_is_left_alone(exact: pycolmap.Reconstruction) -> None:
    model = copy.deepcopy(exact)
    for number in sorted(model.points3D):
        model.delete_observation(6, number - 1)
    assert _Other.of(pycolmap, model, 6) is None


@pytest.mark.slow
@pytest.mark.parametrize(("near", "seen", "relief_m"), [(5, 150, 2.0), (60, 40, 1.0), (100, 40, 2.0)])
def test_an_image_whose_position_lies_on_the_other_side_stays(near: int, seen: int, relief_m: float) -> None:
    """What its own keypoints say counts, however many other images there are."""
    exact = built(near, seen, relief_m)
    positions_m = given(exact, "positions")
    positions_m[-1, 0] *= -1.0
    found = turned(exact, (), positions_m)
    assert found.turned == ()
    assert off_deg(exact, found.model, near + 2) < 1.0


def test_of_two_far_images_only_the_one_that_is_turned_over_is_turned_back(exact: pycolmap.Reconstruction) -> None:
    positions_m = given(exact, "positions")
    positions_m[-1, 0] *= -1.0
    found = turned(exact, (6,), positions_m)
    assert found.turned == (6,)
    assert max(off_deg(exact, found.model, number) for number in (6, 7)) < 1.0
