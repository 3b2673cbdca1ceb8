"""The bundle adjustment of verified matches: exact points of a known block, its file, and the stage that runs it."""

from __future__ import annotations

import csv
import json
import pickle
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import forked
import numpy as np
import pytest
from conftest import IMAGES, Site
from scipy.spatial.transform import Rotation
from test_export_colmap import CAMERA_A, CAMERA_B, ORIGIN_M, Truth, make_truth

from aeromatch_cli.config import load
from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, Pose
from aeromatch_cli.errors import InputError
from aeromatch_cli.formats.adjusted import orientation_text, read_adjusted, write_adjusted
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.cameras import normalise, project
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa, to_omega_phi_kappa
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.sfm import process
from aeromatch_cli.sfm.mapping import Group, Observed, adjust_block, map_block
from aeromatch_cli.stages import adjust, models
from aeromatch_cli.strategies.exporters import Colmap, ExportContents

zlib.compress(b"")  # pycolmap aborts the process when it is imported before zlib was used

NOISE_PX = 0.3
IMAGE_IDS = tuple(f"img{number}" for number in range(6))
CAMERAS = {i: (CAMERA_A, CAMERA_B)[int(i[-1]) % 2] for i in IMAGE_IDS}
FOCAL_SIGMAS = {"a": 0.02, "b": 0.02}


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


def disturbed(truth: Truth, seed: int, *, degrees: float = 0.3, metres: float = 0.5) -> ExportContents:
    """Keypoints with NOISE_PX, poses off by some degrees and metres, as a first pass leaves them."""
    rng = np.random.default_rng(seed)
    keypoints = {i: k + rng.normal(0.0, NOISE_PX, k.shape).astype(np.float32) for i, k in truth.keypoints_px.items()}
    poses = {
        i: Pose(
            p.center_m + rng.normal(0.0, metres, 3),
            Rotation.from_rotvec(rng.normal(0.0, degrees, 3), degrees=True).as_matrix() @ p.world_rotation,
            1.0,
            1.0,
        )
        for i, p in truth.block.poses.items()
    }
    return ExportContents(replace(truth.block, poses=poses), keypoints.__getitem__, truth.pairs)


def given_positions(truth: Truth, seed: int, sigma_m: float) -> dict[str, Pose]:
    rng = np.random.default_rng(seed)
    return {
        i: Pose(p.center_m + rng.normal(0.0, sigma_m, 3), None, sigma_m, 180.0) for i, p in truth.block.poses.items()
    }


@cache
def refined(
    truth: Truth, seed: int = 0, images: tuple[str, ...] = IMAGE_IDS, fixed: bool = False
) -> tuple[AdjustedBlock, list[dict[str, Any]]]:
    positions = given_positions(truth, seed + 100, 0.1)
    groups = [Group("positions", images)]
    return adjust_block(disturbed(truth, seed), Observed(positions, FOCAL_SIGMAS, {}), groups, fixed=fixed)


def errors(truth: Truth, adjusted: AdjustedBlock) -> tuple[FloatArray, FloatArray]:
    """(N, 3) errors of the centres in metres, (N,) of the attitudes in degrees."""
    pairs = [(adjusted.poses[i], truth.block.poses[i]) for i in sorted(adjusted.poses)]
    angles = [angle_between_deg(found.rotation, true.world_rotation) for found, true in pairs]
    return np.array([found.center_m - true.center_m for found, true in pairs]), np.array(angles)


def test_disturbed_poses_are_adjusted_to_the_truth(truth: Truth) -> None:
    adjusted, figures = refined(truth)
    off_m, off_deg = errors(truth, adjusted)
    assert sorted(adjusted.poses) == list(IMAGE_IDS)
    assert np.abs(off_m).max() < 0.4
    assert off_deg.max() < 0.5
    assert len(adjusted.points_m) >= 0.95 * truth.tied
    assert float(np.mean(adjusted.errors_px)) < 2 * NOISE_PX
    assert (figures[0].images, figures[0].points) == (6, len(adjusted.points_m))


