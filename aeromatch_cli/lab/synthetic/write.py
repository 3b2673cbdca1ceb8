"""A rendered block on disk: pictures as a user would have them, and the truth beside them.

OUT/images/city_0001.jpg ...         the pictures; of real lenses with a header that states the focal length
OUT/poses.csv                        exact: image,x,y,z,omega_deg,phi_deg,kappa_deg,camera; metres, degrees
OUT/poses_noisy.csv                  the same with Gaussian noise, whose sigmas truth.json states
OUT/poses_rtk.csv                    positions of an RTK receiver with their sigmas: image,x,y,z,sigma_x_m,...,camera
OUT/poses_gps.csv                    the same of a GPS receiver without corrections, which drifts
OUT/block.json                       cameras (COLMAP's names and corner origin), crs, percentiles of the surface heights
OUT/dem.tif                          bare ground, float32 metres at cell centres, in the block's local frame
OUT/truth/city_0001.depth.tif        (H, W) float32, metres along the optical axis at pixel centres, NaN for sky
OUT/truth/city_0001.surface.tif      (H, W) uint32, what is visible: 1 + the index of the triangle, 0 for sky
OUT/truth/city_0001.sun.png          (H, W) uint8, 255 x the share of the sun's disc in view; 0 also where the surface
                                     faces away from the sun. In shadow: below 128
OUT/truth.json                       scene, seed, flight, light and what else rebuilds the scene; written last. Of a
                                     rolling shutter: seconds from the first row to the last, speed, velocities. Poses
                                     are then of the middle row; depths count from each row's own projection centre
OUT/synth.json                       the same, written first: what an interrupted block goes on with
All rasters are lossless (TIFF: deflate with predictor; PNG).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.errors import ConfigError, InputError, WorkspaceError
from aeromatch_cli.geometry.cameras import corner_params
from aeromatch_cli.lab.synthetic.flights import Flight
from aeromatch_cli.lab.synthetic.lenses import focal_35mm
from aeromatch_cli.lab.synthetic.render import Rendered
from aeromatch_cli.lab.synthetic.stations import Exterior
from aeromatch_cli.lab.synthetic.terrain import GroundGrid

TRUTH_FORMAT = "aeromatch rendered block"
POSE_COLUMNS = ("image", "x", "y", "z", "omega_deg", "phi_deg", "kappa_deg", "camera")
IN_SHADOW_BELOW = 128
_FIRST_TAKEN = datetime(2026, 6, 1, 10, 0, tzinfo=UTC)


def depth_path(out: Path, name: str) -> Path:
    """Where the depth of an image lies in a rendered block."""
    return out / "truth" / f"{Path(name).stem}.depth.tif"


def surface_path(out: Path, name: str) -> Path:
    """Where the visible surfaces of an image lie in a rendered block."""
    return out / "truth" / f"{Path(name).stem}.surface.tif"


def sun_path(out: Path, name: str) -> Path:
    """Where the sunlight of an image lies in a rendered block."""
    return out / "truth" / f"{Path(name).stem}.sun.png"


def prepare(out: Path, names: tuple[str, ...], facts: dict[str, Any]) -> None:
    """Make the folders and note what block they are for: an interrupted one goes on, another one is not mixed in.

    facts: what truth.json will hold. Raises ConfigError where the folder holds another block or other pictures.
    """
    plan, wanted = out / "synth.json", json_bytes(facts)
    if plan.is_file() and plan.read_bytes() != wanted:
        raise ConfigError(f"{out} holds a block that was rendered otherwise (synth.json); choose another folder")
    (out / "images").mkdir(parents=True, exist_ok=True)
    (out / "truth").mkdir(exist_ok=True)
    present = sorted(p.name for p in (out / "images").iterdir() if not p.name.startswith("."))
    foreign = [name for name in present if name not in names or not plan.is_file()]
    if foreign:
        raise ConfigError(
            f"{out / 'images'} already holds other files ({foreign[0]} and {len(foreign) - 1} more); "
            "choose an empty folder for the rendered block"
        )
    write_file(plan, wanted)


def write_rendered(
    out: Path, name: str, rendered: Rendered, jpeg_quality: int, finish: Callable[[bytes], bytes]
) -> None:
    """One picture, its file as `finish` leaves it, and its truth."""
    import cv2

    deflate = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE, cv2.IMWRITE_TIFF_PREDICTOR]
    floating, horizontal = cv2.IMWRITE_TIFF_PREDICTOR_FLOATINGPOINT, cv2.IMWRITE_TIFF_PREDICTOR_HORIZONTAL
    write_file(depth_path(out, name), _encoded(".tif", rendered.depth_m, [*deflate, floating]))
    write_file(surface_path(out, name), _encoded(".tif", rendered.surface, [*deflate, horizontal]))
    write_file(sun_path(out, name), _encoded(".png", rendered.sun, []))
    bgr = np.ascontiguousarray(rendered.pixels[..., ::-1])
    write_file(out / "images" / name, finish(_encoded(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])))


def read_raster(path: Path) -> NDArray[Any]:
    """A truth raster as it was written. Raises InputError where it is missing or damaged."""
    import cv2

    try:
        raster = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error) as error:
        raise InputError(f"{path} cannot be read ({error}); render the block again") from error
    if raster is None:
        raise InputError(f"{path} is no raster; render the block again")
    return raster


def _encoded(suffix: str, raster: NDArray[Any], options: list[int]) -> bytes:
    import cv2

    done, encoded = cv2.imencode(suffix, raster, options)
    if not done:
        raise WorkspaceError(f"OpenCV cannot encode a {suffix} file of shape {raster.shape}; use a smaller --size")
    return bytes(encoded)


def write_dem(path: Path, ground: GroundGrid) -> None:
    """The bare ground as GeoTIFF: exact at the centres of its cells, which are crossings of the scene's triangles."""
    from rasterio.io import MemoryFile
    from rasterio.transform import from_origin

    x_m, y_m, z_m = ground.even_part()
    half = 0.5 * ground.cell_m
    transform = from_origin(x_m - half, y_m + (len(z_m) - 1) * ground.cell_m + half, ground.cell_m, ground.cell_m)
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=z_m.shape[1], height=z_m.shape[0], count=1, dtype="float32", transform=transform,
            compress="deflate", predictor=3,
        ) as raster:  # fmt: skip
            raster.write(z_m[::-1].astype(np.float32), 1)
        write_file(path, memory.read())


