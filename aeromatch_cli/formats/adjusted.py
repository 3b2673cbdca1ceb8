"""The block after bundle adjustment on file: its arrays, the matches that contradict it, and two tables for people.

adjusted.npz and dropped.npz are read by the program; orientation.csv and residuals.csv have one line per image.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Block, Camera, FloatArray, Image, IntArray, PoseResidual
from aeromatch_cli.formats.archives import load_arrays, save_arrays
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.formats.tables import csv_text, read_csv
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa

_POSES = ("rotations", "centers_m", "sigmas_m", "sigmas_deg", "sweeps_m")
_REST = (
    "images",
    "frames",
    "points_m",
    "errors_px",
    "track_images",
    "track_keypoints",
    "track_points",
    "cameras",
    "params",
)
# Columns of orientation.csv.
ORIENTATION = (
    "image", "x", "y", "z", "omega_deg", "phi_deg", "kappa_deg", "sigma_x_m", "sigma_y_m", "sigma_z_m",
    "sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg", "camera", "frame", "unit",
)  # fmt: skip
# image_id0, image_id1 -> fingerprint of the verified entry, and rows of its matches.
Dropped = Mapping[tuple[str, str], tuple[str, IntArray]]
_DROPPED_ARRAYS = ("images", "fingerprints", "counts", "rows", "least")
# Field of a residual -> its columns of residuals.csv.
_RESIDUAL_COLUMNS = {
    "position_m": ("dx_m", "dy_m", "dz_m"),
    "position_sigmas": ("dx_sigmas", "dy_sigmas", "dz_sigmas"),
    "rotation_deg": ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg"),
    "rotation_sigmas": ("rotation_x_sigmas", "rotation_y_sigmas", "rotation_z_sigmas"),
}


def write_adjusted(stream: BinaryIO, adjusted: AdjustedBlock) -> None:
    """An .npz without pickles; text as arrays of characters."""
    ids = sorted(adjusted.poses)
    poses = [adjusted.poses[i] for i in ids]
    lenses = sorted(adjusted.cameras)
    seen = [adjusted.tracks[i] for i in ids]
    cameras = [f"{c.model} {c.width_px} {c.height_px}" for c in (adjusted.cameras[k] for k in lenses)]
    params = [" ".join(map(repr, map(float, adjusted.cameras[k].params))) for k in lenses]
    save_arrays(
        stream,
        images=np.array(ids, dtype=np.str_),
        rotations=np.array([p.rotation for p in poses]).reshape(-1, 3, 3),
        centers_m=_rows([p.center_m for p in poses]),
        sigmas_m=_rows([p.sigmas_m for p in poses]),
        sigmas_deg=_rows([p.sigmas_deg for p in poses]),
        sweeps_m=_rows([p.sweep_m for p in poses]),
        frames=np.array([adjusted.frames.get(i, 0) for i in ids], dtype=np.int32),
        points_m=adjusted.points_m,
        errors_px=adjusted.errors_px,
        track_images=np.repeat(np.arange(len(ids), dtype=np.int32), [len(one) for one in seen]),
        track_keypoints=np.concatenate([np.zeros(0, np.int32), *(one[:, 0] for one in seen)]),
        track_points=np.concatenate([np.zeros(0, np.int32), *(one[:, 1] for one in seen)]),
        cameras=np.array([lenses, cameras], dtype=np.str_).reshape(2, -1),
        params=np.array(params, dtype=np.str_),
    )


def read_adjusted(path: Path) -> AdjustedBlock:
    """Raises BrokenFileError where it is missing or broken."""
    arrays = load_arrays(path, (*_POSES, *_REST))
    ids = [str(name) for name in arrays["images"]]
    cameras = {}
    for name, kind, params in zip(*arrays["cameras"], arrays["params"], strict=True):
        model, width, height = str(kind).split()
        cameras[str(name)] = Camera(model, int(width), int(height), tuple(map(float, str(params).split())))
    parts = zip(*(arrays[name] for name in _POSES), strict=True)
    poses = {
        name: AdjustedPose(center_m, rotation, sigmas_m, sigmas_deg, sweep_m)
        for name, (rotation, center_m, sigmas_m, sigmas_deg, sweep_m) in zip(ids, parts, strict=True)
    }
    both = np.column_stack([arrays["track_keypoints"], arrays["track_points"]]).astype(np.int32)
    ends = np.searchsorted(arrays["track_images"], np.arange(len(ids) + 1))  # written image by image
    tracks = {name: both[start:end] for name, (start, end) in zip(ids, pairwise(ends), strict=True)}
    frames = {name: int(number) for name, number in zip(ids, arrays["frames"], strict=True) if number}
    return AdjustedBlock(cameras, poses, arrays["points_m"], arrays["errors_px"], tracks, frames)


def orientation_text(adjusted: AdjustedBlock, block: Block) -> str:
    """orientation.csv: one line per image of known place, by name."""
    found = (orientation_fields(adjusted, block, image) for image in sorted(block.images, key=lambda one: one.name))
    return csv_text(ORIENTATION, [tuple(one.values()) for one in found if one is not None])


def orientation_fields(adjusted: AdjustedBlock, block: Block, image: Image) -> dict[str, str | float] | None:
    """A line of orientation.csv, in the block's CRS, NaN for what is not known; None where no place is.

    x, y, z: projection centre, metres. omega, phi, kappa: degrees, photogrammetric, against the grid of the CRS.
    sigma_*: their standard deviations. unit: of all lengths of the line, "m", or "arbitrary" in a frame whose scale is.
    frame: "world"; "own N" of images in a frame of their own, whose place, north and scale are arbitrary; "predicted"
    of images that are not oriented, by the pose that is known of them.
    """
    pose, known = adjusted.poses.get(image.image_id), block.poses.get(image.image_id)
    rotation: FloatArray | None
    if pose is not None:
        number = adjusted.frames.get(image.image_id)
        frame, sigmas = f"own {number}" if number else "world", [*pose.sigmas_m, *pose.sigmas_deg]
        center_m, rotation = pose.center_m, pose.rotation
    elif known is not None and not (block.metric and image.image_id in block.frames):
        frame, sigmas = "predicted", [known.sigma_position_m] * 3 + [known.sigma_angle_deg] * 3
        center_m, rotation = known.center_m, known.world_rotation
    else:
        return None
    metric = block.metric and not frame.startswith("own")
    # An origin of the CRS would make places of a frame that has none look like those of a map.
    place = [round(float(v), 4) for v in center_m + np.array(block.origin_m) * metric]
    angles = [np.nan] * 3 if rotation is None else [round(float(v), 6) for v in to_omega_phi_kappa(rotation)]
    known_of = [metric] * 3 + [rotation is not None] * 3
    deviations = [float(f"{v:.3g}") if known else np.nan for v, known in zip(sigmas, known_of, strict=True)]
    unit = "m" if metric else "arbitrary"
    values: tuple[str | float, ...] = (image.name, *place, *angles, *deviations, image.camera_id, frame, unit)
    return dict(zip(ORIENTATION, values, strict=True))


def _rows(values: list[FloatArray]) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(-1, 3)


def write_dropped(stream: BinaryIO, dropped: Dropped, least: int) -> None:
    """Write the rejected matches of every pair as an .npz without pickles. least: a pair that keeps fewer matches is
    rejected."""
    keys = sorted(dropped)
    save_arrays(
        stream,
        images=np.array(keys, dtype=np.str_).reshape(-1, 2),
        fingerprints=np.array([dropped[key][0] for key in keys], dtype=np.str_),
        counts=np.array([len(dropped[key][1]) for key in keys], dtype=np.int64),
        rows=np.concatenate([np.zeros(0, np.int32), *(dropped[key][1] for key in keys)]).astype(np.int32),
        least=np.array(least),
    )


def read_dropped(path: Path) -> tuple[Dropped, int]:
    """Read what `write_dropped` wrote; nothing where there is no file. Raises BrokenFileError where it is broken."""
    if not path.exists():
        return {}, 0
    arrays = load_arrays(path, _DROPPED_ARRAYS)
    rows = np.split(arrays["rows"], np.cumsum(arrays["counts"])[:-1]) if len(arrays["counts"]) else []
    found = {
        (str(id0), str(id1)): (str(made_of), own)
        for (id0, id1), made_of, own in zip(arrays["images"], arrays["fingerprints"], rows, strict=True)
    }
    return found, int(arrays["least"])


def residual_fields(residual: PoseResidual | None) -> dict[str, float]:
    """Return the values of a line of residuals.csv by their columns, NaN where they are unknown."""
    unknown = np.full(3, np.nan)
    found = {
        column: float(value)
        for field, columns in _RESIDUAL_COLUMNS.items()
        for column, value in zip(columns, unknown if residual is None else getattr(residual, field), strict=True)
    }
    found["error_px"] = float("nan") if residual is None else residual.error_px
    found["points"] = 0 if residual is None else residual.points
    found["images_per_point"] = float("nan") if residual is None else residual.images_per_point
    return found


def residuals_text(residuals: Mapping[str, PoseResidual], images: Iterable[Image]) -> str:
    """Return residuals.csv: one line per adjusted image, by name, with empty cells where nothing was given."""
    rows = []
    for image in sorted(images, key=lambda image: image.name):
        if image.image_id in residuals:
            values = residual_fields(residuals[image.image_id])
            # Rounding errors of positions that stay are no residuals; + 0.0 leaves no minus before a zero.
            rows.append((image.name, *(v if isinstance(v, int) else round(v, 6) + 0.0 for v in values.values())))
    return csv_text(("image", *residual_fields(None)), rows)


def read_residuals(path: Path, images: Iterable[Image]) -> dict[str, PoseResidual]:
    """Read residuals.csv, by image_id. Raises BrokenFileError where it is missing or broken."""
    ids = {image.name: image.image_id for image in images}
    with readable(path, ValueError, KeyError):
        return {ids[row["image"]]: _residual(row) for row in read_csv(path)}


def _residual(row: Mapping[str, str]) -> PoseResidual:
    def numbers(columns: Iterable[str]) -> FloatArray:
        return np.array([float(row[column] or "nan") for column in columns])

    error_px, images_per_point = (float(value) for value in numbers(("error_px", "images_per_point")))
    position_m, position_sigmas, rotation_deg, rotation_sigmas = (
        numbers(columns) for columns in _RESIDUAL_COLUMNS.values()
    )
    return PoseResidual(
        position_m, position_sigmas, rotation_deg, rotation_sigmas, error_px, int(row["points"]), images_per_point
    )
