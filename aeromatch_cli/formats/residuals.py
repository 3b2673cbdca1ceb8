"""residuals.csv: adjusted poses beside those given, and how well each image fits its points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from aeromatch_cli.data import FloatArray, Image, PoseResidual
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.formats.tables import csv_text, read_csv

# Field of a residual -> its columns.
COLUMNS = {
    "position_m": ("dx_m", "dy_m", "dz_m"),
    "position_sigmas": ("dx_sigmas", "dy_sigmas", "dz_sigmas"),
    "rotation_deg": ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg"),
    "rotation_sigmas": ("rotation_x_sigmas", "rotation_y_sigmas", "rotation_z_sigmas"),
}


def fields_of(residual: PoseResidual | None) -> dict[str, float]:
    """Column -> value in the order of the file, NaN where it is unknown."""
    unknown = np.full(3, np.nan)
    found = {
        column: float(value)
        for field, columns in COLUMNS.items()
        for column, value in zip(columns, unknown if residual is None else getattr(residual, field), strict=True)
    }
    found["error_px"] = float("nan") if residual is None else residual.error_px
    found["points"] = 0 if residual is None else residual.points
    found["images_per_point"] = float("nan") if residual is None else residual.images_per_point
    return found


def residuals_text(residuals: Mapping[str, PoseResidual], images: Iterable[Image]) -> str:
    """One line per adjusted image, by name; empty cells where nothing was given."""
    rows = []
    for image in sorted(images, key=lambda image: image.name):
        if image.image_id in residuals:
            values = fields_of(residuals[image.image_id])
            rows.append((image.name, *(v if isinstance(v, int) else float(f"{v:.6g}") for v in values.values())))
    return csv_text(("image", *fields_of(None)), rows)


def read_residuals(path: Path, images: Iterable[Image]) -> dict[str, PoseResidual]:
    """By image_id. Raises BrokenFileError where it is missing or broken."""
    ids = {image.name: image.image_id for image in images}
    with readable(path, ValueError, KeyError):
        return {ids[row["image"]]: _residual(row) for row in read_csv(path)}


def _residual(row: Mapping[str, str]) -> PoseResidual:
    def numbers(columns: Iterable[str]) -> FloatArray:
        return np.array([float(row[column] or "nan") for column in columns])

    error_px, images_per_point = (float(value) for value in numbers(("error_px", "images_per_point")))
    position_m, position_sigmas, rotation_deg, rotation_sigmas = (numbers(columns) for columns in COLUMNS.values())
    return PoseResidual(
        position_m, position_sigmas, rotation_deg, rotation_sigmas, error_px, int(row["points"]), images_per_point
    )
