"""City and suburb: what is planned where, that solids are solid, and that painters keep to what surfaces reflect."""

from collections import Counter

import numpy as np
import pytest

from aeromatch_cli.lab.synthetic.buildings import draw_style, hall, slab, tower, town_house
from aeromatch_cli.lab.synthetic.cars import car, lorry
from aeromatch_cli.lab.synthetic.houses import house, pool, shed
from aeromatch_cli.lab.synthetic.materials import PAINTERS
from aeromatch_cli.lab.synthetic.noise import hash01
from aeromatch_cli.lab.synthetic.paint import Samples
from aeromatch_cli.lab.synthetic.rasters import look_up
from aeromatch_cli.lab.synthetic.scenes import city, suburb
from aeromatch_cli.lab.synthetic.scenes.city_blocks import build_block
from aeromatch_cli.lab.synthetic.scenes.lots import bent, straight
from aeromatch_cli.lab.synthetic.scenes.streets import blocks_near, mesh, street_map
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, boxes, shrunk, turned
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.trees import Species, hedge, tree

pytestmark = pytest.mark.slow

SMALL, LARGE = Area(-60.0, -60.0, 60.0, 60.0), Area(-60.0, -60.0, 150.0, 90.0)
SCENES = {"city": city, "suburb": suburb}


def _samples(count, footprint_m, *, seed=3, extent_m=60.0, size_m=(18.0, 16.0), tint=(0.2, 0.12, 0.09), line=False):
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0.0, extent_m, size=(2, count)).astype(np.float32)
    if line:
        u, v = np.linspace(0.0, 12.0, count, dtype=np.float32), np.full(count, 7.3, dtype=np.float32)
    surface = np.zeros(count, dtype=np.int64) + 5
    return Samples(
        u_m=u,
        v_m=v,
        z_m=np.full(count, 2.0, dtype=np.float32),
        footprint_m=np.full(count, footprint_m, dtype=np.float32),
        shift_m=40.0 * hash01(surface, surface, seed),
        size_m=np.tile(np.array(size_m, dtype=np.float32), (count, 1)),
        tint=np.tile(np.array(tint, dtype=np.float32), (count, 1)),
        salt=seed * 101 + 7 * surface,
        slope=np.zeros((count, 2), dtype=np.float32),
        seed=seed,
        moment=0,
    )


def _painters():
    yield from ((material.name, painter) for material, painter in PAINTERS.items())
    yield "city ground", city.SCENE.paint_ground
    yield "suburb ground", suburb.SCENE.paint_ground


def _key(surface):
    return np.round(surface.triangles_m, 6).tobytes(), int(surface.material), surface.tint


@pytest.mark.parametrize("name", SCENES)
def test_a_plan_depends_on_seed_and_place_only(name):
    plan = SCENES[name].SCENE.plan
    first, again, wider, other = plan(5, SMALL), plan(5, SMALL), plan(5, LARGE), plan(6, SMALL)
    assert [_key(s) for s in first.surfaces] == [_key(s) for s in again.surfaces]
    assert first.heading_deg == wider.heading_deg
    missing = Counter(_key(s) for s in first.surfaces) - Counter(_key(s) for s in wider.surfaces)
    assert not missing
    assert all(wider.solids[kind] >= count for kind, count in first.solids.items())
    assert {_key(s) for s in first.surfaces}.isdisjoint({_key(s) for s in other.surfaces})


@pytest.mark.parametrize("name", SCENES)
def test_planned_triangles_are_sound(name):
    plan = SCENES[name].SCENE.plan(1, SMALL)
    triangles = np.concatenate([s.triangles_m for s in plan.surfaces])
    areas = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    assert np.isfinite(triangles).all()
    assert areas.min() > 1e-7
    assert triangles[..., 2].min() > -0.6
    axes = np.stack([np.stack([s.u_axis, s.v_axis]) for s in plan.surfaces])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=2), 1.0, atol=1e-9)
    assert plan.solids["buildings"] > 5
    assert plan.solids["trees"] > 10


def _volume_m3(triangles):
    return float(np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6.0)


def _open_edges(triangles):
    """Directed edges, in millimetres, whose reverse no triangle has."""
    corners = np.rint(triangles * 1000.0).astype(int)
    edges = [(tuple(t[i]), tuple(t[(i + 1) % 3])) for t in corners for i in range(3)]
    found = set(edges)
    return [edge for edge in edges if edge[::-1] not in found]


