"""Exports of a block that falls into groups whose place beside each other is not known: no file mixes their frames."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_export_colmap import ORIGIN_M, Truth, make_truth
from test_exporters import CRS, adjusted_block, geographic
from test_exporters_ply import read_ply

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Pose
from aeromatch_cli.formats.adjusted import orientation_text
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.strategies.exporters import EXPORTERS, Colmap, ExportContents

LARGE, SMALL = ("img0", "img1", "img2", "img3"), ("img4", "img5")
# Everything with one frame.
OTHERS = [name for name in EXPORTERS if name not in ("colmap", "opensfm")]


def names(image_ids: tuple[str, ...]) -> list[str]:
    return [f"flight/{image_id[3:]}.jpg" for image_id in image_ids]


def halves(truth: Truth, frames: dict[str, int]) -> AdjustedBlock:
    """The truth without matches between the two groups, the small one turned, twice as large and elsewhere."""
    found = adjusted_block(truth)
    scale, turn, shift_m = 2.0, from_omega_phi_kappa(3.0, -4.0, 80.0), np.array([7.0, -5.0, 11.0])
    poses = dict(found.poses)
    for image_id in SMALL:
        pose = poses[image_id]
        center_m = scale * turn @ pose.center_m + shift_m
        poses[image_id] = AdjustedPose(center_m, pose.rotation @ turn.T, pose.sigmas_m, pose.sigmas_deg)
    points_m = found.points_m.copy()
    moved = np.unique(np.concatenate([found.tracks[image_id][:, 1] for image_id in SMALL]))
    points_m[moved] = scale * points_m[moved] @ turn.T + shift_m
    return replace(found, poses=poses, points_m=points_m, frames=frames)


@pytest.fixture(scope="module")
def truth() -> Truth:
    whole = make_truth()
    inside = [pair for pair in whole.pairs if (pair.pair.image_id0 in SMALL) == (pair.pair.image_id1 in SMALL)]
    return replace(whole, block=replace(whole.block, ground=ConstantGround(0.0)), pairs=tuple(inside))


@pytest.fixture
def own(truth: Truth) -> ExportContents:
    """Without positions: two frames of their own."""
    adjusted = halves(truth, dict.fromkeys(LARGE, 1) | dict.fromkeys(SMALL, 2))
    block = replace(truth.block, crs="local", origin_m=(0.0, 0.0, 0.0), metric=False)
    return replace(truth.contents(), block=block, adjusted=adjusted)


@pytest.fixture
def placed(truth: Truth) -> ExportContents:
    """With positions, which place the large group alone."""
    return replace(truth.contents(), adjusted=halves(truth, dict.fromkeys(SMALL, 1)), geographic=geographic)


def before(contents: ExportContents) -> ExportContents:
    """The same as it was oriented, without an adjustment: poses in the frames of the groups, no points."""
    adjusted = contents.adjusted
    assert adjusted is not None
    poses = {i: Pose(pose.center_m, pose.rotation, 0.5, 0.2) for i, pose in adjusted.poses.items()}
    block = replace(contents.block, poses=poses, frames=adjusted.frames)
    return replace(contents, block=block, adjusted=None)


def check_model(folder: Path, images: tuple[str, ...], adjusted: AdjustedBlock) -> None:
    """A model has these images, the points that they see, and no others, each where its images see it."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    assert sorted(image.name for image in model.images.values()) == names(images)
    seen = np.unique(np.concatenate([adjusted.tracks[image_id][:, 1] for image_id in images]))
    found = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    np.testing.assert_allclose(found, adjusted.points_m[seen], rtol=1e-12)
    assert model.compute_num_observations() == sum(len(adjusted.tracks[image_id]) for image_id in images)
    model.update_point_3d_errors()
    assert max(point.error for point in model.points3D.values()) < 1e-3
    for image in model.images.values():
        center_m = adjusted.poses[f"img{image.image_id - 1}"].center_m
        np.testing.assert_allclose(image.projection_center(), center_m, atol=1e-9)


def test_parts_of_a_block_have_a_frame_each(truth: Truth) -> None:
    """What positions placed comes first, then the larger group; points are numbered anew."""
    both = halves(truth, dict.fromkeys(SMALL, 1) | dict.fromkeys(LARGE, 2))
    assert [tuple(part.poses) for part in both.parts()] == [LARGE, SMALL]
    assert [set(part.frames.values()) for part in both.parts()] == [{2}, {1}]
    few = halves(truth, dict.fromkeys(LARGE, 1)).parts()
    assert [tuple(part.poses) for part in few] == [SMALL, LARGE]
    assert not few[0].frames
    whole = halves(truth, {})
    assert whole.parts() == [whole]
    assert sum(len(part.points_m) for part in few) == len(whole.points_m)
    for part in few:
        for image_id, track in part.tracks.items():
            np.testing.assert_array_equal(track[:, 0], whole.tracks[image_id][:, 0])
            np.testing.assert_array_equal(part.points_m[track[:, 1]], whole.points_m[whole.tracks[image_id][:, 1]])


