"""Planned flights: overlaps, directions and heights against figures worked out by hand."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import FISHEYE, MODELS, distort, focal_px, has_distortion, parameters, undistort
from aeromatch_cli.geometry.footprints import ground_footprint, view_angles_deg
from aeromatch_cli.lab.synthetic.flight_plans import FLIGHTS, SWEEP_ANGLES_DEG
from aeromatch_cli.lab.synthetic.flights import Flight, ground_area, gsd_m, noisy, plan_flight
from aeromatch_cli.lab.synthetic.stations import Exterior, Station, make_camera

WIDTH, HEIGHT, HEIGHT_M = 800, 600, 90.0
# 90 m over 0.9 x 800 px of focal length.
GSD_M = 0.125


def plan(name: str, images: int, seed: int = 0, lens: str = "OPENCV") -> Flight:
    rng = np.random.default_rng(seed)
    return plan_flight(name, images=images, width_px=WIDTH, height_px=HEIGHT, height_m=HEIGHT_M, lens=lens, rng=rng)


def center(station: Station) -> FloatArray:
    return np.array([station.exterior.x_m, station.exterior.y_m, station.exterior.z_m])


def axis(station: Station) -> FloatArray:
    """Where the optical axis points in the world: the negative third column of Rx(omega) Ry(phi) Rz(kappa)."""
    o, p = np.deg2rad([station.exterior.omega_deg, station.exterior.phi_deg])
    return -np.array([np.sin(p), -np.sin(o) * np.cos(p), np.cos(o) * np.cos(p)])


def picture_top(station: Station) -> FloatArray:
    """Where the top of the picture points in the world: the second column of Rx(omega) Ry(phi) Rz(kappa)."""
    o, p, k = np.deg2rad([station.exterior.omega_deg, station.exterior.phi_deg, station.exterior.kappa_deg])
    return np.array(
        [
            -np.cos(p) * np.sin(k),
            np.cos(o) * np.cos(k) - np.sin(o) * np.sin(p) * np.sin(k),
            np.sin(o) * np.cos(k) + np.cos(o) * np.sin(p) * np.sin(k),
        ]
    )


def tilt(station: Station) -> float:
    return float(np.rad2deg(np.arccos(-axis(station)[2])))


def azimuth(direction: FloatArray) -> float:
    return float(np.rad2deg(np.arctan2(direction[0], direction[1])))


def turn(angle0_deg: float, angle1_deg: float) -> float:
    """Smallest angle between two directions, degrees."""
    return abs((angle0_deg - angle1_deg + 180.0) % 360.0 - 180.0)


def footprints(flight: Flight) -> list[shapely.Polygon]:
    return [
        shapely.Polygon(ground_footprint(flight.cameras[s.camera_id], s.exterior.pose(), 0.0, 4.0 * s.height_m))
        for s in flight.stations
    ]


def overlap(first: shapely.Polygon, second: shapely.Polygon) -> float:
    return first.intersection(second).area / min(first.area, second.area)


def overlapping(flight: Flight) -> list[tuple[Station, Station, float]]:
    """Pairs that share at least 30 % of the smaller footprint, with the angle between their rays to the middle."""
    seen = footprints(flight)
    found = []
    for i, j in combinations(range(len(seen)), 2):
        if overlap(seen[i], seen[j]) >= 0.3:
            first, second = flight.stations[i], flight.stations[j]
            middle = np.array([[*seen[i].intersection(seen[j]).centroid.coords[0], 0.0]])
            angle = view_angles_deg(center(first)[None], center(second)[None], middle)
            found.append((first, second, float(angle[0])))
    return found


def test_neighbours_of_a_nadir_flight_overlap_by_70_and_60_percent() -> None:
    # 54 pictures: sqrt(54 / 1.5) = 6 strips of 9.
    flight = plan("nadir", 54)
    seen = footprints(flight)
    ahead = [overlap(seen[k], seen[k + 1]) for k in range(53) if k % 9 != 8]
    # Strips are flown to and fro: picture s of one lies beside picture 8 - s of the next.
    beside = [overlap(seen[9 * strip + s], seen[9 * strip + 17 - s]) for strip in range(5) for s in range(9)]
    # Between two pictures 2 degrees of tilt and 0.9 m of drift are sqrt(2) x 3.3 m of the 75 m of a footprint: 6 %.
    assert np.median(ahead) == pytest.approx(0.70, abs=0.04)
    assert np.median(beside) == pytest.approx(0.60, abs=0.04)
    assert min(ahead) > 0.7 - 4 * 0.06
    assert min(beside) > 0.6 - 4 * 0.06
    assert gsd_m(flight) == pytest.approx(GSD_M, rel=2e-3)


class StillAir(np.random.Generator):
    """Draws nothing but zeros: a flight without wobble."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def standard_normal(self, size: int) -> FloatArray:  # type: ignore[override]
        return np.zeros(size)


