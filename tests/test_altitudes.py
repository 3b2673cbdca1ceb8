"""Altitudes of one block that count from different zeros, in other units, or with the wrong sign."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.exif_and_xmp import consistent_altitudes
from aeromatch_cli.blocks.xmp import CameraAngles

COUNT = 8
TRUE_M = [142.6, 143.5, 149.6, 149.1, 140.6, 145.9, 144.2, 147.8]
TAKEOFF_M = 34.0


def facts_of(
    exif_m: list[float], xmp_m: list[float] | None = None, relative_m: list[float] | None = None, **more: object
) -> dict[str, ExifFacts]:
    return {
        f"{row}.jpg": ExifFacts(
            40, 30, latitude_deg=52.5, longitude_deg=13.4 + 1e-4 * row, altitude_m=exif_m[row],
            xmp_position=(None, None, xmp_m[row] if xmp_m else None),
            relative_altitude_m=relative_m[row] if relative_m else None, **more,
        )
        for row in range(COUNT)
    }  # fmt: skip


def heights(facts: dict[str, ExifFacts]) -> list[float | None]:
    return [fact.altitude_m for fact in facts.values()]


RELATIVE_M = [z - TAKEOFF_M for z in TRUE_M]


@pytest.mark.parametrize("wrong", [(1, 3, 5, 7), (6,)])
def test_altitudes_below_sea_level_among_others_as_large_get_their_sign(wrong: tuple[int, ...]) -> None:
    facts, (said,) = consistent_altitudes(facts_of([-z if row in wrong else z for row, z in enumerate(TRUE_M)]))
    assert heights(facts) == TRUE_M
    assert said.startswith(f"GPSAltitudeRef of {len(wrong)} of 8 images")
    assert "(141 to 150 m)" in said


def test_a_flight_below_sea_level_keeps_its_sign() -> None:
    below = facts_of([-430.0 + row for row in range(COUNT)])
    assert consistent_altitudes(below) == (below, [])
    mended, (said,) = consistent_altitudes(facts_of([430.0, *(-430.0 + row for row in range(1, COUNT))]))
    assert heights(mended) == [-430.0 + row for row in range(COUNT)]
    assert "of 1 of 8 images (0.jpg) says above sea level" in said
    shore = facts_of([-12.0, -5.0, 3.0, 10.0, 20.0, 30.0, 40.0, 50.0])
    assert consistent_altitudes(shore) == (shore, [])


@pytest.mark.parametrize("xmp", [True, False])
def test_gps_altitudes_above_the_take_off_point_in_a_part_of_the_images_are_raised(xmp: bool) -> None:
    mixed = [z - TAKEOFF_M if row > 4 else z for row, z in enumerate(TRUE_M)]
    facts, (said,) = consistent_altitudes(facts_of(mixed, TRUE_M if xmp else None, RELATIVE_M))
    np.testing.assert_allclose(np.array(heights(facts), float), TRUE_M, atol=1e-9)
    assert "GPSAltitude of 3 of 8 images (5.jpg, 6.jpg, 7.jpg) counts from the take-off point" in said
    assert "lies at 34 m" in said


def test_gps_altitudes_that_are_all_relative_give_way_to_those_of_xmp() -> None:
    facts, (said,) = consistent_altitudes(facts_of(RELATIVE_M, TRUE_M, RELATIVE_M))
    np.testing.assert_allclose(np.array(heights(facts), float), TRUE_M, atol=1e-9)
    assert "8 of 8 images" in said
    sea = facts_of(RELATIVE_M, RELATIVE_M, RELATIVE_M)  # a take-off point at sea level
    assert consistent_altitudes(sea) == (sea, [])


def test_altitudes_in_feet_give_way_to_metres_of_xmp() -> None:
    facts, (said,) = consistent_altitudes(facts_of([z / 0.3048 for z in TRUE_M], TRUE_M))
    assert heights(facts) == TRUE_M
    assert "GPSAltitude of 8 of 8 images" in said
    assert "counts in feet" in said
    one = facts_of([TRUE_M[0] / 0.3048, *TRUE_M[1:]], TRUE_M)
    assert consistent_altitudes(one) == (one, [])


def test_two_levels_of_altitudes_are_named_where_nothing_else_tells_them_apart() -> None:
    mixed = [z - TAKEOFF_M if row > 3 else z for row, z in enumerate(TRUE_M)]
    facts, (said,) = consistent_altitudes(facts_of(mixed))
    assert heights(facts) == mixed
    assert "two levels, 35 m apart: 107 to 114 m in 4 of 8 images (4.jpg, 5.jpg, 6.jpg, 7.jpg)" in said
    angles = CameraAngles(0.0, -90.0, 0.0, "gimbal")
    assert consistent_altitudes(facts_of(mixed, angles=angles))[1] == []
    slope = facts_of([100.0 + 20.0 * row for row in range(COUNT)])
    assert consistent_altitudes(slope) == (slope, [])
