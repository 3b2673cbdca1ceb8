"""The exporters beside COLMAP's: read back by pycolmap's or our own readers, or by the format's description."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import io
import json
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_export_colmap import ORIGIN_M, Truth, make_truth

from aeromatch_cli.blocks.crs import geographic_from_grid
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import normalise
from aeromatch_cli.geometry.rotations import from_quaternion, to_omega_phi_kappa
from aeromatch_cli.strategies.exporters import EXPORTERS, ExportContents, PairContents
from aeromatch_cli.strategies.exporters.solution import matched

CRS = "EPSG:32633"


def geographic(world_m: FloatArray) -> FloatArray:
    places_m = world_m + np.array(ORIGIN_M)
    return np.column_stack([geographic_from_grid(CRS, places_m[:, :2]), places_m[:, 2]])


def adjusted_block(truth: Truth) -> AdjustedBlock:
    """The truth as an adjustment would leave it, with the points that two images and more see."""
    unknown = np.full(3, np.nan)
    poses = {
        i: AdjustedPose(pose.center_m, np.asarray(pose.world_rotation), unknown, unknown)
        for i, pose in truth.block.poses.items()
    }
    found = matched(truth.contents())
    tracks = {}
    for place, image_id in enumerate(found.image_ids):
        own = found.image_idx == place
        tracks[image_id] = np.column_stack([found.keypoint[own], found.track[own]]).astype(np.int32)
    points = np.full((len(found.points_m), 3), np.nan)
    for image_id, track in tracks.items():
        points[track[:, 1]] = truth_of(truth, image_id, track[:, 0])
    return AdjustedBlock(truth.block.cameras, poses, points, np.zeros(len(points)), tracks)


def truth_of(truth: Truth, image_id: str, keypoints) -> FloatArray:
    """The points that keypoints of an image show: the nearest by projection."""
    from aeromatch_cli.geometry.cameras import project

    image = next(image for image in truth.block.images if image.image_id == image_id)
    pose = truth.block.poses[image_id]
    places = project(truth.block.camera(image), np.asarray(pose.world_rotation), pose.center_m, truth.points_m)
    wanted = truth.keypoints_px[image_id][keypoints]
    apart = np.linalg.norm(places[None] - wanted[:, None], axis=2)
    return truth.points_m[np.nanargmin(apart, axis=1)]


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


@pytest.fixture(scope="module")
def contents(truth: Truth):
    """Fresh contents: pairs are iterated once."""
    adjusted = adjusted_block(truth)
    return lambda: dataclasses.replace(truth.contents(), adjusted=adjusted, geographic=geographic)


def corner(truth: Truth) -> ExportContents:
    """One match of the first two images, of the very first and last pixel, without adjustment."""
    pair = truth.pairs[0]
    first, second = (next(i for i in truth.block.images if i.image_id == name) for name in ("img0", "img1"))
    places = {image.image_id: np.zeros((1, 2), np.float32) for image in truth.block.images}
    places["img1"] = np.array([[second.width_px - 1, second.height_px - 1]], np.float32)
    assert (first.width_px, first.height_px) == (1000, 750)
    one = np.zeros((1, 2), np.int32)
    item = PairContents(pair.pair, one, one, "E", pair.model)
    return ExportContents(truth.block, places.__getitem__, iter([item]), geographic=geographic)


@pytest.mark.parametrize("name", [name for name in EXPORTERS if name != "colmap"])
def test_the_summary_counts_and_names_what_is_there(name: str, contents, truth: Truth, tmp_path: Path) -> None:
    folder = tmp_path / name
    summary = EXPORTERS[name]()(contents(), folder)  # type: ignore[operator]
    assert sorted(summary.files) == sorted(path for path in folder.rglob("*") if path.is_file())
    assert (summary.images, summary.posed_images) == (6, 6)
    assert summary.verified_matches == sum(len(pair.verified) for pair in truth.pairs)
    assert summary.keypoints == sum(map(len, truth.keypoints_px.values()))
    again = {path.relative_to(folder): path.read_bytes() for path in summary.files}
    EXPORTERS[name]()(contents(), folder)  # type: ignore[operator]
    assert again == {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", [name for name in EXPORTERS if name != "colmap"])
def test_a_block_without_adjustment_is_exported_too(name: str, truth: Truth, tmp_path: Path) -> None:
    summary = EXPORTERS[name]()(truth.contents(), tmp_path / name)  # type: ignore[operator]
    assert summary.files
    assert [path for path in summary.files if path.stat().st_size == 0] == []
    assert summary.verified_matches == sum(len(pair.verified) for pair in truth.pairs)


def test_tracks_join_verified_matches_and_end_where_one_image_is_seen_twice(truth: Truth) -> None:
    found = matched(truth.contents())
    assert (np.diff(found.starts) >= 2).all()
    for number in range(len(found.points_m)):
        own = slice(found.starts[number], found.starts[number + 1])
        assert len(set(found.image_idx[own])) == own.stop - own.start
        points = [
            truth_of(truth, found.image_ids[i], [k])[0]
            for i, k in zip(found.image_idx[own][:2], found.keypoint[own][:2], strict=True)
        ]
        np.testing.assert_array_equal(points[0], points[1])
        if number > 20:
            break
    pair = truth.pairs[0]
    wrong = dataclasses.replace(pair, verified=np.array([[0, 0]], np.int32))
    other = dataclasses.replace(truth.pairs[5], verified=np.array([[0, 0]], np.int32))  # img1 - img2
    closing = dataclasses.replace(truth.pairs[1], verified=np.array([[1, 0]], np.int32))  # img0 - img2
    spoilt = dataclasses.replace(truth.contents(), pairs=[wrong, closing, other])
    assert len(matched(spoilt).points_m) == 0


class AsOpenSfm(pickle.Unpickler):
    """Reads what OpenSfM's reader of matches allows: names of numpy alone."""

    def find_class(self, module: str, name: str) -> Any:
        assert module in ("numpy", "numpy.core.multiarray"), (module, name)
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def test_opensfm_normalises_from_the_middle_of_the_first_pixel(truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["opensfm"]()(corner(truth), tmp_path / "o")  # type: ignore[operator]
    with np.load(tmp_path / "o" / "features" / "0.jpg.features.npz", allow_pickle=False) as features:
        np.testing.assert_allclose(features["points"][0, :2], [(0.5 - 500) / 1000, (0.5 - 375) / 1000], rtol=1e-6)
        assert int(features["OPENSFM_FEATURES_VERSION"]) == 3
    rows = (tmp_path / "o" / "tracks.csv").read_text().splitlines()
    assert rows[0] == "OPENSFM_TRACKS_VERSION_v2"
    last = rows[2].split("\t")
    assert last[:3] == ["1.jpg", "0", "0"]
    assert len(last) == 11
    np.testing.assert_allclose([float(v) for v in last[3:5]], [(799.5 - 400) / 800, (599.5 - 300) / 800])


def test_opensfm_reads_matches_cameras_and_positions(contents, truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["opensfm"]()(contents(), tmp_path / "o")  # type: ignore[operator]
    raw = gzip.decompress((tmp_path / "o" / "matches" / "0.jpg_matches.pkl.gz").read_bytes())
    assert b"numpy._core" not in raw  # which ODM's fork does not load
    found = AsOpenSfm(io.BytesIO(raw)).load()
    np.testing.assert_array_equal(found["1.jpg"], truth.pairs[0].verified)
    exif = json.loads((tmp_path / "o" / "exif" / "0.jpg.exif").read_text())
    expected = geographic(truth.block.poses["img0"].center_m[None])[0]
    np.testing.assert_allclose([exif["gps"][k] for k in ("latitude", "longitude", "altitude")], expected, rtol=1e-12)
    model = json.loads((tmp_path / "o" / "camera_models.json").read_text())[exif["camera"]]
    camera = truth.block.cameras["a"]
    # Back to our pixels: the principal point from the middle of the first pixel.
    assert model["c_x"] * 1000 + 499.5 == pytest.approx(camera.params[2])
    assert model["focal_y"] * 1000 == pytest.approx(camera.params[1])


def test_opensfm_refuses_two_images_of_one_file_name(truth: Truth, tmp_path: Path) -> None:
    images = [dataclasses.replace(i, name=f"{k}/same.jpg") for k, i in enumerate(truth.block.images)]
    block = dataclasses.replace(truth.block, images=tuple(images))
    with pytest.raises(ConfigError, match=r"would both be called same\.jpg"):
        EXPORTERS["opensfm"]()(dataclasses.replace(truth.contents(), block=block), tmp_path / "o")  # type: ignore[operator]


@pytest.mark.parametrize("binary", [False, True])
def test_micmac_has_both_directions(truth: Truth, tmp_path: Path, binary: bool) -> None:
    EXPORTERS["micmac"](binary=binary)(truth.contents(), tmp_path / "m")  # type: ignore[operator]
    suffix = "dat" if binary else "txt"
    paths = [
        tmp_path / "m" / "Homol" / f"Pastisflight_{a}.jpg" / f"flight_{b}.jpg.{suffix}" for a, b in ((0, 1), (1, 0))
    ]
    if binary:
        tables = []
        for path in paths:
            raw = path.read_bytes()
            two, count = struct.unpack_from("<ii", raw)
            assert (two, len(raw)) == (2, 8 + 44 * count)
            tables.append(np.array([struct.unpack_from("<id4d", raw, 8 + 44 * k)[2:] for k in range(count)]))
    else:
        tables = [np.loadtxt(path) for path in paths]
    np.testing.assert_allclose(tables[0], tables[1][:, [2, 3, 0, 1]])
    verified = truth.pairs[0].verified
    expected = np.hstack([truth.keypoints_px["img0"][verified[:, 0]], truth.keypoints_px["img1"][verified[:, 1]]])
    np.testing.assert_allclose(tables[0], expected, atol=1e-5)


def check_poses(path: Path, truth: Truth, shift_m: FloatArray) -> None:
    """What our reader of the format finds is what was written."""
    found = read_pose_file(path)
    rows = {row.image.rsplit("/", 1)[-1].removeprefix("flight_"): row for row in found.rows}
    assert len(rows) == 6
    for image in truth.block.images:
        row, pose = rows[image.name.rsplit("/", 1)[-1]], truth.block.poses[image.image_id]
        assert row.position is not None
        assert row.attitude is not None
        np.testing.assert_allclose(row.position, pose.center_m + shift_m, atol=1e-5)
        np.testing.assert_allclose(from_quaternion(*row.attitude), pose.world_rotation, atol=1e-9)


def test_orientations_read_back(contents, truth: Truth, tmp_path: Path) -> None:
    origin = np.array(ORIGIN_M)
    for name, file, shift in (
        ("micmac", "Ori-aeromatch", origin),
        ("bundler", "bundle.out", np.zeros(3)),
        ("blocks-exchange", "blocks.xml", origin),
    ):
        EXPORTERS[name]()(contents(), tmp_path / name)  # type: ignore[operator]
        check_poses(tmp_path / name / file, truth, shift)
    assert read_pose_file(tmp_path / "blocks-exchange" / "blocks.xml").crs == CRS


@pytest.mark.parametrize(("name", "file"), [("micmac", "Ori-aeromatch"), ("blocks-exchange", "blocks.xml")])
def test_cameras_read_back(truth: Truth, tmp_path: Path, name: str, file: str) -> None:
    """One with tangential distortion and one with radial alone: the same pixels as before."""
    EXPORTERS[name]()(truth.contents(), tmp_path / name)  # type: ignore[operator]
    found = read_pose_file(tmp_path / name / file)
    cameras = {row.image.rsplit("/", 1)[-1].removeprefix("flight_"): found.cameras[row.camera] for row in found.rows}
    places = np.array([[0.0, 0.0], [799.0, 0.0], [123.0, 456.0], [799.0, 599.0]])
    for image in truth.block.images:
        before, after = truth.block.cameras[image.camera_id], cameras[image.name.rsplit("/", 1)[-1]]
        assert (before.width_px, before.height_px) == (after.width_px, after.height_px)
        np.testing.assert_allclose(normalise(after, places), normalise(before, places), atol=2e-7)


def test_bundlers_points_are_seen_where_its_camera_model_says(contents, truth: Truth, tmp_path: Path) -> None:
    """Of camera B, whose principal point is the middle: x right and y up of it, k1 alone."""
    EXPORTERS["bundler"]()(contents(), tmp_path / "b")  # type: ignore[operator]
    lines = (tmp_path / "b" / "bundle.out").read_text().splitlines()
    cameras, points = map(int, lines[1].split())
    table = [np.array(line.split(), float) for line in lines[2:]]
    assert len(table) == 5 * cameras + 3 * points
    checked = 0
    for number in range(points):
        place, seen = table[5 * cameras + 3 * number], table[5 * cameras + 3 * number + 2]
        for image, _, x, y in seen[1:].reshape(-1, 4):
            if int(image) % 2 == 1:
                focal, *rotation, shift = table[5 * int(image) : 5 * int(image) + 5]
                p = np.array(rotation) @ place + shift
                p = -p[:2] / p[2]
                np.testing.assert_allclose(focal[0] * (1 + focal[1] * p @ p) * p, [x, y], atol=2e-3)
                checked += 1
    assert checked > 300


def test_blocks_exchange_counts_from_the_middle_of_the_first_pixel(truth: Truth, tmp_path: Path) -> None:
    from defusedxml.ElementTree import parse

    EXPORTERS["blocks-exchange"]()(corner(truth), tmp_path / "x")  # type: ignore[operator]
    root = parse(tmp_path / "x" / "blocks.xml").getroot()
    places = [(m.findtext("PhotoId"), float(m.findtext("x")), float(m.findtext("y"))) for m in root.iter("Measurement")]
    assert places == [("0", 0.0, 0.0), ("1", 799.0, 599.0)]
    group = next(root.iter("Photogroup"))
    assert float(group.findtext("PrincipalPoint/x")) == pytest.approx(truth.block.cameras["a"].params[2])


def test_openmvg_has_views_poses_features_and_matches(contents, truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["openmvg"]()(contents(), tmp_path / "v")  # type: ignore[operator]
    data = json.loads((tmp_path / "v" / "sfm_data.json").read_text())
    view = data["views"][1]["value"]["ptr_wrapper"]["data"]
    assert (view["local_path"], view["filename"], view["id_view"]) == ("flight", "1.jpg", 1)
    np.testing.assert_allclose(data["extrinsics"][1]["value"]["center"], truth.block.poses["img1"].center_m)
    features = np.loadtxt(tmp_path / "v" / "matches" / "1.feat")
    np.testing.assert_allclose(features[:, :2], truth.keypoints_px["img1"], atol=1e-4)
    tokens = (tmp_path / "v" / "matches" / "matches.f.txt").read_text().split()
    assert tokens[:3] == ["0", "1", str(len(truth.pairs[0].verified))]
    assert list(map(int, tokens[3:5])) == truth.pairs[0].verified[0].tolist()


def test_openmvg_refuses_two_images_of_one_name(truth: Truth, tmp_path: Path) -> None:
    images = [dataclasses.replace(image, name=f"{image.name[0:6]}/same.jpg") for image in truth.block.images]
    block = dataclasses.replace(truth.block, images=tuple(images))
    with pytest.raises(ConfigError, match="would both be called same"):
        EXPORTERS["openmvg"]()(dataclasses.replace(truth.contents(), block=block), tmp_path / "v")  # type: ignore[operator]


@pytest.mark.parametrize("name", ["bundler", "openmvg", "alicevision", "hloc", "colmap", "ply"])
def test_formats_without_a_crs_say_what_they_count_from(contents, tmp_path: Path, name: str) -> None:
    EXPORTERS[name]()(contents(), tmp_path / name)  # type: ignore[operator]
    world = json.loads((tmp_path / name / "world.json").read_text())
    assert (world["crs"], world["origin_m"]) == (CRS, list(ORIGIN_M))


def test_tracks_are_a_table(contents, truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["tracks"]()(contents(), tmp_path / "t")  # type: ignore[operator]
    with (tmp_path / "t" / "tracks.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    first = rows[0]
    image = next(i for i in truth.block.images if i.name == first["image"])
    keypoint = truth.keypoints_px[image.image_id][int(first["keypoint"])]
    np.testing.assert_allclose([float(first["x_px"]), float(first["y_px"])], keypoint, atol=1e-4)
    point = truth_of(truth, image.image_id, [int(first["keypoint"])])[0]
    np.testing.assert_allclose([float(first[k]) for k in ("x_m", "y_m", "z_m")], point + ORIGIN_M, atol=1e-3)


def test_hloc_reads_keypoints_and_matches(contents, truth: Truth, tmp_path: Path) -> None:
    """As hloc does: the group of a pair is named by both images, -1 stands for no match."""
    import h5py

    EXPORTERS["hloc"]()(contents(), tmp_path / "h")  # type: ignore[operator]
    with h5py.File(tmp_path / "h" / "features.h5") as stream:
        np.testing.assert_array_equal(stream["flight/0.jpg"]["keypoints"][:], truth.keypoints_px["img0"])
        assert stream["flight/0.jpg"]["image_size"][:].tolist() == [1000, 750]
    with h5py.File(tmp_path / "h" / "matches.h5") as stream:
        partner = stream["flight-0.jpg/flight-1.jpg"]["matches0"][:]
    rows = np.flatnonzero(partner >= 0)
    verified = truth.pairs[0].verified
    np.testing.assert_array_equal(np.column_stack([rows, partner[rows]]), verified[np.argsort(verified[:, 0])])
    name, *values = (tmp_path / "h" / "poses.txt").read_text().splitlines()[1].split()
    rotation = from_quaternion(*map(float, values[:4]))
    pose = truth.block.poses["img1"]
    assert name == "flight/1.jpg"
    np.testing.assert_allclose(-rotation.T @ [float(v) for v in values[4:]], pose.center_m, atol=1e-9)


def test_alicevision_writes_rotations_by_columns_and_views_by_number(contents, truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["alicevision"]()(contents(), tmp_path / "a")  # type: ignore[operator]
    data = json.loads((tmp_path / "a" / "cameras.sfm").read_text())
    pose = next(one for one in data["poses"] if one["poseId"] == "2")["pose"]["transform"]
    found = np.array([float(v) for v in pose["rotation"]]).reshape(3, 3, order="F")
    np.testing.assert_allclose(found, truth.block.poses["img1"].world_rotation, atol=1e-12)
    camera, intrinsic = truth.block.cameras["a"], data["intrinsics"][0]
    assert data["version"] == ["1", "2", "1"]
    assert [float(v) for v in intrinsic["pxFocalLength"]] == pytest.approx(list(camera.params[:2]))
    # What AliceVision reads of this version without a default.
    assert float(intrinsic["pxInitialFocalLength"]) == pytest.approx(camera.params[0])
    assert {"serialNumber", "principalPoint", "distortionParams", "type", "width", "height"} <= intrinsic.keys()
    assert float(intrinsic["principalPoint"][0]) + 500.0 == pytest.approx(camera.params[2])
    tokens = (tmp_path / "a" / "matches" / "0.matches.txt").read_text().split()
    assert tokens[:5] == ["1", "2", "1", "sift", str(len(truth.pairs[0].verified))]
    places = np.loadtxt(tmp_path / "a" / "features" / "2.sift.feat")[:, :2]
    np.testing.assert_allclose(places, truth.keypoints_px["img1"], atol=1e-4)


def test_bingo_writes_millimetres_from_the_principal_point(contents, truth: Truth, tmp_path: Path) -> None:
    """Rays of the adjusted points by the collinearity equations: y up, no distortion left."""
    EXPORTERS["bingo"](pixel_um=5.0)(contents(), tmp_path / "p")  # type: ignore[operator]
    lines = (tmp_path / "p" / "image.txt").read_text().splitlines()
    end = lines.index("-99")
    number, focal = lines[0].split()
    fx, fy = truth.block.cameras["a"].params[:2]
    assert (number, float(focal)) == ("1", pytest.approx((fx + fy) / 2 * 0.005))
    adjusted = adjusted_block(truth)
    pose = truth.block.poses["img0"]
    for line in lines[1:end]:
        point, x, y = line.split()
        ray = np.asarray(pose.world_rotation) @ (adjusted.points_m[int(point) - 1] - pose.center_m)
        expected = np.array([ray[0], -ray[1]]) / ray[2] * float(focal)  # square pixels: one focal length
        np.testing.assert_allclose([float(x), float(y)], expected, atol=2e-5)
    assert end > 50
    assert (tmp_path / "p" / "photos.txt").read_text().splitlines()[1] == "2 flight/1.jpg"
    found = read_pose_file(tmp_path / "p" / "exterior.txt", "opk-gon")
    row = found.rows[0]
    assert row.position is not None
    assert row.attitude is not None
    np.testing.assert_allclose(row.position, pose.center_m + ORIGIN_M, atol=1e-4)
    assert pose.world_rotation is not None
    np.testing.assert_allclose(row.attitude, to_omega_phi_kappa(pose.world_rotation), atol=1e-5)


def test_the_guide_has_every_exporter() -> None:
    guide = (Path(__file__).parent.parent / "docs" / "guide.md").read_text()
    assert [name for name in EXPORTERS if f"| `{name}`" not in guide] == []
