"""Which pairs are chosen: overlaps by hand, caps, fallbacks, lists, speed."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.data import Block, Camera, Image, Pair, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.strategies.pairings import PAIRINGS
from aeromatch_cli.strategies.pairings.exhaustive import Exhaustive
from aeromatch_cli.strategies.pairings.file import PairFile
from aeromatch_cli.strategies.pairings.overlap import Overlap
from aeromatch_cli.strategies.pairings.sequential import Sequential

# 100 m above ground this camera sees 100 m x 80 m.
CAMERA = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
NADIR = from_omega_phi_kappa(0.0, 0.0, 0.0)


def pose(x: float, y: float, rotation: Any = NADIR, height_m: float = 100.0) -> Pose:
    return Pose(np.array([x, y, height_m]), rotation, 1.0, 1.0)


def block(poses: dict[str, Pose | None], times: dict[str, str] | None = None) -> Block:
    """Image ids are the keys, names are the keys with a folder and an extension."""
    images = tuple(
        Image(image_id, f"f/{image_id}.jpg", 1000, 800, "cam", time=(times or {}).get(image_id, ""))
        for image_id in sorted(poses)
    )
    known = {image_id: found for image_id, found in poses.items() if found is not None}
    return Block(images, {"cam": CAMERA}, known, "local", (0.0, 0.0, 0.0), ConstantGround(0.0), "given", 0.1)


def strip(count: int, spacing_m: float) -> dict[str, Pose | None]:
    return {f"i{n:03d}": pose(spacing_m * n, 0.0) for n in range(count)}


def keys(pairs: list[Pair]) -> list[tuple[str, str]]:
    return [(pair.image_id0, pair.image_id1) for pair in pairs]


def test_overlap_share_and_view_angle_by_hand() -> None:
    # 40 m apart: 60 m of 100 m shared; the middle of it is 20 m from either foot point, 100 m below.
    (pair,) = Overlap()(block({"b": pose(40.0, 0.0), "a": pose(0.0, 0.0)}))
    assert keys([pair]) == [("a", "b")]
    assert pair.overlap == pytest.approx(0.6)
    assert pair.view_angle_deg == pytest.approx(2.0 * np.rad2deg(np.arctan(0.2)))
    assert pair.reason == "overlap"


def test_share_is_of_the_smaller_footprint() -> None:
    (pair,) = Overlap()(block({"high": pose(0.0, 0.0, height_m=400.0), "low": pose(10.0, 20.0)}))
    assert pair.overlap == pytest.approx(1.0)


def test_minimum_overlap_and_view_angle_are_limits() -> None:
    flight = block(strip(6, 25.0))
    # Shares 0.75, 0.5, 0.25, 0: neighbours up to the third share something.
    shares = {round(pair.overlap, 6) for pair in Overlap(min_overlap=0.0)(flight)}
    assert shares == {0.75, 0.5, 0.25}
    assert {round(pair.overlap, 6) for pair in Overlap(min_overlap=0.3)(flight)} == {0.75, 0.5}
    # Angles 2 atan(0.125 n): 14.3, 28.1, 41.1 degrees.
    assert len(Overlap(max_view_angle_deg=30.0)(flight)) == 5 + 4
    assert len(Overlap(max_view_angle_deg=10.0, fallback_neighbours=1)(flight)) == 5


def test_converging_views_beyond_the_angle_are_left_out() -> None:
    east, west = from_omega_phi_kappa(0.0, 45.0, 0.0), from_omega_phi_kappa(0.0, -45.0, 0.0)
    facing = block({"a": pose(100.0, 0.0, east), "b": pose(-100.0, 0.0, west), "c": pose(100.0, 9.0, east)})
    pairs = {(p.image_id0, p.image_id1): p for p in Overlap(max_view_angle_deg=180.0)(facing)}
    # Both trapezoids meet between the cameras, where each looks 45 degrees off nadir at the other's foot.
    assert pairs["a", "b"].overlap > 0.3
    assert pairs["a", "b"].view_angle_deg == pytest.approx(90.0)
    assert keys([p for p in Overlap()(facing) if p.reason == "overlap"]) == [("a", "c")]


def test_near_horizon_footprints_are_cut() -> None:
    # Both look level to the north, 1400 m apart: without a cut their footprints would meet far away.
    level = from_omega_phi_kappa(85.0, 0.0, 0.0)
    views = block({"a": pose(0.0, 0.0, level), "b": pose(1400.0, 0.0, level), "c": pose(30.0, 0.0, level)})
    assert ("a", "b") not in keys(Overlap(fallback_neighbours=1)(views))
    assert ("a", "c") in keys(Overlap()(views))
    assert ("a", "b") in keys(Overlap(max_distance_factor=40.0, min_overlap=0.0)(views))


def test_cap_keeps_the_best_of_either_image() -> None:
    flight = block(strip(12, 5.0))
    pairs = Overlap(max_neighbours=2)(flight)
    # Inner images keep both direct neighbours; the ends keep their next two.
    assert set(keys(pairs)) == {(f"i{n:03d}", f"i{n + 1:03d}") for n in range(11)} | {
        ("i000", "i002"),
        ("i009", "i011"),
    }


def test_cap_never_splits_the_block() -> None:
    # Two dense strips, 60 m apart: all the best neighbours of an image lie in its own strip.
    poses: dict[str, Pose | None] = {f"a{n}": pose(float(n), 0.0) for n in range(10)}
    poses |= {f"b{n}": pose(float(n), 60.0) for n in range(10)}
    pairs = Overlap(max_neighbours=2)(block(poses))
    across = [pair for pair in pairs if pair.image_id0[0] != pair.image_id1[0]]
    assert len(across) == 1
    assert across[0].overlap == pytest.approx(0.25)


def test_image_without_attitude_gets_its_nearest_and_nothing_else_changes() -> None:
    poses = strip(8, 25.0)
    before = Overlap(fallback_neighbours=2)(block(poses))
    after = Overlap(fallback_neighbours=2)(block(poses | {"x": pose(60.0, 1.0, None)}))
    new = [pair for pair in after if "x" in (pair.image_id0, pair.image_id1)]
    assert [pair for pair in after if pair not in new] == before
    # x = 60 lies nearest to images 2 (50 m) and 3 (75 m).
    assert keys(new) == [("i002", "x"), ("i003", "x")]
    assert all(pair.reason == "position" and np.isnan(pair.overlap) and np.isnan(pair.view_angle_deg) for pair in new)


@pytest.mark.parametrize(
    "blind",
    [
        pose(60.0, 1.0, from_omega_phi_kappa(180.0, 0.0, 0.0)),
        pose(60.0, 1.0, height_m=-5.0),
        pose(60.0, 1.0, from_omega_phi_kappa(70.0, 0.0, 0.0), height_m=1.0),
    ],
    ids=["looks up", "below ground", "overlaps nothing"],
)
def test_images_that_see_no_common_ground_are_paired_by_position(blind: Pose) -> None:
    pairs = Overlap(fallback_neighbours=2, min_overlap=0.2)(block(strip(8, 25.0) | {"x": blind}))
    new = [pair for pair in pairs if "x" in (pair.image_id0, pair.image_id1)]
    assert keys(new) == [("i002", "x"), ("i003", "x")]
    assert {pair.reason for pair in new} == {"position"}


def test_image_without_position_gets_neighbours_by_name_and_time() -> None:
    poses = strip(8, 25.0) | {"i003b": None}
    times = {f"i{n:03d}": f"2024-05-01T10:00:{n:02d}" for n in range(8)} | {"i003b": "2024-05-01T10:00:06.5"}
    pairs = Overlap(fallback_neighbours=2)(block(poses, times))
    new = {(p.image_id0, p.image_id1): p.reason for p in pairs if "i003b" in (p.image_id0, p.image_id1)}
    assert new == {
        ("i003", "i003b"): "name",
        ("i003b", "i004"): "name",
        ("i003b", "i006"): "time",
        ("i003b", "i007"): "time",
    }
    untimed = Overlap(fallback_neighbours=2)(block(poses))
    assert {p.reason for p in untimed if "i003b" in (p.image_id0, p.image_id1)} == {"name"}


def test_images_of_different_places_are_not_paired_by_position() -> None:
    poses: dict[str, Pose | None] = {f"a{n}": pose(10.0 * n, 0.0, None) for n in range(3)}
    poses |= {f"b{n}": pose(10.0 * n, 60_000.0, None) for n in range(3)}
    pairs = Overlap()(block(poses))
    assert {pair.reason for pair in pairs} == {"position"}
    within = [("a0", "a1"), ("a0", "a2"), ("a1", "a2"), ("b0", "b1"), ("b0", "b2"), ("b1", "b2")]
    assert keys(pairs) == within
    near = {i: p if p is None or i[0] == "a" else pose(p.center_m[0], 40_000.0, None) for i, p in poses.items()}
    assert len(Overlap()(block(near))) == 15
    arbitrary = Overlap()(replace(block(poses), metric=False))  # whose lengths say nothing
    assert len(arbitrary) == 15


def test_image_that_lies_apart_from_all_others_is_paired_by_name() -> None:
    poses = strip(4, 25.0) | {"i001b": pose(0.0, 900_000.0, None)}
    pairs = Overlap(fallback_neighbours=2)(block(poses))
    new = {(p.image_id0, p.image_id1): p.reason for p in pairs if "i001b" in (p.image_id0, p.image_id1)}
    assert new == {("i001", "i001b"): "name", ("i001b", "i002"): "name"}


def test_nothing_known_at_all_is_paired_by_name() -> None:
    pairs = Overlap(fallback_neighbours=4)(block({f"i{n}": None for n in range(5)}))
    assert len(pairs) == 4 + 3
    assert {pair.reason for pair in pairs} == {"name"}


def test_block_without_ground_is_paired_by_position() -> None:
    flight = replace(block(strip(4, 25.0)), ground=None)
    pairs = Overlap(fallback_neighbours=1)(flight)
    assert keys(pairs)[0] == ("i000", "i001")
    assert {pair.reason for pair in pairs} == {"position"}


@pytest.mark.parametrize("name", ["overlap", "exhaustive", "sequential"])
@pytest.mark.parametrize("count", [0, 1])
def test_blocks_without_a_pair(name: str, count: int) -> None:
    assert PAIRINGS[name]()(block(strip(count, 10.0))) == []


@pytest.mark.parametrize("name", sorted(PAIRINGS))
def test_contract(name: str, tmp_path: Path) -> None:
    poses = strip(7, 20.0) | {"a-lost": None, "z-flat": pose(30.0, 5.0, None)}
    listed = tmp_path / "list.txt"
    listed.write_text("f/i004.jpg f/i001.jpg\nf/a-lost.jpg f/i000.jpg\n")
    strategy: Any = PAIRINGS[name](path=str(listed)) if name == "file" else PAIRINGS[name]()  # type: ignore[call-arg]
    assert strategy.name == name
    assert hash(strategy) == hash(strategy.model_copy())
    flight = block(poses)
    pairs = strategy(flight)
    found = keys(pairs)
    assert found == sorted(set(found))
    assert all(id0 < id1 for id0, id1 in found)
    shuffled = replace(flight, images=flight.images[::-1], poses=dict(reversed(flight.poses.items())))
    # The order of the images changes nothing (NaN compares by repr).
    assert repr(strategy(shuffled)) == repr(pairs)
    for pair in pairs:
        known = not {"a-lost", "z-flat"} & {pair.image_id0, pair.image_id1}
        assert np.isfinite(pair.overlap) == known


def test_exhaustive_measures_every_pair() -> None:
    pairs = Exhaustive()(block(strip(5, 40.0)))
    assert len(pairs) == 10
    shares = [pair.overlap for pair in pairs if pair.image_id0 == "i000"]
    np.testing.assert_allclose(shares, [0.6, 0.2, 0.0, 0.0], atol=1e-12)
    assert np.isnan(pairs[3].view_angle_deg)


def test_sequential_by_name_and_by_time() -> None:
    poses = {name: pose(0.0, 0.0) for name in "abcd"}
    assert keys(Sequential(window=1)(block(poses))) == [("a", "b"), ("b", "c"), ("c", "d")]
    assert len(Sequential(window=2)(block(poses))) == 5
    times = {"a": "2024-01-01T00:00:02", "b": "2024-01-01T00:00:01", "c": "2024-01-01T00:00:03"}
    by_time = Sequential(window=1, order="time")(block(poses, times))
    assert keys(by_time) == [("a", "b"), ("a", "c"), ("c", "d")]


@pytest.mark.parametrize(
    "text",
    [
        "f/b.jpg f/a.jpg\nf/a.jpg f/c c.jpg\n",
        "# comment\n\nf/a.jpg,f/b.jpg,0.9\n f/c c.jpg , f/a.jpg\n",
        "image0;image1\nf/a.jpg;f/b.jpg\nf/a.jpg;f/c c.jpg\nf/c c.jpg;f/a.jpg\n",
        "\ufefff\\a.jpg\tf\\b.jpg\r\nf\\a.jpg\tf\\c c.jpg\r\n",
    ],
    ids=["blanks", "comma", "semicolon and header", "tab, byte order mark and backslashes"],
)
def test_pair_list(text: str, tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    path.write_text(text, encoding="utf-8")
    flight = block({"a": pose(0.0, 0.0), "b": pose(10.0, 0.0), "c c": None})
    pairs = PairFile(path=str(path))(flight)
    assert keys(pairs) == [("a", "b"), ("a", "c c")]
    assert pairs[0].overlap == pytest.approx(0.9)
    assert {pair.reason for pair in pairs} == {"file"}
    assert PairFile(path=str(path)).fingerprint_files() == (str(path),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("f/a.jpg f/b.jpg\nf/a.jpg f/zzz.jpg\n", ["line 2", "'f/zzz.jpg'"]),
        ("f/a.jpg\n", ["line 1", "two image names"]),
        ("f/a.jpg,f/a.jpg\n", ["line 1", "itself"]),
        ("# nothing\n", ["no pair"]),
    ],
)
def test_pair_list_errors_name_the_line(text: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        PairFile(path=str(path))(block({"a": None, "b": None}))
    for word in [*words, "pairs.csv"]:
        assert word in str(error.value)


def test_missing_pair_list() -> None:
    with pytest.raises(ConfigError, match=r"pairs\.path"):
        PairFile()(block({"a": None}))
    with pytest.raises(ConfigError, match="cannot read the pair list absent"):
        PairFile(path="absent.txt")(block({"a": None}))


@pytest.mark.slow
@pytest.mark.parametrize("tilts_deg", [(0.0,), (0.0, 40.0, -40.0)], ids=["nadir", "oblique"])
def test_screening_loses_no_pair_that_the_cap_keeps(tilts_deg: tuple[float, ...], monkeypatch: Any) -> None:
    rng = np.random.default_rng(4)
    poses: dict[str, Pose | None] = {}
    for number in range(240 // len(tilts_deg)):
        for camera, tilt in enumerate(tilts_deg):
            rotation = from_omega_phi_kappa(tilt + rng.normal(0, 2), rng.normal(0, 2), rng.uniform(-180, 180))
            poses[f"i{number:03d}{camera}"] = pose(*rng.uniform(0.0, 120.0, 2), rotation, rng.uniform(90.0, 130.0))
    flight, strategy = block(poses), Overlap(max_neighbours=12)
    screened = strategy(flight)
    monkeypatch.setattr("aeromatch_cli.strategies.pairings.overlap._CANDIDATES_PER_NEIGHBOUR", 1000)
    exact = strategy(flight)
    assert len(exact) > 1200
    common = set(keys(exact)) & set(keys(screened))
    assert len(common) >= 0.995 * len(exact)
    assert len(screened) <= 1.005 * len(exact)


@pytest.mark.slow
def test_two_thousand_images_in_seconds() -> None:
    rng = np.random.default_rng(1)
    poses: dict[str, Pose | None] = {}
    for row in range(40):
        for column in range(50):
            rotation = from_omega_phi_kappa(*rng.normal(0.0, 3.0, 2), 180.0 * (row % 2) + rng.normal(0.0, 5.0))
            poses[f"r{row:02d}c{column:02d}"] = pose(20.0 * column, 32.0 * row, rotation)
    start = time.perf_counter()
    pairs = Overlap()(block(poses))
    assert time.perf_counter() - start < 12.0
    # 80 % forward and 60 % side overlap: four neighbours each way in the strip, two strips each way.
    per_image = 2.0 * len(pairs) / len(poses)
    assert 25.0 < per_image < 40.0