def in_still_air(name: str, images: int) -> Flight:
    return plan_flight(
        name, images=images, width_px=WIDTH, height_px=HEIGHT, height_m=HEIGHT_M, lens="SIMPLE_PINHOLE", rng=StillAir()
    )


def test_without_wobble_overlaps_and_angles_are_exact() -> None:
    seen = footprints(in_still_air("nadir", 54))
    assert [overlap(seen[k], seen[k + 1]) for k in range(8)] == pytest.approx([0.70] * 8, abs=1e-6)
    # The next strip flies the other way: the principal point, 0.4 % and 0.35 % off the middle, shifts both footprints.
    beside = (0.60 - 2 * 0.004) * (1.0 - 2 * 0.0035)
    assert [overlap(seen[k], seen[17 - k]) for k in range(9)] == pytest.approx([beside] * 9, abs=1e-6)
    assert [p.area for p in seen] == pytest.approx([100.0 * 75.0] * 54, rel=1e-6)
    rig = in_still_air("oblique", 5).stations
    assert [tilt(s) for s in rig] == pytest.approx([0.0, 45.0, 45.0, 45.0, 45.0], abs=1e-5)
    assert [turn(azimuth(axis(s)), look) for s, look in zip(rig[1:], (0, 180, 270, 90), strict=True)] == (
        pytest.approx([0.0] * 4, abs=1e-5)
    )
    looks = [axis(s) for s in in_still_air("sweep", 9).stations]
    assert [np.rad2deg(np.arctan2(v[0], -v[2])) for v in looks] == pytest.approx(SWEEP_ANGLES_DEG, abs=1e-5)
    for station in in_still_air("orbit", 9).stations:
        middle = center(station) + axis(station) * np.linalg.norm(center(station))
        assert middle == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    middles = np.array([p.centroid.coords[0] for p in footprints(in_still_air("mixed", 24))])
    # Obliques reach farther beyond the middle of the round than short of it: a third of a flying height at most.
    assert np.abs(middles).max() < HEIGHT_M * 1.35 / 3.0


