"""Control points as Pix4D, Metashape and ODM write them: the same three points, and what is wrong with others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import invoke
from pyproj import CRS, Transformer

from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.config import load
from aeromatch_cli.data import ControlPoint, FloatArray, Image, Pose
from aeromatch_cli.errors import ConfigError

ORIGIN_M = (390000.0, 5818000.0, 0.0)
CODE = "EPSG:32633"
IMAGES = tuple(Image(f"DJI_{n}_JPG", f"DJI_{n}.JPG", 4000, 3000, "1") for n in (1, 2, 3))
POSES = {image.image_id: Pose(np.array([900.0 + 50.0 * n, 950.0 + 20.0 * n, 140.0]), None, 5.0, 3.0)
         for n, image in enumerate(IMAGES)}  # fmt: skip
# name -> world position, pixels by image, from the upper left corner
PLACES = {"north": (951.2, 970.11, 34.02), "south": (990.75, 999.4, 33.87), "west": (900.5, 960.25, 34.5)}
PIXELS = {("north", 1): (512.5, 390.25), ("north", 2): (2000.0, 1500.0), ("south", 2): (3999.0, 12.0),
          ("west", 3): (100.0, 2900.0), ("west", 1): (600.0, 40.0)}  # fmt: skip
MARKS = "".join(f"DJI_{n}.JPG,{name},{x},{y}\n" for (name, n), (x, y) in PIXELS.items())


def grid(name: str) -> FloatArray:
    return np.array(PLACES[name]) + ORIGIN_M


def degrees(name: str) -> tuple[float, float, float]:
    """Longitude, latitude, height."""
    x, y, z = grid(name)
    return (*Transformer.from_crs(CODE, "EPSG:4326", always_xy=True).transform(x, y), float(z))


def write(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def read(path: str, **more: object) -> tuple[dict[str, ControlPoint], list[str]]:
    points, remarks = read_control(path, IMAGES, CODE, ORIGIN_M, **({"poses": POSES} | more))  # type: ignore[arg-type]
    return {point.name: point for point in points}, remarks


def assert_the_points(points: dict[str, ControlPoint], atol_m: float = 1e-6) -> None:
    assert sorted(points) == sorted(PLACES)
    for name, point in points.items():
        np.testing.assert_allclose(point.position_m, PLACES[name], atol=atol_m)
        expected = {f"DJI_{n}_JPG": (x - 0.5, y - 0.5) for (p, n), (x, y) in PIXELS.items() if p == name}
        assert {image: tuple(pixel) for image, pixel in point.pixels.items()} == expected


def pix4d(*, accuracies: bool = False, geographic: bool = False) -> str:
    lines = []
    for name in PLACES:
        x, y, z = degrees(name) if geographic else grid(name)
        first = (f"{y:.11f}", f"{x:.11f}") if geographic else (f"{x:.4f}", f"{y:.4f}")
        lines.append(",".join([name, *first, f"{z:.3f}", *(["0.011", "0.017"] if accuracies else [])]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("geographic", [False, True])
def test_pix4d_with_its_marks_beside_it_or_named(tmp_path: Path, geographic: bool) -> None:
    path = write(tmp_path, "gcps.csv", pix4d(geographic=geographic))
    marks = write(tmp_path, "marks.txt", MARKS)
    for given in ({}, {"marks": marks}):
        points, remarks = read(path, **given)
        assert_the_points(points, 1e-4)
        assert remarks == []
        assert [point.sigmas_m for point in points.values()] == [(0.02, 0.02, 0.03)] * 3
    assert_the_points(read(marks)[0], 1e-4)  # the marks are named, the coordinates lie beside


def test_pix4d_accuracies_of_points_and_marks_and_check_points(tmp_path: Path) -> None:
    text = pix4d(accuracies=True).replace("0.017\n", "0.017,Check Point\n", 1)
    path = write(tmp_path, "gcps.csv", text)
    write(tmp_path, "marks.csv", MARKS.replace("\n", ",1.5\n"))
    points, _ = read(path)
    assert {point.sigmas_m for point in points.values()} == {(0.011, 0.011, 0.017)}
    assert {point.sigma_px for point in points.values()} == {1.5}
    assert {name: point.check for name, point in points.items()} == {"north": True, "south": False, "west": False}


def test_the_crs_of_a_prj_beside(tmp_path: Path) -> None:
    """Web Mercator, say, which the numbers do not tell."""
    to_mercator = Transformer.from_crs(CODE, "EPSG:3857", always_xy=True)
    lines = [",".join(map(str, (name, *to_mercator.transform(*grid(name)[:2]), grid(name)[2]))) for name in PLACES]
    path = write(tmp_path, "gcps.csv", "\n".join(lines))
    write(tmp_path, "marks.csv", MARKS)
    write(tmp_path, "gcps.prj", CRS.from_epsg(3857).to_wkt("WKT1_ESRI"))
    assert_the_points(read(path)[0], 1e-3)


def test_northing_before_easting_is_put_right_by_the_block(tmp_path: Path) -> None:
    lines = [f"{name};{grid(name)[1]:.4f};{grid(name)[0]:.4f};{grid(name)[2]}".replace(".", ",") for name in PLACES]
    write(tmp_path, "marks.csv", MARKS)
    points, remarks = read(write(tmp_path, "gcps.csv", "\n".join(lines)))
    assert_the_points(points, 1e-4)
    assert remarks == ["gcps.csv: the coordinates of the control points are exchanged (x and y): they were put right"]


def metashape_csv(wkt: str, *, geographic: bool = False, words: bool = False) -> str:
    x, y = ("X/Longitude", "Y/Latitude") if geographic else ("X/Easting", "Y/Northing")
    rows = [f"# CoordinateSystem: {wkt}", f"#Label,Enable,{x},{y},Z/Altitude,Accuracy_X_(m),Accuracy_Y_(m),"
            "Accuracy_Z_(m),Error_(m),X_error,X_est,Y_est,Z_est"]  # fmt: skip
    for name in PLACES:
        east, north, up = degrees(name) if geographic else grid(name)
        enabled = name != "south"
        rows.append(
            f"{name},{enabled if words else int(enabled)},{east:.11f},{north:.11f},{up},0.01,0.02,0.04,9,9,1,2,3"
        )
    return "\n".join([*rows, "# Total error,,,,,0.1"]) + "\n"


@pytest.mark.parametrize("geographic", [False, True])
def test_metashapes_reference_with_projections(tmp_path: Path, geographic: bool) -> None:
    wkt = CRS.from_user_input("EPSG:4326" if geographic else CODE).to_wkt("WKT1_GDAL")
    path = write(tmp_path, "markers.csv", metashape_csv(wkt, geographic=geographic, words=geographic))
    write(tmp_path, "projections.csv", "gcp_name,image_name,image_u,image_v\n" + "".join(
        f"{name},DJI_{n},{x},{y}\n" for (name, n), (x, y) in PIXELS.items()))  # fmt: skip
    points, remarks = read(path)
    assert_the_points(points, 1e-4)
    assert remarks == []
    assert {point.sigmas_m for point in points.values()} == {(0.01, 0.02, 0.04)}
    assert [name for name, point in points.items() if point.check] == ["south"]


def markers_xml(*, reference: str = CODE, more: str = "") -> str:
    markers = "".join(
        f'<marker id="{n}" label="{name}"><reference x="{grid(name)[0]}" y="{grid(name)[1]}" z="{grid(name)[2]}" '
        f'{"sxyz" if n else "sx"}="0.015" enabled="{str(name != "west").lower()}"/></marker>'
        for n, name in enumerate(PLACES)
    )
    places = "".join(
        f'<marker marker_id="{n}">' + "".join(
            f'<location camera_id="{10 * k}" pinned="true" x="{x}" y="{y}"/>' for (p, k), (x, y) in PIXELS.items()
            if p == name) + more + "</marker>"
        for n, name in enumerate(PLACES)
    )  # fmt: skip
    cameras = "".join(f'<camera id="{10 * n}" sensor_id="0" label="DJI_{n}"/>' for n in (1, 2, 3))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><document version="1.2.0"><chunk label="C"><cameras>{cameras}</cameras>'
        f'<markers>{markers}<marker id="7" label="free"/></markers><frames><frame id="0"><markers>{places}</markers>'
        f"</frame></frames><reference>{reference}</reference></chunk></document>"
    )


def test_metashapes_markers_xml(tmp_path: Path) -> None:
    """A place that is not pinned was predicted, and nobody measured it."""
    wkt = CRS.from_user_input(CODE).to_wkt("WKT1_GDAL").replace("<", "&lt;")
    predicted = '<location camera_id="20" pinned="false" x="7" y="7"/>'
    points, remarks = read(write(tmp_path, "m.xml", markers_xml(reference=wkt, more=predicted)))
    assert_the_points(points)
    assert [name for name, point in points.items() if point.check] == ["west"]
    assert points["south"].sigmas_m == (0.015, 0.015, 0.015)
    assert points["north"].sigmas_m == (0.015, 0.015, 0.03)
    assert remarks == [
        "m.xml: 3 places of markers are not pinned there: not used",
        "m.xml: 1 markers have no coordinates there: not used",
    ]


def test_odm_with_accuracies(tmp_path: Path) -> None:
    lines = [CODE]
    for (name, n), (x, y) in PIXELS.items():
        more = {"north": " 0.01 0.02", "south": " check 0.03 0.05 0.8", "west": " 7"}[name]
        lines.append(" ".join(map(str, (*grid(name), x, y, f"DJI_{n}.JPG", name))) + more)
    points, _ = read(write(tmp_path, "gcp_list.txt", "\n".join(lines)))
    assert_the_points(points)
    assert [(p.sigmas_m, p.sigma_px, p.check) for p in points.values()] == [
        ((0.01, 0.01, 0.02), 0.5, False), ((0.03, 0.03, 0.05), 0.8, True), ((0.02, 0.02, 0.03), 0.5, False),
    ]  # fmt: skip


def test_all_may_be_check_points(tmp_path: Path) -> None:
    points, _ = read(write(tmp_path, "m.xml", markers_xml()), use="check")
    assert all(point.check for point in points.values())
    settings = load("baseline", ["block.gcp_use=check"], {})
    assert settings.block.gcp_use == "check"


def test_points_and_measurements_that_do_not_count_are_named(tmp_path: Path) -> None:
    path = write(tmp_path, "gcps.csv", pix4d() + "unseen,390951.0,5818970.0,34\n")
    write(
        tmp_path,
        "marks.csv",
        MARKS + "DJI_1.JPG,other,5,5\nDJI_2.JPG,west,2900,3500\nDJI_1.JPG,north,5,5\nx.jpg,west,1,1\n",
    )
    points, remarks = read(path)
    assert_the_points(points, 1e-4)
    assert remarks == [
        "marks.csv names 1 image that the block does not have: x.jpg",
        "marks.csv measures points twice in an image: the first counts: north in DJI_1.JPG",
        "1 of 9 measurements of control points lies outside their image and is left out (west in DJI_2.JPG at 2900, "
        "3500): are pixel x and y exchanged?",
        "1 of 4 control points is measured in no image of the block: left out: unseen",
        "marks.csv measures 1 point without coordinates in images: left out: other",
    ]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("gcps.csv", "north,390951.2,5818970.1,34\n", "holds no image measurements .* give them with --gcp-marks"),
        ("marks.csv", MARKS, r"holds no coordinates .* give them with --gcp"),
        ("gcps.csv", "north,390951.2,5818970.1,34\nsouth,3,x,4\n", "line 2, column y: 'x' is not a number"),
        ("gcps.csv", "north,390951.2,5818970.1,34\nnorth,3,4,5\n", "line 2: the point north stands in the file twice"),
        ("gcps.csv", "label,x,y,z\nnorth,390951.2,,34\n", "line 2, column y: empty"),
        ("gcp_list.txt", f"{CODE}\n13.39 52.5 34 5 5 DJI_1.JPG a\n13.391 52.501 34 5 5 DJI_2.JPG b\n",
         r"line 1: the coordinates of the control points are degrees, and .* counts in metres: name EPSG:4326 there"),
        ("gcp_list.txt", "EPSG:4326\n390951.2 5818970.1 34 5 5 DJI_1.JPG a\n", "are no degrees, and WGS 84 counts in"),
        ("m.xml", "<document><chunk><markers><marker id='1' label='a'><reference x='1' y='2' z='b'/></marker></markers>"
         "</chunk></document>", "marker 'a', z: 'b' is not a number"),
        ("m.xml", markers_xml().replace('camera_id="20"', 'camera_id="99"'), "no camera has the id '99'"),
        ("m.bin", "a\0b", "are a binary file"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(write(tmp_path, name, text))


def test_two_files_that_may_be_the_other_half(tmp_path: Path) -> None:
    path = write(tmp_path, "gcps.csv", pix4d())
    for name in ("a.csv", "b.csv"):
        write(tmp_path, name, MARKS)
    with pytest.raises(ConfigError, match=r"a\.csv and b\.csv beside it do: name the right one with --gcp-marks"):
        read(path)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (("--gcp-marks", "marks.csv"), "--gcp-marks"),
        (("--gcp-use", "check"), "--gcp-use"),
        (("--gcp-use", "adjust"), "--gcp-use"),
        (("--set", "block.gcp_use=check", "--gcp-marks", "marks.csv"), "--gcp-marks and --gcp-use"),
    ],
)
def test_words_on_control_points_need_control_points(tmp_path: Path, given: tuple[str, ...], named: str) -> None:
    outcome = invoke("run", "--images", tmp_path, "--workspace", tmp_path / "work", *given)
    assert outcome.code == 2
    assert f"error: {named} without control points: name the file that holds them with --gcp" in outcome.stderr
    assert not (tmp_path / "work").exists()
    with_them = invoke("run", "--images", tmp_path, "--workspace", tmp_path / "work", *given, "--gcp", "gcps.csv")
    assert "without control points" not in with_them.stderr


def test_degrees_of_a_block_without_crs(tmp_path: Path) -> None:
    path = write(tmp_path, "gcps.csv", pix4d(geographic=True))
    write(tmp_path, "marks.csv", MARKS)
    with pytest.raises(ConfigError, match=r"the block has no CRS .* give one with --crs"):
        read_control(path, IMAGES, "local", (0.0, 0.0, 0.0))


def test_points_of_another_country_are_said(tmp_path: Path) -> None:
    write(tmp_path, "marks.csv", MARKS)
    path = write(tmp_path, "gcps.csv", pix4d().replace(",5818", ",5218"))
    _, remarks = read(path)
    assert remarks == [
        "the control points of gcps.csv lie 600.0 km from the images: is the CRS that the file states right?"
    ]