def pose_table(names: tuple[str, ...], exteriors: tuple[Exterior, ...], cameras: tuple[str, ...]) -> bytes:
    """repr() of a float64 is its shortest text that reads back to the same bits."""
    rows = [",".join(POSE_COLUMNS)]
    for name, exterior, camera in zip(names, exteriors, cameras, strict=True):
        rows.append(",".join([name, *(repr(v) for v in asdict(exterior).values()), camera]))
    return ("\n".join(rows) + "\n").encode()


def position_table(
    names: tuple[str, ...], positions_m: FloatArray, sigmas_m: tuple[float, float, float], cameras: tuple[str, ...]
) -> bytes:
    """Positions (N, 3) alone, to the millimetre."""
    rows = ["image,x,y,z,sigma_x_m,sigma_y_m,sigma_z_m,camera"]
    for name, position_m, camera in zip(names, positions_m, cameras, strict=True):
        rows.append(",".join([name, *(f"{v:.3f}" for v in position_m), *(f"{v:.3f}" for v in sigmas_m), camera]))
    return ("\n".join(rows) + "\n").encode()


def with_header(jpeg: bytes, camera_id: str, camera: Camera | None, taken_s: float | None) -> bytes:
    """The picture with a header as a camera writes it: make, model, of a camera that is given the 35-mm equivalent of
    its focal length in whole millimetres, and the time, to the millisecond, so long after the first picture."""
    from PIL import ExifTags, Image

    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "aeromatch", f"rendered {camera_id}"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    if camera is not None:
        details[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm(camera)
    if taken_s is not None:
        taken = _FIRST_TAKEN + timedelta(milliseconds=round(1000.0 * taken_s))
        details[ExifTags.Base.DateTimeOriginal] = f"{taken:%Y:%m:%d %H:%M:%S}"
        details[ExifTags.Base.SubsecTimeOriginal] = f"{taken.microsecond // 1000:03d}"
        details[ExifTags.Base.OffsetTimeOriginal] = "+00:00"
    content = exif.tobytes()
    segment = b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content
    return jpeg[:2] + segment + jpeg[2:]


def block_facts(flight: Flight, names: tuple[str, ...], heights_m: NDArray[Any]) -> dict[str, Any]:
    """What block.json holds."""
    ground_z = {f"p{p}": round(float(np.percentile(heights_m, p)), 3) + 0.0 for p in (5, 50, 95)}
    cameras = {camera_id: _lens(camera) for camera_id, camera in flight.cameras.items()}
    return {"crs": "local", "cameras": cameras, "ground_z": ground_z, "registered": len(names)}


def _lens(camera: Camera) -> dict[str, Any]:
    params = list(corner_params(camera))
    return {"model": camera.model, "width": camera.width_px, "height": camera.height_px, "params": params}


def json_bytes(facts: dict[str, Any]) -> bytes:
    return (json.dumps(facts, indent=1) + "\n").encode()


def write_file(path: Path, content: bytes) -> None:
    """All of the file or none of it."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
