"""Rendered blocks: the truth is checked against projections written out by hand, not against the package's own."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from make_scenes import NOON_WEST, make_scene, make_truth, make_view, one_box

from aeromatch_cli.blocks.exif import read_exif
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.geometry.cameras import MODELS, corner_params, project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_omega_phi_kappa
from aeromatch_cli.lab.synthetic import Truth, load_truth, render_block, transfer
from aeromatch_cli.lab.synthetic.receivers import gps_errors_m, rtk_errors_m
from aeromatch_cli.lab.synthetic.render import render_image
from aeromatch_cli.lab.synthetic.sensor import Development
from aeromatch_cli.lab.synthetic.shade import Stage
from aeromatch_cli.lab.synthetic.solids import Material
from aeromatch_cli.lab.synthetic.stations import Exterior, Station, taken_s
from aeromatch_cli.lab.synthetic.terrain import Area, Flat, sample_terrain

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 240, 180
NOISELESS = Development(exposure=0.3, vignetting=0.0, blur_px=0.0, read_noise=0.0, shot_noise=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "block"
    render_block(out, "suburb", seed=3, width_px=WIDTH, height_px=HEIGHT, images=3)
    return out


@pytest.fixture(scope="module")
def truth(folder: Path) -> Truth:
    return load_truth(folder)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def project_by_hand(folder: Path, image: str, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depths (N,) from the text of poses.csv and block.json, every formula written out."""
    row = next(r for r in rows(folder / "poses.csv") if r["image"] == image)
    o, p, k = (np.deg2rad(float(row[f"{name}_deg"])) for name in ("omega", "phi", "kappa"))
    rx = np.array([[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]])
    ry = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    rz = np.array([[np.cos(k), -np.sin(k), 0], [np.sin(k), np.cos(k), 0], [0, 0, 1]])
    photo = (points_m - [float(row["x"]), float(row["y"]), float(row["z"])]) @ (rx @ ry @ rz)
    depth = -photo[:, 2]
    u, v = photo[:, 0] / depth, -photo[:, 1] / depth
    f, cx, cy, k1 = json.loads((folder / "block.json").read_text())["cameras"]["1"]["params"]
    radial = 1 + k1 * (u * u + v * v)
    # The corner origin of COLMAP is half a pixel before the centre of the first pixel.
    return np.stack([f * u * radial + cx - 0.5, f * v * radial + cy - 0.5], axis=1), depth


def pixel_grid(step: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, WIDTH, step), np.arange(0, HEIGHT, step))
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(float)


def test_every_pixel_shows_the_point_that_projects_there(folder: Path, truth: Truth) -> None:
    pixels = pixel_grid(3)
    for name in truth.poses:
        surface = truth.surface_points(name, pixels)
        places, depth = project_by_hand(folder, name, surface)
        assert np.abs(places - pixels).max() < 1e-6  # asked for: 0.02 px
        stored = truth.depth_m(name)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        np.testing.assert_allclose(stored, depth, rtol=1e-7)  # float32
        assert np.median(np.abs(surface[:, 2])) < 1e-9  # most of it is ground, exactly at z = 0


def test_known_corners_and_ground_points_are_seen_where_they_project(folder: Path, truth: Truth) -> None:
    """Nothing is drawn behind a solid's own point, and most roof corners are seen where they are."""
    scene = truth.scene
    roofs = np.flatnonzero(np.isin(scene.materials, (Material.FLAT_ROOF, Material.TILED_ROOF)))
    corners = []
    for surface_idx in roofs:
        patch = scene.triangles_m[scene.surface_idx == surface_idx].reshape(-1, 3)
        corners.append(patch + 0.05 * (patch.mean(axis=0) - patch))
    x, y = np.meshgrid(np.arange(-40.0, 40.0, 4.0), np.arange(-40.0, 40.0, 4.0))
    known = np.concatenate([*corners, np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)])
    name = next(iter(truth.poses))
    places, depth = project_by_hand(folder, name, known)
    inside = ((places > 0) & (places < [WIDTH - 1, HEIGHT - 1])).all(axis=1)
    known, places, depth = known[inside], places[inside], depth[inside]
    assert len(known) > 100
    seen = truth.surface_points(name, places)
    _, seen_depth = project_by_hand(folder, name, seen)
    assert (seen_depth < depth + 1e-3).all()
    hit = np.linalg.norm(seen - known, axis=1) < 1e-6 * depth
    assert hit.mean() > 0.6
    # The depth map agrees at the nearest pixel wherever the surface is level around it.
    column, row = np.rint(places[hit]).astype(int).T
    level = known[hit][:, 2] == 0.0
    nearest = truth.depth_m(name)[row, column]
    assert np.median(np.abs(nearest - depth[hit])[level]) < 0.05


