"""Ground from a constant, a DEM and adjacent images, against planes and projections that are known."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround, DemGround, open_dem
from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, rotation_x, rotation_y, rotation_z
from aeromatch_cli.orientation.terrain import choose_adjacent_pairs, ground_height, pair_height

CAMERA = Camera("OPENCV", 2000, 1500, (1600.0, 1600.0, 999.5, 749.5, -0.05, 0.01, 1e-4, -1e-4))
ORIGIN = (333000.0, 3100000.0, 0.0)
POSITIONS = np.array([[0.0, 0.0, 220.0], [200.0, 150.0, 222.0]])


def plane_m(x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights of a tilted plane in EPSG:32617."""
    return np.asarray(100.0 + 0.02 * (x - ORIGIN[0]) - 0.03 * (y - ORIGIN[1]))


def write_dem(
    path: Path,
    heights: FloatArray,
    west: float,
    north: float,
    cell_m: float,
    crs: str | None = "EPSG:32617",
    nodata: float | None = None,
) -> Path:
    import rasterio

    profile = {"driver": "GTiff", "height": heights.shape[0], "width": heights.shape[1], "count": 1}
    transform = rasterio.Affine(cell_m, 0.0, west, 0.0, -cell_m, north)
    with rasterio.open(path, "w", **profile, dtype="float32", crs=crs, transform=transform, nodata=nodata) as target:
        target.write(heights.astype(np.float32), 1)
    return path


def plane_dem(path: Path, **options: object) -> Path:
    """2 km x 2 km at 5 m around the origin."""
    west, north, cell = ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0
    x, y = np.meshgrid(west + cell * (np.arange(400) + 0.5), north - cell * (np.arange(400) + 0.5))
    return write_dem(path, plane_m(x, y), west, north, cell, **options)  # type: ignore[arg-type]


def test_constant_ground() -> None:
    np.testing.assert_array_equal(ConstantGround(12.5).height_m(np.zeros((3, 2))), [12.5, 12.5, 12.5])
    assert ConstantGround(1.0).height_m(np.zeros((0, 2))).shape == (0,)


def test_dem_is_bilinear_between_cell_centres() -> None:
    dem = DemGround(np.array([[10.0, 20.0], [30.0, 60.0]]), 0.0, 100.0, (10.0, 10.0), -1.0)
    points = np.array([[0, 100], [10, 100], [5, 100], [5, 95], [-4, 104], [14, 86], [-6, 100], [0, 120]])
    np.testing.assert_allclose(dem.height_m(points), [10.0, 20.0, 15.0, 30.0, 10.0, 60.0, -1.0, -1.0])


def test_dem_of_a_plane_in_the_same_crs(tmp_path: Path) -> None:
    ground, notes = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", ORIGIN, POSITIONS)
    assert notes == ()
    xy = np.random.default_rng(0).uniform(-300.0, 400.0, (200, 2))
    np.testing.assert_allclose(ground.height_m(xy), plane_m(xy[:, 0] + ORIGIN[0], xy[:, 1] + ORIGIN[1]), atol=1e-3)
    # Only the block's surroundings: 5 flying heights (about 130 m) on either side, not the 2 km of the file.
    assert ground.heights_m.shape[1] * 5.0 < 1700.0


def test_world_origin_is_subtracted(tmp_path: Path) -> None:
    lifted = (*ORIGIN[:2], 40.0)
    positions = POSITIONS - [0.0, 0.0, 40.0]
    ground, _ = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", lifted, positions)
    assert ground.height_m(np.array([[50.0, 10.0]]))[0] == pytest.approx(100.0 + 1.0 - 0.3 - 40.0, abs=1e-3)


