"""Rendered blocks: the truth is checked against projections written out by hand, not against the package's own."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError, InputError, WorkspaceError
from aeromatch_cli.geometry.cameras import focal_px, from_colmap
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_omega_phi_kappa
from aeromatch_cli.synthetic import Truth, flight, load_truth, noise, read_depth, render_block, transfer
from aeromatch_cli.synthetic.raycast import RayCaster
from aeromatch_cli.synthetic.render import ray_grid, render_image
from aeromatch_cli.synthetic.scene import Scene, assemble, build_scene, sun_direction
from aeromatch_cli.synthetic.solids import Footprint, Material, Surface, box, crown, gabled_house, ground_square

WIDTH, HEIGHT = 240, 180
PLAIN = (Material.PAINT, (0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "block"
    render_block(out, "town", seed=3, width_px=WIDTH, height_px=HEIGHT, images=3)
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
        stored = read_depth(folder, name)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
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
    nearest = read_depth(folder, name)[row, column]
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
    around = np.stack([read_depth(folder, name1)[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    in_front = around.max(axis=0) < depth[inner] - 1.0
    open_to_view = around.min(axis=0) > depth[inner] - 0.1
    assert in_front.sum() > 50
    assert open_to_view.sum() > 1000
    assert hidden[inner][in_front].all()
    assert not hidden[inner][open_to_view].any()


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


def one_box() -> Scene:
    """A box of 10 m x 10 m x 20 m around the origin; the sun 45 degrees high in the west."""
    solids = box(Footprint(0.0, 0.0, 10.0, 10.0, 0.0), 0.0, 20.0, PLAIN, PLAIN)
    return assemble("box", 0, 50.0, [ground_square(500.0, 0.0), *solids], sun_direction(270.0, 45.0), {})


def test_hidden_points_and_shadow_of_one_box_worked_by_hand() -> None:
    scene = one_box()
    camera = Camera("SIMPLE_PINHOLE", 201, 201, (100.0, 100.0, 100.0))
    down = from_omega_phi_kappa(0.0, 0.0, 0.0)
    nadir, east = (flight.Exterior(x, 0.0, 100.0, 0.0, 0.0, 0.0).pose() for x in (0.0, 60.0))
    truth = Truth(scene, RayCaster(scene), {"a": camera, "b": camera}, {"a": nadir, "b": east})
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
    # The sun stands 45 degrees high: the box of 20 m throws its shadow from x = 5 to x = 25.
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    ground = np.array([[6.0, 0, 0], [24.9, 0, 0], [25.1, 0, 0], [-6.0, 0, 0]])
    assert truth.caster.is_free(ground, up, scene.to_sun).tolist() == [False, False, True, True]
    picture = render_image(
        scene, truth.caster, ray_grid(camera), down, nadir.center_m,
        exposure=0.8, noise_sigma=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert picture.depth_m[100, 100] == pytest.approx(80.0, abs=1e-5)
    assert picture.depth_m[100, 120] == pytest.approx(100.0, abs=1e-5)
    lit, dark = picture.pixels[95:106, 128:135].mean((0, 1)), picture.pixels[95:106, 110:122].mean((0, 1))
    assert (dark < 0.6 * lit).all()
    assert dark[2] / dark[0] > lit[2] / lit[0]  # the sky's light is bluer than the sun's


def test_colour_is_centred_on_its_pixel() -> None:
    """A camera turned by 180 degrees about its axis takes the same picture, turned: any constant shift would double."""
    scene, camera = one_box(), Camera("SIMPLE_RADIAL", 81, 61, (80.0, 40.0, 30.0, -0.02))
    caster, rays = RayCaster(scene), ray_grid(camera)
    taken = []
    for kappa_deg in (0.0, 180.0):
        rotation = from_omega_phi_kappa(0.0, 0.0, kappa_deg)
        center_m = np.array([3.0, -2.0, 60.0])
        rng = np.random.default_rng(0)
        taken.append(render_image(scene, caster, rays, rotation, center_m, exposure=0.8, noise_sigma=0.0, rng=rng))
    turned = taken[1].pixels[::-1, ::-1].astype(float)
    assert np.abs(taken[0].pixels - turned).mean() < 0.2
    assert np.abs(np.roll(taken[0].pixels, 1, axis=1) - turned)[:, 1:].mean() > 3.0
    np.testing.assert_allclose(taken[0].depth_m, taken[1].depth_m[::-1, ::-1], rtol=1e-6)


def test_sky_has_no_depth_and_no_place() -> None:
    scene = one_box()
    camera = Camera("SIMPLE_PINHOLE", 41, 41, (30.0, 20.0, 20.0))
    level = flight.Exterior(0.0, -80.0, 30.0, 90.0, 0.0, 0.0).pose()
    caster = RayCaster(scene)
    truth = Truth(scene, caster, {"a": camera}, {"a": level})
    places, hidden = truth.transfer("a", np.array([[20.0, 0.0], [20.0, 40.0]]), "a")
    assert np.isnan(places[0]).all()
    np.testing.assert_allclose(places[1], [20.0, 40.0], atol=1e-9)
    assert hidden.tolist() == [True, False]
    assert level.world_rotation is not None
    picture = render_image(
        scene, caster, ray_grid(camera), level.world_rotation, level.center_m,
        exposure=1.0, noise_sigma=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert np.isnan(picture.depth_m[0]).all()
    assert np.isfinite(picture.depth_m[40]).all()


def test_equal_seeds_give_equal_bytes_and_other_seeds_other_scenes(folder: Path, tmp_path: Path) -> None:
    render_block(tmp_path / "again", "town", seed=3, width_px=WIDTH, height_px=HEIGHT, images=3)
    written = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(written) == 3 + 3 + 4
    for path in written:
        assert (folder / path).read_bytes() == (tmp_path / "again" / path).read_bytes(), path
    render_block(tmp_path / "other", "town", seed=4, width_px=WIDTH, height_px=HEIGHT, images=1)
    picture, other = (cv2.imread(str(p / "images/town_0001.jpg"), 0) for p in (folder, tmp_path / "other"))
    assert np.abs(picture.astype(float) - other).mean() > 10


def test_poses_and_camera_round_trip(folder: Path, truth: Truth) -> None:
    for row in rows(folder / "poses.csv"):
        angles = tuple(float(row[k]) for k in ("omega_deg", "phi_deg", "kappa_deg"))
        rotation = from_omega_phi_kappa(*angles)
        np.testing.assert_allclose(to_omega_phi_kappa(rotation), angles, atol=1e-9)
        assert np.array_equal(truth.poses[row["image"]].world_rotation, rotation)
    lens = json.loads((folder / "block.json").read_text())["cameras"]["1"]
    camera = from_colmap(lens["model"], lens["width"], lens["height"], tuple(lens["params"]))
    assert camera == flight.make_camera(WIDTH, HEIGHT)
    assert json.loads((folder / "block.json").read_text())["ground_z"]["p50"] == 0.0


def test_noise_of_poses_is_what_is_stated(folder: Path) -> None:
    facts = json.loads((folder / "truth.json").read_text())
    exact = flight.Exterior(1.0, 2.0, flight.HEIGHT_M, 1.0, -1.0, 90.0)
    rng = np.random.default_rng(0)
    drawn = [flight.noisy(exact, rng) for _ in range(2000)]
    moved = np.array([[e.x_m - 1.0, e.y_m - 2.0, e.z_m - flight.HEIGHT_M] for e in drawn])
    turned = np.array([[e.omega_deg - 1.0, e.phi_deg + 1.0, e.kappa_deg - 90.0] for e in drawn])
    np.testing.assert_allclose(moved.std(axis=0), facts["pose_noise_sigma_position_m"], rtol=0.06)
    np.testing.assert_allclose(turned.std(axis=0), facts["pose_noise_sigma_angle_deg"], rtol=0.06)
    assert facts["pose_noise_sigma_position_m"] == pytest.approx(0.05 * facts["flying_height_m"])
    differing = [a != b for a, b in zip(rows(folder / "poses.csv"), rows(folder / "poses_noisy.csv"), strict=True)]
    assert all(differing)


def test_flight_has_the_stated_overlaps() -> None:
    camera = flight.make_camera(1000, 750)
    flown = flight.plan_flight(camera, 12, np.random.default_rng(1))
    x, y = (np.array([getattr(e, k) for e in flown]).reshape(3, 4) for k in ("x_m", "y_m"))
    ground_m = flight.HEIGHT_M / focal_px(camera)
    assert 1 - np.abs(np.diff(y, axis=1)).mean() / (750 * ground_m) == pytest.approx(0.70, abs=0.02)
    assert 1 - np.diff(x.mean(axis=1)).mean() / (1000 * ground_m) == pytest.approx(0.60, abs=0.02)
    kappa = np.array([e.kappa_deg for e in flown]).reshape(3, 4)
    assert (np.abs(kappa[[0, 2]]) < 15).all()
    assert (np.abs(kappa[1]) > 165).all()


@pytest.mark.parametrize(
    "surfaces",
    [
        box(Footprint(3.0, 4.0, 5.0, 6.0, 30.0), 0.0, 7.0, PLAIN, PLAIN),
        gabled_house(Footprint(3.0, 4.0, 5.0, 6.0, 30.0), 4.0, 7.0, PLAIN, PLAIN),
        [crown(np.array([3.0, 4.0, 3.5]), 2.0, np.random.default_rng(0), (1, 1, 1))],
    ],
    ids=["box", "gabled house", "crown"],
)
def test_solids_face_outwards(surfaces: list[Surface]) -> None:
    triangles = np.concatenate([s.triangles_m for s in surfaces])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    outwards = triangles.mean(axis=1) - [3.0, 4.0, 2.5]
    assert (np.einsum("ij,ij->i", normals, outwards) > 0).all()
    for surface in surfaces:
        assert surface.u_axis @ surface.v_axis == pytest.approx(0.0, abs=1e-12)


def test_a_larger_extent_changes_no_solid_of_the_smaller() -> None:
    small, large = build_scene("town", 5, 60.0), build_scene("town", 5, 120.0)
    centres = {tuple(t) for t in large.triangles_m.mean(axis=1).round(6).tolist()}
    of_solids = small.triangles_m[small.surface_idx > 0].mean(axis=1).round(6).tolist()
    assert len(large.triangles_m) > 1.5 * len(small.triangles_m)
    assert all(tuple(t) in centres for t in of_solids)


def test_texture_fades_out_where_it_cannot_be_sampled() -> None:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-50, 50, (2, 20000)).astype(np.float32)
    fine, coarse = np.full(len(u), 0.02, np.float32), np.full(len(u), 0.5, np.float32)
    assert noise.octaves(u, v, fine, (0.5,), 1, 0).std() == pytest.approx(0.95, abs=0.08)
    assert not noise.octaves(u, v, coarse, (0.5,), 1, 0).any()
    for footprint in (fine, coarse):
        assert noise.stripes(u, 2.0, 0.3, footprint).mean() == pytest.approx(0.15, abs=0.01)
        assert noise.inside(u, footprint).mean() == pytest.approx(0.5, abs=0.02)
    covered, _ = noise.spots(u, v, 1.0, 0.5, 1, fine)
    # Half of the cells hold a disc of radius 0.10 to 0.26 m, uniformly: pi * mean(r^2) / 2.
    assert covered.mean() == pytest.approx(0.5 * np.pi * (0.18**2 + 0.16**2 / 12), abs=0.01)
    assert np.array_equal(
        noise.hash01(np.array([3, -3]), np.array([4, 4]), 5), noise.hash01(np.array([3, -3]), np.array([4, 4]), 5)
    )


def test_arguments_that_cannot_be_used_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match=r"'villlage'.*use one of: town"):
        render_block(out, "villlage")
    with pytest.raises(ConfigError, match="at least 1 image"):
        render_block(out, "town", images=0)
    with pytest.raises(ConfigError, match="16 px"):
        render_block(out, "town", width_px=8)
    with pytest.raises(ConfigError, match="seed"):
        render_block(out, "town", seed=-1)
    assert not out.exists()


def test_folders_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WorkspaceError, match=r"cannot be written to .*file"):
        render_block(tmp_path / "file" / "block", "town", width_px=32, height_px=24, images=1)
    (tmp_path / "mine" / "images").mkdir(parents=True)
    (tmp_path / "mine" / "images" / "holiday.jpg").write_bytes(b"dear")
    with pytest.raises(ConfigError, match=r"holiday\.jpg"):
        render_block(tmp_path / "mine", "town", width_px=32, height_px=24, images=1)
    assert (tmp_path / "mine" / "images" / "holiday.jpg").read_bytes() == b"dear"


def test_truth_that_cannot_be_trusted_is_refused(folder: Path, truth: Truth, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"truth\.json cannot be read"):
        load_truth(tmp_path)
    for name in ("truth.json", "block.json", "poses.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    facts = json.loads((folder / "truth.json").read_text())
    (tmp_path / "truth.json").write_text(json.dumps(facts | {"scene_version": 0}))
    with pytest.raises(InputError, match="another version"):
        load_truth(tmp_path)
    del facts["seed"]
    (tmp_path / "truth.json").write_text(json.dumps(facts))
    with pytest.raises(InputError, match="damaged"):
        load_truth(tmp_path)
    with pytest.raises(InputError, match="depth of town_0001"):
        read_depth(tmp_path, "town_0001.jpg")
    with pytest.raises(ConfigError, match=r"'x\.jpg' is no image"):
        truth.transfer("x.jpg", np.zeros((1, 2)), "town_0001.jpg")


def test_progress_is_reported(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    summary = render_block(
        tmp_path, "town", width_px=32, height_px=24, images=2, progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(1, 2), (2, 2)]
    assert summary.images == ("town_0001.jpg", "town_0002.jpg")
    assert summary.gsd_m == pytest.approx(85.0 / 28.8)
