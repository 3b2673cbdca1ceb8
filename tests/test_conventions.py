"""Angles read in the wrong way: each fault is put into a block's angles, and must be named and undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as generated
from hypothesis import settings
from hypothesis import strategies as st

from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.rotations import angle_between_deg, rotation_z
from aeromatch_cli.sfm.conventions import recognised

IMAGES = 24


def flown(kind: str, seed: int = 0, tilt_deg: float = 4.0, forward: bool = True) -> dict[str, Angles]:
    """Angles of strips flown to and fro, some degrees off straight down."""
    rng = np.random.default_rng(seed)
    found = {}
    for n in range(IMAGES):
        heading = 35.0 + 180.0 * (n // 6 % 2) + rng.normal(0.0, 4.0)
        first, second = rng.normal(0.0, tilt_deg, 2)
        if kind == "omega_phi_kappa":
            values = (first, second, heading)
        else:
            values = (heading, first - 90.0 if forward else first, second)
        found[f"i{n}"] = Angles(kind, values, forward)
    return found


def written(true: dict[str, Angles], change) -> dict[str, Angles]:
    """The same angles as a wrong list holds them: change takes the values to those that are written."""
    return {i: replace(one, values=change(*one.values)) for i, one in true.items()}


def attitudes(angles: dict[str, Angles], noise_deg: float = 0.3) -> dict[str, np.ndarray]:
    """What the pictures show, with the error of a placed model."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(1)
    return {
        i: Rotation.from_rotvec(rng.normal(0.0, noise_deg, 3), degrees=True).as_matrix() @ one.rotation
        for i, one in angles.items()
    }


FAULTS = [
    ("yaw_pitch_roll", lambda y, p, r: ((y + 180.0) % 360.0, p, r), "all yaws are off by 180 degrees"),
    ("yaw_pitch_roll", lambda y, p, r: (y + 90.0, p, r), "all yaws are off by 90 degrees"),
    ("yaw_pitch_roll", lambda y, p, r: (-y, p, r), "yaw counts counter-clockwise"),
    ("yaw_pitch_roll", lambda y, p, r: (y / 0.9, p / 0.9, r / 0.9), "gon"),
    ("yaw_pitch_roll", lambda y, p, r: tuple(np.deg2rad([y, p, r])), "radians"),
    ("omega_phi_kappa", lambda o, p, k: (p, o, k), "omega and phi are exchanged"),
    ("omega_phi_kappa", lambda o, p, k: (o, p, k - 180.0), "all kappas are off by 180 degrees"),
    ("omega_phi_kappa", lambda o, p, k: (o, p, -k), "kappa counts clockwise"),
    ("omega_phi_kappa", lambda o, p, k: (o / 0.9, p / 0.9, k / 0.9), "gon"),
]


@pytest.mark.parametrize(("kind", "change", "words"), FAULTS, ids=[words for _, _, words in FAULTS])
def test_a_fault_is_named_and_undone(kind: str, change, words: str) -> None:
    true = flown(kind)
    wrong = written(true, change)
    found = recognised(wrong, attitudes(true))
    assert found is not None
    assert words in found.words
    assert max(angle_between_deg(found.rotation(wrong[i]), true[i].rotation) for i in true) < 1.0


@pytest.mark.parametrize(("forward", "remedy"), [(False, "nadir"), (True, "gimbal")])
def test_the_zero_of_pitch_is_recognised(forward: bool, remedy: str) -> None:
    true = flown("yaw_pitch_roll", forward=forward)
    wrong = {i: replace(one, forward=not forward) for i, one in true.items()}
    found = recognised(wrong, attitudes(true))
    assert found is not None
    assert found.words.endswith(f"give --set block.angles={remedy}")
    assert max(angle_between_deg(found.rotation(wrong[i]), true[i].rotation) for i in true) < 1.0


