"""A rendered block on disk: pictures as a user would have them, and the truth beside them.

OUT/images/town_0001.jpg ...   the pictures
OUT/poses.csv                  exact: image,x,y,z,omega_deg,phi_deg,kappa_deg; metres, degrees
OUT/poses_noisy.csv            the same with Gaussian noise, whose sigmas truth.json states
OUT/block.json                 camera (COLMAP's names and corner origin), crs, percentiles of the surface heights
OUT/truth/town_0001.npz        depth_m: (H, W) float32, metres along the optical axis at pixel centres, NaN for sky
OUT/truth.json                 preset, seed and what else rebuilds the scene; written last
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.errors import ConfigError, WorkspaceError
from aeromatch_cli.geometry.cameras import colmap_params, focal_px
from aeromatch_cli.synthetic import flight
from aeromatch_cli.synthetic.flight import Exterior
from aeromatch_cli.synthetic.raycast import RayCaster
from aeromatch_cli.synthetic.render import RayGrid, Rendered, ray_grid, render_image
from aeromatch_cli.synthetic.scene import SCENE_VERSION, Scene, build_scene, scene_digest

TRUTH_FORMAT = "aeromatch rendered block"
POSE_COLUMNS = ("image", "x", "y", "z", "omega_deg", "phi_deg", "kappa_deg")
SMALLEST_PX = 16
IMAGE_NOISE_SIGMA, JPEG_QUALITY = 1.5, 95
_EXPOSURE, _EXPOSURE_SIGMA = 0.8, 0.03
# Independent random streams of one seed; build_scene uses 1 and 2.
_FLIGHT_STREAM, _POSE_NOISE_STREAM, _IMAGE_STREAM = 3, 4, 5


@dataclass(frozen=True)
class SynthSummary:
    """What was rendered. images: names below OUT/images. gsd_m: ground sampling distance at the image centre."""

    out: Path
    preset: str
    seed: int
    images: tuple[str, ...]
    width_px: int
    height_px: int
    gsd_m: float
    solids: Mapping[str, int]
    seconds: float


def render_block(
    out: Path,
    preset: str,
    *,
    seed: int = 0,
    width_px: int = 1000,
    height_px: int = 750,
    images: int = 12,
    progress: Callable[[int, int], None] | None = None,
) -> SynthSummary:
    """Render a block into the folder `out`; equal arguments give equal files, byte for byte.

    progress: called with (done, total) after each image. Raises ConfigError on an unknown preset, an impossible size or
    number, or a folder that holds another block; WorkspaceError where `out` cannot be written.
    """
    started = time.monotonic()
    if images < 1:
        raise ConfigError(f"a block needs at least 1 image, got {images}")
    if width_px < SMALLEST_PX or height_px < SMALLEST_PX:
        raise ConfigError(
            f"rendered images must be at least {SMALLEST_PX} px wide and high, got {width_px}x{height_px}"
        )
    camera = flight.make_camera(width_px, height_px)
    if seed < 0:
        raise ConfigError(f"the seed of a rendered block must be 0 or larger, got {seed}")
    flown = flight.plan_flight(camera, images, np.random.default_rng([seed, _FLIGHT_STREAM]))
    scene = build_scene(preset, seed, flight.reach_m(camera, flown))
    names = tuple(f"{preset}_{i + 1:04d}.jpg" for i in range(images))
    try:
        _prepare(out, names)
        heights_m = _write_images(out, names, scene, camera, flown, progress)
        noise = np.random.default_rng([seed, _POSE_NOISE_STREAM])
        _write(out / "poses.csv", _pose_table(names, flown))
        _write(out / "poses_noisy.csv", _pose_table(names, tuple(flight.noisy(e, noise) for e in flown)))
        _write(out / "block.json", _json(_block_facts(camera, names, heights_m)))
        _write(out / "truth.json", _json(_truth_facts(scene, camera, names)))
    except OSError as error:
        where = error.filename or out
        raise WorkspaceError(
            f"the rendered block cannot be written to {where}: {error.strerror}; choose a folder that can be written"
        ) from error
    gsd_m = flight.HEIGHT_M / focal_px(camera)
    seconds = time.monotonic() - started
    return SynthSummary(out, preset, seed, names, width_px, height_px, gsd_m, dict(scene.solids), seconds)


def _prepare(out: Path, names: tuple[str, ...]) -> None:
    """Make the folders; an interrupted block is gone over again, another block is not mixed with this one."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    (out / "truth").mkdir(exist_ok=True)
    foreign = sorted(p.name for p in (out / "images").iterdir() if p.name not in names and not p.name.startswith("."))
    if foreign:
        raise ConfigError(
            f"{out / 'images'} already holds other files ({foreign[0]} and {len(foreign) - 1} more); "
            "choose an empty folder for the rendered block"
        )
    (out / "truth.json").unlink(missing_ok=True)