def test_transfer_agrees_with_projection_by_hand_and_with_depth(folder: Path, truth: Truth) -> None:
    name0, name1, _ = truth.poses
    pixels = pixel_grid(2)
    places, hidden = transfer(truth, name0, pixels, name1)
    by_hand, depth = project_by_hand(folder, name1, truth.surface_points(name0, pixels))
    assert np.abs(places - by_hand).max() < 1e-6
    off = ~((places >= -0.5) & (places <= [WIDTH - 0.5, HEIGHT - 0.5])).all(axis=1)
    assert hidden[off].all()
    # Second opinion from image 1's depth map, away from its edges.
    inner = ((places > 1) & (places < [WIDTH - 2, HEIGHT - 2])).all(axis=1)
    x, y = np.rint(places[inner]).astype(int).T
    around = np.stack([truth.depth_m(name1)[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    in_front = around.max(axis=0) < depth[inner] - 1.0
    open_to_view = around.min(axis=0) > depth[inner] - 0.1
    assert in_front.sum() > 30
    assert open_to_view.sum() > 1000
    assert hidden[inner][in_front].all()
    # Twigs and posts are thinner than a pixel: the depth map cannot show all of them.
    assert hidden[inner][open_to_view].mean() < 0.003


def test_two_renders_agree_in_brightness_only_at_the_true_place(folder: Path, truth: Truth) -> None:
    name0, name1, _ = truth.poses
    picture0, picture1 = (cv2.imread(str(folder / "images" / n), cv2.IMREAD_GRAYSCALE) for n in (name0, name1))
    pixels = pixel_grid(1)
    places, hidden = truth.transfer(name0, pixels, name1)
    ground = ~hidden & (np.abs(truth.surface_points(name0, pixels)[:, 2]) < 1e-6)
    ground &= ((places > 2) & (places < [WIDTH - 3, HEIGHT - 3])).all(axis=1)
    pixels, places = pixels[ground], places[ground]
    level0 = picture0[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(float)

    def correlation(dx: float, dy: float) -> float:
        x, y = (places[:, None, 0] + dx).astype(np.float32), (places[:, None, 1] + dy).astype(np.float32)
        level1 = np.concatenate(
            [
                cv2.remap(picture1, a, b, cv2.INTER_CUBIC)
                for a, b in zip(np.array_split(x, 9), np.array_split(y, 9), strict=True)
            ]
        )
        return float(np.corrcoef(level0, level1[:, 0].astype(float))[0, 1])

    best = correlation(0.0, 0.0)
    assert best > 0.93
    sides = {(dx, dy): correlation(dx, dy) for dx, dy in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))}
    assert max(sides.values()) < best - 0.005
    # The peak of the parabola through three values lies within a twentieth of a pixel.
    for axis in ((0.5, 0), (0, 0.5)):
        plus, minus = sides[axis], sides[(-axis[0], -axis[1])]
        assert abs(0.25 * (plus - minus) / (2 * best - plus - minus)) < 0.05


def test_hidden_points_and_shadow_of_one_box_worked_by_hand() -> None:
    scene = one_box()
    camera = Camera("SIMPLE_PINHOLE", 201, 201, (100.0, 100.0, 100.0))
    truth = make_truth(
        scene, camera, a=Exterior(0.0, 0.0, 100.0, 0.0, 0.0, 0.0), b=Exterior(60.0, 0.0, 100.0, 0.0, 0.0, 0.0)
    )
    # Seen from above the origin, ground x maps to column 100 + x and roof x to 100 + x / 0.8.
    pixels = np.array(
        [[100 - 8, 100], [100 - 21, 100], [100 - 22, 100], [100 + 8, 100], [100 + 5, 100], [100, 100]], float
    )
    np.testing.assert_allclose(truth.surface_points("a", pixels)[:, 0], [-8, -21, -22, 8, 4, 0], atol=1e-9)
    places, hidden = truth.transfer("a", pixels, "b")
    # The ray from (60, 100) over the roof's western edge (-5, 20) reaches the ground at x = -21.25.
    assert hidden.tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(places[:, 0], [32, 19, 18, 48, 30, 25], atol=1e-9)
    np.testing.assert_allclose(places[:, 1], 100.0, atol=1e-9)
    # The sun stands 45 degrees high in the west: the box of 20 m throws its shadow from x = 5 to x = 25.
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    ground = np.array([[6.0, 0, 0], [24.7, 0, 0], [25.3, 0, 0], [-6.0, 0, 0]])
    assert truth.caster.is_free(ground, up, NOON_WEST.to_sun).tolist() == [False, False, True, True]
    view = make_view(camera, Exterior(0.0, 0.0, 100.0, 0.0, 0.0, 0.0))
    picture = render_image(Stage(scene, truth.caster, NOON_WEST), view, NOISELESS, np.random.default_rng(0))
    assert picture.depth_m[100, 100] == pytest.approx(80.0, abs=1e-5)
    assert picture.depth_m[100, 120] == pytest.approx(100.0, abs=1e-5)
    assert picture.sun[100, 107:125].max() < 10
    assert picture.sun[100, 127:].min() == 255
    assert picture.sun[100, 100] == 255
    lit, dark = picture.pixels[95:106, 128:135].mean((0, 1)), picture.pixels[95:106, 110:122].mean((0, 1))
    assert (dark < [0.55 * lit[0], 0.6 * lit[1], 0.65 * lit[2]]).all()
    assert dark[2] / dark[0] > lit[2] / lit[0]  # the sky's light is bluer than the sun's


def test_penumbra_is_as_wide_as_the_sun() -> None:
    """Behind an edge 20 m high under a 45 degree sun the disc of 0.533 degrees blurs the shadow over 0.53 m."""
    scene = one_box()
    camera = Camera("SIMPLE_PINHOLE", 201, 21, (4000.0, -2400.0, 10.0))  # 1/40 m a pixel; x = 62.5 / 2.5 at the left
    truth = make_truth(scene, camera, a=Exterior(-37.0, 0.0, 100.0, 0.0, 0.0, 0.0))
    view = make_view(camera, Exterior(-37.0, 0.0, 100.0, 0.0, 0.0, 0.0))
    picture = render_image(Stage(scene, truth.caster, NOON_WEST), view, NOISELESS, np.random.default_rng(0))
    x_m = truth.surface_points("a", np.stack([np.arange(201.0), np.full(201, 10.0)], axis=1))[:, 0]
    share = picture.sun[10] / 255.0
    distance, radius = 20.0 * np.sqrt(2.0), np.tan(np.deg2rad(0.2665))
    # Share of a disc of unit radius on one side of a chord at h: (acos(h) - h sqrt(1 - h^2)) / pi.
    h = np.clip((25.0 - x_m) / np.sqrt(2.0) / (distance * radius), -1.0, 1.0)
    expected = (np.arccos(h) - h * np.sqrt(1.0 - h**2)) / np.pi
    assert x_m[0] < 24.5 < 25.5 < x_m[-1]
    assert np.abs(share - expected).max() < 0.13  # sixteen rays stand for the disc
    assert np.abs(share - expected).mean() < 0.02


def test_colour_is_centred_on_its_pixel() -> None:
    """A camera turned by 180 degrees about its axis takes the same picture, turned: any constant shift would double."""
    scene, camera = one_box(), Camera("SIMPLE_RADIAL", 81, 61, (80.0, 40.0, 30.0, -0.02))
    stage = Stage(scene, make_truth(scene, camera).caster, NOON_WEST)
    taken = [
        render_image(stage, make_view(camera, Exterior(3.0, -2.0, 60.0, 0.0, 0.0, kappa)), NOISELESS, _rng())
        for kappa in (0.0, 180.0)
    ]
    turned = taken[1].pixels[::-1, ::-1].astype(float)
    difference = np.abs(taken[0].pixels - turned)
    assert np.median(difference) <= 1.0
    assert np.abs(np.roll(taken[0].pixels, 1, axis=1) - turned)[:, 1:].mean() > 2.0 * difference.mean() + 1.0
    np.testing.assert_allclose(taken[0].depth_m, taken[1].depth_m[::-1, ::-1], rtol=1e-6)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_sky_has_no_depth_and_no_place() -> None:
    scene = one_box()
    camera = Camera("SIMPLE_PINHOLE", 41, 41, (30.0, 20.0, 20.0))
    level = Exterior(0.0, -80.0, 30.0, 90.0, 0.0, 0.0)
    truth = make_truth(scene, camera, a=level)
    places, hidden = truth.transfer("a", np.array([[20.0, 0.0], [20.0, 40.0]]), "a")
    assert np.isnan(places[0]).all()
    np.testing.assert_allclose(places[1], [20.0, 40.0], atol=1e-9)
    assert hidden.tolist() == [True, False]
    picture = render_image(Stage(scene, truth.caster, NOON_WEST), make_view(camera, level), NOISELESS, _rng())
    assert np.isnan(picture.depth_m[0]).all()
    assert (picture.surface[0] == 0).all()
    assert np.isfinite(picture.depth_m[40]).all()
    assert (picture.surface[40] > 0).all()


def test_relief_is_met_where_its_triangles_are() -> None:
    """A slope of 1 in 5 towards the east: the place below a pixel follows from two lines that cross."""

    class Slope(Flat):
        def height_m(self, xy_m: np.ndarray) -> np.ndarray:
            return 0.2 * xy_m[:, 0]

    scene = make_scene(terrain=Slope(cell_m=5.0))
    camera = Camera("SIMPLE_PINHOLE", 101, 101, (100.0, 50.0, 50.0))
    truth = make_truth(scene, camera, a=Exterior(0.0, 0.0, 100.0, 0.0, 0.0, 0.0))
    points = truth.surface_points("a", np.array([[50.0, 50.0], [100.0, 50.0], [0.0, 50.0]]))
    # z = 0.2 x and x = 0.5 (100 - z): x = 50 / 1.1; on the other side x = -50 / 0.9.
    np.testing.assert_allclose(points[:, 0], [0.0, 50.0 / 1.1, -50.0 / 0.9], atol=1e-9)
    np.testing.assert_allclose(points[:, 2], 0.2 * points[:, 0], atol=1e-9)


def test_dem_holds_the_ground(folder: Path, truth: Truth) -> None:
    import rasterio

    with rasterio.open(folder / "dem.tif") as dem:
        heights_m, transform = dem.read(1), dem.transform
    ground = truth.scene.ground
    for row, column in ((0, 0), (3, 5), (len(heights_m) - 1, heights_m.shape[1] - 1)):
        x, y = transform.c + (column + 0.5) * transform.a, transform.f + (row + 0.5) * transform.e
        i, j = np.argmin(np.abs(ground.y_m - y)), np.argmin(np.abs(ground.x_m - x))
        assert (ground.x_m[j], ground.y_m[i]) == pytest.approx((x, y), abs=1e-9)
        assert heights_m[row, column] == pytest.approx(ground.z_m[i, j], abs=1e-4)


def test_ground_grid_is_closed_and_shared_between_areas() -> None:
    class Waves(Flat):
        def height_m(self, xy_m: np.ndarray) -> np.ndarray:
            return np.sin(xy_m[:, 0]) * np.cos(xy_m[:, 1])

    small, large = (sample_terrain(Waves(cell_m=3.0), Area(-a, -a, a, 2 * a)) for a in (20.0, 50.0))
    heights = {
        (x, y): z for y, row in zip(large.y_m, large.z_m, strict=True) for x, z in zip(large.x_m, row, strict=True)
    }
    x0, y0, even = small.even_part()
    assert all(
        heights[(x0 + 3.0 * j, y0 + 3.0 * i)] == even[i, j] for i in range(len(even)) for j in range(even.shape[1])
    )
    triangles = small.triangles_m()
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    directed = {tuple(map(tuple, edge)) for edge in edges.round(9).tolist()}
    unpaired = [edge for edge in directed if edge[::-1] not in directed]
    assert len(unpaired) == 2 * (len(small.x_m) + len(small.y_m) - 2)  # only the rim
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (normals[:, 2] > 0).all()


def test_equal_seeds_give_equal_bytes_and_other_seeds_other_scenes(
    folder: Path, tmp_path: Path, scenes_built_once: Callable[[], None]
) -> None:
    scenes_built_once()  # or this process would not build the scene a second time
    render_block(tmp_path / "again", "suburb", seed=3, width_px=WIDTH, height_px=HEIGHT, images=3, jobs=2)
    written = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(written) == 3 + 3 * 3 + 8
    for path in written:
        assert (folder / path).read_bytes() == (tmp_path / "again" / path).read_bytes(), path
    render_block(tmp_path / "other", "suburb", seed=4, width_px=WIDTH, height_px=HEIGHT, images=1)
    picture, other = (cv2.imread(str(p / "images/suburb_0001.jpg"), 0) for p in (folder, tmp_path / "other"))
    assert np.abs(picture.astype(float) - other).mean() > 10


def test_poses_and_camera_round_trip(folder: Path, truth: Truth) -> None:
    for row in rows(folder / "poses.csv"):
        angles = tuple(float(row[k]) for k in ("omega_deg", "phi_deg", "kappa_deg"))
        rotation = from_omega_phi_kappa(*angles)
        np.testing.assert_allclose(to_omega_phi_kappa(rotation), angles, atol=1e-9)
        assert np.array_equal(truth.poses[row["image"]].world_rotation, rotation)
    lens = json.loads((folder / "block.json").read_text())["cameras"]["1"]
    assert {(c.model, c.width_px, c.height_px) for c in truth.cameras.values()} == {("SIMPLE_RADIAL", WIDTH, HEIGHT)}
    assert all(list(corner_params(camera)) == lens["params"] for camera in truth.cameras.values())


@pytest.mark.parametrize("lens", MODELS)
def test_any_lens_model_is_rendered_exactly(lens: str, tmp_path: Path) -> None:
    render_block(tmp_path, "grass", width_px=64, height_px=48, images=1, lens=lens)
    truth = load_truth(tmp_path)
    (name,) = truth.poses
    facts = json.loads((tmp_path / "block.json").read_text())["cameras"]["1"]
    assert facts["model"] == lens
    given = dict(zip(MODELS[lens], facts["params"], strict=True))
    pixels = np.array([[1.0, 2.0], [60.0, 5.0], [30.0, 45.0]])
    surface, pose = truth.surface_points(name, pixels), truth.poses[name]
    x, y, z = ((surface - pose.center_m) @ np.asarray(pose.world_rotation).T).T
    u, v = x / z, y / z
    r2 = u * u + v * v
    k1, k2, k3, k4, p1, p2 = (given.get(k, 0.0) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    radial = 1 + k1 * r2 + k2 * r2 * r2 + k3 * r2**3
    if lens == "OPENCV_FISHEYE":
        angle = np.arctan(np.sqrt(r2))
        radial = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8) / np.sqrt(r2)
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    fx, skew = fx + given.get("b1", 0.0), given.get("b2", 0.0)
    places = np.stack([fx * du + skew * dv + given["cx"] - 0.5, fy * dv + given["cy"] - 0.5], axis=1)
    assert np.abs(places - pixels).max() < 1e-6


def test_truth_that_cannot_be_trusted_is_refused(folder: Path, truth: Truth, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"truth\.json cannot be read"):
        load_truth(tmp_path)
    for name in ("truth.json", "block.json", "poses.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "poses.csv").rename(tmp_path / "hidden.csv")
    with pytest.raises(InputError, match=r"poses\.csv cannot be read"):
        load_truth(tmp_path)
    (tmp_path / "hidden.csv").rename(tmp_path / "poses.csv")
    bare = load_truth(tmp_path)
    with pytest.raises(InputError, match=r"suburb_0001\.depth\.tif cannot be read"):
        bare.depth_m("suburb_0001.jpg")
    facts = json.loads((folder / "truth.json").read_text())
    (tmp_path / "truth.json").write_text(json.dumps(facts | {"scene_version": 0}))
    with pytest.raises(InputError, match="another version"):
        load_truth(tmp_path)
    del facts["seed"]
    (tmp_path / "truth.json").write_text(json.dumps(facts))
    with pytest.raises(InputError, match="damaged"):
        load_truth(tmp_path)
    with pytest.raises(ConfigError, match=r"'x\.jpg' is no image"):
        truth.transfer("x.jpg", np.zeros((1, 2)), "suburb_0001.jpg")


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real lens and a rolling shutter: 40 ms at 25 m/s are 1 m, 2 px of 0.5 m, on strips along y."""
    out = tmp_path_factory.mktemp("rolling") / "block"
    render_block(
        out, "suburb", seed=3, width_px=WIDTH, height_px=HEIGHT, images=2, lens="REAL", readout_ms=40.0, speed_m_s=25.0
    )
    return out


def test_a_rolling_shutter_needs_a_speed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give --speed"):
        render_block(tmp_path, "suburb", seed=3, width_px=WIDTH, height_px=HEIGHT, images=2, readout_ms=40.0)


def test_pictures_of_a_moving_aircraft_state_when_they_were_taken(rolling: Path) -> None:
    names = ["suburb_0001.jpg", "suburb_0002.jpg"]
    stamps = [datetime.fromisoformat(read_exif(rolling / "images" / name).time) for name in names]
    centers_m = [pose.center_m for pose in load_truth(rolling).poses.values()]
    expected_s = np.linalg.norm((centers_m[1] - centers_m[0])[:2]) / 25.0
    assert (stamps[1] - stamps[0]).total_seconds() == pytest.approx(expected_s, abs=1e-3)


def test_times_of_two_strips_have_a_turn_between_them() -> None:
    """A rig takes two pictures at once; then 50 m at 10 m/s, and a turn of 15 s to the next strip, 40 m aside."""

    def station(x_m: float, y_m: float, heading_deg: float) -> Station:
        return Station(Exterior(x_m, y_m, 100.0, 0.0, 0.0, 0.0), "one", 0, 100.0, heading_deg)

    flown = [station(0, 0, 0.0), station(0, 0, 0.0), station(0, 50, 0.0), station(40, 50, 180.0), station(40, 0, 180.0)]
    assert taken_s(flown, 10.0) == pytest.approx([0.0, 0.0, 5.0, 24.0, 29.0])


def test_every_row_shows_what_its_own_projection_centre_sees(rolling: Path) -> None:
    truth = load_truth(rolling)
    shutter = json.loads((rolling / "truth.json").read_text())["rolling_shutter"]
    assert (shutter["readout_s"], shutter["speed_m_s"]) == (0.04, 25.0)
    camera, pixels = next(iter(truth.cameras.values())), pixel_grid(3)
    for name, pose in truth.poses.items():
        velocity = np.array(shutter["velocities_m_s"][name])
        np.testing.assert_allclose(velocity, [0.0, 25.0, 0.0], atol=1e-9)  # the first strip flies north
        assert pose.world_rotation is not None
        surface = truth.surface_points(name, pixels)
        seconds = (pixels[:, 1] / (HEIGHT - 1) - 0.5) * 0.04
        still = surface - seconds[:, None] * velocity  # as a camera at rest would see it
        np.testing.assert_allclose(project(camera, pose.world_rotation, pose.center_m, still), pixels, atol=1e-6)
        np.testing.assert_allclose(truth.project(name, surface), pixels, atol=1e-6)
        # What was rendered lies there too: depths along the axis from each row's own centre.
        stored = truth.depth_m(name)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        depth = ((still - pose.center_m) @ pose.world_rotation.T)[:, 2]
        np.testing.assert_allclose(stored, depth, rtol=1e-6)
        # Without the shutter's motion places are off by up to half of what it moved.
        off = project(camera, pose.world_rotation, pose.center_m, surface) - pixels
        assert np.abs(off).max() == pytest.approx(0.5 * 1.0 / (110.0 / (0.9 * WIDTH)), rel=0.3)


def test_a_rolling_shutter_transfers_to_where_the_other_image_shows_the_point(rolling: Path) -> None:
    truth = load_truth(rolling)
    name0, name1 = truth.poses
    pixels = pixel_grid(4)
    places, hidden = truth.transfer(name0, pixels, name1)
    assert 0.5 < (~hidden).mean() < 0.9
    back = truth.surface_points(name1, places[~hidden])
    apart_m = np.linalg.norm(back - truth.surface_points(name0, pixels)[~hidden], axis=1)
    assert np.quantile(apart_m, 0.98) < 1e-5


def test_real_lenses_are_exact_in_block_json_and_exif_knows_their_focal_length_alone(rolling: Path) -> None:
    lens = json.loads((rolling / "block.json").read_text())["cameras"]["1"]
    assert lens["model"] == "BROWN"
    f, cx, cy, *distortion = lens["params"]
    assert abs(cx - 0.5 * WIDTH) <= 0.02 * WIDTH
    assert abs(cy - 0.5 * HEIGHT) <= 0.02 * WIDTH
    assert all(value != 0.0 for value in distortion)
    for picture in sorted((rolling / "images").iterdir()):
        header = read_exif(picture)
        assert (header.make, header.model) == ("aeromatch", "rendered 1")
        assert header.focal_35mm_mm == pytest.approx(f / np.hypot(WIDTH, HEIGHT) * 43.267, abs=0.51)
    assert cv2.imread(str(picture)).shape == (HEIGHT, WIDTH, 3)


def test_receivers_positions_have_the_sigmas_that_they_state(rolling: Path) -> None:
    exact = np.array([[float(row[k]) for k in "xyz"] for row in rows(rolling / "poses.csv")])
    for kind, sigma_xy_m, sigma_z_m in (("rtk", 0.02, 0.03), ("gps", 5.099, 5.099)):
        table = rows(rolling / f"poses_{kind}.csv")
        assert list(table[0]) == ["image", "x", "y", "z", "sigma_x_m", "sigma_y_m", "sigma_z_m", "camera"]
        assert [float(table[0][f"sigma_{k}_m"]) for k in "xyz"] == [sigma_xy_m, sigma_xy_m, sigma_z_m]
        off_m = np.array([[float(row[k]) for k in "xyz"] for row in table]) - exact
        assert 0.0 < np.abs(off_m).max() < 4.0 * sigma_z_m
    many = np.random.default_rng(0)
    np.testing.assert_allclose(rtk_errors_m(4000, many).std(axis=0), [0.02, 0.02, 0.03], rtol=0.05)
    drift_m = np.array([gps_errors_m(20, many) for _ in range(400)])
    np.testing.assert_allclose(drift_m.std(axis=(0, 1)), 5.1, rtol=0.1)
    np.testing.assert_allclose(np.diff(drift_m, n=2, axis=1).std(axis=(0, 1)), np.sqrt(6.0), rtol=0.1)  # 1 m each
