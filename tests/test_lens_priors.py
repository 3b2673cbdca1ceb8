"""What is known of a lens before the adjustment, by where its camera comes from, and what the adjustment may find."""

from __future__ import annotations

import pytest

from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import BROWN
from aeromatch_cli.sfm.bundle.network import LENS
from aeromatch_cli.sfm.calibration import Calibration, freed, lens_prior

SIZE = 4000, 3000
MIDDLE = 1999.5, 1499.5
PLAIN = Camera("SIMPLE_PINHOLE", *SIZE, (3000.0, *MIDDLE))
RADIAL = Camera("SIMPLE_RADIAL", *SIZE, (3000.0, *MIDDLE, -0.1))
OPENCV = Camera("OPENCV", *SIZE, (3000.0, 3000.0, 2010.0, 1490.0, -0.1, 0.02, 1e-4, 2e-4))
SKEWED = Camera(BROWN, *SIZE, (3000.0, 2010.0, 1490.0, -0.1, 0.02, 0.0, 1e-4, 2e-4, 0.0, 0.8))


@pytest.mark.parametrize(
    ("camera", "known"),
    [
        (PLAIN, set()),
        (RADIAL, {"k1"}),  # its principal point is the middle of the picture: nobody has looked for it
        (OPENCV, {"cx", "cy", "k1", "k2", "p1", "p2", "b1"}),
        (SKEWED, {"cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2"}),
    ],
    ids=["plain", "radial", "opencv", "skewed"],
)
def test_what_a_model_has_is_four_times_as_well_known(camera: Camera, known: set[str]) -> None:
    usual, own = (dict(zip(LENS, lens_prior(one, 0.03).sigmas, strict=True)) for one in (PLAIN, camera))
    assert {name for name in LENS if usual[name] > 0.0 and own[name] == pytest.approx(usual[name] / 4.0)} == known
    assert all(own[name] == pytest.approx(usual[name]) for name in set(LENS) - known)
    assert own["f"] == 90.0


@pytest.mark.parametrize(
    ("camera", "calibration", "free"),
    [(OPENCV, "auto", False), (SKEWED, "auto", True), (OPENCV, "brown", True), (SKEWED, "given", False)],
)
def test_a_skew_is_free_where_it_is_stated_or_asked_for(camera: Camera, calibration: Calibration, free: bool) -> None:
    found = freed(lens_prior(camera, 0.03), calibration, {}, images=20)
    assert bool(found[LENS.index("b2")] > 0.0) is free
    assert bool(found[LENS.index("b1")] > 0.0) is (calibration != "given")