@pytest.mark.parametrize("species", Species)
def test_a_tree_is_closed_and_keeps_its_size(species):
    rng = np.random.default_rng(2)
    surfaces = tree(rng, 10.0, -4.0, 30.0, 2.5, 8.0, species)
    triangles = np.concatenate([s.triangles_m for s in surfaces])
    assert len(triangles) <= 500
    assert not _open_edges(triangles)
    assert _volume_m3(triangles - [10.0, -4.0, 30.0]) > 5.0
    assert triangles[..., 2].min() > 29.0
    assert 36.5 < triangles[..., 2].max() <= 38.0 + 1e-9
    assert np.hypot(triangles[..., 0] - 10.0, triangles[..., 1] + 4.0).max() < 1.45 * 2.5
    again = tree(np.random.default_rng(2), 10.0, -4.0, 30.0, 2.5, 8.0, species)
    np.testing.assert_array_equal(triangles, np.concatenate([s.triangles_m for s in again]))


def test_a_hedge_follows_its_line():
    line = np.array([[0.0, 0.0], [6.0, 2.0], [9.0, 8.0]])
    triangles = np.concatenate([s.triangles_m for s in hedge(np.random.default_rng(0), line, 1.0, 0.8, 1.5)])
    assert not _open_edges(triangles)
    assert 1.0 <= triangles[..., 2].min() < triangles[..., 2].max() < 2.8


def test_boxes_have_their_volume_and_face_outwards():
    solid = boxes(
        np.array([[3.0, 4.0], [-9.0, 1.0]]), np.array([[2.0, 3.0], [1.0, 1.0]]), 25.0, np.zeros(2), np.array([2.0, 5.0])
    )
    assert _volume_m3(solid) == pytest.approx(2 * 3 * 2 + 5)
    assert not _open_edges(solid)


@pytest.mark.parametrize("make", [car, lorry])
def test_vehicles_are_closed_and_stand_on_the_ground(make):
    for seed in range(12):
        for surface in make(np.random.default_rng(seed), 5.0, 6.0, 70.0, 12.0):
            assert _volume_m3(surface.triangles_m - [5.0, 6.0, 12.0]) > 0.0
            assert not _open_edges(surface.triangles_m)
            assert 12.0 < surface.triangles_m[..., 2].min() < surface.triangles_m[..., 2].max() < 16.0


def _upright(triangles):
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_roofs_face_up_and_walls_face_out():
    rng = np.random.default_rng(0)
    plan = Footprint(40.0, -20.0, 14.0, 9.0, 33.0)
    solids = [house(rng, plan) for _ in range(25)] + [shed(rng, plan) for _ in range(4)] + [pool(rng, plan)]
    solids += [slab(rng, plan, 6), tower(rng, plan, 12), hall(rng, plan)]
    solids += [town_house(rng, plan.corners_m(), draw_style(rng, 5, share)) for share in (0.0, 1.0, 1.0, 1.0)]
    for surface in (s for solid in solids for s in solid):
        normals = _upright(surface.triangles_m)
        if surface.material in (Material.TILED_ROOF, Material.FLAT_ROOF, Material.SHEET):
            assert normals[:, 2].min() > 0.3
        if surface.material is Material.FACADE and len(surface.triangles_m) == 2:
            np.testing.assert_allclose(normals[:, 2], 0.0, atol=1e-9)
            # Texture runs upwards, and a wall's outside is to the right of its u axis.
            np.testing.assert_allclose(surface.v_axis, [0.0, 0.0, 1.0], atol=1e-9)
            outside = np.cross(surface.u_axis, surface.v_axis)
            np.testing.assert_allclose(normals, np.broadcast_to(outside, normals.shape), atol=1e-9)


def test_a_sunk_house_reaches_below_its_floor():
    surfaces = house(np.random.default_rng(1), Footprint(0.0, 0.0, 12.0, 8.0, 0.0), ground_m=50.0, sunk_m=3.0)
    lowest = min(float(s.triangles_m[..., 2].min()) for s in surfaces)
    assert lowest == pytest.approx(47.0)


def test_shrinking_a_square_moves_each_side_by_its_own():
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    np.testing.assert_allclose(shrunk(square, [1.0, 2.0, 3.0, 4.0]), [[4, 1], [8, 1], [8, 7], [4, 7]], atol=1e-12)