def test_nadir_strips_are_flown_to_and_fro_with_the_wobble_of_a_real_flight() -> None:
    flight = plan("nadir", 54)
    for k, station in enumerate(flight.stations):
        assert turn(azimuth(picture_top(station)), 0.0 if k // 9 % 2 == 0 else 180.0) < 10.0
    tilts = [tilt(s) for s in flight.stations]
    # Two independent angles of sigma 2: the mean of the tilt is 2 sqrt(pi / 2) = 2.5 degrees.
    assert np.mean(tilts) == pytest.approx(2.5, abs=0.6)
    assert np.std([s.exterior.z_m for s in flight.stations]) == pytest.approx(0.03 * HEIGHT_M, rel=0.35)
    assert {s.height_m for s in flight.stations} == {HEIGHT_M}
    # First strip: side step 0.4 x 800 x 0.125 m = 40 m, forward step 0.3 x 600 x 0.125 m = 22.5 m, centred.
    assert flight.stations[0].exterior.x_m == pytest.approx(-2.5 * 40.0, abs=4.0)
    assert flight.stations[0].exterior.y_m == pytest.approx(-4 * 22.5, abs=4.0)


def test_the_rig_looks_down_and_to_four_sides_at_45_degrees() -> None:
    flight = plan("oblique", 60)
    assert set(flight.cameras) == {"1", "2", "3", "4", "5"}
    looks = {"2": 0.0, "3": 180.0, "4": 270.0, "5": 90.0}
    for k in range(0, 60, 5):
        rig = {s.camera_id: s for s in flight.stations[k : k + 5]}
        assert list(rig) == ["1", "2", "3", "4", "5"]
        assert len({(s.exterior.x_m, s.exterior.y_m, s.exterior.z_m) for s in rig.values()}) == 1
        # 12 stations in two strips: the first runs north, the second south.
        heading = 0.0 if k < 30 else 180.0
        assert tilt(rig["1"]) < 8.0
        for camera_id, look in looks.items():
            assert tilt(rig[camera_id]) == pytest.approx(45.0, abs=7.0)
            assert turn(azimuth(axis(rig[camera_id])), heading + look) < 12.0
            # The top of an oblique picture points outwards and up.
            assert picture_top(rig[camera_id])[2] == pytest.approx(np.sqrt(0.5), abs=0.1)
            # The cameras are bolted together: 45 degrees from the nadir axis whatever the aircraft does.
            assert axis(rig["1"]) @ axis(rig[camera_id]) == pytest.approx(np.cos(np.deg2rad(45.0)), abs=1e-6)
    # At the slant distance the longer lens of an oblique camera samples like the nadir camera.
    assert np.sqrt(2.0) * HEIGHT_M / focal_px(flight.cameras["2"]) == pytest.approx(GSD_M, rel=2e-3)


def test_oblique_pictures_overlap_nadir_and_opposite_ones_of_other_stations() -> None:
    flight = plan("oblique", 60)
    places = [(s.exterior.x_m, s.exterior.y_m) for s in flight.stations]
    assert len(set(places)) == 12
    elsewhere = [p for p in overlapping(flight) if center(p[0])[:2].tolist() != center(p[1])[:2].tolist()]
    kinds = [(a.camera_id == "1") + (b.camera_id == "1") for a, b, _ in elsewhere]
    assert kinds.count(1) >= 30
    opposite = [
        p
        for p in elsewhere
        if turn(azimuth(axis(p[0])), azimuth(axis(p[1]))) > 150.0 and "1" not in (p[0].camera_id, p[1].camera_id)
    ]
    assert len(opposite) >= 10
    assert len(plan("oblique", 13).stations) == 13


def test_a_sweep_rolls_the_long_camera_from_right_to_left() -> None:
    flight = plan("sweep", 36)
    assert len(SWEEP_ANGLES_DEG) == 9
    assert focal_px(flight.cameras["6"]) == pytest.approx(4.0 * WIDTH, rel=1e-3)
    # Nine frames: 50, 37.5, .. -50 degrees; the strip in the west flies north and looks east first.
    for k, station in enumerate(flight.stations):
        expected = 50.0 - 12.5 * (k % 9)
        east = 1.0 if k < 18 else -1.0
        look = axis(station)
        assert np.rad2deg(np.arctan2(east * look[0], -look[2])) == pytest.approx(expected, abs=3.0)
        assert abs(np.rad2deg(np.arcsin(look[1]))) < 3.0
        assert turn(azimuth(picture_top(station)), 0.0 if east > 0 else 180.0) < 4.0
        # 4 / 0.9 times the height of the nadir flight, for the same ground sampling distance.
        assert station.height_m == pytest.approx(400.0)
    assert gsd_m(flight) == pytest.approx(GSD_M, rel=2e-3)
    strips = [np.mean([s.exterior.x_m for s in part]) for part in (flight.stations[:18], flight.stations[18:])]
    assert strips[1] - strips[0] == pytest.approx(0.97 * 400.0, abs=3.0)


def test_sweeps_from_two_sides_see_the_same_ground_30_to_80_degrees_apart() -> None:
    pairs = overlapping(plan("sweep", 36))
    apart = [p for p in pairs if 30.0 <= p[2] <= 80.0]
    assert len(apart) >= 20
    # From opposite sides: one looks east, the other west, or one of them straight down.
    assert all(axis(a)[0] * axis(b)[0] < 0.05 or abs(center(a)[0] - center(b)[0]) > 300.0 for a, b, _ in apart)


def test_an_orbit_looks_at_the_middle_from_every_heading() -> None:
    flight = plan("orbit", 30)
    for k, station in enumerate(flight.stations):
        place, look = center(station), axis(station)
        hit = place + look * (place[2] / -look[2])
        assert np.hypot(*hit[:2]) < 0.08 * HEIGHT_M  # aimed with a sigma of 2 % of the height
        assert turn(azimuth(look), 12.0 * k) < 4.0
        assert 32.0 < tilt(station) < 58.0
        assert np.linalg.norm(place) == pytest.approx(np.sqrt(2.0) * HEIGHT_M, rel=0.04)
    tilts = np.array([tilt(s) for s in flight.stations])
    assert np.ptp(tilts) > 15.0
    assert gsd_m(flight) == pytest.approx(GSD_M, rel=0.03)


def test_an_arc_looks_at_the_middle_from_one_side_and_far_beyond_it() -> None:
    flight = plan("arc", 9)
    for k, station in enumerate(flight.stations):
        place, look = center(station), axis(station)
        assert np.hypot(*(place + look * (place[2] / -look[2]))[:2]) < 0.1 * HEIGHT_M
        assert turn(azimuth(look), 8.0 * (k - 4)) < 4.0
        assert tilt(station) == pytest.approx((64.0, 60.0, 68.0)[k % 3], abs=2.5)
    assert gsd_m(flight) == pytest.approx(GSD_M, rel=0.03)
    # Half the opening angle of the picture's shorter side below the horizon: no picture shows the sky.
    upper_deg = np.rad2deg(np.arctan2(0.5 * HEIGHT, focal_px(flight.cameras["2"])))
    assert 76.0 < 60.0 + upper_deg < 68.0 + upper_deg < 85.0
    # A long arc is a circle: no two pictures of many have one place.
    headings = sorted(azimuth(axis(s)) % 360.0 for s in plan("arc", 90).stations)
    assert np.median(np.diff(headings)) == pytest.approx(4.0, abs=1.0)


def test_the_second_flight_crosses_the_first_at_1_35_times_its_height() -> None:
    flight = plan("two-flights", 25)
    parts = [[s for s in flight.stations if s.sortie == sortie] for sortie in (0, 1)]
    assert [len(part) for part in parts] == [13, 12]
    for part, height, heading in zip(parts, (90.0, 121.5), (0.0, 75.0), strict=True):
        assert [s.height_m for s in part] == pytest.approx([height] * len(part))
        assert np.mean([s.exterior.z_m for s in part]) == pytest.approx(height, rel=0.03)
        # To and fro: twice the direction is the same for both.
        assert all(turn(2.0 * azimuth(picture_top(s)), 2.0 * heading) < 20.0 for s in part)
    assert list(flight.cameras) == ["1"]
    # The second flight starts half a strip before its middle, along its own heading.
    assert sum(a.sortie != b.sortie for a, b, _ in overlapping(flight)) >= 50


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_mixed_flight_of_24_holds_every_kind_of_pair(seed: int) -> None:
    flight = plan("mixed", 24, seed)
    assert [s.sortie for s in flight.stations] == [0] * 12 + [1] * 12
    heights = {(s.sortie, s.camera_id == "6"): s.height_m for s in flight.stations}
    assert heights == pytest.approx({(0, False): 90.0, (0, True): 400.0, (1, False): 121.5, (1, True): 540.0})

    def kind(station: Station) -> str:
        return {"1": "nadir", "6": "sweep"}.get(station.camera_id, "oblique")

    counts: dict[tuple[str, bool], int] = {}
    for first, second, angle in overlapping(flight):
        name = "-".join(sorted((kind(first), kind(second))))
        if name == "oblique-oblique" and turn(azimuth(axis(first)), azimuth(axis(second))) < 150.0:
            continue
        if name == "oblique-oblique":
            assert angle > 70.0
        key = name, first.sortie != second.sortie
        counts[key] = counts.get(key, 0) + 1
    for name in ("nadir-nadir", "nadir-oblique", "oblique-oblique", "sweep-sweep", "nadir-sweep", "oblique-sweep"):
        assert counts[name, False] >= 6, (name, counts)
        assert counts[name, True] >= 6, (name, counts)
    area = ground_area(flight, 0.0)
    # One small ground: three flying heights and a half wide at most.
    assert max(area.x1_m - area.x0_m, area.y1_m - area.y0_m) < 3.7 * HEIGHT_M


def test_few_images_of_a_mixed_flight_are_spread_over_sorties_and_kinds() -> None:
    assert {(s.sortie, s.camera_id in "16") for s in plan("mixed", 6).stations} == {
        (0, True),
        (0, False),
        (1, True),
        (1, False),
    }
    many = plan("mixed", 48)
    assert set(many.cameras) == {"1", "2", "3", "4", "5", "6"}
    # The second round lies a quarter of the height beside the first.
    assert len({(s.exterior.x_m, s.exterior.y_m) for s in many.stations}) == 48


def test_the_area_is_the_rectangle_around_all_footprints() -> None:
    flight = plan("oblique", 10)
    union = shapely.union_all(footprints(flight)).bounds
    area = ground_area(flight, 15.0)
    np.testing.assert_allclose((area.x0_m, area.y0_m), np.array(union[:2]) - 15.0)
    np.testing.assert_allclose((area.x1_m, area.y1_m), np.array(union[2:]) + 15.0)
    nearer = ground_area(flight, 0.0, z_m=30.0)
    assert area.x0_m < nearer.x0_m
    assert nearer.x1_m < area.x1_m
    with pytest.raises(ConfigError, match="fly higher"):
        ground_area(flight, 0.0, z_m=500.0)


@pytest.mark.parametrize("name", FLIGHTS)
@pytest.mark.parametrize("images", [1, 2, 7, 31])
def test_every_flight_takes_the_pictures_asked_for_and_sees_ground(name: str, images: int) -> None:
    flight = plan(name, images)
    assert flight.name == name
    assert len(flight.stations) == images
    assert {s.camera_id for s in flight.stations} == set(flight.cameras)
    assert all(p.is_valid and p.area > 1000.0 for p in footprints(flight))
    steepest_deg = 72.0 if name == "arc" else 60.0
    assert all(tilt(s) < steepest_deg and s.exterior.z_m > 0.0 for s in flight.stations)
    assert gsd_m(flight) > 0.0


@pytest.mark.parametrize("name", FLIGHTS)
def test_seeds_and_text_give_the_same_poses_again(name: str) -> None:
    flight = plan(name, 12, seed=4)
    assert flight == plan(name, 12, seed=4)
    assert flight.stations != plan(name, 12, seed=5).stations
    for station in flight.stations:
        for exterior in (station.exterior, noisy(station.exterior, np.random.default_rng(1), station.height_m)):
            values = [exterior.x_m, exterior.y_m, exterior.z_m]
            angles = [exterior.omega_deg, exterior.phi_deg, exterior.kappa_deg]
            text = [f"{v:.4f}" for v in values] + [f"{v:.6f}" for v in angles]
            assert Exterior(*(float(v) for v in text)) == exterior
            assert all(-180.0 <= v <= 180.0 for v in angles)


def test_noise_is_five_percent_of_the_height_and_three_degrees() -> None:
    rng, exact = np.random.default_rng(0), Exterior(10.0, -20.0, 90.0, 1.0, 2.0, 179.0)
    drawn = [noisy(exact, rng, 200.0) for _ in range(2000)]
    places = np.array([[e.x_m - 10.0, e.y_m + 20.0, e.z_m - 90.0] for e in drawn])
    angles = np.array(
        [[e.omega_deg - 1.0, e.phi_deg - 2.0, (e.kappa_deg - 179.0 + 180.0) % 360.0 - 180.0] for e in drawn]
    )
    np.testing.assert_allclose(places.std(axis=0), 10.0, rtol=0.06)
    np.testing.assert_allclose(angles.std(axis=0), 3.0, rtol=0.06)


@pytest.mark.parametrize("lens", MODELS)
@pytest.mark.parametrize("focal_share", [0.9, 1.27, 4.0])
def test_every_lens_is_one_to_one_over_the_picture(lens: str, focal_share: float) -> None:
    camera = make_camera(lens, WIDTH, HEIGHT, focal_share)
    x, y = np.meshgrid(np.linspace(-0.5, WIDTH - 0.5, 41), np.linspace(-0.5, HEIGHT - 0.5, 31))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    straight = undistort(camera, pixels)
    np.testing.assert_allclose(distort(camera, straight), pixels, atol=1e-6)
    p = parameters(camera)
    # Corner origin: 0.504 x 800 and 0.4965 x 600, half a pixel less in the frame of pixel centres.
    assert (p["cx"], p["cy"]) == pytest.approx((402.7, 297.4))
    corner = np.array([[p["cx"] + 400.0, p["cy"] + 300.0]])
    moved = distort(camera, corner) - corner
    if lens == FISHEYE:
        # Inwards of the equidistant place, f times the angle, by 1.5 % of it at the corner and less within.
        equidistant = p["fx"] * np.arctan(500.0 / p["fx"])
        assert 500.0 + moved[0] @ [0.8, 0.6] == pytest.approx(equidistant * 0.9865, rel=2.5e-3)
    elif has_distortion(camera):
        # Barrel: inwards by 1.5 % of 500 px, and at most a fifth of that by decentring.
        assert moved[0] @ [-0.8, -0.6] == pytest.approx(7.5, abs=1.0)
    else:
        assert np.abs(moved).max() == 0.0
    assert all(v != 0.0 for v in camera.params)


@given(width=st.integers(64, 6000), height=st.integers(64, 6000), share=st.floats(0.6, 5.0))
@settings(max_examples=30, deadline=None)
def test_the_corners_have_rays_whatever_the_format(width: int, height: int, share: float) -> None:
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    for lens in MODELS:
        camera = make_camera(lens, width, height, share)
        np.testing.assert_allclose(distort(camera, undistort(camera, corners)), corners, atol=1e-5)


def test_wrong_orders_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"'zigzag'.*nadir, oblique, sweep, orbit, arc, two-flights, mixed, cross"):
        plan("zigzag", 3)
    with pytest.raises(ConfigError, match=r"'FISHEYE'.*SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV"):
        plan("nadir", 3, lens="FISHEYE")
    with pytest.raises(ConfigError, match="0 images"):
        plan("nadir", 0)
    for width, height_m in ((0, 90.0), (800, 0.0), (800, float("nan"))):
        with pytest.raises(ConfigError, match="positive"):
            plan_flight(
                "nadir",
                images=3,
                width_px=width,
                height_px=600,
                height_m=height_m,
                lens="OPENCV",
                rng=np.random.default_rng(0),
            )


