"""What a run has found, against the reference or the exact truth of a rendered block."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.ground import DemGround
from aeromatch_cli.data import FloatArray
from aeromatch_cli.files import read_json
from aeromatch_cli.formats.tables import read_cameras, read_images, read_poses
from aeromatch_cli.formats.terrain import read_terrain
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.sfm.georeferencing import similarity
from benchmarks.orientation.cases import ANGLES
from benchmarks.tables import Row, interval, medians, plain

# Places in every image where the terrain is asked.
_SAMPLES = 60


def judged(work: Path, reference: Path, names: Sequence[str], wrong: set[str]) -> Row:
    """Attitudes, focal length and named images of a finished workspace against the reference."""
    name_of = {image.image_id: image.name for image in read_images(work / "images.csv")}
    found = {name_of[i]: pose for i, pose in read_poses(work / "poses.csv").items() if pose.world_rotation is not None}
    truth = attitudes_of(reference / "poses.csv")
    common = [name for name in names if name in found and name in truth]
    errors, whole_deg = turned_errors({name: found[name].world_rotation for name in common}, truth)
    adjusted, _ = turned_errors(attitudes_of(work / "orientation" / "orientation.csv"), truth)
    lenses = json.loads((reference / "block.json").read_text(encoding="utf-8"))["cameras"]
    focal = {k: focal_px(camera) for k, camera in read_cameras(work / "cameras.csv").items()}
    # Cameras from EXIF have names of their own, and real blocks have one.
    true = {k: lenses[k if k in lenses else next(iter(lenses))]["params"][0] for k in focal}
    shares = [focal[k] / float(true[k]) - 1.0 for k in focal]
    record = work / "reports" / "orient.json"
    facts = read_json(record)["result"] if record.is_file() else {}
    remarks = facts.get("remarks", [])
    whole = any("angles" in remark for remark in remarks)
    own = facts.get("frame") == "own"
    named = wrong if whole else {name_of[i] for i in facts.get("wrong_attitudes", {})}
    return {
        "oriented": len(common),
        "attitude_deg": float(np.median(errors)) if len(errors) else float("nan"),
        "attitude_interval_deg": [plain(bound) for bound in interval(errors, medians)],
        "adjusted_interval_deg": [plain(bound) for bound in interval(adjusted, medians)],
        "attitude_max_deg": float(errors.max()) if len(errors) else float("nan"),
        "turn_deg": None if own or not common else whole_deg,
        "adjusted_deg": float(np.median(adjusted)) if len(adjusted) else None,
        "focal_share": max(shares, key=abs),
        "poses_from": facts.get("poses_from", "none"),
        "named": len(named & wrong),
        "wrong": len(wrong),
        "named_without_cause": len(named - wrong),
        "said": remarks,
        "terrain_share": plain(terrain_error(work, reference)) if (reference / "truth.json").is_file() else None,
    }


def turned_errors(found: Mapping[str, FloatArray], truth: Mapping[str, FloatArray]) -> tuple[FloatArray, float]:
    """Errors (N,) in degrees of rotations cam_from_world after the common turn that fits best, and its angle."""
    turns = [found[name].T @ truth[name] for name in sorted(found.keys() & truth.keys())]
    if not turns:
        return np.zeros(0), float("nan")
    u, _, vt = np.linalg.svd(sum(turns, np.zeros((3, 3))))
    turn = u * [1.0, 1.0, np.linalg.det(u @ vt)] @ vt
    cosines = np.array([np.trace(turn), *(np.trace(one.T @ turn) for one in turns)])
    angles = np.rad2deg(np.arccos(np.clip((cosines - 1.0) / 2.0, -1.0, 1.0)))
    return angles[1:], float(angles[0])


def attitudes_of(path: Path) -> dict[str, FloatArray]:
    """Rotations cam_from_world of a table with omega, phi, kappa, by image name; none where there is no such file.

    Of orientation.csv those of oriented images.
    """
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row.get("frame") != "predicted"]
    return {row["image"]: from_omega_phi_kappa(*(float(row[k]) for k in ANGLES)) for row in rows}


def most_alike(found: Mapping[str, FloatArray], truth: Mapping[str, FloatArray], limit_deg: float) -> int:
    """How many rotations agree with the truth after one common turn: that with which most do."""
    common = sorted(found.keys() & truth.keys())
    turns = np.array([found[name].T @ truth[name] for name in common]).reshape(-1, 3, 3)
    traces = np.einsum("mij,nij->mn", turns, turns)
    angles = np.rad2deg(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    return int((angles <= limit_deg).sum(axis=1).max(initial=0))


def terrain_error(work: Path, rendered: Path) -> float:
    """Median height of the terrain found above the rendered surface, without sign, as a share of the flying height.

    Asked at places that the images show. A block in a frame of its own is brought to the truth by its projection
    centres.
    """
    path = work / "orientation" / "terrain.tif"
    if not path.is_file():
        return float("nan")
    truth = load_truth(rendered)
    name_of = {image.image_id: image.name for image in read_images(work / "images.csv")}
    found = read_poses(work / "poses.csv")
    ids = sorted(found)
    own = np.array([found[i].center_m for i in ids])
    origin_m = np.array(read_json(work / "block.json")["origin_m"])
    true = np.array([truth.poses[name_of[i]].center_m for i in ids]) - origin_m
    if read_json(work / "reports" / "orient.json")["result"].get("frame") == "world":
        scale, rotation, shift_m = 1.0, np.eye(3), np.zeros(3)
    else:
        scale, rotation, shift_m = similarity(true, own)
    rng = np.random.default_rng(0)
    camera = next(iter(truth.cameras.values()))
    pixels = rng.uniform([0, 0], [camera.width_px - 1, camera.height_px - 1], (_SAMPLES, 2))
    seen = np.concatenate([truth.surface_points(name_of[i], pixels) for i in ids]) - origin_m
    seen = seen[np.isfinite(seen).all(axis=1)]
    seen = seen[np.abs(seen[:, :2] - true[:, :2].mean(axis=0)).max(axis=1) <= np.ptp(true[:, :2], axis=0).max()]
    moved = scale * seen @ rotation.T + shift_m
    heights, west_m, north_m, cell_m = read_terrain(path, origin_m)
    ground = DemGround(heights, west_m, north_m, (cell_m, cell_m), float(np.median(heights)))
    off_m = np.abs(ground.height_m(moved[:, :2]) - moved[:, 2]) / scale
    return float(np.median(off_m) / (np.median(true[:, 2]) - np.median(seen[:, 2])))
