"""What page and exports show of adjusted positions beside those given."""

from __future__ import annotations

import csv
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import Site
from make_results import filled
from test_export_colmap import Truth
from test_exporters import contents, truth  # noqa: F401 - fixtures

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, FloatArray, PoseResidual
from aeromatch_cli.report.figures import round_length
from aeromatch_cli.report.residuals import residual_section
from aeromatch_cli.results.adjustment import GroupResult
from aeromatch_cli.strategies.exporters import EXPORTERS

STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
UNKNOWN = np.full(3, np.nan)
NAMES = {"a": "a.jpg", "b": "b.jpg", "c": "c.jpg"}


def residual(position_m: FloatArray | list[float], sigma_m: float = 0.5) -> PoseResidual:
    offset_m = np.asarray(position_m, float)
    return PoseResidual(offset_m, offset_m / sigma_m, UNKNOWN, UNKNOWN, 0.3, 100, 3.5)


def adjusted(count: int = 3) -> AdjustedBlock:
    poses = {
        i: AdjustedPose(np.array([25.0 * k, 40.0 * (k % 2), 100.0]), STRAIGHT_DOWN, UNKNOWN, UNKNOWN)
        for k, i in enumerate("abc"[:count])
    }
    return dataclasses.replace(AdjustedBlock.empty(), poses=poses)


def test_the_table_has_root_mean_squares_in_metres_pixels_and_deviations() -> None:
    found = {"a": residual([3.0, 0.0, 0.0]), "b": residual([0.0, 4.0, 0.0]), "c": residual([0.0, 0.0, -12.0])}
    section = residual_section(adjusted(), found, NAMES, 0.1)
    assert section is not None
    metres, pixels, sigmas = section.rows
    expected = np.sqrt(np.array([9.0, 16.0, 144.0, 25.0, 169.0]) / 3.0)
    assert metres == ("metres", *(f"{value:.3f}" for value in expected))
    assert pixels == ("pixels on the ground", *(f"{10.0 * value:.2f}" for value in expected))
    assert sigmas[1:4] == tuple(f"{2.0 * value:.2f}" for value in expected[:3])
    assert "Farthest: c.jpg, 12.000 m." in section.words
    assert len(residual_section(adjusted(), found, NAMES, None).rows) == 2  # type: ignore[union-attr]


def test_the_weights_of_positions_stand_beside_their_stated_accuracy() -> None:
    found = dict.fromkeys("abc", residual([0.0, 0.0, 0.2]))
    small = filled(GroupResult, positions={"used": 2, "factors": [5.0, 5.0]})
    large = filled(GroupResult, positions={"used": 9, "factors": [1.84, 0.62]})
    section = residual_section(adjusted(), found, NAMES, 0.1, [small, large])
    assert section is not None
    assert section.words.endswith(
        " By what they are off the adjustment weighs them with 1.8 times the stated standard deviations horizontally "
        "and 0.6 times vertically. Unlike in the verdict, drifts, shifts and delays of flights, antenna offsets and "
        "positions that are not used count here."
    )
    without = residual_section(adjusted(), found, NAMES, 0.1, [large.model_copy(update={"positions": None})])
    assert without is not None
    assert "weighs them" not in without.words


def test_the_plan_shows_each_camera_in_the_colour_of_its_height() -> None:
    found = {"a": residual([3.0, 0.0, 9.0]), "b": residual([0.0, 4.0, 9.0]), "c": residual([0.0, 0.0, -9.0])}
    section = residual_section(adjusted(), found, NAMES, 0.1)
    assert section is not None
    assert section.plan.count("<title>") == 3
    assert "a.jpg: x +3.000 m, y +0.000 m, z +9.000 m" in section.plan
    assert set(re.findall(r'class="(height\d)"', section.plan)) == {"height0", "height8"}
    # Neighbours lie 47 m apart; the arrow of the ninth tenth, 3.8 m, is 0.6 of that.
    assert "arrows enlarged 7.45 times" in section.plan


