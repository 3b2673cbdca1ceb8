from __future__ import annotations

import contextlib
import csv
import io
import os
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from make_features import random_features

from aeromatch_cli.data import Camera, Features, Image, Matches, Pair, Pose, Verdict
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats.features import features_fingerprint, read_features, read_keypoints, write_features
from aeromatch_cli.formats.rows import (
    MatchEntry,
    VerifiedEntry,
    read_match_row,
    read_verified_row,
    write_match_row,
    write_verified_row,
)
from aeromatch_cli.formats.tables import (
    cameras_text,
    csv_text,
    images_text,
    pairs_text,
    poses_text,
    read_cameras,
    read_csv,
    read_images,
    read_pairs,
    read_poses,
)
from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.store.index import Index

FINITE = st.floats(allow_nan=False, allow_infinity=False)
quick = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def written(folder: Path, text: str) -> Path:
    path = folder / "x.csv"
    path.write_text(text, encoding="utf-8", newline="")
    return path


def archived(folder: Path, write: Any, *args: Any, name: str = "x.npz") -> Path:
    with (folder / name).open("wb") as stream:
        write(stream, *args)
    return folder / name


def matches(count: int, *, seed: int = 0, measured: bool = False) -> Matches:
    rng = np.random.default_rng(seed)
    indices = rng.integers(0, 60000, (count, 2)).astype(np.int32)
    points = [None, None]
    if measured:
        indices[::2] = -1
        points = [rng.random((count, 2)) * 5472, rng.random((count, 2)) * 5472]  # type: ignore[list-item]
    views = rng.integers(0, 3, (count, 2)).astype(np.int16)
    return Matches(indices, rng.random(count).astype(np.float32), views, *points)


def assert_same_matches(found: Matches, expected: Matches) -> None:
    np.testing.assert_array_equal(found.indices, expected.indices)
    np.testing.assert_array_equal(found.scores, expected.scores)
    assert found.indices.dtype == np.int32
    assert found.scores.dtype == np.float32
    assert found.indices.shape == (len(expected.indices), 2)


# --- tables ---------------------------------------------------------------------------------------------------------


@quick
@given(values=st.lists(FINITE, min_size=1, max_size=5))
def test_csv_floats_come_back_to_the_last_bit(tmp_path: Path, values: list[float]) -> None:
    path = written(tmp_path, csv_text([f"c{i}" for i in range(len(values))], [values, [*map(np.float64, values)]]))
    for row in read_csv(path):
        assert [float(cell) for cell in row.values()] == values