def test_colmap_has_a_model_for_each_frame(own: ExportContents, tmp_path: Path) -> None:
    import pycolmap

    folder = tmp_path / "colmap"
    summary = Colmap()(own, folder)
    assert own.adjusted is not None
    check_model(folder / "sparse", LARGE, own.adjusted)
    check_model(folder / "sparse_own2", SMALL, own.adjusted)
    assert sorted(path.name for path in folder.iterdir()) == [
        "database.db", "orientation.csv", "sparse", "sparse_own2", "world.json",
    ]  # fmt: skip
    with pycolmap.Database.open(folder / "database.db") as opened:
        assert opened.num_images() == 6
    assert summary.posed_images == 6
    assert {path.relative_to(folder).as_posix() for path in summary.files} >= {"sparse_own2/images.txt"}
    (remark,) = summary.remarks
    assert "sparse (4 images), sparse_own2 (2 images)" in remark
    frames = json.loads((folder / "world.json").read_text())["frames"]
    assert frames == [
        {"model": "sparse", "frame": "own 1", "unit": "arbitrary", "images": names(LARGE)},
        {"model": "sparse_own2", "frame": "own 2", "unit": "arbitrary", "images": names(SMALL)},
    ]


def test_colmap_has_the_world_in_its_first_model(placed: ExportContents, tmp_path: Path) -> None:
    folder = tmp_path / "colmap"
    Colmap()(placed, folder)
    assert placed.adjusted is not None
    check_model(folder / "sparse", LARGE, placed.adjusted)
    check_model(folder / "sparse_own1", SMALL, placed.adjusted)
    world = json.loads((folder / "world.json").read_text())
    assert (world["crs"], world["unit"]) == (CRS, "m")
    told = [(frame["frame"], frame["unit"], frame["images"]) for frame in world["frames"]]
    assert told == [("world", "m", names(LARGE)), ("own 1", "arbitrary", names(SMALL))]
    # Read as poses, the second model is not in the CRS of the first.
    for model, image_id, crs, origin_m in (("sparse", "img0", CRS, ORIGIN_M), ("sparse_own1", "img4", None, (0, 0, 0))):
        found = read_pose_file(folder / model)
        assert found.crs == crs
        expected = placed.adjusted.poses[image_id].center_m + np.array(origin_m)
        np.testing.assert_allclose(found.rows[0].position, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["own", "placed"])
