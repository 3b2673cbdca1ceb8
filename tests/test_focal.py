"""Focal lengths of a camera file that cannot be right: by the matches under given poses, else by EXIF."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.blocks.cameras import CameraAssignment, contradicting_exif
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.geometry.cameras import focal_px, project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.focal import better_cameras, with_focal_length

TRUE = Camera("SIMPLE_PINHOLE", 1000, 750, (900.0, 499.5, 374.5))


def block(tilt_deg: float, relief_m: float) -> tuple[list[PairPoints], dict[str, Pose]]:
    """Six images 100 m above the ground in two strips, and exact matches of all pairs."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-60, 100, (3000, 2)), rng.uniform(0, relief_m, 3000)])
    poses = {}
    for k in range(6):
        rotation = from_omega_phi_kappa(tilt_deg * (-1) ** k, tilt_deg * (k % 3 - 1), 90.0 * k)
        poses[f"i{k}"] = Pose(np.array([20.0 * (k % 3), 25.0 * (k // 3), 100.0]), rotation, 0.1, 0.1)
    seen = {i: project(TRUE, np.asarray(p.world_rotation), p.center_m, points) for i, p in poses.items()}
    pairs = []
    for a in poses:
        for b in (other for other in poses if other > a):
            inside = [(px > 0).all(axis=1) & (px < [1000, 750]).all(axis=1) for px in (seen[a], seen[b])]
            both = np.flatnonzero(inside[0] & inside[1])
            pairs.append(PairPoints(a, b, seen[a][both], seen[b][both], np.column_stack([both, both])))
    return pairs, poses


def judged(pairs: list[PairPoints], poses: dict[str, Pose], px: float, likely: dict[str, float]) -> float | None:
    """Focal length that is taken for one of px, None where it stays."""
    ids = dict.fromkeys(poses, "c")
    cameras = {"c": with_focal_length(TRUE, px)}
    found = better_cameras(pairs, poses, cameras, ids, dict.fromkeys(poses, 3.0), likely)
    return focal_px(found["c"]) if found else None


@pytest.mark.parametrize("px", [450.0, 700.0, 1800.0])
def test_poses_and_matches_tell_a_wrong_focal_length(px: float) -> None:
    pairs, poses = block(tilt_deg=20.0, relief_m=30.0)
    assert judged(pairs, poses, px, {}) == pytest.approx(900.0, rel=0.02)
    assert judged(pairs, poses, 900.0, {}) is None
    assert judged(pairs, poses, 900.0, {"c": 1800.0}) is None  # EXIF is wrong, the camera file right


def test_exif_decides_where_flat_ground_leaves_it_open() -> None:
    pairs, poses = block(tilt_deg=0.0, relief_m=0.0)
    assert judged(pairs, poses, 450.0, {}) is None
    assert judged(pairs, poses, 450.0, {"c": 900.0}) == pytest.approx(900.0)


@pytest.mark.parametrize(("stated", "likely"), [(334.0, 668.0), (450.0, 702.1), (660.0, None)])
def test_a_camera_file_of_pictures_of_another_size(stated: float, likely: float | None) -> None:
    """EXIF says 702 px: 334 px is half of 668, which is near."""
    camera = Camera("SIMPLE_PINHOLE", 1200, 675, (stated, 599.5, 337.0))
    fact = ExifFacts(width_px=1200, height_px=675, focal_35mm_mm=22.07)
    found, remarks = contradicting_exif(CameraAssignment({"c": camera}, {"a.jpg": "c"}, {}, ()), {"a.jpg": fact})
    assert (found.get("c") is None) == (likely is None)
    assert len(remarks) == (likely is not None)
    if likely is not None:
        assert found["c"] == pytest.approx(likely, rel=0.001)
