"""PLY of tie points: read back by its header, where and in which colours the truth has them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_export_colmap import ORIGIN_M, Truth, make_truth
from test_exporters import adjusted_block, geographic
from test_exporters_opensfm import painted

from aeromatch_cli.strategies.exporters import EXPORTERS

_TYPES = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1"}


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """Comments and vertices, by the header alone."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    words = [line.split() for line in lines]
    (count,) = (int(line[2]) for line in words if line[:2] == ["element", "vertex"])
    kind = np.dtype([(line[2], _TYPES[line[1]]) for line in words if line[0] == "property"])
    assert len(body) == count * kind.itemsize
    return [line.removeprefix("comment ") for line in lines if line.startswith("comment")], np.frombuffer(body, kind)


def test_points_are_the_truth_with_the_colours_of_the_pictures(truth: Truth, tmp_path: Path) -> None:
    adjusted = adjusted_block(truth)
    errors = np.linspace(0.1, 0.9, len(adjusted.points_m))
    contents = dataclasses.replace(
        truth.contents(), adjusted=dataclasses.replace(adjusted, errors_px=errors), geographic=geographic,
        colours=lambda image_id: painted(truth, image_id),
    )  # fmt: skip
    EXPORTERS["ply"]()(contents, tmp_path / "p")  # type: ignore[operator]
    comments, points = read_ply(tmp_path / "p" / "points.ply")
    assert "crs EPSG:32633" in comments
    offset = next(line for line in comments if line.startswith("offset ")).split()[1:]
    assert [float(value) for value in offset] == list(ORIGIN_M)
    places = np.column_stack([points[axis] for axis in "xyz"])
    np.testing.assert_array_equal(places, adjusted.points_m)
    seen = [[] for _ in adjusted.points_m]
    for image_id, track in adjusted.tracks.items():
        for keypoint, point in track:
            seen[point].append(painted(truth, image_id)[keypoint])
    np.testing.assert_array_equal(points["images"], list(map(len, seen)))
    found = np.column_stack([points[name] for name in ("red", "green", "blue")])
    np.testing.assert_allclose(found, [np.mean(one, axis=0) for one in seen], atol=0.5)
    np.testing.assert_allclose(points["error_px"], errors, rtol=1e-6)


def test_points_without_a_place_in_the_crs_are_left_out(truth: Truth, tmp_path: Path) -> None:
    adjusted = dataclasses.replace(adjusted_block(truth), frames={"img1": 1})
    contents = dataclasses.replace(truth.contents(), adjusted=adjusted, geographic=geographic)
    EXPORTERS["ply"]()(contents, tmp_path / "p")  # type: ignore[operator]
    theirs = np.unique(adjusted.tracks["img1"][:, 1])
    _, points = read_ply(tmp_path / "p" / "points.ply")
    assert len(points) == len(adjusted.points_m) - len(theirs)
    assert (np.column_stack([points[name] for name in ("red", "green", "blue")]) == 128).all()  # no picture is seen


def test_a_block_that_is_not_adjusted_says_why_it_has_no_point(truth: Truth, tmp_path: Path) -> None:
    summary = EXPORTERS["ply"]()(truth.contents(), tmp_path / "p")  # type: ignore[operator]
    assert summary.remarks == ("points.ply has no point: no block was adjusted whose points have a place",)
    assert len(read_ply(tmp_path / "p" / "points.ply")[1]) == 0
