"""MicMac: the folder Ori-<name> of Orientation-<image>.xml, one such file, and text for OriConvert (OriTxtInFile).

XML: `Centre` and the matrix camera to world (OpenCV's axes) of `CodageMatr`. Text: the first line says what the columns
are, such as `#F=N X Y Z W P K` (N name, W P K omega, phi, kappa in degrees, S skipped). No CRS is stated.

Calibration (`FileInterne`, or `Interne` in the file): F, PP and SzIm in pixels, whole numbers being middles of pixels;
ModRad and ModPhgrStd (Fraser) in powers of pixels from CDist, from the undistorted to the measured place
(eConvApero_DistM2C; src/photogram/phgr_ebner_brown_dist.cpp). P1 and P2 are exchanged against OpenCV's p1 and p2; b1
and b2 turn the undistorted place, not the distorted one, so that only the nearest camera of ours has them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, image_name, number, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import brown_camera
from aeromatch_cli.geometry.lenses import Nearest, brown, nearest

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
    cameras = CameraShelf(source.path.name)
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
        key, internal = _internal(one)
        if key not in cameras.found:
            cameras.add(key, None if internal is None else _lens(internal))
        rows.append(rotation_row(name, len(rows) + 1, center, matrix.T, camera=cameras.key(key)))
    title = f"MicMac orientation, {len(files)} files"
    return PoseList(tuple(rows), "grid", tuple(cameras.remarks), title, None, cameras.found)


def _internal(orientation: Source) -> tuple[str, Any]:
    """Name and element of the calibration that an orientation names or holds; None where there is none."""
    named = (orientation.xml.findtext(".//FileInterne") or "").strip()
    if not named:
        return orientation.path.stem, orientation.xml.find(".//Interne")
    folder = orientation.path.parent
    for path in (folder.parent / named, folder / Path(named).name):
        if path.is_file():
            return path.stem, Source(path).xml
    return Path(named).stem, None


def _lens(calibration: Any) -> Nearest | None:
    """Return the lens of a calibration; None where it is incomplete."""
    try:
        (focal,), principal = _values(calibration, ".//F", 1), _values(calibration, ".//PP", 2)
        width, height = (int(value) for value in _values(calibration, ".//SzIm", 2))
        distortion = _distortion(calibration, principal)
    except (TypeError, ValueError, OverflowError):
        return None
    if distortion is None:
        return Nearest(None)
    center, radial, (p1, p2, b1, b2) = distortion
    powers = [term * focal ** (2 * k) for k, term in enumerate(radial, 1)]
    middle = principal[0] + 0.5, principal[1] + 0.5
    if np.allclose(center, principal) and not b1 and not b2:
        return brown((width, height), (focal, focal), middle, powers, (p2 * focal, p1 * focal))

    def forward(rays: FloatArray) -> FloatArray:
        x, y = (focal * rays + principal - center).T
        r2 = x * x + y * y
        factor = sum(term * r2**k for k, term in enumerate(radial, 1))
        return (
            np.column_stack(
                [
                    x + x * factor + p1 * (2.0 * x * x + r2) + 2.0 * p2 * x * y + b1 * x + b2 * y,
                    y + y * factor + p2 * (2.0 * y * y + r2) + 2.0 * p1 * x * y,
                ]
            )
            + center
        )

    values = {"fx": focal * (1.0 + b1), "fy": focal, "skew": focal * b2, "cx": principal[0], "cy": principal[1]}
    values |= {"p1": p2 * focal, "p2": p1 * focal} | {f"k{k}": term for k, term in enumerate(powers[:3], 1)}
    return nearest(brown_camera((width, height), values), forward)


def _distortion(calibration: Any, principal: list[float]) -> tuple[FloatArray, list[float], tuple[float, ...]] | None:
    """Return the centre (2,) of the distortion, its radial terms, and p1, p2, b1, b2; None for others.

    principal: the principal point, which is the centre where there is no distortion. Raises ValueError and TypeError
    where numbers are missing.
    """
    models = [model for place in calibration.iter("CalibDistortion") for model in place]
    direct = (calibration.findtext(".//KnownConv") or "eConvApero_DistM2C").strip() == "eConvApero_DistM2C"
    if {model.tag for model in models} - {"ModRad", "ModPhgrStd", "ModNoDist"} or not direct or len(models) > 1:
        return None
    center, radial = np.array(principal), list[float]()
    if models and models[0].tag != "ModNoDist":
        center = np.array(_values(models[0], ".//CDist", 2))
        radial = [float(item.text) for item in models[0].iter("CoeffDist")]
    terms = tuple(float(calibration.findtext(f".//{name}") or 0.0) for name in ("P1", "P2", "b1", "b2"))
    return center, radial, terms


def _values(element: Any, place: str, count: int) -> list[float]:
    """Raises ValueError where there are not so many numbers."""
    values = [float(cell) for cell in (element.findtext(place) or "").split()]
    if len(values) != count:
        raise ValueError(f"{place}: {len(values)} numbers")
    return values


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
