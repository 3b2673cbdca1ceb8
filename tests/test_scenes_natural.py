"""The natural scenes: terrain as stated, content that depends on seed and place only, painters in range."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import RELIEF_REACH_M, random_waves, turned, unturned
from aeromatch_cli.lab.synthetic.noise import octave, octave_slope, slopes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples
from aeromatch_cli.lab.synthetic.scenes import SceneKind, desert, farmland, grass, hills, parcels, water_edge
from aeromatch_cli.lab.synthetic.scenes.growth import winding_path
from aeromatch_cli.lab.synthetic.solids import Material, Surface
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.water import BANK_M, DEEPEST_M, LEVEL_M, paint_water, shore

pytestmark = pytest.mark.slow

_SCENES = {
    "farmland": farmland.SCENE,
    "grass": grass.SCENE,
    "desert": desert.SCENE,
    "hills": hills.SCENE,
    "water-edge": water_edge.SCENE,
}
_EACH = pytest.mark.parametrize("scene", _SCENES.values(), ids=_SCENES)
_SMALL, _LARGE = Area(-60.0, -45.0, 50.0, 55.0), Area(-130.0, -90.0, 95.0, 120.0)


def _samples(
    uv_m: FloatArray, footprint_m: float, *, seed: int = 4, moment: int = 0, slope: float = 0.0, z_m: float = 1.0
) -> Samples:
    count = len(uv_m)
    uv = uv_m.astype(np.float32)

    def same(value: float) -> FloatArray:
        return np.full(count, value, dtype=np.float32)

    return Samples(
        u_m=uv[:, 0], v_m=uv[:, 1], z_m=same(z_m), footprint_m=same(footprint_m), shift_m=same(0.0),
        size_m=np.ones((count, 2), dtype=np.float32), tint=np.ones((count, 3), dtype=np.float32),
        salt=np.full(count, seed * 101), slope=np.full((count, 2), slope, dtype=np.float32), seed=seed, moment=moment,
    )  # fmt: skip


def _grid(half_m: float, step_m: float) -> FloatArray:
    steps = np.arange(-half_m, half_m, step_m)
    return np.stack(np.meshgrid(steps, steps), axis=2).reshape(-1, 2)


def _solids(surfaces: list[Surface], inside: Area) -> set[bytes]:
    """Surfaces whose first triangle lies well inside an area, as bytes."""
    near = inside.grown(-12.0)
    return {
        s.triangles_m.round(6).tobytes()
        for s in surfaces
        if s.material != Material.WATER and near.contains(*s.triangles_m[0, 0, :2].tolist())
    }


@_EACH
def test_same_seed_gives_the_same_scene_and_another_seed_another(scene: SceneKind) -> None:
    xy = _grid(80.0, 9.0)
    first, second, other = (scene.plan(seed, Area(-30.0, -40.0, 35.0, 25.0)) for seed in (5, 5, 6))
    assert np.array_equal(first.terrain.height_m(xy), second.terrain.height_m(xy))
    assert len(first.surfaces) == len(second.surfaces)
    assert first.solids == second.solids
    assert all(
        np.array_equal(a.triangles_m, b.triangles_m) for a, b in zip(first.surfaces, second.surfaces, strict=True)
    )
    assert not np.allclose(first.terrain.height_m(xy), other.terrain.height_m(xy), atol=1e-3)


@_EACH
def test_larger_area_only_adds(scene: SceneKind) -> None:
    small, large = scene.plan(7, _SMALL), scene.plan(7, _LARGE)
    xy = _grid(70.0, 7.0)
    assert np.array_equal(small.terrain.height_m(xy), large.terrain.height_m(xy))
    assert small.heading_deg == large.heading_deg
    # Whatever stands well inside the small area stands in both.
    assert _solids(small.surfaces, _SMALL) == _solids(large.surfaces, _SMALL)
    assert all(large.solids[kind] >= count for kind, count in small.solids.items())


@_EACH
def test_terrain_is_smooth_float64(scene: SceneKind) -> None:
    """Second differences of a smooth surface fall with the square of the step."""
    terrain = scene.plan(3, _SMALL).terrain
    xy = _grid(150.0, 11.0)
    assert terrain.height_m(xy).dtype == np.float64
    bends = []
    for step in (0.4, 0.1):
        left, right = (terrain.height_m(xy + np.array([side * step, 0.0])) for side in (-1.0, 1.0))
        bends.append(np.abs(left + right - 2.0 * terrain.height_m(xy)))
    # The bank of the lake has one bend at the water line, where beach and bed meet with equal slope.
    assert np.quantile(bends[1], 0.98) <= np.quantile(bends[0], 0.98) / 8.0
    assert terrain.cell_m is not None
    assert 1.0 <= terrain.cell_m <= 4.0


@pytest.mark.parametrize("seed", [0, 1, 9])
@pytest.mark.parametrize(
    ("scene", "low_m", "high_m"),
    [
        (grass.SCENE, *grass.RELIEF_M),
        (farmland.SCENE, *farmland.RELIEF_M),
        (hills.SCENE, *hills.RELIEF_M),
        (desert.SCENE, 2.0, 11.0),
        (water_edge.SCENE, -DEEPEST_M, -DEEPEST_M + BANK_M + 3.0),
    ],
    ids=["grass", "farmland", "hills", "desert", "water-edge"],
)
def test_relief_is_as_stated(scene: SceneKind, low_m: float, high_m: float, seed: int) -> None:
    heights = scene.plan(seed, _SMALL).terrain.height_m(_grid(RELIEF_REACH_M, 3.0))
    # The stated relief is measured at crossings 10 m apart; between them the land rises and falls a little more.
    assert low_m * 0.95 <= np.ptp(heights) <= high_m * 1.08


@pytest.mark.parametrize(
    ("scene", "least", "most"),
    [(grass.SCENE, 0.001, 0.08), (farmland.SCENE, 0.005, 0.15), (desert.SCENE, 0.4, 0.8), (hills.SCENE, 0.35, 1.3)],
    ids=["grass", "farmland", "desert", "hills"],
)
def test_steepest_slopes_are_natural(scene: SceneKind, least: float, most: float) -> None:
    terrain = scene.plan(2, _SMALL).terrain
    xy = _grid(200.0, 3.0)
    climb = [
        (terrain.height_m(xy + np.array(step)) - terrain.height_m(xy - np.array(step))) / 0.2
        for step in ((0.1, 0.0), (0.0, 0.1))
    ]
    assert least <= np.quantile(np.hypot(*climb), 0.999) <= most


def test_dunes_fall_more_steeply_than_they_rise() -> None:
    land = desert.dunes(8)
    u = np.arange(-200.0, 200.0, 0.5)
    uv = np.stack([np.tile(u, 20), np.repeat(np.arange(20) * 17.0, len(u))], axis=1)
    climb = np.diff(land.height_m(unturned(uv, land.heading_deg)).reshape(20, -1), axis=1) / 0.5
    assert -np.quantile(climb, 0.005) > 2.0 * np.quantile(climb, 0.995)


@_EACH
@pytest.mark.parametrize("footprint_m", [0.02, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("slope", [0.0, 0.7])
def test_ground_is_painted_in_range(scene: SceneKind, footprint_m: float, slope: float) -> None:
    painted = scene.paint_ground(_samples(_grid(40 * footprint_m, footprint_m), footprint_m, slope=slope))
    _assert_in_range(painted)
    assert painted.albedo.dtype == np.float32


def _assert_in_range(painted: Painted) -> None:
    # Noise is Gaussian: a sample in a thousand may leave the range, and is clipped by whoever lights it.
    assert np.isfinite(painted.albedo).all()
    assert np.quantile(painted.albedo, 0.001) > -0.01
    assert np.quantile(painted.albedo, 0.999) < 1.0
    assert painted.relief is not None
    assert np.isfinite(painted.relief).all()
    assert np.abs(painted.relief).max() < 3.0
    assert painted.gloss is None or (painted.gloss.min() >= 0.0 and painted.gloss.max() <= 1.0)


@_EACH
def test_land_stands_still_and_looks_the_same_in_parts(scene: SceneKind) -> None:
    samples = _samples(_grid(8.0, 0.25), 0.1)
    painted, later = scene.paint_ground(samples), scene.paint_ground(replace(samples, moment=3))
    assert np.array_equal(painted.albedo, later.albedo)
    some = np.arange(0, len(samples.u_m), 7)
    assert np.allclose(scene.paint_ground(samples.part(some)).albedo, painted.albedo[some], atol=1e-5)


@_EACH
def test_coarse_samples_see_the_mean_of_fine_ones(scene: SceneKind) -> None:
    """Band limits: a sample of 2 m is about the mean of the samples within it, so that nothing flickers."""
    centers = _grid(60.0, 12.0) + 3.0
    fine = (centers[:, None] + _grid(1.0, 0.1)[None]).reshape(-1, 2)
    mean = scene.paint_ground(_samples(fine, 0.1)).albedo.reshape(len(centers), -1, 3).mean(axis=(1, 2))
    coarse = scene.paint_ground(_samples(centers, 2.0)).albedo.mean(axis=1)
    assert np.median(np.abs(coarse - mean)) < 0.15 * mean.mean()
    assert coarse.mean() == pytest.approx(mean.mean(), rel=0.1)


def test_water_moves_and_its_bed_shows_near_the_shore() -> None:
    land = shore(4)
    uv = _grid(60.0, 0.5)
    inland = land.inland_m(uv[:, 0], uv[:, 1])
    first, second = (paint_water(_samples(uv, 0.1, moment=moment)) for moment in (0, 1))
    _assert_in_range(first)
    assert first.relief is not None
    assert second.relief is not None
    assert np.abs(first.relief - second.relief).mean() > 0.03
    deep, shallow = inland < -30.0, (inland < -1.0) & (inland > -4.0)
    assert first.albedo[deep].mean() < 0.06 < first.albedo[shallow].mean()
    # What differs between two moments is the light on the waves, hardly the bed below.
    assert np.abs(first.albedo - second.albedo)[deep].mean() < 0.01


@pytest.mark.parametrize("seed", [1, 4, 12])
def test_water_lies_level_over_sunken_ground(seed: int) -> None:
    plan = water_edge.SCENE.plan(seed, _SMALL)
    sheet = next(s for s in plan.surfaces if s.material == Material.WATER)
    assert np.all(sheet.triangles_m[..., 2] == LEVEL_M)
    land = shore(seed)
    uv = _grid(250.0, 5.0)
    heights = land.height_m(unturned(uv, land.heading_deg))
    inland = land.inland_m(uv[:, 0], uv[:, 1])
    assert np.all(heights[inland < -0.1] < LEVEL_M)
    assert np.all(heights[inland > 0.1] > LEVEL_M)
    # Beyond the edge of the sheet there is land alone.
    assert heights[uv[:, 1] > 80.0].min() > LEVEL_M
    assert plan.solids["piers"] >= 1


def test_rows_of_a_field_have_their_period() -> None:
    """The strongest wavelength of the brightness and of the relief across a field's rows is the crop's."""
    seed, step_m, count = 4, 0.02, 1500
    found = 0
    for column in range(-4, 3):
        for row in range(-3, 3):
            at = np.array([float(column)]), np.array([float(row)])
            u0 = float(parcels.border_u_m(at[0], seed)[0]) + 16.0
            v0 = float(parcels.border_v_m(at[0], at[1], seed)[0]) + 22.0
            fields = parcels.parcels_at(np.array([u0]), np.array([v0]), seed)
            crop = farmland.CROPS[int(farmland.crop_index(fields, seed)[0])]
            across_u = bool(farmland.row_coordinates(fields, seed)[2][0])
            if crop.row_m not in (0.55, 0.75) or parcels.is_farm(*at, seed)[0]:
                continue
            line = np.arange(count) * step_m
            # Sixteen lines side by side, so that clods and weeds average out.
            u, v = (u0 + line, np.full(count, v0)) if across_u else (np.full(count, u0), v0 + line)
            profiles = [_profile(u + (not across_u) * k, v + across_u * k, seed, across_u) for k in np.arange(16) * 0.7]
            for profile in np.mean(profiles, axis=0):
                spectrum = np.abs(np.fft.rfft((profile - profile.mean()) * np.hanning(count)))
                spectrum[:10] = 0.0
                assert count * step_m / float(np.argmax(spectrum)) == pytest.approx(crop.row_m, rel=0.03)
            found += 1
    assert found >= 4


def _profile(u_m: FloatArray, v_m: FloatArray, seed: int, across_u: bool) -> FloatArray:
    """Brightness and slope across the rows (2, N) along a line in bent coordinates."""
    uv = np.stack(parcels.unbent(u_m, v_m, seed), axis=1)
    painted = farmland.SCENE.paint_ground(_samples(uv, 0.02, seed=seed))
    assert painted.relief is not None
    return np.stack([painted.albedo.mean(axis=1), painted.relief[:, 0 if across_u else 1]])


def test_bent_coordinates_invert() -> None:
    u, v = np.moveaxis(_grid(300.0, 31.0), -1, 0)
    again = parcels.bent(*parcels.unbent(u, v, 3), 3)
    assert np.allclose(again, (u, v), atol=1e-6)
    xy = _grid(50.0, 9.0)
    assert np.allclose(unturned(turned(xy, 33.0), 33.0), xy, atol=1e-12)


def test_grass_has_little_texture() -> None:
    """Contrast of a lawn in photographs: some per cent of its brightness, more between its blades."""
    coarse = grass.SCENE.paint_ground(_samples(_grid(60.0, 1.0), 0.5)).albedo.mean(axis=1)
    fine = grass.SCENE.paint_ground(_samples(_grid(3.0, 0.02), 0.02)).albedo.mean(axis=1)
    assert 0.02 < coarse.std() / coarse.mean() < 0.16
    assert 0.08 < fine.std() / fine.mean() < 0.30


def test_trees_stand_on_the_slope() -> None:
    plan = hills.SCENE.plan(1, _LARGE)
    assert plan.solids["trees"] > 20
    for surface in plan.surfaces:
        lowest = surface.triangles_m.reshape(-1, 3)
        foot = lowest[np.argmin(lowest[:, 2])]
        above = foot[2] - float(plan.terrain.height_m(foot[None, :2])[0])
        assert -6.0 < above < 14.0


def test_slope_of_noise_is_its_derivative() -> None:
    uv = np.random.default_rng(1).uniform(-60.0, 60.0, size=(4000, 2)).astype(np.float32)
    u, v, step = uv[:, 0], uv[:, 1], np.float32(0.1)
    slope = octave_slope(u, v, 8.0, 2, 5)
    numeric = np.stack(
        [octave(u + step, v, 8.0, 2, 5) - octave(u - step, v, 8.0, 2, 5),
         octave(u, v + step, 8.0, 2, 5) - octave(u, v - step, 8.0, 2, 5)], axis=1
    )  # fmt: skip
    assert np.corrcoef(numeric.ravel(), slope.ravel())[0, 1] > 0.9
    assert np.sqrt((slope**2).sum(axis=1).mean()) == pytest.approx(0.95, abs=0.1)
    nothing = slopes(u, v, np.full(len(u), 5.0, dtype=np.float32), ((8.0, 0.3),), 2, 5)
    assert np.all(nothing == 0.0)


def test_waves_have_unit_variance_and_their_slope_is_exact() -> None:
    waves = random_waves((3, 1), 20.0, 90.0, 12)
    xy = np.random.default_rng(2).uniform(-3000.0, 3000.0, size=(20000, 2))
    assert waves.at(xy[:, 0], xy[:, 1]).std() == pytest.approx(1.0, rel=0.05)
    step = 1e-4
    numeric = (waves.at(xy[:, 0] + step, xy[:, 1]) - waves.at(xy[:, 0] - step, xy[:, 1])) / (2.0 * step)
    assert np.allclose(waves.slope_at(xy[:, 0], xy[:, 1])[:, 0], numeric, atol=1e-6)


def test_paths_are_as_wide_as_asked() -> None:
    """Area of a path over the length of its middle line."""
    step = 0.25
    samples = _samples(_grid(120.0, step), 0.1)
    area, middle = (winding_path(samples, 150.0, width, 9)[0].sum() * step**2 for width in (2.0, 1.0))
    assert area > 50.0
    assert area / middle == pytest.approx(2.0, rel=0.12)


def test_planning_is_fast() -> None:
    for scene in _SCENES.values():
        start = time.process_time()
        scene.plan(1, Area(-200.0, -200.0, 200.0, 200.0))
        assert time.process_time() - start < 4.0  # a second on an idle machine