def test_colmap_has_a_model_for_each_frame_also_without_adjustment(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """As where the adjustment has failed: no frame is taken for another, and worlds are as of an adjusted block."""
    import pycolmap

    contents, folder = request.getfixturevalue(kind), tmp_path / "oriented"
    summary = Colmap()(before(contents), folder)
    Colmap()(contents, tmp_path / "adjusted")
    second = {"own": "sparse_own2", "placed": "sparse_own1"}[kind]
    for model, images in (("sparse", LARGE), (second, SMALL)):
        found = pycolmap.Reconstruction(folder / model)
        assert (sorted(image.name for image in found.images.values()), found.num_points3D()) == (names(images), 0)
        for image in found.images.values():
            center_m = contents.adjusted.poses[f"img{image.image_id - 1}"].center_m
            np.testing.assert_allclose(image.projection_center(), center_m, atol=1e-9)
    for path in ("world.json", f"{second}/world.json"):
        assert (folder / path).read_text() == (tmp_path / "adjusted" / path).read_text()
    assert (summary.posed_images, len(summary.remarks)) == (6, 1)
    assert f"sparse (4 images), {second} (2 images)" in summary.remarks[0]


@pytest.mark.parametrize("adjusted", [True, False])
def test_a_model_in_a_frame_of_its_own_alone_is_not_in_the_crs(
    placed: ExportContents, adjusted: bool, tmp_path: Path
) -> None:
    """As where the adjustment keeps nothing of what positions have placed."""
    assert placed.adjusted is not None
    _, loose = placed.adjusted.parts()
    alone = replace(placed, adjusted=loose)
    Colmap()(alone if adjusted else before(alone), tmp_path / "colmap")
    (frame,) = json.loads((tmp_path / "colmap" / "world.json").read_text())["frames"]
    assert frame == {"model": "sparse", "frame": "own 1", "unit": "arbitrary", "images": names(SMALL)}
    found = read_pose_file(tmp_path / "colmap" / "sparse")
    assert found.crs is None
    np.testing.assert_allclose(found.rows[0].position, loose.poses["img4"].center_m, atol=1e-6)
    summary = EXPORTERS["bundler"]()(alone if adjusted else before(alone), tmp_path / "bundler")  # type: ignore[operator]
    assert summary.posed_images == 0


def test_a_block_that_has_become_one_leaves_no_second_model(own: ExportContents, truth: Truth, tmp_path: Path) -> None:
    folder = tmp_path / "colmap"
    Colmap()(own, folder)
    whole = replace(own, adjusted=adjusted_block(truth), pairs=iter(truth.pairs))
    assert Colmap()(whole, folder).remarks == ()
    assert not list(folder.glob("sparse_*"))
    assert "frames" not in json.loads((folder / "world.json").read_text())


def test_opensfm_has_parts_without_crs_and_the_placed_one_with_it(
    own: ExportContents, placed: ExportContents, tmp_path: Path
) -> None:
    summary = EXPORTERS["opensfm"]()(own, tmp_path / "own")  # type: ignore[operator]
    parts = json.loads((tmp_path / "own" / "reconstruction.json").read_text())
    assert [sorted(part["shots"]) for part in parts] == [["0.jpg", "1.jpg", "2.jpg", "3.jpg"], ["4.jpg", "5.jpg"]]
    assert own.adjusted is not None
    first, second = own.adjusted.parts()
    assert [len(part["points"]) for part in parts] == [len(first.points_m), len(second.points_m)]
    assert "reference_lla" not in parts[0]
    for part, image_id in zip(parts, ("img0", "img4"), strict=True):
        pose, shot = own.adjusted.poses[image_id], part["shots"][f"{image_id[3:]}.jpg"]
        np.testing.assert_allclose(shot["translation"], -pose.rotation @ pose.center_m, atol=1e-9)
    point = parts[1]["points"][str(int(own.adjusted.tracks["img4"][0, 1]))]
    np.testing.assert_allclose(point["coordinates"], second.points_m[second.tracks["img4"][0, 1]], atol=1e-6)
    assert (summary.posed_images, len(summary.remarks)) == (6, 1)
    assert "2 parts" in summary.remarks[0]
    summary = EXPORTERS["opensfm"]()(placed, tmp_path / "placed")  # type: ignore[operator]
    (part,) = json.loads((tmp_path / "placed" / "reconstruction.json").read_text())
    assert len(part["shots"]) == summary.posed_images == 4
    assert "2 images of another group" in summary.remarks[0]


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("kind", ["own", "placed"])
def test_formats_of_one_frame_say_what_they_leave_out(
    name: str, kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    contents = request.getfixturevalue(kind)
    summary = EXPORTERS[name]()(contents, tmp_path / name)  # type: ignore[operator]
    assert (summary.images, summary.posed_images) == (6, 4)
    assert "2 images of another group, whose place beside the first is not known" in summary.remarks[-1]
    posed, points = FOUND[name](tmp_path / name)
    assert posed is None or posed == names(LARGE)
    assert points in (None, len(contents.adjusted.parts()[0].points_m))


@pytest.mark.parametrize("name", [*OTHERS, "opensfm"])
@pytest.mark.parametrize("kind", ["own", "placed"])
def test_formats_of_one_frame_say_what_they_leave_out_also_without_adjustment(
    name: str, kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    contents = before(request.getfixturevalue(kind))
    summary = EXPORTERS[name]()(contents, tmp_path / name)  # type: ignore[operator]
    assert (summary.images, summary.posed_images) == (6, 4)
    assert "2 images of another group, whose place beside the first is not known" in summary.remarks[-1]
    if name == "opensfm":
        assert not (tmp_path / name / "reconstruction.json").exists()
    elif name != "ply":
        # Tracks are told with their points, of which there are none.
        assert FOUND[name](tmp_path / name)[0] == ([] if name == "tracks" else names(LARGE))


def test_an_image_of_an_own_frame_that_was_not_adjusted_has_no_place_in_the_world(
    placed: ExportContents, tmp_path: Path
) -> None:
    oriented = before(placed)
    assert placed.adjusted is not None
    first, _ = placed.adjusted.parts()
    EXPORTERS["geojson"]()(replace(oriented, adjusted=first), tmp_path / "geojson")  # type: ignore[operator]
    features = json.loads((tmp_path / "geojson" / "cameras.geojson").read_text())["features"]
    assert [one["properties"]["image"] for one in features] == names(LARGE)
    rows = orientation_text(first, oriented.block).splitlines()[1:]
    assert [row.split(",")[0] for row in rows] == names(LARGE)


def test_an_image_that_the_adjustment_brings_into_the_world_has_no_footprint_of_its_own_frame(
    placed: ExportContents, truth: Truth, tmp_path: Path
) -> None:
    tied = replace(before(placed), adjusted=adjusted_block(truth))
    EXPORTERS["geojson"]()(tied, tmp_path / "geojson")  # type: ignore[operator]
    shown = {
        name: [one["properties"]["image"] for one in json.loads((tmp_path / "geojson" / name).read_text())["features"]]
        for name in ("cameras.geojson", "footprints.geojson")
    }
    assert shown == {"cameras.geojson": names((*LARGE, *SMALL)), "footprints.geojson": names(LARGE)}


def test_maps_show_images_without_adjusted_pose_only_where_their_frame_is_known(
    own: ExportContents, placed: ExportContents, tmp_path: Path
) -> None:
    for name, contents, shown in (("own", own, LARGE[:3]), ("placed", placed, LARGE)):
        assert contents.adjusted is not None
        poses = {i: pose for i, pose in contents.adjusted.poses.items() if i != "img3"}
        without = replace(contents, adjusted=replace(contents.adjusted, poses=poses))
        EXPORTERS["geojson"]()(without, tmp_path / name)  # type: ignore[operator]
        features = json.loads((tmp_path / name / "cameras.geojson").read_text())["features"]
        assert [one["properties"]["image"] for one in features] == names(shown)


def of_images(numbers: Any) -> list[str]:
    return [f"flight/{number}.jpg" for number in sorted(map(int, numbers))]


def in_alicevision(folder: Path) -> Any:
    poses = json.loads((folder / "cameras.sfm").read_text())["poses"]
    return of_images(int(pose["poseId"]) - 1 for pose in poses), None


def in_bingo(folder: Path) -> Any:
    return of_images(int(line.split()[0]) - 1 for line in (folder / "exterior.txt").read_text().splitlines()), None


def in_blocks_exchange(folder: Path) -> Any:
    text = (folder / "blocks.xml").read_text()
    posed = [photo for photo in text.split("<Photo>")[1:] if "<Pose>" in photo]
    return sorted(photo.split("<ImagePath>")[1].split("<")[0] for photo in posed), text.count("<Position>")


def in_bundler(folder: Path) -> Any:
    lines = (folder / "bundle.out").read_text().splitlines()
    cameras, points = map(int, lines[1].split())
    return of_images(k for k in range(cameras) if lines[2 + 5 * k] != "0 0 0"), points


def in_geojson(folder: Path) -> Any:
    features = {path.stem: json.loads(path.read_text())["features"] for path in folder.glob("*.geojson")}
    ends = {one["properties"][key] for one in features["pairs"] for key in ("image0", "image1")}
    assert ends == set(names(LARGE))
    assert {one["properties"]["image"] for one in features["footprints"]} == ends
    return sorted(one["properties"]["image"] for one in features["cameras"]), None


def in_geopackage(folder: Path) -> Any:
    import pyogrio

    meta, _, _, columns = pyogrio.raw.read(folder / "block.gpkg", layer="cameras", read_geometry=False)
    return sorted(columns[list(meta["fields"]).index("image")]), None


def in_hloc(folder: Path) -> Any:
    return sorted(line.split()[0] for line in (folder / "poses.txt").read_text().splitlines()), None


def in_micmac(folder: Path) -> Any:
    found = (folder / "Ori-aeromatch").glob("Orientation-flight_*.jpg.xml")
    return of_images(path.name.split("_")[1].split(".")[0] for path in found), None


def in_openmvg(folder: Path) -> Any:
    return of_images(pose["key"] for pose in json.loads((folder / "sfm_data.json").read_text())["extrinsics"]), None


def in_tracks(folder: Path) -> Any:
    with (folder / "tracks.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["x_m"]]
    return sorted({row["image"] for row in rows}), len({row["track"] for row in rows})


# Images with a pose or a point, and the number of points; None where a format has none.
FOUND = {
    "alicevision": in_alicevision, "bingo": in_bingo, "blocks-exchange": in_blocks_exchange, "bundler": in_bundler,
    "geojson": in_geojson, "geopackage": in_geopackage, "hloc": in_hloc, "micmac": in_micmac, "openmvg": in_openmvg,
    "ply": lambda folder: (None, len(read_ply(folder / "points.ply")[1])), "tracks": in_tracks,
}  # fmt: skip
