"""Images that are turned over: seen from afar over ground that is about level, and turned back."""

from __future__ import annotations

import copy
from functools import partial

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.orientation.adjusting import adjusted
from aeromatch_cli.orientation.flips import _Other, other_pose, turned_back
from aeromatch_cli.orientation.placing import Placement

# Straight down from 100 m; the last one, with a long lens, from 400 m away and 25 degrees off the vertical.
CENTERS_M = np.array([[-30, 0, 100], [0, 5, 105], [30, -5, 95], [-15, 20, 100], [15, -25, 102], [175, 0, 370]], float)
PHI_DEG = (0.0, 0.0, 0.0, 0.0, 0.0, 25.3)
AFAR = len(CENTERS_M)
SIGMAS_M = np.full(AFAR, 5.0)
FOCAL_PX = (600.0, 3000.0)
NOWHERE = np.full((AFAR, 3), np.nan)


@pytest.fixture(scope="module")
def exact() -> pycolmap.Reconstruction:
    """Ground with 4 m of relief, places in images to 0.3 px; all images see all points."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-25, 25, (2, 150))
    points_m = np.column_stack([x, y, 2.0 * np.sin(x / 7.0) + 2.0 * np.cos(y / 9.0)])
    model = pycolmap.Reconstruction()
    for number, focal_px in enumerate(FOCAL_PX, 1):
        camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=800, height=600)
        camera.params = [focal_px, 400.0, 300.0]
        model.add_camera_with_trivial_rig(camera)
    for number, (center_m, phi_deg) in enumerate(zip(CENTERS_M, PHI_DEG, strict=True), 1):
        rotation = from_omega_phi_kappa(0.0, phi_deg, 0.0)
        pose = pycolmap.Rigid3d(np.column_stack([rotation, -rotation @ center_m]))
        camera = model.cameras[2 if number == AFAR else 1]
        pixels = camera.img_from_cam(pose * points_m) + rng.normal(0.0, 0.3, (len(points_m), 2))
        image = pycolmap.Image(f"{number}.jpg", pixels, camera_id=camera.camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    for row, point_m in enumerate(points_m):
        elements = [pycolmap.TrackElement(number, row) for number in range(1, AFAR + 1)]
        model.add_point3D(point_m, pycolmap.Track(elements))
    return model


def center_m(model: pycolmap.Reconstruction, number: int = AFAR) -> NDArray[np.float64]:
    return np.asarray(model.images[number].projection_center())


def adjust_with(positions_m: FloatArray, model: pycolmap.Reconstruction) -> Placement:
    cameras = {
        str(number): {"params": [focal_px, 400.0, 300.0], "focal_px": focal_px, "sigma": 0.01}
        for number, focal_px in enumerate(FOCAL_PX, 1)
    }
    return adjusted(pycolmap, model, cameras, positions_m, SIGMAS_M, np.full((AFAR, 3), np.nan), 1e-6)


def turned_over(exact: pycolmap.Reconstruction, positions_m: FloatArray) -> tuple[pycolmap.Reconstruction, Placement]:
    model = copy.deepcopy(exact)
    other = _Other.of(pycolmap, model, AFAR)
    assert other is not None
    other.take(model)
    return model, adjust_with(positions_m, model)


def test_level_ground_looks_nearly_the_same_from_the_other_pose(exact: pycolmap.Reconstruction) -> None:
    image, camera = exact.images[AFAR], exact.cameras[2]
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


@pytest.mark.parametrize("positions_m", [CENTERS_M + np.array([1.0, -2.0, 1.5]), NOWHERE], ids=["positions", "nothing"])
def test_an_image_that_is_turned_over_is_turned_back(exact: pycolmap.Reconstruction, positions_m: FloatArray) -> None:
    model, placement = turned_over(exact, positions_m)
    seen_m = center_m(model) - center_m(model, 2)
    assert seen_m[0] < 0.0
    found, _ = turned_back(
        pycolmap, model, placement, positions_m, SIGMAS_M, partial(adjust_with, positions_m)
    )  # fmt: skip
    relative = exact.images[AFAR].cam_from_world() * exact.images[2].cam_from_world().inverse()
    again = found.images[AFAR].cam_from_world() * found.images[2].cam_from_world().inverse()
    assert angle_between_deg(relative.rotation.matrix(), again.rotation.matrix()) < 1.0


@pytest.mark.parametrize("positions_m", [CENTERS_M, NOWHERE], ids=["positions", "nothing"])
def test_images_in_their_places_stay(exact: pycolmap.Reconstruction, positions_m: FloatArray) -> None:
    """Also one whose given position is on the other side: its pictures are better."""
    wrong_m = positions_m.copy()
    wrong_m[-1, 0] = -175.0
    for given_m in (positions_m, wrong_m):
        model = copy.deepcopy(exact)
        placement = adjust_with(given_m, model)
        found, same = turned_back(
            pycolmap, model, placement, given_m, SIGMAS_M, partial(adjust_with, given_m)
        )  # fmt: skip
        assert found is model
        assert same is placement