def test_dem_in_another_crs_is_transformed(tmp_path: Path) -> None:
    from pyproj import Transformer

    to_geographic = Transformer.from_crs("EPSG:32617", "EPSG:4326", always_xy=True)
    west, north = to_geographic.transform(ORIGIN[0] - 1500.0, ORIGIN[1] + 1500.0)
    cell = 5e-5
    longitude, latitude = np.meshgrid(west + cell * (np.arange(600) + 0.5), north - cell * (np.arange(560) + 0.5))
    x, y = to_geographic.transform(longitude, latitude, direction="INVERSE")
    path = write_dem(tmp_path / "dem.tif", plane_m(x, y), west, north, cell, crs="EPSG:4326")
    ground, notes = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert notes == ()
    xy = np.random.default_rng(0).uniform(-200.0, 300.0, (100, 2))
    np.testing.assert_allclose(ground.height_m(xy), plane_m(xy[:, 0] + ORIGIN[0], xy[:, 1] + ORIGIN[1]), atol=0.01)


def test_gaps_get_the_median_and_a_note(tmp_path: Path) -> None:
    heights = np.full((400, 400), 120.0)
    heights[:, :200] = -9999.0
    path = write_dem(tmp_path / "dem.tif", heights, ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0, nodata=-9999.0)
    ground, (note,) = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    np.testing.assert_allclose(ground.height_m(np.array([[-300.0, 0.0], [200.0, 0.0], [-5000.0, 0.0]])), 120.0)
    assert "no data" in note
    assert "120.0 m" in note


def test_dem_without_crs_is_taken_in_the_blocks(tmp_path: Path) -> None:
    path = plane_dem(tmp_path / "dem.tif", crs=None)
    ground, (note,) = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert "names no CRS" in note
    assert ground.height_m(np.zeros((1, 2)))[0] == pytest.approx(100.0, abs=1e-3)
    local, notes = open_dem(path, "local", ORIGIN, POSITIONS)
    assert notes == ()
    assert local.height_m(np.zeros((1, 2)))[0] == pytest.approx(100.0, abs=1e-3)


def test_dem_travels_to_workers(tmp_path: Path) -> None:
    ground, _ = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", ORIGIN, POSITIONS)
    xy = np.array([[12.0, 34.0]])
    assert pickle.loads(pickle.dumps(ground)).height_m(xy) == ground.height_m(xy)


def test_unusable_dems_are_refused(tmp_path: Path) -> None:
    path = plane_dem(tmp_path / "dem.tif")
    with pytest.raises(ConfigError, match="does not cover the block"):
        open_dem(path, "EPSG:32617", (433000.0, 3100000.0, 0.0), POSITIONS)
    with pytest.raises(ConfigError, match="local frame"):
        open_dem(path, "local", ORIGIN, POSITIONS)
    with pytest.raises(ConfigError, match="needs image positions"):
        open_dem(path, "EPSG:32617", ORIGIN, np.zeros((0, 3)))
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(ConfigError, match=r"cannot read the DEM .*text\.tif"):
        open_dem(tmp_path / "text.tif", "EPSG:32617", ORIGIN, POSITIONS)
    with pytest.raises(ConfigError, match="cannot read the DEM"):
        open_dem(tmp_path / "absent.tif", "EPSG:32617", ORIGIN, POSITIONS)


# --- ground from adjacent images ---------------------------------------------------------------------------------

GROUND_Z = 37.0


def flight(tilt_deg: float = 12.0, sigma_position_m: float = 0.05, sigma_angle_deg: float = 0.05) -> dict[str, Pose]:
    """Four strips of six images, about 100 m above ground, alternately heading east and west."""
    poses = {}
    for row in range(4):
        for column in range(6):
            heading = 180.0 * (row % 2)
            rotation = from_omega_phi_kappa(tilt_deg, 1.0 * column - 3.0, heading + row)
            center = np.array([18.0 * column, 30.0 * row, GROUND_Z + 100.0 + row + 0.5 * column])
            poses[f"r{row}c{column}"] = Pose(center, rotation, sigma_position_m, sigma_angle_deg)
    return poses


