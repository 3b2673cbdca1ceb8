"""reconstruction.json of OpenSfM: read by its description, seen where the images see it, coloured as they are."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_export_colmap import Truth, make_truth
from test_exporters import adjusted_block, geographic

from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.pose_files.geodesy import from_topocentric
from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.ellipsoid import geocentric, topocentric
from aeromatch_cli.geometry.rotations import angle_between_deg, from_quaternion, rotation_z
from aeromatch_cli.strategies.exporters import EXPORTERS, ExportContents

# Where the grid is turned by 1.6 degrees against north and 1.0004 times as long as the ground.
EAST_M = np.array([250_000.0, 0.0, 0.0])


def eastern(world_m: FloatArray) -> FloatArray:
    return geographic(world_m + EAST_M)


def painted(truth: Truth, image_id: str) -> np.ndarray[Any, Any]:
    """Colours that tell image and keypoint."""
    rows = np.arange(len(truth.keypoints_px[image_id]))
    return np.column_stack([rows % 256, rows // 2 % 256, np.full(len(rows), 40 * int(image_id[3:]))]).astype(np.uint8)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


@pytest.fixture(scope="module")
def contents(truth: Truth) -> ExportContents:
    block = dataclasses.replace(
        truth.block, images=tuple(dataclasses.replace(i, time="2024-05-01T10:00:00") for i in truth.block.images)
    )
    return dataclasses.replace(
        truth.contents(), block=block, adjusted=adjusted_block(truth), pairs=truth.pairs, geographic=eastern,
        colours=lambda image_id: painted(truth, image_id),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(contents: ExportContents, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "opensfm"
    EXPORTERS["opensfm"]()(contents, path)  # type: ignore[operator]
    return path


def as_opensfm(camera: dict[str, float], shot: dict[str, Any], point: FloatArray) -> FloatArray:
    """Where an image sees a point, by opensfm/src/geometry: Brown's model and shares of the longer side."""
    from scipy.spatial.transform import Rotation

    x, y, z = Rotation.from_rotvec(shot["rotation"]).as_matrix() @ point + shot["translation"]
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
    across = u * radial + 2 * camera["p1"] * u * v + camera["p2"] * (r2 + 2 * u * u)
    down = v * radial + 2 * camera["p2"] * u * v + camera["p1"] * (r2 + 2 * v * v)
    return np.array([camera["focal_x"] * across + camera["c_x"], camera["focal_y"] * down + camera["c_y"]])


def test_points_are_seen_where_tracks_say(folder: Path) -> None:
    (part,) = json.loads((folder / "reconstruction.json").read_text())
    assert part["reference_lla"] == json.loads((folder / "reference_lla.json").read_text())
    assert part["cameras"] == json.loads((folder / "camera_models.json").read_text())
    rows = [line.split("\t") for line in (folder / "tracks.csv").read_text().splitlines()[1:]]
    assert {row[1] for row in rows} == part["points"].keys()
    errors_px = []
    for row in rows:
        shot, point = part["shots"][row[0]], part["points"][row[1]]
        camera = part["cameras"][shot["camera"]]
        seen = as_opensfm(camera, shot, np.array(point["coordinates"]))
        measured = np.array([float(row[3]), float(row[4])])
        errors_px.append(float(np.linalg.norm(seen - measured)) * max(camera["width"], camera["height"]))
    assert len(rows) > 500
    # Heights as they are beside distances of another scale would be 0.2 px here.
    assert max(errors_px) < 0.005


def test_shots_stand_and_look_as_the_adjusted_block(folder: Path, truth: Truth) -> None:
    """By our own reader: latitude, longitude and height, and attitudes against true north."""
    found = read_pose_file(folder / "reconstruction.json")
    assert found.position_kind == "geographic"
    rows = {row.image: row for row in found.rows}
    assert len(rows) == 6
    for number in range(6):
        pose, row = truth.block.poses[f"img{number}"], rows[f"{number}.jpg"]
        assert row.position is not None
        assert row.attitude is not None
        expected = eastern(pose.center_m[None])
        reference = expected[0, 0], expected[0, 1], 0.0
        np.testing.assert_allclose(
            topocentric(reference, np.array([row.position])), topocentric(reference, expected), atol=2e-3
        )
        # Grid north against true north, by two places one above the other in the grid.
        ends = topocentric(reference, eastern(pose.center_m + np.array([[0.0, -50.0, 0.0], [0.0, 50.0, 0.0]])))
        turn = np.rad2deg(np.arctan2(*(ends[1] - ends[0])[:2]))
        assert abs(turn) > 1.0
        wanted = np.asarray(pose.world_rotation) @ rotation_z(float(turn))
        assert angle_between_deg(from_quaternion(*row.attitude), wanted) < 1e-3


def test_colours_are_those_of_the_pictures(folder: Path, truth: Truth) -> None:
    (part,) = json.loads((folder / "reconstruction.json").read_text())
    seen: dict[str, list[np.ndarray[Any, Any]]] = {}
    for line in (folder / "tracks.csv").read_text().splitlines()[1:]:
        row = line.split("\t")
        colour = painted(truth, f"img{row[0][0]}")[int(row[2])]
        assert [int(value) for value in row[6:9]] == colour.tolist()
        seen.setdefault(row[1], []).append(colour)
    for track, colours in seen.items():
        np.testing.assert_allclose(part["points"][track]["color"], np.mean(colours, axis=0), atol=0.5)
    with np.load(folder / "features" / "3.jpg.features.npz") as features:
        np.testing.assert_array_equal(features["colors"], painted(truth, "img3"))


def test_positions_and_times_come_along(folder: Path, contents: ExportContents, truth: Truth) -> None:
    (part,) = json.loads((folder / "reconstruction.json").read_text())
    exif = json.loads((folder / "exif" / "2.jpg.exif").read_text())
    shot = part["shots"]["2.jpg"]
    assert shot["capture_time"] == exif["capture_time"] == 1714557600.0
    assert shot["gps_dop"] == exif["gps"]["dop"] == 0.5
    reference = tuple(part["reference_lla"][key] for key in ("latitude", "longitude", "altitude"))
    expected = topocentric(reference, eastern(truth.block.poses["img2"].center_m[None]))[0]
    np.testing.assert_allclose(shot["gps_position"], expected, atol=1e-6)


def test_a_block_that_is_not_adjusted_has_no_reconstruction(truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["opensfm"]()(truth.contents(), tmp_path / "o")  # type: ignore[operator]
    assert not (tmp_path / "o" / "reconstruction.json").exists()


def test_geocentric_coordinates_are_those_of_proj() -> None:
    from pyproj import Transformer

    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-90, 90, 50), rng.uniform(-180, 180, 50), rng.uniform(-100, 9000, 50)])
    forward = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = np.column_stack(forward.transform(places[:, 1], places[:, 0], places[:, 2]))
    np.testing.assert_allclose(geocentric(places), expected, atol=1e-6)
    reference = 47.0, 11.0, 600.0
    shifts = np.array([[10.0, -20.0, 30.0], [4000.0, 100.0, -50.0]])
    back, _ = from_topocentric(reference, shifts, [None, None])
    np.testing.assert_allclose(topocentric(reference, back), shifts, atol=1e-4)
