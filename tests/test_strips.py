"""Attitudes that a strip predicts for images that could not be oriented."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Block, Camera, Image, Pose
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.sfm.pair_registration import predicted

CAMERA = Camera("PINHOLE", 400, 300, (800.0, 800.0, 199.5, 149.5))


def flight(kappas_deg: list[float]) -> tuple[Block, dict[str, Pose]]:
    """Images in the order of capture, their names in another order, all with positions and true attitudes."""
    images, poses = [], {}
    for number, kappa in enumerate(kappas_deg):
        name = f"{(7 * number) % 100:02d}.jpg"
        images.append(Image(f"i{number}", name, 400, 300, "1", time=f"2026-05-01T10:00:{number:02d}"))
        poses[f"i{number}"] = Pose(np.array([10.0 * number, 0.0, 80.0]), from_omega_phi_kappa(1, 2, kappa), 5.0, 0.2)
    given = {i: replace(pose, world_rotation=None) for i, pose in poses.items()}
    block = Block(tuple(images), {"1": CAMERA}, given, "local", (0.0, 0.0, 0.0), None, "", None)
    return block, poses


def test_an_image_between_two_of_its_strip_has_their_attitude() -> None:
    block, true = flight([10.0, 12.0, 14.0, 190.0, 191.0, 192.0])
    found = predicted(block, {i: true[i] for i in ("i0", "i2", "i3", "i5")})
    assert found.keys() == {"i1", "i4"}
    for image_id, pose in found.items():
        assert angle_between_deg(pose.world_rotation, true[image_id].world_rotation) < 0.1
        assert pose.sigma_angle_deg == 5.0
        np.testing.assert_array_equal(pose.center_m, block.poses[image_id].center_m)


def test_the_deviation_grows_with_the_turn() -> None:
    block, true = flight([10.0, 20.0, 32.0])
    found = predicted(block, {i: true[i] for i in ("i0", "i2")})
    assert 20.0 < found["i1"].sigma_angle_deg < 23.0


def test_nothing_is_predicted_at_a_turn_or_at_an_end() -> None:
    block, true = flight([10.0, 12.0, 14.0, 190.0, 191.0])
    assert predicted(block, {i: true[i] for i in ("i0", "i1", "i4")}) == {}
    assert predicted(block, {}) == {}
