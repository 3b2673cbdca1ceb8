"""Flights and velocities of images, from times, serial numbers, names and take-off heights made up here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from make_images import DJI_XMP, gps_tags, write_image
from read_inputs import read_inputs

from aeromatch_cli.blocks.crs import convergence_deg, grid_from_geographic
from aeromatch_cli.blocks.sorties import Capture, flights, velocities

ONE_DAY_S = 86400.0


def captures(times_s: Sequence[float | None], **more: object) -> list[Capture]:
    return [
        Capture(f"i{n}", f"DJI_{n:04d}.JPG", "1", time_s=time_s, **{k: v[n] for k, v in more.items()})  # type: ignore[index,arg-type]
        for n, time_s in enumerate(times_s)
    ]


def sizes(found: dict[str, str]) -> list[int]:
    names = list(found.values())
    return [names.count(f"flight {number}") for number in range(1, 1 + len(set(names)))]


def test_a_new_flight_begins_where_the_time_jumps() -> None:
    """Strips of five images, with half a minute of turning, and ten minutes to change the battery."""
    times_s = [strip * 40.0 + 2.0 * k for strip in range(4) for k in range(5)]
    later_s = [times_s[-1] + 600.0 + time_s for time_s in times_s]
    found = flights(captures([*times_s, *later_s]))
    assert sizes(found) == [20, 20]
    assert (found["i0"], found["i19"], found["i20"]) == ("flight 1", "flight 1", "flight 2")


def test_images_that_are_missing_are_no_landing() -> None:
    """Two parts of one flight, with 60 images between them; and the same with a battery's change in between."""
    numbers = [*range(1, 7), *range(67, 73)]
    for pause_s, expected in ((0.0, [12]), (240.0, [6, 6])):
        found = flights(
            Capture(f"i{n}", f"DJI_{n:04d}.JPG", "1", time_s=6.0 * n + (pause_s if n > 50 else 0.0)) for n in numbers
        )
        assert sizes(found) == expected


def test_times_in_names_are_no_running_numbers() -> None:
    names = [f"IMG_20240501_{t}.jpg" for t in (103300, 103302, 103304, 104300, 104302)]
    found = flights(
        Capture(name, name, "1", time_s=time_s)
        for name, time_s in zip(names, (0.0, 2.0, 4.0, 600.0, 602.0), strict=True)
    )
    assert sizes(found) == [3, 2]


def test_the_names_do_not_count_where_times_are_known() -> None:
    found = flights(reversed(captures([0.0, 2.0, 4.0, 900.0, 902.0, 904.0])))
    assert (sizes(found), found["i3"]) == ([3, 3], "flight 2")


def test_aircraft_that_take_minutes_to_turn() -> None:
    """60 m/s, 4 s apart, five minutes between the strips; an hour's pause is a landing."""
    times_s = [strip * 400.0 + 4.0 * k for strip in range(3) for k in range(10)]
    times_s += [times_s[-1] + 3600.0 + 4.0 * k for k in range(10)]
    places = [np.array([60.0 * time_s, 0.0, 900.0]) for time_s in times_s]
    assert sizes(flights(captures(times_s, center_m=places))) == [30, 10]
    slow = [place / 10.0 for place in places]
    assert sizes(flights(captures(times_s, center_m=slow))) == [10, 10, 10, 10]


def test_other_dates_are_other_flights() -> None:
    assert sizes(flights(captures([0.0, ONE_DAY_S, 2 * ONE_DAY_S]))) == [1, 1, 1]
    assert sizes(flights(captures([ONE_DAY_S - 2.0, ONE_DAY_S, ONE_DAY_S + 2.0]))) == [3]  # over midnight


def test_two_aircraft_in_the_air_at_once() -> None:
    times_s = [float(n) for n in range(6)]
    assert sizes(flights(captures(times_s, serial=["A", "B"] * 3))) == [3, 3]
    assert sizes(flights(captures(times_s, serial=["A", ""] * 3))) == [6]  # the number was lost from some


def test_without_times_names_tell() -> None:
    names = [f"100/DJI_{n:04d}.JPG" for n in (1, 2, 4, 5, 300, 301)] + ["101/DJI_0302.JPG", "101/IMG_0303.JPG"]
    found = flights(Capture(name, name, "1") for name in names)
    assert sizes(found) == [4, 2, 1, 1]
    assert found["100/DJI_0300.JPG"] == found["100/DJI_0301.JPG"]


def test_images_without_a_time_go_with_the_one_before() -> None:
    found = flights(captures([None, 0.0, None, 2.0, 900.0, None, 902.0]))
    assert [found[f"i{n}"] for n in range(7)] == ["flight 1"] * 4 + ["flight 2"] * 3


@pytest.mark.parametrize("times_s", [[None] * 12, [2.0 * n for n in range(12)]])
def test_the_take_off_point_moves(times_s: list) -> None:
    """By 15 m, with noise of some decimetres; a single altitude that is off is no other flight."""
    rng = np.random.default_rng(0)
    heights_m = [34.0 + (15.0 if n >= 6 else 0.0) for n in range(12)] + rng.normal(0.0, 0.3, 12)
    assert sizes(flights(captures(times_s, takeoff_m=list(heights_m)))) == [6, 6]
    heights_m = 34.0 + rng.normal(0.0, 0.3, 12)
    heights_m[4] += 15.0
    assert sizes(flights(captures(times_s, takeoff_m=list(heights_m)))) == [12]
    drifting = list(34.0 + 1.5 * np.arange(12))
    assert sizes(flights(captures(times_s, takeoff_m=drifting))) == [12]


