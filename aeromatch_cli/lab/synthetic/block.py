"""render_block: plan the flight, build the scene, take every picture, write it all down."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import AeromatchError, ConfigError, WorkspaceError
from aeromatch_cli.executor import Executor, Progress
from aeromatch_cli.geometry.cameras import resized
from aeromatch_cli.lab.synthetic import flights, presets, receivers, write
from aeromatch_cli.lab.synthetic.flights import Flight
from aeromatch_cli.lab.synthetic.imagery import GroundImagery, load_imagery
from aeromatch_cli.lab.synthetic.lenses import REAL
from aeromatch_cli.lab.synthetic.light import Light
from aeromatch_cli.lab.synthetic.presets import PRESETS
from aeromatch_cli.lab.synthetic.raycast import RayCaster, check_installed
from aeromatch_cli.lab.synthetic.render import View, look_at, render_image
from aeromatch_cli.lab.synthetic.scene import SCENE_VERSION, Scene, build_scene, scene_digest
from aeromatch_cli.lab.synthetic.sensor import Development, meter
from aeromatch_cli.lab.synthetic.shade import Stage
from aeromatch_cli.lab.synthetic.stations import Station, taken_s
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.write import read_raster

SMALLEST_PX = 16
# Room around the pictures' footprints for what leans into them, and for what throws its shadow in from outside.
_MARGIN_M, _TALLEST_M = 40.0, 40.0
# A square kilometre of city is two million triangles, about a gigabyte.
_LARGEST_AREA_KM2 = 3.0
_LARGEST_SEED = 2**31 - 1
_TEXTURE_GSD_M = 0.08
_METER_PX, _METERED = 64, 3
_FLIGHT_STREAM, _POSE_NOISE_STREAM, _RECEIVER_STREAM = 103, 104, 105


@dataclass(frozen=True)
class SynthSummary:
    """What was rendered. images: names below OUT/images. gsd_m: ground sampling distance at the image centre."""

    out: Path
    preset: str
    flight: str
    seed: int
    images: tuple[str, ...]
    width_px: int
    height_px: int
    gsd_m: float
    solids: Mapping[str, int]
    seconds: float


@dataclass(frozen=True)
class _SceneKey:
    """What rebuilds a scene under its light; equal in every process."""

    scene: str
    seed: int
    area: Area
    texture: str


@dataclass(frozen=True)
class _Taking:
    """What all pictures of a block have in common. header: whether their files state the focal length."""

    header: bool
    readout_s: float
    speed_m_s: float

    def sweep_m(self, station: Station) -> FloatArray | None:
        """As `View` has it."""
        moved: FloatArray = self.readout_s * station.velocity_m_s(self.speed_m_s)
        return moved if moved.any() else None


@dataclass(frozen=True, eq=False)
class _Shot:
    """One picture to take. moment: its number in the block. taken_s: since the first one, None without a speed."""

    out: Path
    name: str
    key: _SceneKey
    light: Light
    flight: Flight
    station: Station
    moment: int
    settings: Development
    taking: _Taking
    taken_s: float | None


def render_block(
    out: Path,
    preset: str,
    *,
    seed: int = 0,
    width_px: int = 1000,
    height_px: int = 750,
    images: int = 12,
    flight: str = "nadir",
    lens: str = "SIMPLE_RADIAL",
    height_m: float | None = None,
    sun_deg: tuple[float, float] | None = None,
    texture: Path | None = None,
    readout_ms: float = 0.0,
    speed_m_s: float = 0.0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> SynthSummary:
    """Render a block into the folder `out`; equal arguments give equal files, byte for byte, whatever the jobs.

    flight: one of flight_plans.FLIGHTS. lens: one of geometry.cameras.MODELS, or lenses.REAL for one of the seed's for
    each camera, whose pictures state its focal length in EXIF. height_m: flying height above the datum instead of the
    preset's. sun_deg: azimuth and elevation of the first sortie's sun instead of the seed's. texture: folder of
    pictures to lay over the ground. readout_ms, speed_m_s: of a rolling shutter, from the first row to the last, while
    the aircraft flies along; poses are those of the middle of a picture. With a speed pictures state when they were
    taken. An interrupted call goes on where it was.
    Raises ConfigError on an unknown name, an impossible size or number, a folder that holds another block, or where no
    library casts rays;
    WorkspaceError where `out` cannot be written.
    """
    started = time.monotonic()
    check_installed()
    if not (0.0 <= readout_ms <= 1000.0 and 0.0 <= speed_m_s <= 100.0):
        raise ConfigError(
            f"a rolling shutter reads for 0 to 1000 ms at 0 to 100 m/s, got {readout_ms:g} ms at {speed_m_s:g} m/s"
        )
    if readout_ms > 0.0 and speed_m_s == 0.0:
        raise ConfigError("a rolling shutter shows nothing while the aircraft stands still; give --speed M_PER_S too")
    chosen = _checked(preset, seed, width_px, height_px, height_m, sun_deg)
    planned = flights.plan_flight(
        flight, images=images, width_px=width_px, height_px=height_px, height_m=height_m or chosen.height_m, lens=lens,
        rng=np.random.default_rng([seed, _FLIGHT_STREAM]),
    )  # fmt: skip
    names = tuple(f"{preset}_{i + 1:04d}.jpg" for i in range(images))
    lights = presets.lights(chosen, seed)
    if sun_deg is not None:
        lights = (Light(*sun_deg, lights[0].haze_per_km, lights[0].sky, lights[0].season), lights[1])
    key = _SceneKey(chosen.scene, seed, _area(planned, lights), str(texture or ""))
    shots = _shots(out, names, key, lights, planned, _Taking(lens == REAL, 1e-3 * readout_ms, speed_m_s))
    scene = _scene(key).scene
    facts = _truth_facts(preset, scene, planned, lights, names, shots)
    if readout_ms > 0.0:
        facts["rolling_shutter"] = {
            "readout_s": 1e-3 * readout_ms,
            "speed_m_s": speed_m_s,
            "velocities_m_s": {
                name: station.velocity_m_s(speed_m_s).tolist()
                for name, station in zip(names, planned.stations, strict=True)
            },
        }
    try:
        write.prepare(out, names, facts)
        heights_m = _take_all(shots, jobs, progress)
        _write_tables(out, names, planned, seed, heights_m)
        write.write_dem(out / "dem.tif", scene.ground)
        write.write_file(out / "truth.json", write.json_bytes(facts))
    except OSError as error:
        raise _unwritable(out, error) from error
    seconds = time.monotonic() - started
    gsd_m = flights.gsd_m(planned)
    return SynthSummary(out, preset, flight, seed, names, width_px, height_px, gsd_m, dict(scene.solids), seconds)


def _checked(
    preset: str, seed: int, width_px: int, height_px: int, height_m: float | None, sun_deg: tuple[float, float] | None
) -> presets.Preset:
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r} for a rendered block; use one of: {', '.join(PRESETS)}")
    if width_px < SMALLEST_PX or height_px < SMALLEST_PX:
        raise ConfigError(
            f"rendered images must be at least {SMALLEST_PX} px wide and high, got {width_px}x{height_px}"
        )
    if not 0 <= seed <= _LARGEST_SEED:
        raise ConfigError(f"the seed of a rendered block must be 0 to {_LARGEST_SEED}, got {seed}")
    if height_m is not None and not 1.0 <= height_m <= 10_000.0:
        raise ConfigError(f"the flying height of a rendered block must be 1 to 10000 m, got {height_m:g}")
    if sun_deg is not None and not (0.0 <= sun_deg[0] <= 360.0 and 5.0 <= sun_deg[1] <= 90.0):
        raise ConfigError(f"the sun must stand at azimuth 0-360 and elevation 5-90 degrees, got {sun_deg}")
    return PRESETS[preset]


def _area(flight: Flight, lights: tuple[Light, Light]) -> Area:
    """Where solids stand: what the pictures show and what reaches into it. Raises ConfigError where it is too large."""
    lowest_deg = min(lights[station.sortie].sun_elevation_deg for station in flight.stations)
    area = flights.ground_area(flight, max(_MARGIN_M, _TALLEST_M / np.tan(np.deg2rad(lowest_deg))))
    size_km2 = (area.x1_m - area.x0_m) * (area.y1_m - area.y0_m) * 1e-6
    if size_km2 > _LARGEST_AREA_KM2:
        raise ConfigError(
            f"the pictures cover {size_km2:.1f} square kilometres, more than the {_LARGEST_AREA_KM2:g} that a scene "
            "may have: use fewer --images, a lower --height, or another --flight"
        )
    return area


@dataclass(frozen=True, eq=False)
class _Built:
    scene: Scene
    caster: RayCaster
    imagery: GroundImagery | None


@lru_cache(maxsize=1)
def _scene(key: _SceneKey) -> _Built:
    """The scene of a block, built once per process."""
    scene = build_scene(key.scene, key.seed, key.area)
    imagery = load_imagery(Path(key.texture), _TEXTURE_GSD_M, key.seed) if key.texture else None
    return _Built(scene, RayCaster(scene), imagery)


@lru_cache(maxsize=2)
def _stage(key: _SceneKey, light: Light) -> Stage:
    built = _scene(key)
    return Stage(built.scene, built.caster, light, built.imagery)


def _shots(
    out: Path,
    names: tuple[str, ...],
    key: _SceneKey,
    lights: tuple[Light, Light],
    flight: Flight,
    taking: _Taking,
) -> list[_Shot]:
    metered = {
        sortie: _metered(key, lights[sortie], flight, [s for s in flight.stations if s.sortie == sortie])
        for sortie in sorted({s.sortie for s in flight.stations})
    }
    speed_m_s = taking.speed_m_s
    times_s = taken_s(flight.stations, speed_m_s) if speed_m_s else [None] * len(names)
    return [
        _Shot(
            out, name, key, lights[station.sortie], flight, station, i,
            presets.development(key.seed, i, station.sortie, metered[station.sortie]), taking, time_s,
        )
        for i, (name, station, time_s) in enumerate(zip(names, flight.stations, times_s, strict=True))
    ]  # fmt: skip


def _metered(key: _SceneKey, light: Light, flight: Flight, stations: list[Station]) -> float:
    """One exposure for a sortie, from small looks at a few of its pictures."""
    seen = []
    for station in stations[:: max(1, len(stations) // _METERED)][:_METERED]:
        view = _view(flight, station, 0)
        scale = _METER_PX / view.camera.width_px
        height = max(1, round(view.camera.height_px * scale))
        small = resized(view.camera, scale, _METER_PX, height)
        seen.append(look_at(_stage(key, light), View(small, view.world_rotation, view.center_m, 0)))
    return meter(np.concatenate(seen))


def _view(flight: Flight, station: Station, moment: int) -> View:
    pose = station.exterior.pose()
    assert pose.world_rotation is not None
    return View(flight.cameras[station.camera_id], pose.world_rotation, pose.center_m, moment)


def _take_all(shots: list[_Shot], jobs: int, progress: Progress | None) -> FloatArray:
    """Render and write every image; returns surface heights (N,) of a sample of all pixels."""
    with Executor("processes", jobs, progress) as executor:
        outcomes = executor.run(_take, shots, "synth")
    for outcome in outcomes:
        if outcome.value is None:
            raise AeromatchError(outcome.error)
    return np.concatenate([outcome.value for outcome in outcomes if outcome.value is not None])


def _take(shot: _Shot) -> FloatArray:
    """Make one picture and its truth, unless they are there already; returns heights as `_heights`."""
    scene = _scene(shot.key).scene
    if (shot.out / "images" / shot.name).is_file():  # written last, whole or not at all
        return _heights(scene, read_raster(write.surface_path(shot.out, shot.name)))
    view = replace(_view(shot.flight, shot.station, shot.moment), sweep_m=shot.taking.sweep_m(shot.station))
    rng = presets.image_rng(shot.key.seed, shot.moment)
    rendered = render_image(_stage(shot.key, shot.light), view, shot.settings, rng)
    try:
        write.write_rendered(shot.out, shot.name, rendered, shot.settings.jpeg_quality, partial(_headed, shot))
    except OSError as error:
        raise _unwritable(shot.out, error) from error
    return _heights(scene, rendered.surface)


def _headed(shot: _Shot, jpeg: bytes) -> bytes:
    """Pictures of real lenses and of a moving aircraft say what real ones do."""
    camera_id = shot.station.camera_id
    camera = shot.flight.cameras[camera_id] if shot.taking.header else None
    headed = camera is not None or shot.taken_s is not None
    return write.with_header(jpeg, camera_id, camera, shot.taken_s) if headed else jpeg


def _heights(scene: Scene, surface: NDArray[np.uint32]) -> FloatArray:
    """World z of the middle of the triangle that every 16th pixel sees."""
    seen = surface.reshape(-1)[::16].astype(np.int64)
    heights: FloatArray = scene.triangles_m[seen[seen > 0] - 1, :, 2].mean(axis=1)
    return heights


def _write_tables(out: Path, names: tuple[str, ...], flight: Flight, seed: int, heights_m: FloatArray) -> None:
    rng = np.random.default_rng([seed, _POSE_NOISE_STREAM])
    exact = tuple(station.exterior for station in flight.stations)
    noisy = tuple(flights.noisy(station.exterior, rng, station.height_m) for station in flight.stations)
    cameras = tuple(station.camera_id for station in flight.stations)
    write.write_file(out / "poses.csv", write.pose_table(names, exact, cameras))
    write.write_file(out / "poses_noisy.csv", write.pose_table(names, noisy, cameras))
    centers_m = np.array([[e.x_m, e.y_m, e.z_m] for e in exact])
    rng = np.random.default_rng([seed, _RECEIVER_STREAM])
    for kind, errors_m, sigmas_m in (
        ("rtk", receivers.rtk_errors_m(len(exact), rng), receivers.RTK_M),
        ("gps", receivers.gps_errors_m(len(exact), rng), receivers.GPS_M),
    ):
        table = write.position_table(names, centers_m + errors_m, sigmas_m, cameras)
        write.write_file(out / f"poses_{kind}.csv", table)
    write.write_file(out / "block.json", write.json_bytes(write.block_facts(flight, names, heights_m)))


def _truth_facts(
    preset: str,
    scene: Scene,
    flight: Flight,
    lights: tuple[Light, Light],
    names: tuple[str, ...],
    shots: list[_Shot],
) -> dict[str, Any]:
    return {
        "format": write.TRUTH_FORMAT,
        "scene_version": SCENE_VERSION,
        "preset": preset,
        "scene": scene.name,
        "seed": scene.seed,
        "area_m": asdict(scene.area),
        "scene_sha256": scene_digest(scene),
        "solids": dict(scene.solids),
        "flight": flight.name,
        "gsd_m": round(flights.gsd_m(flight), 6),
        "pose_noise": {
            "share_of_height": flights.NOISE_SHARE_OF_HEIGHT,
            "angle_deg": flights.NOISE_ANGLE_DEG,
        },
        "lights": [asdict(light) for light in lights],
        "images": [
            {"name": name, "sortie": shot.station.sortie, "height_m": shot.station.height_m} | asdict(shot.settings)
            for name, shot in zip(names, shots, strict=True)
        ],
    }


def _unwritable(out: Path, error: OSError) -> WorkspaceError:
    where = error.filename or out
    return WorkspaceError(
        f"the rendered block cannot be written to {where}: {error.strerror}; choose a folder that can be written"
    )