def disturbed(poses: dict[str, Pose], position_m: float, angle_deg: float, seed: int) -> dict[str, Pose]:
    """Poses with noise, and saying so."""
    rng = np.random.default_rng(seed)
    found = {}
    for image_id, pose in poses.items():
        a, b, c = rng.normal(0.0, angle_deg, 3)
        assert pose.world_rotation is not None
        rotation = rotation_x(a) @ rotation_y(b) @ rotation_z(c) @ pose.world_rotation
        center = pose.center_m + rng.normal(0.0, position_m, 3)
        found[image_id] = Pose(center, rotation, position_m, angle_deg)
    return found


class Matcher:
    """Matched pixels of ground points with relief, pixel noise and wrong matches."""

    def __init__(self, truth: dict[str, Pose], noise_px: float = 0.5, wrong: float = 0.3, count: int = 250) -> None:
        rng = np.random.default_rng(5)
        xy = rng.uniform([-80.0, -80.0], [180.0, 180.0], (4000, 2))
        # Mostly level ground, some trees and houses.
        z = GROUND_Z + rng.normal(0.0, 0.3, 4000) + np.where(rng.random(4000) < 0.2, rng.uniform(0.0, 8.0, 4000), 0.0)
        self.points, self.truth = np.column_stack([xy, z]), truth
        self.noise_px, self.wrong, self.count = noise_px, wrong, count
        self.calls: list[tuple[str, str]] = []

    def matched(self, pairs: list[tuple[str, str]]) -> dict[tuple[str, str], tuple[FloatArray, FloatArray]]:
        return {pair: self(*pair) for pair in pairs}

    def __call__(self, id0: str, id1: str) -> tuple[FloatArray, FloatArray]:
        self.calls.append((id0, id1))
        rng = np.random.default_rng(len(self.calls))
        pixels = []
        for image_id in (id0, id1):
            pose = self.truth[image_id]
            assert pose.world_rotation is not None
            pixels.append(project(CAMERA, pose.world_rotation, pose.center_m, self.points))
        both = np.concatenate(pixels, axis=1)
        size = [CAMERA.width_px, CAMERA.height_px] * 2
        both = both[(np.isfinite(both) & (both > 0.0) & (both < size)).all(axis=1)][: self.count]
        both = both + rng.normal(0.0, self.noise_px, both.shape)
        bad = rng.random(len(both)) < self.wrong
        both[bad, 2:] = rng.uniform([0.0, 0.0], size[:2], (int(bad.sum()), 2))
        return both[:, :2], both[:, 2:]


def cameras(poses: dict[str, Pose]) -> dict[str, Camera]:
    return dict.fromkeys(poses, CAMERA)


def test_chosen_pairs_are_near_alike_and_spread() -> None:
    poses = flight()
    poses["backward"] = Pose(np.array([45.0, 45.0, 140.0]), from_omega_phi_kappa(-60.0, 0.0, 0.0), 1.0, 1.0)
    poses["flat"] = Pose(np.array([45.0, 46.0, 140.0]), None, 1.0, 1.0)
    pairs = choose_adjacent_pairs(poses, 4)
    assert 8 <= len(pairs) <= 12
    assert len(set(pairs)) == len(pairs)
    assert all(id0 < id1 and {id0, id1}.isdisjoint({"backward", "flat"}) for id0, id1 in pairs)
    distances = [float(np.linalg.norm(poses[a].center_m - poses[b].center_m)) for a, b in pairs]
    assert max(distances) < 70.0
    used = np.array([poses[image_id].center_m[:2] for pair in pairs for image_id in pair])
    assert np.ptp(used, axis=0) == pytest.approx([90.0, 90.0])
    assert choose_adjacent_pairs(dict(reversed(poses.items())), 4) == pairs
    assert choose_adjacent_pairs({"a": poses["r0c0"]}, 4) == []


