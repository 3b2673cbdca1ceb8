"""The COLMAP exporter: what is written reads back, and COLMAP's own mappers find the truth from it."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeromatch_cli.data import Block, Camera, FloatArray, Image, Pair, Pose
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.geometry.cameras import colmap_camera, project
from aeromatch_cli.geometry.epipolar import essential, fundamental_from_poses, relative_pose
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_quaternion
from aeromatch_cli.geometry.warps import undistorted_from_ground
from aeromatch_cli.strategies.exporters import EXPORTERS, Colmap, ExportContents, ExportSummary, PairContents

zlib.compress(b"")  # pycolmap aborts the process when it is imported before zlib was used

CAMERA_A = Camera("OPENCV", 1000, 750, (820.0, 815.0, 503.2, 371.1, -0.08, 0.03, 1e-3, -5e-4))
CAMERA_B = Camera("SIMPLE_RADIAL", 800, 600, (660.0, 399.5, 299.5, -0.05))
ORIGIN_M = (500000.0, 4100000.0, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """Six images over 400 points. tied: how many of the points are keypoints of three images or more.

    COLMAP ignores tracks of two images by default.
    """

    block: Block
    points_m: FloatArray
    keypoints_px: dict[str, FloatArray]
    pairs: tuple[PairContents, ...]
    tied: int

    def contents(self) -> ExportContents:
        return ExportContents(self.block, self.keypoints_px.__getitem__, iter(self.pairs), frozenset({"b"}))


def make_truth(folder_name: str = "flight") -> Truth:
    rng = np.random.default_rng(3)
    points_m = np.column_stack([rng.uniform(-60, 60, 400), rng.uniform(-50, 50, 400), rng.uniform(0, 15, 400)])
    images, poses, keypoints, seen = [], {}, {}, {}
    for number in range(6):
        image_id, camera_id, camera = f"img{number}", "ab"[number % 2], (CAMERA_A, CAMERA_B)[number % 2]
        center_m = np.array([-30.0 + 30 * (number % 3), -15.0 + 30 * (number // 3), 100.0 + rng.uniform(-3, 3)])
        rotation = from_omega_phi_kappa(*rng.uniform(-6, 6, 2), rng.uniform(-10, 10))
        pixels = project(camera, rotation, center_m, points_m)
        inside = np.isfinite(pixels).all(axis=1) & (pixels >= 0).all(axis=1)
        inside &= (pixels <= [camera.width_px - 1, camera.height_px - 1]).all(axis=1)
        images.append(Image(image_id, f"{folder_name}/{number}.jpg", camera.width_px, camera.height_px, camera_id))
        poses[image_id] = Pose(center_m, rotation, 0.5, 1.0)
        seen[image_id] = rng.permutation(np.flatnonzero(inside))
        keypoints[image_id] = pixels[seen[image_id]].astype(np.float32)
    pairs = []
    for first in range(6):
        for second in range(first + 1, 6):
            id0, id1 = f"img{first}", f"img{second}"
            _, rows0, rows1 = np.intersect1d(seen[id0], seen[id1], return_indices=True)
            verified = np.column_stack([rows0, rows1]).astype(np.int32)
            matches = np.concatenate([verified, np.column_stack([rows0[:5], rows1[5:10]]).astype(np.int32)])
            model = essential(*relative_pose(poses[id0], poses[id1]))
            pairs.append(PairContents(Pair(id0, id1, np.nan, np.nan, "overlap"), matches, verified, "E", model))
    cameras = {"a": CAMERA_A, "b": CAMERA_B}
    block = Block(tuple(images), cameras, poses, "EPSG:32633", ORIGIN_M, None, "constant", None)
    tied = (np.bincount(np.concatenate(list(seen.values())), minlength=len(points_m)) > 2).sum()
    return Truth(block, points_m, keypoints, tuple(pairs), int(tied))


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


@pytest.fixture(scope="module")
def exported(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ExportSummary]:
    folder = tmp_path_factory.mktemp("export") / "colmap"
    return folder, Colmap()(truth.contents(), folder)


@pytest.fixture
def database(exported: tuple[Path, ExportSummary]) -> Iterator[Any]:
    import pycolmap

    with pycolmap.Database.open(exported[0] / "database.db") as opened:
        yield opened


def export_one_pair(truth: Truth, folder: Path, **changes: Any) -> Any:
    """Export the first pair with other contents, and read its two-view geometry back."""
    import pycolmap

    pair = dataclasses.replace(truth.pairs[0], **changes)
    Colmap()(dataclasses.replace(truth.contents(), pairs=[pair]), folder)
    with pycolmap.Database.open(folder / "database.db") as opened:
        return opened.read_two_view_geometry(1, 2)


def homogeneous(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def test_the_table_names_it() -> None:
    assert EXPORTERS["colmap"] is Colmap
    assert Colmap().name == "colmap"


def test_summary_counts(truth: Truth, exported: tuple[Path, ExportSummary]) -> None:
    folder, summary = exported
    assert [path.relative_to(folder).as_posix() for path in summary.files] == [
        "database.db",
        "sparse/cameras.txt",
        "sparse/images.txt",
        "sparse/points3D.txt",
        "world.json",
    ]
    assert all(path.is_file() for path in summary.files)
    assert (summary.images, summary.posed_images) == (6, 6)
    assert summary.keypoints == sum(len(k) for k in truth.keypoints_px.values())
    assert (summary.matched_pairs, summary.verified_pairs) == (15, 15)
    assert summary.verified_matches == sum(len(p.verified) for p in truth.pairs)
    assert summary.matches == summary.verified_matches + 15 * 5


def test_cameras_and_images_read_back(truth: Truth, database: Any) -> None:
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    assert [cameras[i].model.name for i in (1, 2)] == ["OPENCV", "SIMPLE_RADIAL"]
    np.testing.assert_array_equal(cameras[1].params, colmap_camera(CAMERA_A)[1])
    assert (cameras[1].params[2], cameras[1].params[3]) == (503.7, 371.6)
    assert [cameras[i].has_prior_focal_length for i in (1, 2)] == [True, False]  # "b" was declared a guess
    names = {image.image_id: (image.name, image.camera_id) for image in database.read_all_images()}
    assert names == {n + 1: (f"flight/{n}.jpg", n % 2 + 1) for n in range(6)}
    for number, image_id in enumerate(sorted(truth.keypoints_px), start=1):
        keypoints = database.read_keypoints(number)
        np.testing.assert_array_equal(keypoints, truth.keypoints_px[image_id] + np.float32(0.5))


def test_matches_and_geometries_read_back(truth: Truth, database: Any) -> None:
    for item in truth.pairs:
        numbers = [int(name[3:]) + 1 for name in (item.pair.image_id0, item.pair.image_id1)]
        np.testing.assert_array_equal(database.read_matches(*numbers), item.matches)
        geometry = database.read_two_view_geometry(*numbers)
        np.testing.assert_array_equal(geometry.inlier_matches, item.verified)
        np.testing.assert_allclose(geometry.E, item.model, atol=1e-12)
        assert geometry.config == 2  # CALIBRATED
    assert database.num_verified_image_pairs() == 15


def test_exported_essential_fits_colmaps_own_rays(truth: Truth, database: Any) -> None:
    geometry = database.read_two_view_geometry(1, 2)
    rays = []
    for side, number in enumerate((1, 2)):
        keypoints = database.read_keypoints(number)[geometry.inlier_matches[:, side]]
        rays.append(homogeneous(database.read_camera(number).cam_from_img(keypoints)))
    assert np.abs(np.einsum("ni,ij,nj->n", rays[1], geometry.E, rays[0])).max() < 1e-6


def test_the_fundamental_matrix_of_an_essential_one_is_in_colmaps_pixels(truth: Truth, database: Any) -> None:
    geometry = database.read_two_view_geometry(1, 2)
    k0, k1 = (database.read_camera(number).calibration_matrix() for number in (1, 2))
    assert (k0[0, 2], k1[0, 2]) == (503.7, 400.0)  # from the corner of the first pixel
    expected = np.linalg.inv(k1).T @ truth.pairs[0].model @ np.linalg.inv(k0)
    scale = np.sum(geometry.F * expected) / np.sum(expected**2)
    assert scale > 0
    np.testing.assert_allclose(geometry.F / scale, expected, rtol=1e-6, atol=1e-12 * np.abs(expected).max())
    pixels = []
    for side, (number, k) in enumerate(((1, k0), (2, k1))):
        keypoints = database.read_keypoints(number)[geometry.inlier_matches[:, side]]
        pixels.append(homogeneous(database.read_camera(number).cam_from_img(keypoints)) @ k.T)
    lines = pixels[0] @ geometry.F.T
    distances_px = np.abs((lines * pixels[1]).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert distances_px.max() < 1e-3


def test_pose_priors_are_cartesian_world_coordinates(truth: Truth, database: Any) -> None:
    priors = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
    assert sorted(priors) == [1, 2, 3, 4, 5, 6]
    for number, prior in priors.items():
        pose = truth.block.poses[f"img{number - 1}"]
        np.testing.assert_allclose(prior.position, pose.center_m)
        np.testing.assert_allclose(prior.position_covariance, 0.25 * np.eye(3))
        assert prior.coordinate_system.name == "CARTESIAN"


def test_text_model_carries_the_poses(truth: Truth, exported: tuple[Path, ExportSummary]) -> None:
    folder, _ = exported
    rows = [line.split() for line in (folder / "sparse/images.txt").read_text().splitlines() if line[:1].isdigit()]
    assert [(int(row[0]), int(row[8]), row[9]) for row in rows] == [
        (n + 1, n % 2 + 1, f"flight/{n}.jpg") for n in range(6)
    ]
    for row, image_id in zip(rows, sorted(truth.block.poses), strict=True):
        pose = truth.block.poses[image_id]
        assert pose.world_rotation is not None
        values = np.array(row[1:8], dtype=float)
        np.testing.assert_allclose(values[:4], to_quaternion(pose.world_rotation), atol=1e-15)
        np.testing.assert_allclose(-pose.world_rotation.T @ values[4:], pose.center_m, atol=1e-9)
    assert json.loads((folder / "world.json").read_text())["origin_m"] == list(ORIGIN_M)


MAPPING = """
import sys, zlib
zlib.compress(b"")
import pycolmap
folder, output = sys.argv[1:]
pycolmap.logging.minloglevel = 2
models = pycolmap.incremental_mapping(folder + "/database.db", folder, output)
print(len(models), models[0].num_reg_images(), models[0].compute_mean_reprojection_error())
for image in sorted(models[0].images.values(), key=lambda image: image.image_id):
    print(*image.projection_center())