def strips(interval_s: float, speed_m_s: float) -> list[Capture]:
    """Two strips of six images, to the east and back."""
    way_m = speed_m_s * interval_s
    places = [np.array([way_m * k, 0.0, 100.0]) for k in range(6)]
    places += [np.array([way_m * (5 - k), 30.0, 100.0]) for k in range(6)]
    times_s = [interval_s * k for k in range(6)] + [interval_s * (k + 9) for k in range(6)]
    return captures(times_s, center_m=places)


def test_velocity_along_strips_up_to_their_ends_and_none_at_a_corner() -> None:
    images = strips(2.5, 8.0)
    found = velocities(images, flights(images))
    assert sorted(found) == sorted(f"i{n}" for n in range(12))
    for n in range(12):
        np.testing.assert_allclose(found[f"i{n}"], [8.0 if n < 6 else -8.0, 0.0, 0.0])
    places = [np.array([20.0 * min(n, 4), 20.0 * max(n - 4, 0), 100.0]) for n in range(9)]
    cornered = captures([2.5 * n for n in range(9)], center_m=places)
    found = velocities(cornered, flights(cornered))
    assert sorted(found) == sorted(f"i{n}" for n in range(9) if n != 4)
    np.testing.assert_allclose(found["i5"], [0.0, 8.0, 0.0])
    two = images[:8]  # the second strip has two images
    np.testing.assert_allclose(velocities(two, flights(two))["i7"], [-8.0, 0.0, 0.0])


def test_whole_seconds_need_a_longer_way() -> None:
    """2.4 s apart, cut to whole seconds: single intervals are off by a fifth."""
    exact = strips(2.4, 10.0)
    cut = [Capture(c.image_id, c.name, "1", time_s=float(int(c.time_s or 0.0)), center_m=c.center_m) for c in exact]
    found = velocities(cut, flights(cut))
    speeds = [np.linalg.norm(found[f"i{n}"]) for n in (2, 3)]
    np.testing.assert_allclose(speeds, 10.0, rtol=0.1)


def test_no_velocity_without_times_or_of_a_clock_that_stands() -> None:
    for times_s in ([None] * 5, [7.0] * 5):
        images = captures(times_s, center_m=[np.array([20.0 * n, 0.0, 0.0]) for n in range(5)])
        assert velocities(images, flights(images)) == {}


def test_what_the_header_states_counts_first_and_zeros_are_no_statement() -> None:
    places = [np.array([20.0 * n, 0.0, 0.0]) for n in range(4)]
    stated = [np.array([9.0, 1.0, 0.0]), None, None, np.zeros(3)]
    images = captures([0.0, 2.0, 4.0, 6.0], center_m=places, speed_m_s=stated)
    found = velocities(images, flights(images))
    assert {i: speed.tolist() for i, speed in found.items()} == {
        "i0": [9.0, 1.0, 0.0], "i1": [10.0, 0.0, 0.0], "i2": [10.0, 0.0, 0.0], "i3": [0.0, 0.0, 0.0],
    }  # fmt: skip
    images = captures([0.0, 2.0, 4.0, 6.0], center_m=places, speed_m_s=[np.zeros(3)] * 4)
    assert velocities(images, flights(images)) == {}


def test_flights_and_velocities_of_a_folder(tmp_path: Path) -> None:
    """Two batteries of four images; DJI states the speed to true north, to the east and down."""
    for n in range(8):
        speed = 'drone-dji:FlightXSpeed="10.0" drone-dji:FlightYSpeed="2.0" drone-dji:FlightZSpeed="-0.5" '
        xmp = DJI_XMP.format(yaw="0", pitch="-90", roll="0", relative=f"{60 + n}")
        write_image(
            tmp_path / f"DJI_{n:04d}.JPG",
            exif={36867: f"2024:05:01 10:{12 * (n // 4):02d}:{3 * n:02d}"},
            gps=gps_tags(52.5 + 3e-4 * n, 12.0, 100.0 + n),
            xmp=xmp.replace("drone-dji:GimbalYaw", speed + "drone-dji:GimbalYaw"),
        )
    inputs = read_inputs(tmp_path, "exif")
    ids = [image.image_id for image in inputs.images]
    assert [inputs.flights[i] for i in ids] == ["flight 1"] * 4 + ["flight 2"] * 4
    turn_deg = convergence_deg("EPSG:32633", np.array([52.501]), np.array([12.0]))[0]
    assert turn_deg == pytest.approx(-2.38, abs=0.01)  # west of the meridian, true north lies right of grid north
    north = np.diff(grid_from_geographic("EPSG:32633", np.array([52.5, 52.501]), np.array([12.0, 12.0])), axis=0)[0]
    north = north / np.linalg.norm(north)
    expected = [*(10.0 * north + 2.0 * np.array([north[1], -north[0]])), 0.5]
    np.testing.assert_allclose(inputs.velocities[ids[0]], expected, atol=1e-3)


def test_a_battery_is_told_by_the_take_off_height_alone(tmp_path: Path) -> None:
    """No capture times; the altitude of the second half is 15 m higher at the same height above the take-off point."""
    for n in range(8):
        xmp = DJI_XMP.format(yaw="0", pitch="-90", roll="0", relative=f"{60 + n % 3}")
        up_m = 15.0 if n >= 4 else 0.0
        write_image(tmp_path / f"DJI_{n:04d}.JPG", gps=gps_tags(52.5 + 3e-4 * n, 12.0, 100.0 + n % 3 + up_m), xmp=xmp)
    inputs = read_inputs(tmp_path, "exif")
    assert [inputs.flights[image.image_id] for image in inputs.images] == ["flight 1"] * 4 + ["flight 2"] * 4
