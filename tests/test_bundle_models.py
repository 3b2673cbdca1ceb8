"""pycolmap models as networks and back, and cameras as lenses and back."""

from __future__ import annotations

import copy
import zlib
from typing import Any

import numpy as np
import pytest
from make_networks import given_positions

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import BROWN, FISHEYE, MODELS, colmap_camera, parameters
from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.bundle.network import LENS, READOUT
from aeromatch_cli.sfm.bundle.of_model import image_numbers, image_points, lens_of, set_lens, take, unknowns_of
from aeromatch_cli.sfm.bundle.projection import project
from aeromatch_cli.sfm.calibration import Calibration, LensPrior, camera_of, freed, held_by, lens_prior
from aeromatch_cli.sfm.calibration import lens_of as lens_of_camera
from aeromatch_cli.sfm.model_adjustment import Given, Work, _network, intersect, state_errors

zlib.compress(b"")  # pycolmap aborts the process when it is imported before zlib was used
import pycolmap  # noqa: E402

# By the names of all models: what no model has twice.
VALUES = {
    "f": 900.0, "fx": 905.0, "fy": 900.0, "cx": 510.0, "cy": 380.0, "k1": -0.05, "k2": 0.02, "k3": -0.004, "k4": 0.001,
    "p1": 0.0006, "p2": -0.0003, "b1": 4.0, "b2": -1.5,
}  # fmt: skip
SIZE_PX = 1000, 750


def camera(model: str, **other: float) -> Camera:
    return Camera(model, *SIZE_PX, tuple((VALUES | other)[name] for name in MODELS[model]))


@pytest.mark.parametrize("model", MODELS)
def test_a_camera_is_the_same_after_it_was_a_lens(model: str) -> None:
    given = camera(model)
    assert camera_of(lens_of_camera(given), given) == given


@pytest.mark.parametrize("model", [model for model in MODELS if model not in (BROWN, FISHEYE)])
def test_what_a_model_does_not_hold_makes_it_the_blocks_own(model: str) -> None:
    lens = lens_of_camera(camera(model))
    lens[LENS.index("p1")] += 0.01
    lens[LENS.index("b2")] = 2.0
    found = camera_of(lens, camera(model))
    assert found.model == BROWN
    np.testing.assert_array_equal(lens_of_camera(found), lens)


def test_only_the_focal_length_changed_keeps_the_model() -> None:
    lens = lens_of_camera(camera("SIMPLE_RADIAL"))
    lens[0] = 950.0
    assert camera_of(lens, camera("SIMPLE_RADIAL")) == camera("SIMPLE_RADIAL", f=950.0)


@pytest.mark.parametrize("model", [model for model in MODELS if model != BROWN])
def test_pycolmaps_camera_is_the_same_lens(model: str) -> None:
    """Its pixels count from the corner of the first, which lens_of takes off."""
    given = camera(model)
    name, params = colmap_camera(given)
    found = pycolmap.Camera(model=name, width=SIZE_PX[0], height=SIZE_PX[1], params=params, camera_id=1)
    np.testing.assert_allclose(lens_of(found), lens_of_camera(given), atol=1e-12)
    set_lens(pycolmap, found, lens_of_camera(given), model == FISHEYE)
    assert found.model.name == (FISHEYE if model == FISHEYE else "FULL_OPENCV")
    np.testing.assert_allclose(lens_of(found), lens_of_camera(given), atol=1e-12)


def prior(**other: float) -> LensPrior:
    return lens_prior(camera("SIMPLE_PINHOLE", **other), 0.02)


@pytest.mark.parametrize(("calibration", "images", "names"), [
    ("given", 20, ""),
    ("focal", 20, "f"),
    ("focal", 2, ""),
    ("auto", 20, "f cx cy k1 k2 k3 p1 p2 b1"),  # of a skew nobody has stated anything
    ("brown", 20, "f cx cy k1 k2 k3 p1 p2 b1 b2"),
    ("auto", 3, "f"),
    ("auto", 2, ""),
])  # fmt: skip
def test_what_is_free_of_a_camera(calibration: Calibration, images: int, names: str) -> None:
    sigmas = freed(prior(), calibration, {}, images)
    assert {LENS[k] for k in np.flatnonzero(sigmas)} == set(names.split())
    np.testing.assert_array_equal(sigmas[sigmas > 0], prior().sigmas[sigmas > 0])


@pytest.mark.parametrize("calibration", ["given", "focal", "auto", "brown"])
@pytest.mark.parametrize("switches", [{}, {"f": False, "k3": False}, {"f": True, "cx": True, "b2": False}])
def test_the_settings_that_hold_are_named_for_what_they_hold(
    calibration: Calibration, switches: dict[str, bool]
) -> None:
    sigmas = freed(prior(), calibration, switches, 20)
    found = held_by(calibration, switches)
    unstated = {"b2"} if calibration == "auto" and "b2" not in switches else set()
    assert set(found) == {LENS[k] for k in range(10) if sigmas[k] == 0.0} - unstated
    assert {name for name, setting in found.items() if setting == "adjust.hold"} == {
        name for name, free in switches.items() if not free
    }
    assert set(found.values()) <= {"adjust.hold", f"adjust.calibration={calibration}"}


