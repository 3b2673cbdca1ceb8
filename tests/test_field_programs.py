"""Lists of Metashape, ORIMA and POSPac as people edit and export them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from make_pose_files import written

from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.errors import ConfigError

X, Y, Z = 390950.0, 5818970.0, 142.6
OMEGA, PHI, KAPPA = 0.775, 0.957, 178.449
WKT = (
    'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,'
    '298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32633"]]'
)


def quoted(cells: list[str], separator: str) -> str:
    stream = io.StringIO()
    csv.writer(stream, delimiter=separator, lineterminator="").writerow(cells)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("first", "unit", "one_m"),
    [
        (f"# CoordinateSystem: {WKT}", "(m)", 1.0),
        (quoted([f"# CoordinateSystem: {WKT}"], ";"), "(m)", 1.0),
        (quoted([*f"# CoordinateSystem: {WKT}".split(","), "", ""], ","), "(cm)", 0.01),
    ],
)
def test_metashape_references_that_a_spreadsheet_has_saved(tmp_path: Path, first: str, unit: str, one_m: float) -> None:
    names = (
        f"#Label,X/Easting,Y/Northing,Z/Altitude,Omega,Phi,Kappa,Accuracy_X/Y/Z_{unit},Accuracy_Omega/Phi/Kappa_(deg)"
    )
    text = f"{first}\n{names}\na,{X},{Y},{Z},{OMEGA},{PHI},{KAPPA},3/4/6,2/1/0.5\n"
    found = read_pose_file(written(tmp_path, text))
    (row,) = found.rows
    assert found.crs is not None
    assert "32633" in found.crs
    assert row.position == pytest.approx((X, Y, Z))
    assert row.attitude == pytest.approx((OMEGA, PHI, KAPPA))
    assert row.sigmas_m == pytest.approx((3 * one_m, 4 * one_m, 6 * one_m))
    assert row.sigma_angle_deg == pytest.approx(2.0)


def test_one_accuracy_of_metashape_for_all_axes(tmp_path: Path) -> None:
    text = f"#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y/Z_(m)\na,{X},{Y},{Z},0.03\nb,{X},{Y},{Z},0.03/0.05\n"
    with pytest.raises(ConfigError, match=r"0\.03/0\.05"):
        read_pose_file(written(tmp_path, text))
    (row,) = read_pose_file(written(tmp_path, text.rpartition("b,")[0])).rows
    assert row.sigmas_m == pytest.approx((0.03, 0.03, 0.03))


def test_a_number_behind_the_angles_of_a_list_without_header(tmp_path: Path) -> None:
    lines = [f"a{k} {X} {Y} {Z + k} {OMEGA / 0.9} {PHI / 0.9} {KAPPA / 0.9} 0" for k in range(3)]
    found = read_pose_file(written(tmp_path, "\n".join(lines)), "opk-gon")
    assert [row.position for row in found.rows] == [(X, Y, Z + k) for k in range(3)]
    assert found.rows[0].attitude == pytest.approx((OMEGA, PHI, KAPPA))
    found = read_pose_file(written(tmp_path, "\n".join(lines)))
    assert any("what stands behind the angles is not read" in line for line in found.warnings)
    plain = read_pose_file(written(tmp_path, "\n".join(line[:-2] for line in lines)))
    assert not any("behind the angles" in line for line in plain.warnings)


@pytest.mark.parametrize(("units", "one_m"), [("Meters", 1.0), ("US survey feet", 1200.0 / 3937.0)])
def test_a_report_of_pospac_with_text_above_its_columns(tmp_path: Path, units: str, one_m: float) -> None:
    text = (
        f"POSEO - Exterior Orientation\nProjection: UTM Zone 33\nDatum: WGS84\nUnits: {units}; angles in degrees\n\n"
        "ID EASTING NORTHING ORTHOMETRIC_HEIGHT OMEGA PHI KAPPA\n"
        f"a {X / one_m} {Y / one_m} {Z / one_m} {OMEGA} {PHI} {KAPPA}\n"
    )
    found = read_pose_file(written(tmp_path, text))
    (row,) = found.rows
    assert (row.image, row.line, found.format) == ("a", 7, "report with named columns")
    assert row.position == pytest.approx((X, Y, Z), abs=1e-6)
    assert row.attitude == pytest.approx((OMEGA, PHI, KAPPA))
    assert "5 lines above the one that names the columns ('POSEO - Exterior Orientation' ...)" in found.warnings[0]
    plain = read_pose_file(written(tmp_path, f"name,easting,northing,z\na,{X},{Y},{Z}\n"))
    assert plain.format == "list with named columns"
