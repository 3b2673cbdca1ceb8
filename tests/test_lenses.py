"""What the mapper cannot know of cameras and places is taken back before a model is adjusted."""

from __future__ import annotations

import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aeromatch_cli.orientation import mapper
from aeromatch_cli.orientation.adjusting import (
    _prefer_prior_focal_lengths,
    drop_far_images,
    images_by_camera,
    reset_lenses,
)
from aeromatch_cli.orientation.mapper import _calibrate_large_block, _far_from_priors

zlib.compress(b"")  # pycolmap aborts the process when it is imported before zlib was used

MANY, FEW = 12, 4


@pytest.fixture
def model() -> Any:
    """Images of two cameras around one place: MANY of the first, FEW of the second."""
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 1
    options.num_frames_per_rig, options.num_points3D = MANY, 200
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_RADIAL, [800.0, 512.0, 384.0, 0.01]
    made = pycolmap.synthesize_dataset(options)
    second = [image for image in made.images.values() if image.camera_id == 2]
    for image in sorted(second, key=lambda image: image.image_id)[FEW:]:
        made.deregister_frame(image.frame_id)
    return made


def priors(model: Any) -> dict[str, Any]:
    return {
        str(number): {"params": [800.0, 512.0, 384.0, 0.01], "focal_px": 800.0, "sigma": 0.05}
        for number in model.cameras
    }


def test_a_sound_model_keeps_its_images_and_focal_lengths(model: Any) -> None:
    known = priors(model)
    model.cameras[1].params = [790.0, 512.0, 384.0, 0.02]
    model.cameras[2].params = [830.0, 512.0, 384.0, -4.0]
    reset_lenses(model, known)
    drop_far_images(model)
    assert images_by_camera(model) == {1: MANY, 2: FEW}
    np.testing.assert_allclose(model.cameras[1].params, [790.0, 512.0, 384.0, 0.02])
    # Four images do not determine another distortion than the one that was given.
    np.testing.assert_allclose(model.cameras[2].params, [830.0, 512.0, 384.0, 0.01])


def test_four_images_determine_a_distortion_that_nobody_gave(model: Any) -> None:
    known = priors(model)
    known["2"]["params"][3] = 0.0
    model.cameras[2].params = [830.0, 512.0, 384.0, -0.04]
    reset_lenses(model, known)
    np.testing.assert_allclose(model.cameras[2].params, [830.0, 512.0, 384.0, -0.04])


@pytest.mark.parametrize("focal_px", [-7.4e6, 200.0, 2500.0])
def test_images_behind_a_lens_that_cannot_be_leave_the_model(model: Any, focal_px: float) -> None:
    known = priors(model)
    model.cameras[2].params = [focal_px, 512.0, 384.0, -5772.0]
    reset_lenses(model, known)
    assert images_by_camera(model) == {1: MANY}
    np.testing.assert_allclose(model.cameras[2].params, known["2"]["params"])


@pytest.mark.parametrize(
    ("focal_px", "sigma", "far"),
    [(820.0, 0.005, False), (900.0, 0.02, True), (900.0, 0.05, False), (1600.0, 0.2, True)],
)
def test_a_focal_length_far_from_its_prior_has_to_be_better(
    model: Any, focal_px: float, sigma: float, far: bool
) -> None:
    """Beyond a tenth, and beyond four standard deviations."""
    known = {number: {**prior, "sigma": sigma} for number, prior in priors(model).items()}
    assert not _far_from_priors([model], known)
    model.cameras[2].params = [focal_px, 512.0, 384.0, 0.0]
    assert _far_from_priors([model], known) is far
    assert not _far_from_priors([], known)


def test_an_image_at_any_distance_leaves_the_model(model: Any) -> None:
    import pycolmap

    lost = next(image for image in model.images.values() if image.has_pose)
    far = pycolmap.Rigid3d(np.column_stack([np.eye(3), [0.0, 0.0, 1e5]]))
    lost.frame.set_cam_from_world(lost.camera_id, far)
    drop_far_images(model)
    assert sum(images_by_camera(model).values()) == MANY + FEW - 1
    assert not model.images[lost.image_id].has_pose


@pytest.mark.parametrize(("rise", "share"), [(0.0, 1.0), (0.0125, 0.5), (1.0, 0.0123)])
def test_a_focal_length_near_its_prior_is_weighed_with_it(model: Any, rise: float, share: float) -> None:
    """One standard deviation away: where the cost with the prior is larger by 0.0125, both count the same."""

    def adjuster(which: Any, fixed_cameras: bool) -> Any:
        assert fixed_cameras
        cost = 100.0 * (1.0 + rise * (which.cameras[1].params[0] == 800.0))
        return SimpleNamespace(solve=lambda: SimpleNamespace(ceres_summary=SimpleNamespace(final_cost=cost)))

    model.cameras[1].params = [840.0, 512.0, 384.0, 0.02]
    _prefer_prior_focal_lengths(model, {"1": priors(model)["1"]}, 100.0, adjuster)
    assert model.cameras[1].params[0] == pytest.approx(840.0 - 40.0 * share, abs=0.01)
    assert model.cameras[1].params[3] == pytest.approx(0.02 - 0.01 * share, abs=1e-5)


@pytest.mark.parametrize(("images", "found"), [(21, True), (20, False)])
def test_a_large_block_starts_from_focal_lengths_of_a_rough_mapping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: int, found: bool
) -> None:
    import pycolmap

    monkeypatch.setattr(mapper, "LARGE_BLOCK", 20)

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D, options.num_points2D_without_point3D = images, 60, 0
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_RADIAL, [800.0, 512.0, 384.0, 0.0]
    database = tmp_path / "database.db"
    with pycolmap.Database.open(database) as opened:
        pycolmap.synthesize_dataset(options, opened)
        camera = opened.read_all_cameras()[0]
        camera.params = [960.0, 512.0, 384.0, 0.0]
        opened.update_camera(camera)
    _calibrate_large_block(pycolmap, database, tmp_path / "rough")
    with pycolmap.Database.open(database) as opened:
        focal_px = opened.read_all_cameras()[0].mean_focal_length()
    assert focal_px == pytest.approx(800.0 if found else 960.0, rel=0.01)
