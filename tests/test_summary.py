"""Each implausible block raises exactly its own warning; a clean block none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_results import filled

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.blocks.summary import summarise
from aeromatch_cli.data import Block, Camera, FloatArray, Image, Pair, Pose
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, from_yaw_pitch_roll
from aeromatch_cli.results.stages import OrientResult
from aeromatch_cli.sfm.mapping import Group, own_frames
from aeromatch_cli.stages.messages import frame_remarks

CAMERA = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
ORIGIN = (333000.0, 3100000.0, 0.0)  # EPSG:32617


def block(
    centers_m: FloatArray | None = None,
    rotations: list[FloatArray | None] | None = None,
    *,
    ground_z_m: float = 120.0,
    crs: str = "EPSG:32617",
) -> Block:
    """Six images, 100 m above ground, 20 m apart, tilted and turned a little each."""
    if centers_m is None:
        centers_m = np.array([[20.0 * i, 5.0 * i, 220.0 + i] for i in range(6)])
    if rotations is None:
        rotations = [from_omega_phi_kappa(2.0 + i, -1.0 * i, 80.0 + i) for i in range(6)]
    images = tuple(Image(f"img{i}", f"flight/img{i}.jpg", 1000, 800, "cam") for i in range(6))
    poses = {f"img{i}": Pose(c, r, 1.0, 1.0) for i, (c, r) in enumerate(zip(centers_m, rotations, strict=True))}
    return Block(images, {"cam": CAMERA}, poses, crs, ORIGIN, ConstantGround(ground_z_m), "given: 120 m", None)


def centers(**changes: FloatArray | float) -> FloatArray:
    found = block()
    values = np.array([found.poses[image.image_id].center_m for image in found.images])
    for axis, value in changes.items():
        values[:, "xyz".index(axis)] = value
    return values


def test_clean_block_has_figures_and_no_warning() -> None:
    pairs = [
        Pair("img0", "img1", 0.8, 10.0, "overlap"),
        Pair("img1", "img2", 0.6, 10.0, "overlap"),
        Pair("img3", "img4", float("nan"), float("nan"), "position"),
        Pair("img4", "img5", 0.5, 10.0, "overlap"),
    ]
    summary = summarise(block(), pairs)
    assert summary.warnings == ()
    assert (summary.images, summary.positioned, summary.oriented, summary.cameras) == (6, 6, 6, 1)
    assert summary.flying_height_m == pytest.approx((100.0, 102.5, 105.0))
    assert summary.extent_m == pytest.approx((100.0, 25.0))
    assert summary.max_tilt_deg > summary.mean_tilt_deg > 2.0
    assert summary.gsd_m == pytest.approx(0.103, rel=0.02)
    # Best neighbours: 0.8, 0.8, 0.6, unknown, 0.5, 0.5.
    assert summary.best_overlap == pytest.approx((0.8 + 0.8 + 0.6 + 0.5 + 0.5) / 5)
    assert summary.pairs_by_reason == (("overlap", 3), ("position", 1))
    text = "\n".join([*summary.given_lines(), *summary.lines()])
    for part in ("6, 6 with position", "EPSG:32617", "given: 120 m", "102.5 m (100.0 to 105.0)", "100.0 m east-west"):
        assert part in text


RELATIVE = centers(z=np.linspace(98.0, 102.0, 6))
ONE_BELOW = centers()
ONE_BELOW[2, 2] = 100.0
NULL_ISLAND = centers()
# Latitude 0, longitude 0 as UTM zone 31 would have it is outside of zone 17: the raw coordinates are zero here.
NULL_ISLAND[4, :2] = -np.array(ORIGIN[:2])
FAR = centers()
FAR[5, 0] += 1.2e6
PLACES = centers()
PLACES[3:, 1] += 60_000.0
LOW = centers(z=122.0)
HIGH = centers(z=12120.0 + np.arange(6))
TILTED = [from_omega_phi_kappa(2.0, 1.0, 10.0 * i) for i in range(6)]


@pytest.mark.parametrize(
    ("case", "words"),
    [
        (block(ONE_BELOW), ["1 image (flight/img2.jpg)", "below the ground (120 m)", "--ground"]),
        (block(RELATIVE), ["relative to the take-off point", "98 to 102 m", "6 images", "--ground"]),
        (block(centers(z=6.0), ground_z_m=-58.0), ["ground lies at -58 m", "take-off point, or from the ellipsoid"]),
        (block(NULL_ISLAND), ["1 image (flight/img4.jpg)", "latitude 0, longitude 0"]),
        (block(FAR), ["lie in 2 places 1,200 km apart", "flight/img4.jpg); 1 image (flight/img5.jpg).", "--crs"]),
        (
            block(PLACES),
            ["lie in 2 places 60 km apart", "3 images (flight/img0.jpg, flight/img1.jpg, flight/img2.jpg); 3"],
        ),
        (block(centers(x=0.0, y=0.0)), ["all 6 positions are identical"]),
        (block(LOW), ["6 images", "2.0 to 2.0 m above ground"]),
        (block(HIGH), ["6 images", "12,000.0 to 12,005.0 m above ground"]),
        (block(rotations=[from_omega_phi_kappa(0.0, 0.0, 0.0)] * 6), ["all angles of 6 images", "zero"]),
        (block(rotations=[from_yaw_pitch_roll(-0.8, 0, 0, forward=True)] * 6), ["all angles of 6 images", "zero"]),
        (block(rotations=[from_yaw_pitch_roll(1.5, 0, 0, forward=False)] * 6), ["all angles of 6 images", "zero"]),
        (
            block(rotations=[*TILTED[:2], *[from_omega_phi_kappa(75.0, 0, i) for i in range(4)]]),
            ["4 images (flight/img2.jpg, flight/img3.jpg, flight/img4.jpg, flight/img5.jpg)", "horizon in view"],
        ),
    ],
    ids=[
        "one below ground",
        "relative altitude",
        "low ground",
        "null island",
        "far away",
        "two places",
        "identical",
        "low",
        "high",
        "zero omega phi kappa",
        "zero gimbal angles",
        "zero body angles",
        "horizon",
    ],
)
def test_each_oddity_gives_exactly_its_warning(case: Block, words: list[str]) -> None:
    warnings = summarise(case).warnings
    assert len(warnings) == 1, warnings
    for word in words:
        assert word in warnings[0]


def test_far_positions_are_one_place_where_others_lie_between() -> None:
    far = centers()
    far[:, 0] = 40_000.0 * np.arange(6)
    assert summarise(block(far)).warnings == ()
    far[3:, 0] += 20_000.0
    (warning,) = summarise(block(far)).warnings
    assert "lie in 2 places 140 km apart" in warning  # from 40 to 180 km


def test_ground_below_sea_level_is_not_odd_where_all_images_fly_below_it() -> None:
    assert summarise(block(centers(z=-310.0), ground_z_m=-417.0)).warnings == ()


def test_null_island_as_geographic_position() -> None:
    # In UTM zone 31 (central meridian 3 E) latitude 0, longitude 0 is easting 166021, northing 0.
    found = block(NULL_ISLAND)
    moved = {
        i: replace(p, center_m=p.center_m + np.array([166021.0, 0, 0])) if i == "img4" else p
        for i, p in found.poses.items()
    }
    found = replace(found, crs="EPSG:32631", poses=moved)
    (warning,) = summarise(found).warnings
    assert "latitude 0, longitude 0" in warning


def test_local_frame_may_hold_zero_and_low_ground() -> None:
    shifted = replace(block(centers(z=42.0), ground_z_m=-58.0, crs="local"), origin_m=(0.0, 0.0, 0.0))
    assert summarise(shifted).warnings == ()


def test_unpaired_images_are_named() -> None:
    pairs = [Pair(f"img{i}", f"img{i + 1}", 0.8, 5.0, "overlap") for i in range(4)]
    summary = summarise(block(), pairs)
    assert summary.unpaired == ("flight/img5.jpg",)
    (unpaired,) = summary.warnings
    assert "1 image (flight/img5.jpg)" in unpaired


def test_block_without_any_pose_is_summed_up() -> None:
    bare = replace(block(), poses={}, ground=None, ground_source="", crs="local")
    summary = summarise(bare, [Pair("img0", "img1", float("nan"), float("nan"), "name")])
    assert (summary.positioned, summary.oriented) == (0, 0)
    assert np.isnan(summary.flying_height_m).all()
    text = "\n".join([*summary.given_lines(), *summary.lines()])
    assert "without position 6: paired by name and time" in text
    assert "nan" not in text


def test_missing_attitude_is_stated() -> None:
    rotations: list[FloatArray | None] = [*TILTED[:4], None, None]
    summary = summarise(block(rotations=rotations))
    assert summary.warnings == ()
    assert "without attitude 2: paired by position" in summary.lines()
    given = summarise(block(rotations=[*TILTED]))
    words = "without attitude 2: those given contradict the pictures and are not used; paired by position"
    assert words in summary.lines(given)


def test_given_positions_that_a_frame_of_its_own_does_not_hold_are_said_to_be_given() -> None:
    """Two images with positions are not oriented, four without are, in a frame of their own."""
    whole = block()
    given = summarise(replace(whole, poses={i: whole.poses[i] for i in ("img0", "img1")}))
    oriented = {f"img{k}": whole.poses[f"img{k}"] for k in range(2, 6)}
    own = summarise(replace(whole, poses=oriented, crs="local", metric=False, frames=dict.fromkeys(oriented, 1)))
    assert "images           6, 2 with position, 2 with attitude, 1 camera" in given.given_lines()
    lines = own.lines(given)
    assert "outside frame    2: paired by name and time; the 2 given positions are not in it" in lines
    assert not any("without position" in line for line in lines)
    assert "outside frame    2: paired by name and time" in own.lines()


@pytest.mark.parametrize(
    ("given", "why"),
    [(0, "positions the result"), (2, "positions (2 given, none places a group of oriented images) the result")],
)
def test_a_frame_of_its_own_is_explained_by_the_positions_that_are_given(given: int, why: str) -> None:
    found = filled(OrientResult, frame="own", positions_given=given)
    (remark,) = frame_remarks(found, [Group("level", ("a", "b", "c"))])
    assert remark == f"without usable {why} is in a frame of its own: scale, north and place are arbitrary"


def test_images_are_apart_that_nothing_ties_to_the_world_or_to_the_largest_group() -> None:
    large, small, placed = Group("level", ("a", "b", "c")), Group("level", ("d", "e")), Group("positions", ("f",))

    def apart(*groups: Group) -> frozenset[str]:
        poses = {i: Pose(np.zeros(3), np.eye(3), 1.0, 1.0) for group in groups for i in group.images}
        return replace(block(), poses=poses, frames=own_frames(groups)).aside(in_world=False)

    assert apart(large, small) == {"d", "e"}
    assert apart(placed, large, small) == {"a", "b", "c", "d", "e"}
    assert apart(large) == apart(placed) == apart() == set()
    assert own_frames([placed, large, small]) == dict.fromkeys("abc", 1) | dict.fromkeys("de", 2)


def test_lengths_are_of_images_whose_places_to_each_other_are_known() -> None:
    """Two images lie 1000 units aside and as high, in a frame of their own, and are tilted there."""
    found = block()
    assert "extent           100.0 m east-west, 25.0 m north-south" in summarise(found).lines()
    far = {"img4": 1, "img5": 1}
    tilted = from_omega_phi_kappa(40.0, 0.0, 0.0)
    moved = {
        i: replace(p, center_m=p.center_m + 1000.0, world_rotation=tilted) if i in far else p
        for i, p in found.poses.items()
    }
    summary = summarise(replace(found, poses=moved, frames=far))
    alone = summarise(replace(found, images=found.images[:4]))
    (words,) = (line for line in summary.lines() if line.startswith("extent"))
    assert "60.0 m east-west, 15.0 m north-south, of 4 images that hang together; height, tilt and ground" in words
    assert (summary.positioned, summary.oriented, summary.together) == (6, 6, 4)
    assert summary.flying_height_m == pytest.approx(alone.flying_height_m)
    assert (summary.gsd_m, summary.max_tilt_deg) == (pytest.approx(alone.gsd_m), pytest.approx(alone.max_tilt_deg))