@pytest.mark.slow
def test_a_mapper_makes_the_same_bytes_again(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two runs, of which the second is no copy of the first: `forked.kept_run` relies on it."""
    observed = Observed(given_positions(truth, 100, 0.1), FOCAL_SIGMAS, {})
    adjusted, _ = refined(truth)
    mapped = map_block(disturbed(truth, 0), observed, "global")
    monkeypatch.setattr(process, "subprocess", SimpleNamespace(run=forked.run))
    again, _ = adjust_block(disturbed(truth, 0), observed, [Group("positions", IMAGE_IDS)], fixed=False)
    mapped_again = map_block(disturbed(truth, 0), observed, "global")
    assert [pickle.dumps(one) for one in (adjusted, *mapped)] == [pickle.dumps(one) for one in (again, *mapped_again)]


def test_points_are_those_that_their_keypoints_see(truth: Truth) -> None:
    adjusted, _ = refined(truth)
    for image_id, track in adjusted.tracks.items():
        pose, camera = adjusted.poses[image_id], adjusted.cameras["ab"[int(image_id[-1]) % 2]]
        seen_px = project(camera, pose.rotation, pose.center_m, adjusted.points_m[track[:, 1]])
        distances_px = np.linalg.norm(seen_px - truth.keypoints_px[image_id][track[:, 0]], axis=1)
        assert np.median(distances_px) < 2 * NOISE_PX
        assert len(np.unique(track[:, 0])) == len(track) > 50


@pytest.mark.slow
def test_standard_deviations_are_those_of_repeated_measurements(truth: Truth) -> None:
    """Eight blocks with other noise: root mean square errors, and the standard deviations that are stated."""
    runs = [refined(truth)[0], *(refined(truth, seed)[0] for seed in range(1, 8))]
    measured = np.array([errors(truth, run)[0] for run in runs])
    stated = np.array([[run.poses[i].sigmas_m for i in IMAGE_IDS] for run in runs])
    ratio = np.sqrt((measured**2).mean(axis=(0, 1))) / np.sqrt((stated**2).mean(axis=(0, 1)))
    assert ((ratio > 0.6) & (ratio < 1.6)).all(), ratio
    angles = np.array([errors(truth, run)[1] for run in runs])
    whole = np.array([[np.linalg.norm(run.poses[i].sigmas_deg) for i in IMAGE_IDS] for run in runs])
    assert 0.6 < np.sqrt((angles**2).mean() / (whole**2).mean()) < 1.6


def test_surveyed_poses_stay_and_get_points(truth: Truth) -> None:
    contents = replace(disturbed(truth, 0), block=truth.block)
    groups = [Group("given", IMAGE_IDS)]
    adjusted, _ = adjust_block(contents, Observed(truth.block.poses, FOCAL_SIGMAS, {}), groups, fixed=True)
    off_m, off_deg = errors(truth, adjusted)
    assert np.abs(off_m).max() < 1e-9
    assert off_deg.max() < 1e-5
    assert adjusted.cameras == truth.block.cameras
    assert len(adjusted.points_m) >= 0.95 * truth.tied


@pytest.mark.slow
def test_an_image_outside_is_tied_by_its_points(truth: Truth) -> None:
    adjusted, figures = refined(truth, images=IMAGE_IDS[:5])
    assert figures[0].registered == ["img5"]
    off_m, off_deg = errors(truth, adjusted)
    assert sorted(adjusted.poses) == list(IMAGE_IDS)
    assert np.abs(off_m[5]).max() < 0.5
    assert off_deg[5] < 0.5


@pytest.mark.slow
def test_groups_that_matches_tie_become_one(truth: Truth) -> None:
    """A first pass has put three images 40 m and 9 degrees beside the others; final matches tie them all."""
    contents = disturbed(truth, 0)
    turn = Rotation.from_rotvec([3.0, -2.0, 8.0], degrees=True).as_matrix()
    poses = {
        i: replace(pose, center_m=turn @ pose.center_m + [40.0, 0.0, 5.0], world_rotation=pose.world_rotation @ turn.T)
        if i in ("img2", "img4", "img5")
        else pose
        for i, pose in contents.block.poses.items()
    }
    apart = replace(contents, block=replace(contents.block, poses=poses))
    groups = [Group("positions", ("img0", "img1", "img3")), Group("level", ("img2", "img4", "img5"))]
    observed = Observed(given_positions(truth, 1, 0.1), FOCAL_SIGMAS, {})
    adjusted, figures = adjust_block(apart, observed, groups, fixed=False)
    assert [(one.kind, one.images) for one in figures] == [("positions", 6)]
    off_m, off_deg = errors(truth, adjusted)
    assert np.abs(off_m).max() < 0.5
    assert off_deg.max() < 0.5


@pytest.mark.slow
def test_every_group_ties_its_images_outside(truth: Truth) -> None:
    """Two flights in one folder: each group lacks its last image, and finds it."""
    again = make_truth("second")
    ids = {i: f"other{i}" for i in IMAGE_IDS}
    flights = [disturbed(truth, 0), disturbed(again, 1)]
    images = [replace(image, image_id=ids[image.image_id]) for image in again.block.images]
    poses = {ids[i]: pose for i, pose in flights[1].block.poses.items()}
    pairs = [
        replace(p, pair=replace(p.pair, image_id0=ids[p.pair.image_id0], image_id1=ids[p.pair.image_id1]))
        for p in again.pairs
    ]
    keypoints = {i: flights[0].keypoints_px(i) for i in IMAGE_IDS} | {
        ids[i]: flights[1].keypoints_px(i) for i in IMAGE_IDS
    }
    block = replace(truth.block, images=(*truth.block.images, *images), poses={**flights[0].block.poses, **poses})
    positions = given_positions(truth, 100, 0.1)
    positions |= {ids[i]: pose for i, pose in given_positions(again, 101, 0.1).items()}
    groups = [Group("positions", IMAGE_IDS[:5]), Group("positions", tuple(ids[i] for i in IMAGE_IDS[:5]))]
    contents = ExportContents(block, keypoints.__getitem__, (*truth.pairs, *pairs))
    adjusted, figures = adjust_block(contents, Observed(positions, FOCAL_SIGMAS, {}), groups, fixed=False)
    assert [one.registered for one in figures] == [["img5"], ["otherimg5"]]
    for image_id in ("img5", "otherimg5"):
        true = truth.block.poses["img5"]
        assert np.abs(adjusted.poses[image_id].center_m - true.center_m).max() < 0.5
        assert angle_between_deg(adjusted.poses[image_id].rotation, true.world_rotation) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("turned_deg", "used"), [(0.0, True), (180.0, False)])
def test_tilts_given_with_wrong_headings_level_no_block(truth: Truth, turned_deg: float, used: bool) -> None:
    """Given attitudes that all lean 4 degrees over: they level the block, unless their headings are wrong as well."""
    turn = Rotation.from_euler("zx", [turned_deg, 4.0], degrees=True).as_matrix()
    leaning = {i: pose.world_rotation @ turn for i, pose in truth.block.poses.items()}
    rng = np.random.default_rng(7)
    positions = {
        i: replace(pose, center_m=pose.center_m + rng.normal(0.0, 1.0, 3), world_rotation=leaning[i],
                   sigma_position_m=3.0)
        for i, pose in truth.block.poses.items()
    }  # fmt: skip
    angles = {i: Angles("omega_phi_kappa", to_omega_phi_kappa(rotation), True) for i, rotation in leaning.items()}
    groups = [Group("positions", IMAGE_IDS)]
    adjusted, _ = adjust_block(disturbed(truth, 0), Observed(positions, FOCAL_SIGMAS, angles), groups, fixed=False)
    ups = [pose.rotation.T @ truth.block.poses[i].world_rotation[:, 2] for i, pose in adjusted.poses.items()]
    off_deg = float(np.rad2deg(np.arccos(np.mean(ups, axis=0)[2])))
    assert (off_deg > 2.5) is used
    assert off_deg < (5.0 if used else 2.0)


@pytest.mark.slow
def test_two_groups_are_both_adjusted(truth: Truth) -> None:
    contents = disturbed(truth, 0)
    sides = {i: n % 3 == 2 for n, i in enumerate(IMAGE_IDS)}
    apart = [p for p in truth.pairs if sides[p.pair.image_id0] == sides[p.pair.image_id1]]
    groups = [Group("positions", ("img0", "img1", "img3", "img4")), Group("positions", ("img2", "img5"))]
    observed = Observed(given_positions(truth, 1, 0.1), FOCAL_SIGMAS, {})
    adjusted, figures = adjust_block(replace(contents, pairs=apart), observed, groups, fixed=False)
    assert [one.images for one in figures] == [4, 2]
    assert sorted(adjusted.poses) == list(IMAGE_IDS)
    seen = np.concatenate([track[:, 1] for track in adjusted.tracks.values()])
    assert set(seen.tolist()) == set(range(len(adjusted.points_m)))


@pytest.mark.slow
def test_a_group_whose_images_share_no_point_is_left_out(truth: Truth) -> None:
    contents, groups = disturbed(truth, 0), [Group("positions", IMAGE_IDS[:4]), Group("positions", IMAGE_IDS[4:])]
    within = [p for p in truth.pairs if {p.pair.image_id0, p.pair.image_id1} <= set(IMAGE_IDS[:4])]
    observed = Observed(given_positions(truth, 1, 0.1), FOCAL_SIGMAS, {})
    adjusted, figures = adjust_block(replace(contents, pairs=within), observed, groups, fixed=False)
    assert [one.images for one in figures] == [4]
    assert sorted(adjusted.poses) == list(IMAGE_IDS[:4])


@pytest.mark.slow
def test_groups_share_their_cameras(truth: Truth) -> None:
    """A second flight whose lens is another by 0.5 %: stated errors are those of the cameras that are handed over."""
    contents = disturbed(truth, 0)
    names = {i: f"far{i[-1]}" for i in IMAGE_IDS}
    middles = {i: (CAMERAS[i].width_px / 2, CAMERAS[i].height_px / 2) for i in IMAGE_IDS}
    keypoints = {i: contents.keypoints_px(i) for i in IMAGE_IDS}
    keypoints |= {
        far: (middles[i] + 1.005 * (keypoints[i] - middles[i])).astype(np.float32) for i, far in names.items()
    }
    away_m = np.array([1000.0, 0.0, 0.0])
    block, given = contents.block, given_positions(truth, 1, 0.1)

    def moved(poses: Mapping[str, Pose]) -> dict[str, Pose]:
        return {**poses, **{far: replace(poses[i], center_m=poses[i].center_m + away_m) for i, far in names.items()}}

    images = [replace(image, image_id=names[image.image_id], name=f"far/{image.name}") for image in block.images]
    both = replace(block, images=(*block.images, *images), poses=moved(block.poses))
    ends = [(names[p.pair.image_id0], names[p.pair.image_id1]) for p in truth.pairs]
    more = [
        replace(p, pair=replace(p.pair, image_id0=id0, image_id1=id1))
        for p, (id0, id1) in zip(truth.pairs, ends, strict=True)
    ]
    doubled = ExportContents(both, keypoints.__getitem__, (*truth.pairs, *more))
    groups = [Group("positions", IMAGE_IDS), Group("positions", tuple(names.values()))]
    adjusted, figures = adjust_block(doubled, Observed(moved(given), FOCAL_SIGMAS, {}), groups, fixed=False)
    assert [one.images for one in figures] == [6, 6]
    for group, figure in zip(groups, figures, strict=True):
        off_px = []
        for image_id in group.images:
            track, pose = adjusted.tracks[image_id], adjusted.poses[image_id]
            camera = adjusted.cameras["ab"[int(image_id[-1]) % 2]]
            seen_px = project(camera, pose.rotation, pose.center_m, adjusted.points_m[track[:, 1]])
            off_px.append(np.linalg.norm(seen_px - keypoints[image_id][track[:, 0]], axis=1))
        assert float(np.concatenate(off_px).mean()) == pytest.approx(figure.reprojection_error_px, rel=0.15)


@pytest.mark.slow
def test_groups_of_different_cameras_are_both_adjusted(truth: Truth) -> None:
    """Two places, each with cameras of its own: what the first has found of its lenses is nothing to the second."""
    far = {i: f"far{i[-1]}" for i in IMAGE_IDS}
    others = {"a": "c", "b": "d"}
    contents, block = disturbed(truth, 0), truth.block
    images = [
        replace(one, image_id=far[one.image_id], name=f"far/{one.name}", camera_id=others[one.camera_id])
        for one in block.images
    ]
    both = replace(
        block,
        images=(*block.images, *images),
        cameras={**block.cameras, **{other: block.cameras[k] for k, other in others.items()}},
        poses={**contents.block.poses, **{far[i]: pose for i, pose in contents.block.poses.items()}},
    )
    keypoints = {i: contents.keypoints_px(i) for i in IMAGE_IDS}
    keypoints |= {far[i]: keypoints[i] for i in IMAGE_IDS}
    more = [
        replace(p, pair=replace(p.pair, image_id0=far[p.pair.image_id0], image_id1=far[p.pair.image_id1]))
        for p in truth.pairs
    ]
    given = given_positions(truth, 1, 0.1)
    groups = [Group("positions", IMAGE_IDS), Group("level", tuple(far.values()))]
    observed = Observed(given, dict.fromkeys("abcd", 0.02), {})
    adjusted, figures = adjust_block(
        ExportContents(both, keypoints.__getitem__, (*truth.pairs, *more)), observed, groups, fixed=False
    )
    assert [one.images for one in figures] == [6, 6]
    assert adjusted.cameras.keys() == set("abcd")


@pytest.mark.slow
def test_a_further_group_keeps_its_points_where_the_first_has_found_another_lens(truth: Truth) -> None:
    """Strips there and back, oriented with a principal point 20 px off, and attitudes that make up for it: beside the
    lens that the first group finds they are 40 px off each other."""
    centred = Camera("PINHOLE", 1000, 750, (820.0, 820.0, 499.5, 374.5))
    tilt = Rotation.from_euler("y", np.rad2deg(np.arctan2(20.0, 820.0)), degrees=True).as_matrix()
    turns = {i: np.diag([(-1.0) ** n, (-1.0) ** n, 1.0]) for n, i in enumerate(IMAGE_IDS)}
    far = {i: f"far{i[-1]}" for i in IMAGE_IDS[:3]}
    rng, keypoints, poses = np.random.default_rng(5), {}, {}
    for i, pose in truth.block.poses.items():
        rays = np.column_stack([normalise(CAMERAS[i], truth.keypoints_px[i]), np.ones(len(truth.keypoints_px[i]))])
        turned = rays @ turns[i].T
        seen_px = 820.0 * turned[:, :2] / turned[:, 2:] + [519.5, 374.5]
        for image_id in (i, *([far[i]] if i in far else [])):
            keypoints[image_id] = (seen_px + rng.normal(0.0, NOISE_PX, seen_px.shape)).astype(np.float32)
            poses[image_id] = replace(pose, world_rotation=tilt @ turns[i] @ pose.world_rotation)
    images = [replace(image, width_px=1000, height_px=750, camera_id="a") for image in truth.block.images]
    images += [
        replace(one, image_id=far[one.image_id], name=f"far/{one.name}") for one in images if one.image_id in far
    ]
    block = replace(truth.block, images=tuple(images), cameras={"a": centred}, poses=poses)
    more = [
        replace(p, pair=replace(p.pair, image_id0=far[p.pair.image_id0], image_id1=far[p.pair.image_id1]))
        for p in truth.pairs
        if {p.pair.image_id0, p.pair.image_id1} <= far.keys()
    ]
    given = {i: Pose(poses[i].center_m, None, 0.1, 180.0) for i in IMAGE_IDS}
    groups = [Group("positions", IMAGE_IDS), Group("level", tuple(far.values()))]
    contents = ExportContents(block, keypoints.__getitem__, (*truth.pairs, *more))
    adjusted, figures = adjust_block(contents, Observed(given, {"a": 0.02}, {}), groups, fixed=False)
    ahead = project(adjusted.cameras["a"], np.eye(3), np.zeros(3), np.array([[0.0, 0.0, 1.0]]))
    assert ahead[0, 0] == pytest.approx(519.5, abs=1.0)
    assert [one.images for one in figures] == [6, 3]
    assert figures[1].points > 150
    assert figures[1].track_length == 3.0


@pytest.mark.slow
def test_positions_do_not_pull_a_group_in_a_frame_of_its_own(truth: Truth) -> None:
    """Given positions that are mirrored: of a group that is level they are no observations."""
    mirrored = {
        i: replace(p, center_m=p.center_m * [-1.0, 1.0, 1.0]) for i, p in given_positions(truth, 1, 0.1).items()
    }
    groups = [Group("level", IMAGE_IDS)]
    adjusted, _ = adjust_block(disturbed(truth, 0), Observed(mirrored, FOCAL_SIGMAS, {}), groups, fixed=False)
    free, _ = adjust_block(disturbed(truth, 0), Observed({}, FOCAL_SIGMAS, {}), groups, fixed=False)
    for image_id, pose in adjusted.poses.items():
        np.testing.assert_allclose(pose.center_m, free.poses[image_id].center_m, atol=1e-9)
        np.testing.assert_allclose(pose.sigmas_m, free.poses[image_id].sigmas_m, atol=1e-12)


@pytest.mark.slow
def test_no_image_is_in_two_groups(truth: Truth) -> None:
    """The matches tie all images: the second group stays by itself, the image in neither is tied to the first."""
    groups = [Group("positions", IMAGE_IDS[:2]), Group("positions", IMAGE_IDS[2:5])]
    observed = Observed(given_positions(truth, 1, 0.1), FOCAL_SIGMAS, {})
    adjusted, figures = adjust_block(disturbed(truth, 0), observed, groups, fixed=False)
    assert sum(one.images for one in figures) == len(adjusted.poses) <= len(IMAGE_IDS)
    seen = np.bincount(np.concatenate([track[:, 1] for track in adjusted.tracks.values()]))
    assert (seen >= 2).all()


def test_the_file_reads_back_exactly(truth: Truth, tmp_path: Path) -> None:
    adjusted, _ = refined(truth)
    path = tmp_path / "adjusted.npz"
    with path.open("wb") as stream:
        write_adjusted(stream, adjusted)
    again = read_adjusted(path)
    assert again.cameras == adjusted.cameras
    np.testing.assert_array_equal(again.points_m, adjusted.points_m)
    np.testing.assert_array_equal(again.errors_px, adjusted.errors_px)
    for image_id, pose in adjusted.poses.items():
        for name in ("center_m", "rotation", "sigmas_m", "sigmas_deg"):
            np.testing.assert_array_equal(getattr(again.poses[image_id], name), getattr(pose, name))
        np.testing.assert_array_equal(again.tracks[image_id], adjusted.tracks[image_id])


def test_the_table_is_in_the_crs(truth: Truth) -> None:
    adjusted, _ = refined(truth)
    rows = list(csv.DictReader(orientation_text(adjusted, truth.block).splitlines()))
    assert [row["image"] for row in rows] == sorted(image.name for image in truth.block.images)
    for row, image in zip(rows, truth.block.images, strict=True):
        true = truth.block.poses[image.image_id]
        center_m = np.array([float(row[axis]) for axis in "xyz"]) - ORIGIN_M
        np.testing.assert_allclose(center_m, true.center_m, atol=0.4)
        angles = [float(row[f"{name}_deg"]) for name in ("omega", "phi", "kappa")]
        assert angle_between_deg(from_omega_phi_kappa(*angles), true.world_rotation) < 0.5
        assert 0.0 < float(row["sigma_x_m"]) < 0.5
        assert 0.0 < float(row["sigma_kappa_deg"]) < 0.5


def test_the_exported_model_has_points_and_the_databases_keypoints(truth: Truth, tmp_path: Path) -> None:
    import pycolmap

    contents = disturbed(truth, 0)
    positions = given_positions(truth, 100, 0.1)
    adjusted, _ = refined(truth)
    folder = tmp_path / "colmap"
    Colmap()(replace(contents, pairs=iter(truth.pairs), positions=positions, adjusted=adjusted), folder)
    model = pycolmap.Reconstruction(folder / "sparse")
    assert (model.num_reg_images(), model.num_points3D()) == (6, len(adjusted.points_m))
    stated = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(stated, rel=1e-4)
    assert stated == pytest.approx(float(np.mean(adjusted.errors_px)), rel=1e-3)
    with pycolmap.Database.open(folder / "database.db") as database:
        for image in model.images.values():
            stored = database.read_keypoints(image.image_id)
            np.testing.assert_allclose([p.xy for p in image.points2D], stored[:, :2], atol=1e-4)
        for prior, image_id in zip(database.read_all_pose_priors(), IMAGE_IDS, strict=True):
            np.testing.assert_allclose(np.ravel(prior.position), positions[image_id].center_m, atol=1e-9)
            assert prior.position_covariance[0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("changed", "velocities", "why"),
    [
        ([], {"a": [4.0, 0.0, 0.0]}, None),
        ([], {"a": [0.0, 0.0, 0.0], "outside": [4.0, 0.0, 0.0]}, "the velocity of the aircraft is not known; capture "
         "times of images with positions tell it, or DJI's XMP"),
        (["adjust.rolling_shutter=false"], {"a": [4.0, 0.0, 0.0]}, "adjust.rolling_shutter=false"),
        (["orient=given"], {"a": [4.0, 0.0, 0.0]}, "orient=given"),
    ],
)  # fmt: skip
def test_why_no_read_out_time_was_tried_is_said(changed: list[str], velocities: Any, why: str | None) -> None:
    observed = Observed({}, {}, {}, velocities={i: np.array(v) for i, v in velocities.items()})
    context: Any = SimpleNamespace(settings=load("baseline", changed), observed=observed)
    assert adjust.readout_not_tried(context, {"a"}) == why


@pytest.mark.slow
def test_the_stage_writes_the_block_once(done_site: Site, rendered: Path) -> None:
    report = done_site.work / "reports" / "adjust.json"
    record = json.loads(report.read_text())
    facts = record["result"]
    assert (facts["images"], facts["outside"]) == (IMAGES, {})
    assert facts["points"] > 80
    adjusted = read_adjusted(done_site.work / "orientation" / "adjusted.npz")
    true = load_truth(rendered).poses
    names = {name.replace(".", "_"): name for name in true}
    for image_id, pose in adjusted.poses.items():
        assert angle_between_deg(pose.rotation, true[names[image_id]].world_rotation) < 0.5
    again = done_site("adjust")
    assert (again.code, again.done(), again.counts("adjust")) == (0, {}, (0, IMAGES, 0))
    (done_site.work / "orientation" / "adjusted.npz").unlink()
    assert done_site("adjust").counts("adjust") == (IMAGES, 0, 0)
    made = json.loads(report.read_text())
    assert {key: made[key] for key in ("result", "files")} == {key: record[key] for key in ("result", "files")}


@pytest.mark.slow
def test_matches_are_exported_where_the_adjustment_fails(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def stops(*_: object, **__: object) -> None:
        raise InputError("pycolmap's bundle adjustment stopped with exit code -6: Check failed")

    monkeypatch.setattr(adjust, "adjust_block", stops)
    outcome = done_site("run", "--overwrite")
    assert outcome.code == 1
    assert done_site.failures() == [("adjust", "all images")]
    assert outcome.facts["stages"]["adjust"]["result"]["images"] == 0  # not those of the adjustment before
    assert (
        "no image is adjusted: pycolmap's bundle adjustment stopped with exit code -6: Check failed" in outcome.stdout
    )
    lost = read_csv(done_site.work / "lost.csv")
    assert len(lost) == IMAGES
    assert {row["what"] for row in lost} == {"not oriented"}
    assert all(row["reason"].startswith("pycolmap's bundle adjustment stopped") for row in lost)
    export = done_site.work / "export" / "colmap"
    assert (export / "database.db").is_file()
    assert not (export / "orientation.csv").exists()


@pytest.mark.slow
def test_an_image_without_texture_is_named(site: Site) -> None:
    import cv2

    shape = cv2.imread(str(site.image(4))).shape
    cv2.imwrite(str(site.image(4)), np.full(shape, 128, np.uint8))
    outcome = site("run")
    reasons = outcome.facts["stages"]["adjust"]["result"]["outside"]
    assert list(reasons) == [site.names()[4]]
    assert "no texture, or blurred" in next(iter(reasons.values()))
    assert f"not oriented: {site.names()[4]}: " in outcome.stdout


@pytest.mark.slow
def test_a_point_has_one_keypoint_in_each_image(truth: Truth) -> None:
    """img0 has every keypoint twice, 1.5 px apart, and is matched to others by the one or by the other."""
    contents = disturbed(truth, 4)
    own = truth.keypoints_px["img0"]
    doubled = np.concatenate([own, own + np.float32(1.5)])
    pairs = []
    for pair in truth.pairs:
        verified = pair.verified.copy()
        if pair.pair.image_id0 == "img0" and pair.pair.image_id1 in ("img2", "img4"):
            verified[:, 0] += len(own)
        pairs.append(replace(pair, verified=verified, matches=verified))
    keypoints = {**truth.keypoints_px, "img0": doubled}
    groups = [Group("positions", IMAGE_IDS)]
    observed = Observed(given_positions(truth, 4, 0.1), FOCAL_SIGMAS, {})
    twice = replace(contents, keypoints_px=keypoints.__getitem__, pairs=tuple(pairs))
    adjusted, _ = adjust_block(twice, observed, groups, fixed=False)
    track = adjusted.tracks["img0"]
    assert len(np.unique(track[:, 1])) == len(track) > 50
    for other in adjusted.tracks.values():
        assert len(np.unique(other[:, 1])) == len(other)


def positions(site: Site) -> dict[str, FloatArray]:
    """Adjusted projection centres, metres, by image."""
    with (site.work / "orientation" / "orientation.csv").open(newline="") as stream:
        return {row["image"]: np.array([float(row[key]) for key in "xyz"]) for row in csv.DictReader(stream)}


@pytest.mark.slow
def test_a_block_without_an_orientation_gets_one_from_its_verified_matches(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the first pass had found too few matches to orient anything."""
    assert site("run").facts["stages"]["adjust"]["result"]["images"] == IMAGES
    before = positions(site)
    monkeypatch.setattr(adjust, "_groups", lambda _: [])
    again = site("adjust", "--overwrite", "--executor", "serial")
    assert again.facts["stages"]["adjust"]["result"]["images"] == IMAGES
    assert f"from the verified matches: {IMAGES} images, 0 from the first pass" in again.stdout
    after = positions(site)
    assert before.keys() == after.keys()
    assert max(float(np.linalg.norm(after[name] - before[name])) for name in before) < 2.0


@pytest.mark.slow
def test_an_orientation_in_another_frame_is_not_taken(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its lengths are arbitrary, and the block's would be called metres."""
    monkeypatch.setattr(adjust, "_groups", lambda _: [])
    of_models = models.from_models
    own = {"frame": "own"}
    monkeypatch.setattr(
        models,
        "from_models",
        lambda *args: replace(found := of_models(*args), result=found.result.model_copy(update=own)),
    )
    outcome = site("run", "--executor", "serial")
    assert outcome.facts["stages"]["adjust"]["result"]["images"] == 0
    assert not (site.work / "orientation" / "adjusted.npz").exists()