"""


def test_incremental_mapping_finds_the_truth(
    truth: Truth, exported: tuple[Path, ExportSummary], tmp_path: Path
) -> None:
    process = subprocess.run(
        [sys.executable, "-c", MAPPING, str(exported[0]), str(tmp_path)], capture_output=True, text=True, check=True
    )
    lines = process.stdout.splitlines()[-7:]
    models, registered, error_px = lines[0].split()
    assert (models, registered) == ("1", "6")
    assert float(error_px) < 0.1
    found = np.array([line.split() for line in lines[1:]], dtype=float)
    expected = np.array([truth.block.poses[f"img{n}"].center_m for n in range(6)])
    # Similarity alignment (Umeyama 1991), then the largest error against the extent of the block.
    a, b = found - found.mean(axis=0), expected - expected.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    aligned = (np.trace(np.diag(s) @ flip) / (a**2).sum()) * a @ (u @ flip @ vt).T
    assert np.linalg.norm(aligned - b, axis=1).max() / np.ptp(expected, axis=0).max() < 1e-3


def test_mapping_with_pose_priors_stays_in_the_world(
    truth: Truth, exported: tuple[Path, ExportSummary], tmp_path: Path
) -> None:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(use_prior_position=True)
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 2
    models = pycolmap.incremental_mapping(exported[0] / "database.db", exported[0], tmp_path, options)
    pycolmap.logging.minloglevel = level
    assert len(models) == 1
    centres = {image.image_id: image.projection_center() for image in models[0].images.values()}
    assert sorted(centres) == [1, 2, 3, 4, 5, 6]
    for number, centre in centres.items():
        np.testing.assert_allclose(centre, truth.block.poses[f"img{number - 1}"].center_m, atol=1e-3)


@pytest.mark.parametrize("name", ["flight", "flight 2, north"])
def test_triangulating_the_given_poses_finds_the_points(name: str, tmp_path: Path) -> None:
    import pycolmap

    truth = make_truth(name)  # COLMAP cannot read the space of the second name from text
    folder = tmp_path / "colmap"
    Colmap()(truth.contents(), folder)
    model = pycolmap.Reconstruction(folder / "sparse")
    assert {image.name for image in model.images.values()} == {image.name for image in truth.block.images}
    (tmp_path / "out").mkdir()
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 2
    model = pycolmap.triangulate_points(model, folder / "database.db", tmp_path, tmp_path / "out")
    pycolmap.logging.minloglevel = level
    found = np.array([point.xyz for point in model.points3D.values()])
    distances = np.linalg.norm(found[:, None] - truth.points_m[None], axis=2).min(axis=1)
    assert len(found) == truth.tied
    assert distances.max() < 1e-3  # metres, from 100 m
    assert model.compute_mean_reprojection_error() < 1e-3


def test_fundamental_moves_to_colmaps_pixels(truth: Truth, tmp_path: Path) -> None:
    plain0 = Camera("SIMPLE_PINHOLE", 1000, 750, (820.0, 499.5, 374.5))
    plain1 = Camera("SIMPLE_PINHOLE", 800, 600, (660.0, 399.5, 299.5))
    pose0, pose1 = truth.block.poses["img0"], truth.block.poses["img1"]
    model = fundamental_from_poses(plain0, pose0, plain1, pose1)
    geometry = export_one_pair(truth, tmp_path / "colmap", model_kind="F", model=model)
    assert geometry.config == 3  # UNCALIBRATED
    assert geometry.E is None
    pixels = []
    for camera, pose in ((plain0, pose0), (plain1, pose1)):
        assert pose.world_rotation is not None
        pixels.append(homogeneous(project(camera, pose.world_rotation, pose.center_m, truth.points_m) + 0.5))
    algebraic = np.abs(np.einsum("ni,ij,nj->n", pixels[1], geometry.F, pixels[0]))
    assert algebraic.max() / np.abs(geometry.F).max() < 1e-6


def test_homography_moves_to_colmaps_pixels(truth: Truth, tmp_path: Path) -> None:
    plain0 = Camera("SIMPLE_PINHOLE", 1000, 750, (820.0, 499.5, 374.5))
    plain1 = Camera("SIMPLE_PINHOLE", 800, 600, (660.0, 399.5, 299.5))
    pose0, pose1 = truth.block.poses["img0"], truth.block.poses["img1"]
    model = undistorted_from_ground(plain1, pose1, 0.0) @ np.linalg.inv(undistorted_from_ground(plain0, pose0, 0.0))
    geometry = export_one_pair(truth, tmp_path / "colmap", model_kind="H", model=model)
    assert geometry.config == 4  # PLANAR
    ground_m = truth.points_m * [1.0, 1.0, 0.0]
    assert pose0.world_rotation is not None
    assert pose1.world_rotation is not None
    pixels0 = homogeneous(project(plain0, pose0.world_rotation, pose0.center_m, ground_m) + 0.5)
    mapped = pixels0 @ geometry.H.T
    expected = project(plain1, pose1.world_rotation, pose1.center_m, ground_m) + 0.5
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], expected, atol=1e-6)


def test_rejected_pairs_keep_their_matches_only(truth: Truth, tmp_path: Path) -> None:
    import pycolmap

    rejected = dataclasses.replace(truth.pairs[0], verified=np.zeros((0, 2), np.int32), model_kind="")
    contents = dataclasses.replace(truth.contents(), pairs=[rejected])
    summary = Colmap()(contents, tmp_path / "with")
    assert (summary.matched_pairs, summary.verified_pairs, summary.verified_matches) == (1, 0, 0)
    Colmap(raw_matches=False, pose_priors=False)(contents, tmp_path / "without")
    with pycolmap.Database.open(tmp_path / "with/database.db") as opened:
        assert (opened.num_matches(), opened.num_verified_image_pairs()) == (len(rejected.matches), 0)
        assert opened.num_pose_priors() == 6
    with pycolmap.Database.open(tmp_path / "without/database.db") as opened:
        assert (opened.num_matches(), opened.num_pose_priors()) == (0, 0)


def test_images_without_pose_or_features_are_exported(truth: Truth, tmp_path: Path) -> None:
    import pycolmap

    poses = dict(truth.block.poses)
    del poses["img0"]
    poses["img1"] = dataclasses.replace(poses["img1"], world_rotation=None)
    contents = ExportContents(dataclasses.replace(truth.block, poses=poses), lambda _: np.zeros((0, 2), np.float32), ())
    summary = Colmap()(contents, tmp_path / "colmap")
    assert (summary.images, summary.posed_images, summary.keypoints) == (6, 4, 0)
    assert sorted(pycolmap.Reconstruction(tmp_path / "colmap/sparse").images) == [3, 4, 5, 6]
    with pycolmap.Database.open(tmp_path / "colmap/database.db") as opened:
        assert (opened.num_images(), opened.num_keypoints(), opened.num_pose_priors()) == (6, 0, 5)


def test_a_second_export_replaces_the_first(truth: Truth, tmp_path: Path) -> None:
    folder = tmp_path / "colmap"
    Colmap()(truth.contents(), folder)
    (folder / "leftover.txt").write_text("of an older version")
    (tmp_path / ".colmap.partial").mkdir()  # as after a killed run
    (tmp_path / ".colmap.partial" / "database.db").write_text("half")
    Colmap()(truth.contents(), folder)
    assert sorted(path.name for path in folder.iterdir()) == ["database.db", "sparse", "world.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["colmap"]


@pytest.mark.parametrize("bad", [-1, 10_000])
def test_a_failed_export_leaves_the_old_one(truth: Truth, tmp_path: Path, bad: int) -> None:
    folder = tmp_path / "colmap"
    Colmap()(truth.contents(), folder)
    before = (folder / "database.db").read_bytes()
    broken = dataclasses.replace(truth.pairs[0], verified=np.array([[0, bad]], np.int32))
    with pytest.raises(ValueError, match="img0, img1 has a match without keypoint"):
        Colmap()(dataclasses.replace(truth.contents(), pairs=[broken]), folder)
    assert (folder / "database.db").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["colmap"]


FULL_DISK = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_export_colmap import Colmap, WorkspaceError, make_truth
truth, folder = make_truth(), Path(sys.argv[2])
Colmap()(truth.contents(), folder)
before = (folder / "database.db").read_bytes()
for limit in range(20_000, len(before), 15_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        Colmap()(truth.contents(), folder)
    except WorkspaceError as error:
        assert "check free space" in str(error), error
    else:
        raise AssertionError(f"{limit} bytes were enough")
    assert (folder / "database.db").read_bytes() == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    print("refused")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a file size limit")
def test_a_full_disk_leaves_the_old_export(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL_DISK, str(Path(__file__).parent), str(tmp_path / "colmap")]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr[-2000:]
    assert process.stdout.count("refused") >= 5


def test_an_unwritable_folder_is_named(truth: Truth, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(WorkspaceError, match=f"{os.sep}file{os.sep}colmap cannot be written"):
        Colmap()(truth.contents(), tmp_path / "file" / "colmap")