def test_turning_surfaces_turns_their_texture_with_them():
    wall = slab(np.random.default_rng(0), Footprint(5.0, 0.0, 20.0, 10.0, 0.0), 4)
    moved = turned(wall, 90.0)
    for before, after in zip(wall, moved, strict=True):
        x, y, z = before.triangles_m.T
        np.testing.assert_allclose(after.triangles_m.T, np.stack([-y, x, z]), atol=1e-9)
        inner = (before.triangles_m - before.origin_m) @ before.u_axis
        np.testing.assert_allclose((after.triangles_m - after.origin_m) @ after.u_axis, inner, atol=1e-9)


def test_city_blocks_share_their_streets():
    """From both sides a street has the same axis, width and markings."""
    streets = {}
    for block in blocks_near(4, 0.0, 0.0, 300.0, 300.0):
        for side in block.sides:
            key = (*np.round(side.first_uv, 6), *np.round(side.last_uv, 6))
            facts = (side.half_m, side.first_gap_m, side.last_gap_m, side.number, side.wide)
            assert streets.setdefault(key, facts) == facts
    assert len(streets) > 20


def test_city_buildings_stay_off_the_streets():
    for i in range(3):
        for block in mesh(7, i, 1):
            corners = np.concatenate(
                [
                    s.triangles_m.reshape(-1, 3)
                    for s in build_block(7, block).surfaces
                    if s.material in (Material.FACADE, Material.FLAT_ROOF, Material.TILED_ROOF)
                ]
                + [np.zeros((0, 3))]
            )
            if len(corners):
                own, here = street_map(block, corners[:, :2])
                assert own.all()
                assert here.plot_m.min() > -0.01


def test_suburban_houses_stay_off_the_streets():
    plan = suburb.SCENE.plan(2, SMALL)
    corners = np.concatenate([s.triangles_m.reshape(-1, 3) for s in plan.surfaces if s.material is Material.FACADE])
    uv = Footprint(0.0, 0.0, 1.0, 1.0, -plan.heading_deg).at(corners[:, :2])
    samples = _samples(len(uv), 0.1, seed=2)
    object.__setattr__(samples, "u_m", uv[:, 0].astype(np.float32))
    object.__setattr__(samples, "v_m", uv[:, 1].astype(np.float32))
    kerb_m = look_up(suburb.draw_ground, samples)[:, 0]
    assert kerb_m.min() > 2.5


def test_a_bent_plan_can_be_straightened():
    pq = np.random.default_rng(0).uniform(-800.0, 800.0, size=(500, 2))
    np.testing.assert_allclose(straight(9, bent(9, pq)), pq, atol=1e-3)


@pytest.mark.parametrize("name", SCENES)
def test_the_ground_map_depends_on_the_place_only(name):
    draw = SCENES[name].draw_ground
    u, v = np.meshgrid(np.arange(120) * 0.5, np.arange(100) * 0.5)
    whole = draw(3, u, v)
    assert whole.shape[2] % 4 == 0
    assert np.isfinite(whole).all()
    np.testing.assert_allclose(draw(3, u[20:60, 30:90], v[20:60, 30:90]), whole[20:60, 30:90], atol=1e-4)


@pytest.mark.parametrize(("name", "painter"), list(_painters()))
def test_painters_give_albedo(name, painter):
    means = []
    for footprint_m in (0.02, 0.1, 0.5, 2.0):
        for tint in ((0.06, 0.09, 0.03), (0.5, 0.48, 0.46) if name != "LEAVES" else (0.09, 0.11, 0.04)):
            painted = painter(_samples(4000, footprint_m, tint=tint))
            assert painted.albedo.shape == (4000, 3)
            assert np.isfinite(painted.albedo).all()
            assert painted.albedo.min() > -0.01
            assert np.percentile(painted.albedo, 99.5) < 0.95
            for extra in (painted.relief, painted.gloss):
                assert extra is None or np.isfinite(extra).all()
        means.append(painted.albedo.mean())
    # Coarse samples see the mean of what fine ones see.
    np.testing.assert_allclose(means, means[0], rtol=0.12)


@pytest.mark.parametrize(("name", "painter"), list(_painters()))
def test_painters_show_nothing_finer_than_their_samples(name, painter):
    fine, coarse = (painter(_samples(1200, f, line=True)).albedo.mean(axis=1) for f in (0.01, 1.0))
    assert np.abs(np.diff(coarse)).mean() < 0.5 * np.abs(np.diff(fine)).mean() + 1e-6
