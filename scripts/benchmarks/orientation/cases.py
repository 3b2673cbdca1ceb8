"""Reference poses and cameras made worse: what is given in each case of the benchmark."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_omega_phi_kappa

CASES = (
    "reference", "noisy", "unoriented", "noise", "nothing", "third", "yaw", "longer", "shorter", "outliers", "columns",
    "mirrored", "shuffled", "ground", "level",
)  # fmt: skip
POSITIONS_ONLY = ("noise", "outliers", "mirrored", "level")
NOISE_M, OUTLIER_M = 5.0, 100.0
# Of noisy poses: positions, as a share of each image's own flying height, and angles.
NOISE_SHARE, NOISE_DEG = 0.05, 3.0
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")


def worsened(case: str, reference: Path, names: Sequence[str], folder: Path) -> tuple[list[str], set[str]]:
    """Options of the command for one case, and the names of images whose attitude it made wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    with (reference / "poses.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["image"] in set(names)]
    camera = json.loads((reference / "block.json").read_text(encoding="utf-8"))
    ground_z = camera.pop("ground_z", None)  # the terrain is to be found
    rng = np.random.default_rng(len(names))
    below_m = ground_z["p50"] if isinstance(ground_z, dict) else ground_z or 0.0
    wrong = _worsen(case, rows, rng, below_m)
    for lens in camera["cameras"].values():
        factor = {"longer": 2.0, "shorter": 0.5}.get(case, 1.0)
        count = 2 if lens["model"] in ("PINHOLE", "OPENCV") else 1
        lens["params"][:count] = [value * factor for value in lens["params"][:count]]
    (folder / "block.json").write_text(json.dumps(camera), encoding="utf-8")
    poses = folder / "poses.csv"
    unknown = {*(ANGLES if case in POSITIONS_ONLY else ()), *("z" if case == "level" else ())}
    keep = [key for key in rows[0] if key not in unknown]
    with poses.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, keep, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    crs = [] if camera["crs"] == "local" else ["--crs", camera["crs"]]
    if case == "ground":
        flying_m = float(np.median([float(row["z"]) for row in rows])) - below_m
        crs += ["--ground", repr(below_m - flying_m)]
    if case == "unoriented":
        crs += ["--set=orient=none", "--ground", repr(below_m)]
    exact = (reference / "truth.json").is_file()  # rendered images have no EXIF
    lens = ["--cameras", str(folder / "block.json") if exact or case not in (*POSITIONS_ONLY, "nothing") else "exif"]
    if case == "nothing":
        return ["--poses", "none", *lens], wrong
    return ["--poses", str(poses), *lens, *(crs or ["--crs", "local"])], wrong


def _worsen(case: str, rows: list[dict[str, Any]], rng: np.random.Generator, below_m: float) -> set[str]:
    """Change the rows of a pose list in place; names of images whose attitude is wrong now. below_m: ground height."""
    wrong = set()
    if case == "shuffled":
        order = rng.permutation(len(rows))
        lines = [{k: v for k, v in rows[n].items() if k != "image"} for n in order]
        for row, line in zip(rows, lines, strict=True):
            row.update(line)
    for number, row in enumerate(rows):
        if case == "mirrored":
            row["x"], row["y"] = row["y"], row["x"]
        if case == "columns":
            row[ANGLES[0]], row[ANGLES[1]] = row[ANGLES[1]], row[ANGLES[0]]
            wrong.add(str(row["image"]))
        off_m = np.zeros(3)
        if case in ("noisy", "unoriented"):
            off_m = NOISE_SHARE * (float(row["z"]) - below_m) * rng.normal(size=3)
            for key, off_deg in zip(ANGLES, rng.normal(0.0, NOISE_DEG, 3), strict=True):
                row[key] = repr(float(row[key]) + float(off_deg))
        if case in ("noise", "level"):
            off_m = NOISE_M * rng.normal(size=3)
        if case == "outliers" and number % 10 == 0:
            turn = rng.uniform(0.0, 2.0 * np.pi)
            off_m = OUTLIER_M * np.array([np.cos(turn), np.sin(turn), 0.0])
        for key, value in zip("xyz", off_m, strict=True):
            row[key] = repr(float(row[key]) + float(value))
        rotation = from_omega_phi_kappa(*(float(row[key]) for key in ANGLES))
        if case == "third" and number % 3 == 0:
            rotation = _random_rotation(rng)
        if case == "yaw":
            rotation = rotation @ np.diag([-1.0, -1.0, 1.0])
        if case == "yaw" or (case == "third" and number % 3 == 0):
            wrong.add(str(row["image"]))
        for key, angle in zip(ANGLES, to_omega_phi_kappa(rotation), strict=True):
            row[key] = repr(float(angle))
    return wrong


def _random_rotation(rng: np.random.Generator) -> FloatArray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))