@pytest.mark.parametrize("tilt_deg", [0.0, 12.0, 40.0])
def test_exact_poses_give_the_ground(tilt_deg: float) -> None:
    poses = flight(tilt_deg)
    pairs = choose_adjacent_pairs(poses, 4)
    matcher = Matcher(poses)
    estimate = ground_height(matcher.matched(pairs), poses, cameras(poses))
    assert estimate.z_m == pytest.approx(GROUND_Z, abs=1.0)
    assert estimate.pairs >= 6
    assert f"{estimate.pairs} adjacent pairs" in estimate.reason


@pytest.mark.parametrize(("position_m", "angle_deg", "within_m"), [(0.3, 1.0, 3.0), (0.1, 3.0, 3.0), (2.0, 2.0, 10.0)])
def test_noisy_poses_are_fitted_before_they_are_used(position_m: float, angle_deg: float, within_m: float) -> None:
    truth = flight()
    errors = []
    for seed in range(3):
        poses = disturbed(truth, position_m, angle_deg, seed)
        estimate = ground_height(Matcher(truth).matched(choose_adjacent_pairs(poses, 4)), poses, cameras(poses))
        assert estimate.z_m is not None, estimate.reason
        errors.append(estimate.z_m - GROUND_Z)
    assert np.abs(errors).max() < within_m


def test_estimate_is_reproducible() -> None:
    poses = disturbed(flight(), 1.0, 1.0, 0)
    pairs = choose_adjacent_pairs(poses, 3)
    first, second = (ground_height(Matcher(flight()).matched(pairs), poses, cameras(poses)) for _ in range(2))
    assert first == second


def test_too_few_points_are_refused() -> None:
    poses = flight()
    pairs = choose_adjacent_pairs(poses, 3)
    nothing = ground_height(dict.fromkeys(pairs, (np.zeros((0, 2)), np.zeros((0, 2)))), poses, cameras(poses))
    assert nothing.z_m is None
    assert "too few matches" in nothing.reason
    random = ground_height(Matcher(poses, wrong=1.0).matched(pairs), poses, cameras(poses))
    assert random.z_m is None
    none = ground_height({}, poses, cameras(poses))
    assert (none.z_m, none.reason) == (None, "no adjacent images with attitude")


def test_wrong_angle_convention_is_refused() -> None:
    truth = flight()
    # The optical axis of every image points to the sky.
    upside = {i: Pose(p.center_m, rotation_y(180.0) @ p.world_rotation, 0.5, 1.0) for i, p in truth.items()}
    estimate = ground_height(Matcher(truth).matched(choose_adjacent_pairs(upside, 4)), upside, cameras(upside))
    assert estimate.z_m is None
    assert "contradict" in estimate.reason or "above the cameras" in estimate.reason


def test_shuffled_poses_are_refused() -> None:
    truth = flight()
    order = np.random.default_rng(2).permutation(len(truth))
    values = list(truth.values())
    shuffled = {image_id: values[idx] for image_id, idx in zip(truth, order, strict=True)}
    estimate = ground_height(Matcher(truth).matched(choose_adjacent_pairs(shuffled, 4)), shuffled, cameras(shuffled))
    assert estimate.z_m is None


def test_pair_height_says_why_there_is_none() -> None:
    poses = flight()
    points = Matcher(poses)("r0c0", "r0c1")
    flat = Pose(poses["r0c0"].center_m, None, 1.0, 1.0)
    assert pair_height(flat, poses["r0c1"], CAMERA, CAMERA, *points) == "no attitude"
    near = Pose(poses["r0c0"].center_m + np.array([0.05, 0, 0]), poses["r0c0"].world_rotation, 0.001, 0.001)
    pixels = Matcher(poses, wrong=0.0, noise_px=0.0)("r0c0", "r0c0")
    assert pair_height(poses["r0c0"], near, CAMERA, CAMERA, *pixels) == "rays too parallel"