def test_flights_of_calibrations_have_strips_across_second_heights_and_tilts() -> None:
    cross = in_still_air("cross", 24).stations
    assert Counter(round(s.heading_deg) % 180 for s in cross) == {0: 16, 90: 8}
    assert {s.exterior.z_m for s in cross} == {HEIGHT_M}
    heights = Counter(round(s.exterior.z_m / HEIGHT_M, 6) for s in in_still_air("two-heights", 24).stations)
    assert heights == {1.0: 12, 1.35: 12}
    tilted = in_still_air("tilted", 24).stations
    assert Counter(round(tilt(s)) for s in tilted) == {0: 16, 30: 8}
    for station in tilted[16:]:  # they look where they fly
        assert turn(azimuth(axis(station)), station.heading_deg) < 1e-3
    rig = in_still_air("dense-rig", 20)
    assert len(rig.cameras) == 5
    assert overlap(*footprints(rig)[0:6:5]) == pytest.approx(0.70, abs=1e-6)


def test_real_lenses_differ_by_camera_and_seed() -> None:
    cameras = plan("dense-rig", 5, lens="REAL").cameras
    assert len(set(cameras.values())) == 5
    assert {camera.model for camera in cameras.values()} == {"BROWN"}
    assert plan("dense-rig", 5, lens="REAL").cameras == cameras