@pytest.mark.parametrize(
    ("kind", "change", "words"), FAULTS[:2] + FAULTS[5:8], ids=[w for _, _, w in FAULTS[:2] + FAULTS[5:8]]
)
def test_a_tilted_frame_does_not_change_the_verdict(kind: str, change, words: str) -> None:
    from scipy.spatial.transform import Rotation

    true = flown(kind)
    frame = Rotation.from_euler("xy", [2.5, -2.0], degrees=True).as_matrix()
    found = recognised(written(true, change), {i: r @ frame for i, r in attitudes(true).items()})
    assert found is not None
    assert found.words.startswith(words) or words in found.words.split(" and ")[0]


def test_a_transposed_quaternion_is_named() -> None:
    from aeromatch_cli.geometry.rotations import to_quaternion

    true = {i: Angles("quaternion", to_quaternion(one.rotation)) for i, one in flown("omega_phi_kappa").items()}
    wrong = {i: replace(one, values=(one.values[0], *(-v for v in one.values[1:]))) for i, one in true.items()}
    found = recognised(wrong, attitudes(true))
    assert found is not None
    assert "camera to world" in found.words


@pytest.mark.parametrize("kind", ["omega_phi_kappa", "yaw_pitch_roll"])
def test_right_angles_are_not_questioned(kind: str) -> None:
    true = flown(kind)
    assert recognised(true, attitudes(true)) is None


def test_random_angles_are_no_convention() -> None:
    rng = np.random.default_rng(2)
    true = flown("omega_phi_kappa")
    wrong = {i: replace(one, values=tuple(rng.uniform(-180.0, 180.0, 3))) for i, one in true.items()}
    assert recognised(wrong, attitudes(true)) is None


def test_a_third_at_random_does_not_hide_the_convention() -> None:
    rng = np.random.default_rng(3)
    true = flown("yaw_pitch_roll")
    wrong = written(true, lambda y, p, r: (y + 180.0, p, r))
    for i in list(wrong)[::3]:
        wrong[i] = replace(wrong[i], values=tuple(rng.uniform(-180.0, 180.0, 3)))
    found = recognised(wrong, attitudes(true))
    assert found is not None
    assert "off by 180 degrees" in found.words


@pytest.mark.parametrize(("turned", "all_are"), [(14, False), (22, True)])
def test_what_holds_for_some_images_is_no_convention(turned: int, all_are: bool) -> None:
    """Headings of a part of the images are off by 180 degrees, those of the others are right."""
    true = flown("yaw_pitch_roll")
    ids = sorted(true)
    wrong = written({i: true[i] for i in ids[:turned]}, lambda yaw, pitch, roll: (yaw + 180.0, pitch, roll))
    found = recognised({**true, **wrong}, attitudes(true))
    assert (found is not None) == all_are


def test_the_meridian_convergence_is_named() -> None:
    true = flown("yaw_pitch_roll")  # yaw counts from grid north
    wrong = {i: replace(one, convergence_deg=2.1) for i, one in true.items()}
    found = recognised(wrong, attitudes(true))
    assert found is not None
    assert "they count from grid north, not from true north" in found.words


@generated(st.floats(-179.0, 179.0).filter(lambda a: 5.0 < abs(a) < 175.0 and abs(abs(a) - 90.0) > 5.0))
@settings(max_examples=30, deadline=None)
def test_any_common_turn_is_found(turn_deg: float) -> None:
    given = flown("omega_phi_kappa")
    turned = {i: one.rotation @ rotation_z(turn_deg).T for i, one in given.items()}
    found = recognised(given, turned)
    assert found is not None
    assert max(angle_between_deg(found.rotation(given[i]), turned[i]) for i in given) < 0.5


def test_a_turn_within_what_the_positions_leave_open_is_no_fault() -> None:
    """One strip, headings 8 degrees off: by a short strip's positions north is known to 5 degrees, by a long one's to
    one. Half a turn is a fault by both."""
    true = {i: one for i, one in flown("yaw_pitch_roll").items() if int(i[1:]) < 6}
    for turn_deg, sigma_deg, named in ((8.0, 5.0, False), (8.0, 1.0, True), (180.0, 5.0, True)):
        wrong = written(true, lambda y, p, r, turn_deg=turn_deg: (y + turn_deg, p, r))
        found = recognised(wrong, attitudes(true), sigma_deg)
        assert (found is not None) is named
        assert not named or found.words.startswith("all yaws are off by")