def _write_images(
    out: Path,
    names: tuple[str, ...],
    scene: Scene,
    camera: Camera,
    flown: tuple[Exterior, ...],
    progress: Callable[[int, int], None] | None,
) -> FloatArray:
    """Render and write every image; returns surface heights (N,) of a sample of all pixels."""
    caster, rays = RayCaster(scene), ray_grid(camera)
    heights_m = []
    for i, (name, exterior) in enumerate(zip(names, flown, strict=True)):
        rendered = _take(scene, caster, rays, exterior, i)
        _write(out / "images" / name, _jpeg(rendered.pixels))
        _write(depth_path(out, name), _npz(depth_m=rendered.depth_m))
        heights_m.append(_heights(rays, exterior, rendered))
        if progress is not None:
            progress(i + 1, len(names))
    return np.concatenate(heights_m)


def _take(scene: Scene, caster: RayCaster, rays: RayGrid, exterior: Exterior, image_idx: int) -> Rendered:
    rng = np.random.default_rng([scene.seed, _IMAGE_STREAM, image_idx])
    exposure = _EXPOSURE * float(np.exp(_EXPOSURE_SIGMA * rng.standard_normal()))
    pose = exterior.pose()
    assert pose.world_rotation is not None
    return render_image(
        scene, caster, rays, pose.world_rotation, pose.center_m,
        exposure=exposure, noise_sigma=IMAGE_NOISE_SIGMA, rng=rng,
    )  # fmt: skip


def _heights(rays: RayGrid, exterior: Exterior, rendered: Rendered) -> FloatArray:
    """World z of every 16th pixel's surface."""
    pose = exterior.pose()
    assert pose.world_rotation is not None
    uv, depth_m = rays.uv.reshape(-1, 2)[::16], rendered.depth_m.reshape(-1)[::16]
    down = uv @ pose.world_rotation[:2, 2] + pose.world_rotation[2, 2]
    heights: FloatArray = (pose.center_m[2] + depth_m * down)[np.isfinite(depth_m)]
    return heights


def depth_path(out: Path, name: str) -> Path:
    """Where the depth of an image lies in a rendered block."""
    return out / "truth" / f"{Path(name).stem}.npz"


def _block_facts(camera: Camera, names: tuple[str, ...], heights_m: FloatArray) -> dict[str, Any]:
    lens = {
        "model": camera.model,
        "width": camera.width_px,
        "height": camera.height_px,
        "params": list(colmap_params(camera)),
    }
    ground_z = {f"p{p}": round(float(np.percentile(heights_m, p)), 3) + 0.0 for p in (5, 50, 95)}
    return {"crs": "local", "cameras": {"1": lens}, "ground_z": ground_z, "registered": len(names)}


def _truth_facts(scene: Scene, camera: Camera, names: tuple[str, ...]) -> dict[str, Any]:
    x, y, z = scene.to_sun
    return {
        "format": TRUTH_FORMAT,
        "scene_version": SCENE_VERSION,
        "preset": scene.preset,
        "seed": scene.seed,
        "half_extent_m": scene.half_extent_m,
        "scene_sha256": scene_digest(scene),
        "solids": dict(scene.solids),
        "sun_azimuth_deg": round(float(np.rad2deg(np.arctan2(x, y)) % 360.0), 6),
        "sun_elevation_deg": round(float(np.rad2deg(np.arcsin(z))), 6),
        "flying_height_m": flight.HEIGHT_M,
        "forward_overlap": flight.FORWARD_OVERLAP,
        "side_overlap": flight.SIDE_OVERLAP,
        "gsd_m": round(flight.HEIGHT_M / focal_px(camera), 6),
        "pose_noise_sigma_position_m": flight.NOISE_SHARE_OF_HEIGHT * flight.HEIGHT_M,
        "pose_noise_sigma_angle_deg": flight.NOISE_ANGLE_DEG,
        "image_noise_sigma": IMAGE_NOISE_SIGMA,
        "jpeg_quality": JPEG_QUALITY,
        "images": list(names),
    }


def _pose_table(names: tuple[str, ...], flown: tuple[Exterior, ...]) -> bytes:
    """repr() of a float64 is its shortest text that reads back to the same bits."""
    rows = [",".join(POSE_COLUMNS)]
    rows += [",".join([name, *(repr(v) for v in asdict(e).values())]) for name, e in zip(names, flown, strict=True)]
    return ("\n".join(rows) + "\n").encode()


def _json(facts: dict[str, Any]) -> bytes:
    return (json.dumps(facts, indent=1) + "\n").encode()


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    import cv2

    done, encoded = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise WorkspaceError(f"OpenCV cannot encode a JPEG of shape {pixels.shape}")
    return bytes(encoded)


def _npz(**arrays: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    """All of the file or none of it."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