def test_switches_free_and_hold_in_any_case() -> None:
    held = freed(prior(), "auto", {"k3": False, "b1": False, "f": False}, 20)
    assert {LENS[k] for k in np.flatnonzero(held)} == {"cx", "cy", "k1", "k2", "p1", "p2"}
    free = freed(prior(), "given", {"cx": True, "b2": True}, 2)
    assert {LENS[k] for k in np.flatnonzero(free)} == {"cx", "b2"}


def test_a_stated_calibration_is_known_four_times_as_well() -> None:
    unknown, stated = prior(cx=499.5, cy=374.5), lens_prior(camera("OPENCV"), 0.02)
    assert unknown.sigmas[0] == pytest.approx(18.0)
    assert unknown.sigmas[1:3] == pytest.approx([20.0, 20.0])
    shared = ~np.isin(LENS[1:10], ("k3", "b2"))  # which OPENCV has not
    np.testing.assert_allclose(stated.sigmas[1:10][shared], 0.25 * unknown.sigmas[1:10][shared], rtol=0.02)
    np.testing.assert_array_equal(unknown.sigmas[READOUT:], 0.0)
    # Each radial term moves the corner by 5 % of its distance from the middle.
    radius = np.hypot(*SIZE_PX) / 2.0 / 900.0
    assert unknown.sigmas[3:6] * radius ** np.array([2, 4, 6]) == pytest.approx([0.05] * 3)


def test_a_fisheye_has_four_radial_terms_and_no_decentring() -> None:
    found = lens_prior(camera(FISHEYE), 0.01)
    assert found.fisheye
    free = {LENS[k] for k in np.flatnonzero(freed(found, "auto", {}, 20))}
    assert free == {"f", "cx", "cy", "k1", "k2", "k3", "p1", "b1"}
    assert found.lens[LENS.index("p1")] == parameters(camera(FISHEYE))["k4"]


@pytest.fixture(scope="module")
def model() -> Any:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 4
    options.num_points3D = 100
    pycolmap.set_random_seed(3)
    return pycolmap.synthesize_dataset(options)


def nothing_given(count: int) -> Given:
    return given_positions(np.full((count, 3), np.nan), np.full(count, np.nan))


def work_of(model: Any) -> Work:
    lenses = {int(number): lens_of(one) for number, one in model.cameras.items()}
    held = {number: np.zeros(12) for number in lenses}
    return Work(pycolmap, lenses, held, frozenset(), Options(1e-8, final=False))


def state_of(model: Any) -> list[FloatArray]:
    ids, points = image_numbers(model), sorted(model.points3D)
    poses = [model.images[i].cam_from_world().matrix() for i in ids]
    return [
        np.array(poses),
        np.array([model.points3D[i].xyz for i in points]),
        np.array([lens_of(one) for _, one in sorted(model.cameras.items())]),
    ]


def test_a_model_is_the_same_after_it_was_a_network(model: Any) -> None:
    own = copy.deepcopy(model)
    work = work_of(own)
    network, state, points, numbers = _network(work, own, nothing_given(len(own.images)))
    before = state_of(own)
    lenses = dict(zip(numbers, ((one, False) for one in state.lens), strict=True))
    take(pycolmap, own, image_numbers(own), points, state, lenses)
    for one, other in zip(state_of(own), before, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    tracks = {k: [(e.image_id, e.point2D_idx) for e in p.track.elements] for k, p in model.points3D.items()}
    assert {k: [(e.image_id, e.point2D_idx) for e in p.track.elements] for k, p in own.points3D.items()} == tracks
    assert len(network.point) == sum(len(track) for track in tracks.values())


def test_a_networks_points_are_where_pycolmap_has_them(model: Any) -> None:
    """Exact image points of a synthetic model: half a pixel of origin is in both."""
    network, state, _, numbers = _network(work_of(model), model, nothing_given(len(model.images)))
    assert numbers == [1, 2]
    np.testing.assert_allclose(project(network, state), network.xy_px, atol=1e-6)
    ids, points = image_numbers(model), sorted(model.points3D)
    image, point, keypoint, xy_px = image_points(model, ids, points)
    for row in (0, len(image) // 2, len(image) - 1):
        seen = model.images[ids[image[row]]].points2D[keypoint[row]]
        assert seen.point3D_id == points[point[row]]
        np.testing.assert_allclose(xy_px[row], seen.xy - 0.5)


def test_a_model_without_points_is_a_network_without_image_points(model: Any) -> None:
    own = copy.deepcopy(model)
    for number in list(own.points3D):
        own.delete_point3D(number)
    ids = image_numbers(own)
    image, point, keypoint, xy_px = image_points(own, ids, [])
    assert (len(image), len(point), len(keypoint), xy_px.shape) == (0, 0, 0, (0, 2))
    state = unknowns_of(own, ids, [], np.zeros((2, 12)), 2, 1)
    assert state.points_m.shape == (0, 3)
    before = state_of(own)
    intersect(work_of(own), own, nothing_given(len(ids)))
    for one, other in zip(state_of(own), before, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert state_errors(work_of(own), own, nothing_given(len(ids))) == 0.0


def test_points_go_where_their_rays_meet(model: Any) -> None:
    own = copy.deepcopy(model)
    rng = np.random.default_rng(0)
    for point in own.points3D.values():
        point.xyz = point.xyz + rng.normal(0.0, 0.05, 3)
    work, given = work_of(own), nothing_given(len(own.images))
    assert state_errors(work, own, given) > 1.0
    intersect(work, own, given)
    assert state_errors(work, own, given) < 1e-4
    for one, other in zip(state_of(own), state_of(model), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