@quick
@given(text=st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x00"), max_size=20))
def test_csv_text_comes_back(tmp_path: Path, text: str) -> None:
    assert read_csv(written(tmp_path, csv_text(("a", "b"), [(text, "end")]))) == [{"a": text, "b": "end"}]


def test_csv_unknown_cells_are_empty() -> None:
    rows = list(csv.reader(io.StringIO(csv_text("abcd", [(None, float("nan"), np.float64("nan"), 0.1)]))))
    assert rows == [["a", "b", "c", "d"], ["", "", "", "0.1"]]


def test_images_round_trip(tmp_path: Path) -> None:
    images = (
        Image("a--1_jpg", "a/1.jpg", 5472, 3648, "c0", 6, "2024-05-01T10:00:00"),
        Image("u-0123", 'ü "b", c/Ωλ\u3042.jpg', 1, 2, "c1"),
    )
    path = written(tmp_path, images_text(images, {"a--1_jpg": "f0", "u-0123": "f1"}))
    assert read_images(path) == images
    assert [row["fingerprint"] for row in read_csv(path)] == ["f0", "f1"]


@quick
@given(params=st.lists(FINITE, min_size=8, max_size=8))
def test_cameras_round_trip(tmp_path: Path, params: list[float]) -> None:
    cameras = {"b": Camera("OPENCV", 10, 20, tuple(params)), "a b": Camera("PINHOLE", 1, 2, tuple(params[:4]))}
    assert read_cameras(written(tmp_path, cameras_text(cameras))) == cameras
    numpy_values = {"b": Camera("OPENCV", 10, 20, tuple(np.array(params))), "a b": cameras["a b"]}
    assert cameras_text(numpy_values) == cameras_text(cameras)


def test_poses_round_trip(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("xyz", [178.0, 3.0, -71.0], degrees=True).as_matrix()
    poses = {
        "a": Pose(np.array([1e-9, -123456.789012345, 1 / 3]), rotation, 5.0, 3.0),
        "b": Pose(np.array([1.0, 2.0, 3.0]), None, 0.02, 180.0),
    }
    found = read_poses(written(tmp_path, poses_text(poses)))
    assert list(found) == ["a", "b"]
    np.testing.assert_array_equal(found["a"].center_m, poses["a"].center_m)
    np.testing.assert_allclose(found["a"].world_rotation, rotation, atol=2e-14)
    assert found["b"].world_rotation is None
    assert (found["b"].sigma_position_m, found["b"].sigma_angle_deg) == (0.02, 180.0)


def test_poses_written_again_are_the_same_to_the_last_digit(tmp_path: Path) -> None:
    """A grown block keeps the poses of its old images, and what was made with them."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.random(500, random_state=0).as_matrix()
    text = poses_text({f"i{n:03}": Pose(np.zeros(3), turn, 1.0, 1.0) for n, turn in enumerate(turns)})
    assert poses_text(read_poses(written(tmp_path, text))) == text


def test_pairs_round_trip_with_unknown_overlap(tmp_path: Path) -> None:
    pairs = [Pair("a", "b", 0.1 + 0.2, 12.5, "overlap"), Pair("a", "ü", float("nan"), float("nan"), "name")]
    found = read_pairs(written(tmp_path, pairs_text(pairs)))
    assert found[0] == pairs[0]
    assert (found[1].image_id1, found[1].reason) == ("ü", "name")
    assert np.isnan([found[1].overlap, found[1].view_angle_deg]).all()
    assert read_pairs(written(tmp_path, pairs_text([]))) == []


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"other,columns\n1,2\n",
        b"image_id0,image_id1,overlap,view_angle_deg,reason\na,b,much,1,x\n",
        b"image_id0,image_id1,overlap,view_angle_deg,reason\na\n",
        b"image_id0,\xff\xfe\n",
    ],
)
def test_broken_tables_say_so(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "pairs.csv"
    path.write_bytes(data)
    with pytest.raises(WorkspaceError, match=r"pairs\.csv"):
        read_pairs(path)
    with pytest.raises(WorkspaceError, match=r"gone\.csv"):
        read_pairs(tmp_path / "gone.csv")


# --- features -------------------------------------------------------------------------------------------------------


def known(kind: str, path: Path) -> Any:
    """The fingerprint, or those by image_id1, that the store knows of a file; nothing where it is damaged or absent."""
    workspace: Any = SimpleNamespace(**{name: lambda _: path for name in ("features", "matches", "verified")})
    store = BlockStore(workspace, Index())
    if kind == "features":
        return store.features_fingerprint("x")
    row: Any = store.matches("x") if kind == "matches" else store.verdicts("x")
    return {image_id1: one.fingerprint for image_id1, one in row.items()}


@pytest.mark.parametrize("count", [0, 1, 50_000])
def test_features_round_trip(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    features = replace(random_features(count), colours=rng.integers(0, 256, (count, 3), dtype=np.uint8))
    path = archived(tmp_path, write_features, features, "print")
    found = read_features(path)
    for field in fields(Features):
        before, after = getattr(features, field.name), getattr(found, field.name)
        np.testing.assert_array_equal(after, before)
        assert (after.dtype, after.shape) == (before.dtype, before.shape), field.name
    assert features_fingerprint(path) == "print"
    np.testing.assert_array_equal(read_keypoints(path)[0], features.keypoints_px)
    np.testing.assert_array_equal(read_keypoints(path)[2], features.colours)
    plain = archived(tmp_path, write_features, replace(features, colours=None), "print")
    assert read_features(plain).colours is None
    assert read_keypoints(plain)[2] is None


def test_keypoints_of_a_large_image_keep_their_fraction(tmp_path: Path) -> None:
    """Half precision is off by up to 2 px at 5472; float32 keeps 1/4000 px, measured against the float64 truth."""
    truth = np.array([[2048.3, 4095.7], [5471.123, 3647.456], [5471.9999, 0.0001]])
    features = random_features(3)
    path = archived(
        tmp_path, write_features, Features(**(vars(features) | {"keypoints_px": truth.astype(np.float32)})), "x"
    )
    assert np.abs(read_features(path).keypoints_px.astype(np.float64) - truth).max() < 2.5e-4
    assert np.abs(truth.astype(np.float16).astype(np.float64) - truth).max() > 0.3


# --- rows -----------------------------------------------------------------------------------------------------------


def entry(image_id1: str, count: int, **options: Any) -> MatchEntry:
    return MatchEntry(image_id1, f"print of {image_id1}", "nearest", matches(count, seed=count, **options))


@pytest.mark.parametrize("counts", [(), (0,), (0, 0), (5,), (3, 0, 40_001), (0, 7)])
def test_match_row_round_trip(tmp_path: Path, counts: tuple[int, ...]) -> None:
    row = [entry(f"image-{i}", count) for i, count in enumerate(counts)]
    path = archived(tmp_path, write_match_row, row)
    found = read_match_row(path)
    assert list(found) == [one.image_id1 for one in row]
    assert known("matches", path) == {one.image_id1: one.fingerprint for one in row}
    for one in row:
        assert_same_matches(found[one.image_id1].matches, one.matches)
        np.testing.assert_array_equal(found[one.image_id1].matches.view_pairs, one.matches.view_pairs)
        assert found[one.image_id1].strategy == "nearest"
        assert found[one.image_id1].matches.points0_px is None


def test_indices_beyond_16_bits_survive(tmp_path: Path) -> None:
    indices = np.array([[32767, 32768], [40000, 65536], [2**31 - 1, 0]], np.int32)
    one = MatchEntry("b", "f", "s", Matches(indices, np.ones(3, np.float32), np.zeros((3, 2), np.int16)))
    found = read_match_row(archived(tmp_path, write_match_row, [one]))["b"].matches.indices
    assert found.tolist() == [[32767, 32768], [40000, 65536], [2147483647, 0]]


def test_measured_points_survive_beside_pairs_without(tmp_path: Path) -> None:
    row = [entry("a", 4), entry("b", 5, measured=True)]
    found = read_match_row(archived(tmp_path, write_match_row, row))
    np.testing.assert_array_equal(found["b"].matches.points0_px, row[1].matches.points0_px)
    np.testing.assert_array_equal(found["b"].matches.points1_px, row[1].matches.points1_px)
    assert found["b"].matches.indices[0].tolist() == [-1, -1]
    assert_same_matches(found["a"].matches, row[0].matches)
    assert found["a"].matches.points0_px is None or np.isnan(found["a"].matches.points0_px).all()


def verified(image_id1: str, count: int, **options: Any) -> VerifiedEntry:
    verdict = Verdict(keep=np.ones(count, bool), **options)
    return VerifiedEntry(image_id1, f"print {image_id1}", count + 10, matches(count, seed=count), verdict)


def test_verified_row_round_trip(tmp_path: Path) -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    row = [
        verified(
            "a",
            3,
            state="verified",
            model_kind="E",
            model=np.arange(9.0).reshape(3, 3) / 7,
            errors_px=np.array([0.1, np.nan, 2.5], np.float32),
            rejected={"pose": 4, "poselib": 6},
            relative_rotation=turn,
        ),
        verified("é-1", 0, state="rejected", reason='9 inliers of 10 matches, "15" needed'),
        verified("z", 0, state="not verifiable", reason=""),
    ]
    path = archived(tmp_path, write_verified_row, row)
    found = read_verified_row(path)
    assert list(found) == ["a", "é-1", "z"]
    for one in row:
        other = found[one.image_id1]
        assert (other.fingerprint, other.matches_in) == (one.fingerprint, one.matches_in)
        assert_same_matches(other.matches, one.matches)
        for name in ("state", "reason", "model_kind", "rejected"):
            assert getattr(other.verdict, name) == getattr(one.verdict, name)
        np.testing.assert_array_equal(other.verdict.model, one.verdict.model)
    np.testing.assert_array_equal(found["a"].verdict.errors_px, row[0].verdict.errors_px)
    np.testing.assert_array_equal(found["a"].verdict.relative_rotation, turn)
    assert found["z"].verdict.relative_rotation is None
    assert found["a"].verdict.keep.all()


def test_empty_verified_row(tmp_path: Path) -> None:
    path = archived(tmp_path, write_verified_row, [])
    assert read_verified_row(path) == {}
    assert known("verified", path) == {}


def test_absent_rows_are_empty(tmp_path: Path) -> None:
    assert read_match_row(tmp_path / "x.npz") == {}
    assert read_verified_row(tmp_path / "x.npz") == {}
    assert known("verified", tmp_path / "x.npz") == {}
    assert known("features", tmp_path / "x.npz") == ""


def test_archives_are_byte_identical_when_written_twice(tmp_path: Path) -> None:
    writes = [
        (write_features, (random_features(100), "f")),
        (write_match_row, ([entry("a", 4), entry("b", 5, measured=True)],)),
        (write_verified_row, ([verified("a", 3, state="verified")],)),
    ]
    for write, args in writes:
        first = archived(tmp_path, write, *args).read_bytes()
        assert archived(tmp_path, write, *args, name="again.npz").read_bytes() == first


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.999])
@pytest.mark.parametrize("kind", ["features", "matches", "verified"])
def test_cut_archives_say_so(tmp_path: Path, kind: str, keep: float) -> None:
    write, read, value = {
        "features": (write_features, read_features, (random_features(50), "f")),
        "matches": (write_match_row, read_match_row, ([entry("a", 40)],)),
        "verified": (write_verified_row, read_verified_row, ([verified("a", 30, state="verified")],)),
    }[kind]
    path = archived(tmp_path, write, *value)  # type: ignore[misc]
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 and keep else int(keep)])
    with pytest.raises(WorkspaceError, match="delete it to have it made again"):
        read(path)  # type: ignore[operator]
    assert not known(kind, path)


@pytest.mark.parametrize("seed", range(30))
def test_damaged_archives_never_raise_anything_else(tmp_path: Path, seed: int) -> None:
    """Flipped bytes are found by the archive's checksums (WorkspaceError), or change nothing."""
    rng = np.random.default_rng(seed)
    path = archived(tmp_path, write_match_row, [entry("a", 40), entry("b", 10)])
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    data[rng.integers(0, len(data), 5)] ^= rng.integers(1, 256, 5, dtype=np.uint8)
    path.write_bytes(data.tobytes())
    found = {}
    with contextlib.suppress(WorkspaceError):
        found = read_match_row(path)
    if found:
        assert_same_matches(found["a"].matches, entry("a", 40).matches)


@pytest.mark.parametrize("kind", ["features", "matches", "verified"])
def test_a_flipped_byte_in_any_array_leaves_no_fingerprint(tmp_path: Path, kind: str) -> None:
    """So that a stage that is up to date makes the file again, though nothing reads the array any more."""
    write, array, value = {
        "features": (write_features, "descriptors", (random_features(50), "f")),
        "matches": (write_match_row, "indices", ([entry("a", 40)],)),
        "verified": (write_verified_row, "errors_px", ([verified("a", 30, state="verified")],)),
    }[kind]
    path = archived(tmp_path, write, *value)  # type: ignore[misc]
    assert known(kind, path)
    data = bytearray(path.read_bytes())
    with np.load(path) as archive:
        at = data.index(archive[array].tobytes()) + 5
    data[at] ^= 0x10
    path.write_bytes(data)
    os.utime(path, ns=(0, 0))  # read again
    assert not known(kind, path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["features", "matches", "verified"])
def test_any_flipped_byte_leaves_no_fingerprint(tmp_path: Path, kind: str) -> None:
    """Also in the names, dates and lists of a zip archive, of which its members' checksums say nothing."""
    write, value = {
        "features": (write_features, (random_features(3), "f")),
        "matches": (write_match_row, ([entry("a", 2)],)),
        "verified": (write_verified_row, ([verified("a", 2, state="verified")],)),
    }[kind]
    path = archived(tmp_path, write, *value)  # type: ignore[misc]
    whole = path.read_bytes()
    for at in range(len(whole)):
        data = bytearray(whole)
        data[at] ^= 1 << at % 8
        path.write_bytes(data)
        os.utime(path, ns=(0, at))
        assert not known(kind, path), at
    path.write_bytes(whole)
    os.utime(path, ns=(0, len(whole)))
    assert known(kind, path)


def test_archives_without_a_checksum_of_the_whole_are_read(tmp_path: Path) -> None:
    """Those of earlier versions."""
    path = archived(tmp_path, write_features, random_features(3), "f")
    with np.load(path) as archive:
        np.savez(tmp_path / "earlier.npz", **archive)
    assert known("features", tmp_path / "earlier.npz") == "f"
    np.testing.assert_array_equal(read_features(tmp_path / "earlier.npz").sizes_px, random_features(3).sizes_px)


def test_compressed_archives_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez_compressed(path, image_id1=np.zeros(10_000_000), fingerprint=np.array(["f"]))
    with pytest.raises(WorkspaceError, match=r"image_id1\.npy is compressed"):
        read_match_row(path)
    assert known("features", path) == ""


def test_archives_with_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, image_id1=np.array([{"a": 1}], dtype=object), fingerprint=np.array(["f"]), offsets=np.array([0, 0]))
    with pytest.raises(WorkspaceError, match="it holds Python objects"):
        read_match_row(path)
