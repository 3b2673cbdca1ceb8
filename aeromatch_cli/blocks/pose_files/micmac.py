"""MicMac: the folder Ori-<name> of Orientation-<image>.xml, one such file, and text for OriConvert (OriTxtInFile).

XML: `Centre` and the matrix camera to world (OpenCV's axes) of `CodageMatr`. Text: the first line says what the columns
are, such as `#F=N X Y Z W P K` (N name, W P K omega, phi, kappa in degrees, S skipped). No CRS is stated.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from aeromatch_cli.blocks.pose_files.source import Source, image_name, number, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError

_PREFIX = "Orientation-"
# Conventions whose matrix takes the camera to the world with OpenCV's axes.
_KNOWN = ("eConvApero_DistM2C", "")


def is_ori(source: Source) -> bool:
    if source.is_folder:
        return any(source.path.glob(f"{_PREFIX}*.xml"))
    return source.xml is not None and source.xml.find(".//ParamRotation/CodageMatr") is not None


def read_ori(source: Source) -> PoseList:
    """Raises ConfigError naming the file."""
    files = sorted(source.path.glob(f"{_PREFIX}*.xml")) if source.is_folder else [source.path]
    rows: list[PoseRow] = []
    for path in files:
        one = Source(path)
        external = None if one.xml is None else one.xml.find(".//Externe")
        if external is None:
            raise ConfigError(f"{path}: no orientation (Externe) in this XML: is it MicMac's?")
        known = (external.findtext(".//KnownConv") or "").strip()
        if known not in _KNOWN:
            raise ConfigError(f"{path}: convention {known} is not read: convert it by OriConvert to {_KNOWN[0]}")
        matrix = np.array([_numbers(one, external, f".//CodageMatr/L{row}") for row in (1, 2, 3)])
        center = _numbers(one, external, "Centre")
        name = path.name.removeprefix(_PREFIX).removesuffix(".xml")
        rows.append(rotation_row(name, len(rows) + 1, center, matrix.T))
    return PoseList(tuple(rows), "grid", (), f"MicMac orientation, {len(files)} files")


def _numbers(source: Source, element: Any, place: str) -> list[float]:
    cells = (element.findtext(place) or "").split()
    if len(cells) != 3:
        raise ConfigError(f"{source.path}: {place.lstrip('./')} must hold three numbers")
    return [number(f"{source.path}, {place.lstrip('./')}", cell) for cell in cells]


def is_ori_txt(source: Source) -> bool:
    first = next((line for line in source.lines if line.strip()), "")
    return first[1:3] == "F=" and not first[:1].isalnum()


def read_ori_txt(source: Source) -> PoseList:
    """Raises ConfigError with line and column."""
    start, first = next((n, line) for n, line in enumerate(source.lines, 1) if line.strip())
    letters = first[3:].replace("_", " ").split()
    if "N" not in letters or not {"X", "Y", "Z"} <= set(letters):
        raise ConfigError(f"{source.at(start)}: {first.strip()!r} must name the columns N, X, Y and Z")
    angles = {"W", "P", "K"} <= set(letters)
    rows = []
    for line, record in source.records(first[:1]):
        cells = record.split()
        if line <= start:
            continue
        if len(cells) < len(letters):
            raise ConfigError(f"{source.at(line)}: {len(cells)} values, {len(letters)} are named in line {start}")
        record_of = dict(zip(letters, cells, strict=False))
        values = {key: number(source.at(line, key), record_of[key]) for key in "XYZWPK" if key in record_of}
        rows.append(
            PoseRow(
                image=image_name(record_of["N"]), line=line, position=(values["X"], values["Y"], values["Z"]),
                position_kind="grid", attitude=(values["W"], values["P"], values["K"]) if angles else None,
                attitude_kind="omega_phi_kappa" if angles else "none",
            )
        )  # fmt: skip
    return PoseList(tuple(rows), "grid", (), f"MicMac OriTxt, {'omega, phi, kappa' if angles else 'positions'}")
