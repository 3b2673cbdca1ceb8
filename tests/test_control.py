"""Ground control: ODM's list read into a block, and errors at points with known ones."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PAGE, Site
from make_results import filled
from test_export_colmap import ORIGIN_M, Truth, make_truth

from aeromatch_cli.blocks.control import far_control, read_control
from aeromatch_cli.blocks.crs import grid_from_geographic
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, ControlPoint, FloatArray, Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.results.adjustment import Control, ControlInGroup
from aeromatch_cli.sfm.control import control_figures
from aeromatch_cli.stages import surveyed as control_stage
from aeromatch_cli.stages.messages import control_words

IMAGES = (Image("a_jpg", "sub/a.jpg", 100, 80, "1"), Image("b_jpg", "b.jpg", 100, 80, "1"))


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


def adjusted_truth(truth: Truth) -> AdjustedBlock:
    nan = np.full(3, np.nan)
    poses = {i: AdjustedPose(p.center_m, p.world_rotation, nan, nan) for i, p in truth.block.poses.items()}
    return AdjustedBlock(truth.block.cameras, poses, np.zeros((0, 3)), np.zeros(0), {})


def surveyed(truth: Truth, rows: list[int], offsets_m: FloatArray, checks: set[int]) -> list[ControlPoint]:
    """Points of the truth measured exactly in every image, surveyed with some offsets."""
    points = []
    for row, offset_m in zip(rows, offsets_m, strict=True):
        place = truth.points_m[row]
        pixels = {
            image.image_id: project(truth.block.camera(image), pose.world_rotation, pose.center_m, place[None])[0]
            for image in truth.block.images
            for pose in [truth.block.poses[image.image_id]]
        }
        points.append(ControlPoint(f"p{row}", place + offset_m, row in checks, pixels))
    return points


def cameras(truth: Truth) -> dict:
    return {image.image_id: truth.block.camera(image) for image in truth.block.images}


def test_check_points_show_their_own_error(truth: Truth) -> None:
    rows = list(range(0, 400, 40))
    offsets_m = np.zeros((10, 3))
    offsets_m[7:] = [0.03, -0.04, 0.12]  # the check points are surveyed wrong by this
    points = surveyed(truth, rows, offsets_m, set(rows[7:]))
    figures = control_figures(adjusted_truth(truth), cameras(truth), points)
    assert (figures.control, figures.check, figures.check_kind) == (7, 3, "check points")
    np.testing.assert_allclose(figures.offset_m, 0.0, atol=1e-6)
    assert figures.check_rmse_m == (0.03, 0.04, 0.12)
    assert max(figures.control_rmse_m) < 1e-6
    assert figures.transformation.scale == pytest.approx(1.0, abs=1e-9)
    assert figures.residuals[f"p{rows[9]}"] == (-0.03, 0.04, -0.12)
    assert figures.reprojection_error_px < 1e-3


def test_residuals_are_as_large_as_survey_and_measurements_let_expect(truth: Truth) -> None:
    """Of 200 points surveyed and measured with known errors, in a block of another scale too."""
    rows, rng, sigmas_m, sigma_px = list(range(0, 400, 2)), np.random.default_rng(0), (0.02, 0.02, 0.03), 2.0
    exact = surveyed(truth, rows, rng.normal(0.0, sigmas_m, (200, 3)), set())
    points = [
        replace(p, pixels={i: px + rng.normal(0.0, sigma_px, 2) for i, px in p.pixels.items()}, sigma_px=sigma_px)
        for p in exact
    ]
    whole = adjusted_truth(truth)
    figures = control_figures(whole, cameras(truth), points)
    residuals, stated = (np.array([own[p.name] for p in points]) for own in (figures.residuals, figures.point_sigmas_m))
    assert (stated > 1.05 * np.array(sigmas_m)).all()  # the survey alone is less
    np.testing.assert_allclose(np.sqrt(((residuals / stated) ** 2).mean(axis=0)), 1.0, atol=0.1)
    # Of 2 px in each coordinate, of which three unknowns of a point take a part.
    images = np.mean([len(own) for own in figures.image_residuals_px.values()])
    expected_px = sigma_px * np.sqrt(2.0) * np.sqrt(1.0 - 3.0 / (2.0 * images))
    assert figures.reprojection_error_px == pytest.approx(expected_px, rel=0.1)
    halved = {i: replace(pose, center_m=0.5 * pose.center_m) for i, pose in whole.poses.items()}
    small = control_figures(replace(whole, poses=halved), cameras(truth), points, metric=False)
    np.testing.assert_allclose([small.point_sigmas_m[p.name] for p in points], stated, rtol=0.02)
    assert small.ground_pixel_m == pytest.approx(figures.ground_pixel_m, rel=0.01)
    assert small.offset_m is None
    scale = small.transformation.scale
    assert scale == pytest.approx(2.0, rel=1e-3)
    assert f"to fit them the exported block is to be scaled to {scale:.4g} m per unit" in control_words(small)


def test_without_check_points_each_is_left_out_once(truth: Truth) -> None:
    rows = list(range(0, 400, 40))
    rng = np.random.default_rng(0)
    points = surveyed(truth, rows, rng.normal(0.0, 0.05, (10, 3)), set())
    figures = control_figures(adjusted_truth(truth), cameras(truth), points)
    assert figures.check_kind == "leave one out"
    assert all(left > fit for left, fit in zip(figures.check_rmse_m, figures.control_rmse_m, strict=True))
    assert 0.03 < np.mean(figures.check_rmse_m) < 0.1


def test_a_block_in_another_frame_is_transformed(truth: Truth) -> None:
    rows = list(range(0, 400, 50))
    turn = from_omega_phi_kappa(180.0, 0.0, 30.0)
    points = [
        ControlPoint(p.name, 2.0 * turn @ p.position_m + [5.0, 6.0, 7.0], False, p.pixels)
        for p in surveyed(truth, rows, np.zeros((8, 3)), set())
    ]
    figures = control_figures(adjusted_truth(truth), cameras(truth), points)
    assert figures.transformation.scale == pytest.approx(2.0)
    assert max(figures.check_rmse_m) < 1e-6


def test_a_point_that_the_others_contradict_is_named(truth: Truth) -> None:
    rows = list(range(0, 400, 50))
    offsets_m = np.random.default_rng(0).normal(0.0, 0.01, (8, 3))
    offsets_m[5] += [5.0, 0.0, 0.0]
    figures = control_figures(adjusted_truth(truth), cameras(truth), surveyed(truth, rows, offsets_m, set()))
    assert figures.doubtful == ["p250"]
    offsets_m[5] = 0.0
    figures = control_figures(adjusted_truth(truth), cameras(truth), surveyed(truth, rows, offsets_m, set()))
    assert figures.doubtful == []


def test_a_point_whose_rays_meet_behind_the_cameras_is_named_and_left_out(truth: Truth) -> None:
    points = surveyed(truth, list(range(0, 400, 100)), np.zeros((4, 3)), set())
    (id0, pixel0), (id1, pixel1) = list(points[1].pixels.items())[:2]
    swapped = replace(points[1], pixels={id0: pixel1, id1: pixel0})
    left = control_figures(adjusted_truth(truth), cameras(truth), [points[0], swapped, *points[2:]])
    assert left.rays_do_not_meet == ["p100"]
    assert left.not_measured_in_two_images == []
    assert max(left.control_rmse_m) < 1e-6
    assert left.reprojection_error_px < 1e-3
    assert json.dumps(left.as_json(), allow_nan=False)
    assert control_words(left)[1].startswith("rays do not meet of p100: ")


def test_two_points_determine_nothing(truth: Truth) -> None:
    figures = control_figures(adjusted_truth(truth), cameras(truth), surveyed(truth, [0, 40], np.zeros((2, 3)), set()))
    assert (figures.control, figures.transformation, figures.check_rmse_m) == (2, None, None)


def test_check_points_alone_have_the_residuals_of_the_block_as_it_is(truth: Truth) -> None:
    rows = [0, 40, 80, 120]
    points = surveyed(truth, rows, np.tile([0.03, -0.04, 0.12], (4, 1)), set(rows))
    figures = control_figures(adjusted_truth(truth), cameras(truth), points)
    assert figures.residuals == {f"p{row}": (-0.03, 0.04, -0.12) for row in rows}
    assert [*figures.point_sigmas_m] == figures.checks == [*figures.residuals]
    own = control_figures(adjusted_truth(truth), cameras(truth), points, metric=False)
    assert not own.residuals  # nothing says what its units are


def test_points_in_one_place_or_on_one_line_determine_no_transformation(truth: Truth) -> None:
    rows = list(range(0, 400, 50))
    points = surveyed(truth, rows, np.zeros((8, 3)), set())
    same = [replace(point, position_m=points[0].position_m) for point in points]
    line = [replace(point, position_m=np.array([10.0 * k, 20.0 * k, 5.0])) for k, point in enumerate(points)]
    for wrong in (same, line):
        found = control_figures(adjusted_truth(truth), cameras(truth), wrong)
        assert (found.control, found.transformation, found.control_rmse_m) == (8, None, None)
        assert json.dumps(found.as_json(), allow_nan=False)


def test_image_points_that_count_from_below_are_said(truth: Truth) -> None:
    images = {image.image_id: image for image in truth.block.images}

    def said(points: list[ControlPoint]) -> list[str]:
        context = SimpleNamespace(given=SimpleNamespace(control=points), block=truth.block, image_by_id=images)
        figures = control_figures(adjusted_truth(truth), cameras(truth), points)
        return control_stage.counted_from_below(context, adjusted_truth(truth), figures)

    points = surveyed(truth, list(range(0, 400, 50)), np.zeros((8, 3)), set())
    below = [
        replace(p, pixels={i: np.array([x, images[i].height_px - 1.0 - y]) for i, (x, y) in p.pixels.items()})
        for p in points
    ]
    assert said(points) == []
    [words] = said(below)
    assert "to 0.0 px if y in their list counts from the lower edge" in words


@pytest.mark.parametrize("head", ["EPSG:32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs"])
def test_a_list_is_read_into_the_block(tmp_path: Path, head: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        f"{head}\n# a comment\n500010.5 4100020.25 12.5 50.5 40.5 a.jpg north\n"
        "500010.5 4100020.25 12.5 10 20 b.jpg north\n500030 4100040 13 1 2 b.jpg south check\n"
        "500030 4100040 13 1 2 c.jpg south check\n"
    )
    points, remarks = read_control(str(path), IMAGES, "EPSG:32633", ORIGIN_M)
    assert [(p.name, p.check, sorted(p.pixels)) for p in points] == [
        ("north", False, ["a_jpg", "b_jpg"]),
        ("south", True, ["b_jpg"]),
    ]
    np.testing.assert_allclose(points[0].position_m, [10.5, 20.25, 12.5], atol=1e-6)
    np.testing.assert_array_equal(points[0].pixels["a_jpg"], [50.0, 40.0])
    assert remarks == ["gcp_list.txt names 1 image that the block does not have: c.jpg"]


def test_points_of_another_place_are_said_before_the_long_stages(truth: Truth) -> None:
    near = surveyed(truth, [0, 40], np.zeros((2, 3)), set())
    assert far_control(near, truth.block.poses, "dir/gcp_list.txt") == []
    far = surveyed(truth, [0, 40], np.full((2, 3), 300_000.0), set())
    (said,) = far_control(far, truth.block.poses, "dir/gcp_list.txt")
    assert said.startswith("the control points of gcp_list.txt lie 424.")
    assert far_control(far, {}, "gcp_list.txt") == []


def test_geographic_points_are_brought_to_the_blocks_crs(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text("EPSG:4326\n15.01 37.02 12.5 50.5 40.5 a.jpg\n15.02 37.03 12.5 50.5 40.5 a.jpg\n")
    points, _ = read_control(str(path), IMAGES, "EPSG:32633", ORIGIN_M)
    expected = grid_from_geographic("EPSG:32633", np.array([37.02]), np.array([15.01]))[0] - ORIGIN_M[:2]
    np.testing.assert_allclose(points[0].position_m[:2], expected, atol=1e-6)


def test_names_of_images_are_paths_first(tmp_path: Path) -> None:
    images = (Image("a--1_jpg", "a/1.jpg", 100, 80, "1"), Image("b--1_jpg", "b/1.jpg", 100, 80, "1"),
              Image("1_jpg", "1.jpg", 100, 80, "1"), Image("b--2_jpg", "b/2.jpg", 100, 80, "1"))  # fmt: skip
    path = tmp_path / "gcp_list.txt"
    path.write_text("EPSG:32633\n1 2 3 4 5 1.jpg p\n1 2 3 4 5 a/1.jpg p\n1 2 3 4 5 2.jpg p\n")
    ((point,), remarks) = read_control(str(path), images, "EPSG:32633", ORIGIN_M)
    assert (set(point.pixels), remarks) == ({"1_jpg", "a--1_jpg", "b--2_jpg"}, [])
    with pytest.raises(
        ConfigError, match=r"line 2, column image: '1\.jpg' may be a/1\.jpg or b/1\.jpg: write the path"
    ):
        read_control(str(path), images[:2], "EPSG:32633", ORIGIN_M)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no control points"),
        ("EPSG:32633\n1 2 3 4 5\n", "line 2: 5 columns"),
        ("EPSG:32633\n1 2 x 4 5 a.jpg\n", "line 2, column z: 'x' is not a number"),
        ("nowhere\n1 2 3 4 5 a.jpg\n", "line 1: 'nowhere' is no CRS"),
        ("EPSG:32633\n1 2 3 4 5 a.jpg p\n1 2 9 4 5 b.jpg p\n", "line 3: p has other coordinates"),
    ],
)
def test_a_malformed_list_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_control(str(path), IMAGES, "EPSG:32633", ORIGIN_M)


def write_gcp_list(path: Path, rendered: Path, lower_m: float = 0.0) -> Path:
    """Points of a rendered block, measured without error, so many metres lower than they are."""
    truth = load_truth(rendered)
    names = sorted(truth.poses)
    rng = np.random.default_rng(3)
    lines = ["local"]
    for number, pixel in enumerate(rng.uniform([60, 60], [260, 180], (12, 2))):
        place = truth.surface_points(names[0], pixel[None])[0] - [0.0, 0.0, lower_m]
        for name in names:
            found, hidden = truth.transfer(names[0], pixel[None], name)
            if not hidden[0]:
                x, y = found[0] + 0.5
                lines.append(" ".join(map(str, (*place, x, y, name, f"p{number}"))))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
def test_control_above_the_geoid_gives_the_block_its_heights(done_site: Site, rendered: Path) -> None:
    path = write_gcp_list(done_site.root / "gcp_list.txt", rendered, lower_m=45.0)
    outcome = done_site("run", "--gcp", path, *PAGE)
    assert outcome.code == 0
    facts = outcome.facts["stages"]["adjust"]["result"]
    inside = facts["groups"][0]["control"]
    assert inside["held_out_rms_m"][2] < 1.5 < 40.0 < inside["without_rms_m"][2]
    (remark,) = [line for line in facts["remarks"] if "the block has the heights of the control points" in line]
    assert 35.0 < float(re.search(r"lie ([\d.]+) m above", remark)[1]) < 55.0
    assert "shift of a flight" not in [
        one["what"] for one in outcome.facts["quality"]["findings"] if one["level"] != "good"
    ]


@pytest.mark.slow
def test_the_run_says_the_errors(done_site: Site, rendered: Path) -> None:
    path = write_gcp_list(done_site.root / "gcp_list.txt", rendered)
    outcome = done_site("run", "--gcp", path, *PAGE)
    assert outcome.code == 0
    control = outcome.facts["stages"]["adjust"]["result"]["control"]
    assert control["control"] >= 6
    assert max(control["check_rmse_m"][:2]) < 0.5  # a pixel is 0.4 m on the ground
    inside = outcome.facts["stages"]["adjust"]["result"]["groups"][0]["control"]
    assert (len(inside["used"]), inside["wrong"], inside["exchanged"]) == (control["control"], [], [])
    assert max(inside["held_out_rms_m"][:2]) < 0.5 < max(inside["without_rms_m"])
    assert "take part in the adjustment; RMSE at control points left out in turn: " in outcome.stdout
    assert control["doubtful"] == []
    page = (done_site.work / "report" / "index.html").read_text()
    assert "Control points, each left out once" in page
    assert "The read-out time of a rolling shutter was not tried: the velocity of the aircraft is not known" in page


@pytest.mark.parametrize(
    ("offset_m", "words"),
    [
        ((0.3, -0.2, 0.1), []),
        ((0.0, 500_000.0, 0.0), ["500,000 m beside"]),
        ((0.0, 0.0, -47.0), ["47.0 m below"]),
    ],
)
def test_control_points_of_another_place_are_said(truth: Truth, offset_m: tuple, words: list[str]) -> None:
    """Given positions have 0.5 m: 10 m is the limit."""
    context = SimpleNamespace(block=truth.block, given=SimpleNamespace(block=truth.block))
    said = control_stage.control_remarks(context, offset_m)
    assert len(said) == len(words)
    assert all(word in line for word, line in zip(words, said, strict=True))
    local = SimpleNamespace(block=replace(truth.block, crs="local"), given=truth.block)
    assert control_stage.control_remarks(local, offset_m) == []


def test_what_control_points_did_in_the_adjustment_is_said() -> None:
    control = {
        "points": 5, "control": 5, "check": 0, "not_measured_in_two_images": [], "control_rmse_m": [0.01, 0.01, 0.02],
    }  # fmt: skip
    adjusted = {
        "used": ["a", "b", "c", "d"], "wrong": ["e"], "exchanged": [], "held_out": "leave one out", "kept": True,
        "held_out_rms_m": [0.02, 0.03, 0.04], "without_rms_m": [2.0, 3.0, 4.0],
    }  # fmt: skip
    assert control_words(filled(Control, control), [filled(ControlInGroup, adjusted)]) == [
        "control: 5 control points, 0 check points",
        "control points that the others contradict: e; they were left out",
        "4 control points take part in the adjustment; RMSE at control points left out in turn: x 0.020, y 0.030, z "
        "0.040 m, without any control x 2.000, y 3.000, z 4.000 m",
    ]