def test_positions_that_stay_have_no_plan() -> None:
    section = residual_section(adjusted(), dict.fromkeys("abc", residual([0.0, 0.0, 0.0])), NAMES, 0.1)
    assert section is not None
    assert (section.plan, section.words) == ("", "Positions stay as they were given.")


@pytest.mark.parametrize(("count", "drawn"), [(1, False), (2, True)])
def test_two_cameras_have_a_plan(count: int, drawn: bool) -> None:
    section = residual_section(adjusted(count), dict.fromkeys("abc", residual([0.0, 0.0, 0.2])), NAMES, 0.1)
    assert section is not None
    assert section.plan.startswith("<svg") == drawn
    assert section.rows[0][3] == "0.200"


def test_without_given_positions_there_is_nothing_to_show() -> None:
    assert residual_section(adjusted(), dict.fromkeys("abc", residual(UNKNOWN)), NAMES, 0.1) is None
    assert residual_section(adjusted(), {}, NAMES, 0.1) is None


def test_lengths_of_the_key_are_round() -> None:
    assert [round_length(length) for length in (0.034, 1.0, 7.3, 260.0)] == pytest.approx([0.02, 1.0, 5.0, 200.0])


def test_cameras_of_a_geopackage_have_their_residuals(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    import pyogrio

    found = {"img0": residual([0.1, -0.2, 0.3])}
    EXPORTERS["geopackage"]()(dataclasses.replace(contents(), residuals=found), tmp_path / "g")  # type: ignore[operator]
    meta, _, _, fields = pyogrio.raw.read(tmp_path / "g" / "block.gpkg", layer="cameras")
    table = dict(zip(meta["fields"], fields, strict=True))
    assert [table[name][0] for name in ("dx_m", "dy_m", "dz_m")] == [0.1, -0.2, 0.3]
    assert [table[name][0] for name in ("dx_sigmas", "error_px", "points")] == [0.2, 0.3, 100]
    assert np.isnan(table["dx_m"][1:]).all()


@pytest.mark.slow
def test_a_run_states_residuals_everywhere(site: Site) -> None:
    def moved(rows: list[dict[str, str]]) -> list[dict[str, str]]:
        for row, shift_m in zip(rows, (0.5, -0.5, 0.0, 0.5, -0.5), strict=True):
            row["x"] = str(float(row["x"]) + shift_m)
        return rows

    site.rewrite_poses(moved)
    outcome = site("run")
    assert outcome.code == 0
    figures = outcome.facts["stages"]["adjust"]["result"]["residuals"]
    assert figures["positions"] == figures["images"] == 5
    own, exported = (site.work / folder / "residuals.csv" for folder in ("orientation", "export/colmap"))
    rows, left = (list(csv.DictReader(path.read_text().splitlines())) for path in (own, exported))
    assert [row["image"] for row in rows] == site.names()
    of_points = ("error_px", "points", "images_per_point")
    for before, after in zip(rows, left, strict=True):
        assert {k: v for k, v in before.items() if k not in of_points} == {
            k: v for k, v in after.items() if k not in of_points
        }
    final = outcome.facts["stages"]["consistency"]["result"]
    assert sum(int(row["points"]) for row in left) == final["observations_left"]
    mean_px = sum(int(row["points"]) * float(row["error_px"]) for row in left) / final["observations_left"]
    assert mean_px == pytest.approx(final["reprojection_error_px"], rel=0.1)
    rms_m = np.sqrt(np.mean([float(row["dx_m"]) ** 2 for row in rows]))
    assert figures["position_m_rms"][0] == pytest.approx(rms_m, rel=1e-3)
    stated_px = outcome.facts["stages"]["adjust"]["result"]["reprojection_error_px"]
    points = np.array([float(row["points"]) for row in rows])
    errors_px = np.array([float(row["error_px"]) for row in rows])
    assert (points @ errors_px) / points.sum() == pytest.approx(stated_px, rel=0.1)
    assert site("report").code == 0
    page = (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "Camera positions and error estimates" in page
    assert page.count("pixels on the ground") == 1
