"""Exports for GIS: GeoJSON and GeoPackage."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_export_colmap import ORIGIN_M, Truth
from test_exporters import CRS, adjusted_block, contents, geographic, truth  # noqa: F401 - fixtures

from aeromatch_cli.data import PoseResidual
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, from_yaw_pitch_roll, to_yaw_pitch_roll
from aeromatch_cli.strategies.exporters import EXPORTERS


def test_geojson_lies_where_the_cameras_are(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    EXPORTERS["geojson"]()(contents(), tmp_path / "g")  # type: ignore[operator]
    cameras, pairs = (json.loads((tmp_path / "g" / f"{name}.geojson").read_text()) for name in ("cameras", "pairs"))
    place = cameras["features"][0]["geometry"]["coordinates"]
    latitude, longitude, height = geographic(truth.block.poses["img0"].center_m[None])[0]
    np.testing.assert_allclose(place, [longitude, latitude, height], atol=1e-4)
    assert len(pairs["features"]) == len(truth.pairs)
    assert pairs["features"][0]["properties"]["matches"] == len(truth.pairs[0].verified)
    assert "crs" not in pairs


def test_geojson_of_a_local_block_is_no_longitude_and_latitude(truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    import pyogrio

    local = dataclasses.replace(truth.contents(), geographic=None)
    EXPORTERS["geojson"]()(local, tmp_path / "g")  # type: ignore[operator]
    assert pyogrio.read_info(tmp_path / "g" / "cameras.geojson")["crs"].startswith(
        'LOCAL_CS["local frame of the block"'
    )


def test_styles_name_the_fields_of_their_layers(contents, tmp_path: Path) -> None:  # noqa: F811
    from defusedxml.ElementTree import parse

    EXPORTERS["geojson"]()(contents(), tmp_path / "g")  # type: ignore[operator]
    for name, field in (("cameras", "weak"), ("footprints", None), ("pairs", "matches")):
        renderer = parse(tmp_path / "g" / f"{name}.qml", forbid_dtd=False).getroot().find("renderer-v2")
        assert renderer.get("attr") == field
        symbols = {symbol.get("name") for symbol in renderer.iter("symbol")}
        used = {one.get("symbol") for one in (*renderer.iter("range"), *renderer.iter("category"))}
        assert used <= symbols
        if field:
            features = json.loads((tmp_path / "g" / f"{name}.geojson").read_text())["features"]
            assert field in features[0]["properties"]


def test_a_geopackage_has_three_layers_in_the_blocks_crs(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    import pyogrio
    from shapely import from_wkb

    EXPORTERS["geopackage"]()(contents(), tmp_path / "g")  # type: ignore[operator]
    path = tmp_path / "g" / "block.gpkg"
    layers = dict(pyogrio.list_layers(path).tolist())
    assert layers["cameras"] == "Point Z"
    assert set(layers) >= {"cameras", "pairs"}
    meta, _, geometry, fields = pyogrio.raw.read(path, layer="cameras")
    assert meta["crs"] == CRS
    styles = pyogrio.raw.read(path, layer="layer_styles", read_geometry=False)
    table = dict(zip(styles[0]["fields"], styles[3], strict=True))
    assert {"cameras", "pairs"} <= set(table["f_table_name"])
    assert table["useAsDefault"].all()
    assert all("renderer-v2" in text for text in table["styleQML"])
    point = from_wkb(geometry[0])
    np.testing.assert_allclose([point.x, point.y, point.z], truth.block.poses["img0"].center_m + ORIGIN_M)
    assert fields[list(meta["fields"]).index("image")][0] == "flight/0.jpg"
    _, _, lines, fields = pyogrio.raw.read(path, layer="pairs")
    assert len(lines) == len(truth.pairs)


def known_block(contents, truth: Truth):  # noqa: F811
    """img0 to img4 adjusted with known deviations and residuals; img5 has its given position alone."""
    adjusted = adjusted_block(truth)
    poses = {
        i: dataclasses.replace(
            pose, sigmas_m=np.array([0.01, 0.02, 0.03]) * (n + 1), sigmas_deg=np.array([0.1, 0.2, 0.3])
        )
        for n, (i, pose) in enumerate(sorted(adjusted.poses.items()))
        if i != "img5"
    }
    residual = PoseResidual(
        np.array([1.0, -2.0, 3.0]), np.full(3, np.nan), np.array([0.5, 0.0, 0.0]), np.full(3, np.nan), 0.25, 77, 3.5
    )
    images = tuple(
        dataclasses.replace(i, time="2024-05-01T10:00:07" * (i.image_id != "img1")) for i in truth.block.images
    )
    lone = dataclasses.replace(truth.block.poses["img5"], world_rotation=None)
    block = dataclasses.replace(truth.block, images=images, poses={**truth.block.poses, "img5": lone})
    return dataclasses.replace(
        contents(), block=block, adjusted=dataclasses.replace(adjusted, poses=poses), residuals={"img2": residual}
    )


def check_fields(row: Callable[[int, str], Any], truth: Truth) -> None:  # noqa: F811
    """row: value of an attribute of the image of a number, None where it is not known."""
    assert [row(n, "image") for n in range(6)] == [f"flight/{n}.jpg" for n in range(6)]
    assert [row(n, "camera") for n in range(6)] == ["a", "b"] * 3
    assert [bool(row(n, "oriented")) for n in range(6)] == [True] * 5 + [False]
    assert [row(n, "frame") for n in range(6)] == ["world"] * 5 + ["predicted"]
    for n in range(5):
        rotation = truth.block.poses[f"img{n}"].world_rotation
        assert rotation is not None
        angles = [row(n, f"{name}_deg") for name in ("omega", "phi", "kappa")]
        np.testing.assert_allclose(from_omega_phi_kappa(*angles), rotation, atol=1e-7)
        angles = [row(n, f"{name}_deg") for name in ("yaw", "pitch", "roll")]
        np.testing.assert_allclose(from_yaw_pitch_roll(*angles, forward=False), rotation, atol=1e-7)
        sigmas = [row(n, f"sigma_{name}") for name in ("x_m", "y_m", "z_m", "omega_deg", "phi_deg", "kappa_deg")]
        np.testing.assert_allclose(sigmas, [0.01 * (n + 1), 0.02 * (n + 1), 0.03 * (n + 1), 0.1, 0.2, 0.3])
    assert [row(5, f"{name}_deg") for name in ("omega", "kappa", "yaw", "sigma_phi")] == [None] * 4
    assert row(5, "sigma_x_m") == 0.5  # as it was given
    assert [row(2, key) for key in ("dx_m", "dy_m", "dz_m", "rotation_x_deg")] == [1.0, -2.0, 3.0, 0.5]
    assert (row(2, "error_px"), row(2, "points"), row(2, "images_per_point")) == (0.25, 77, 3.5)
    assert [row(n, "dx_m") for n in (0, 5)] == [None, None]
    place = [row(3, axis) for axis in "xyz"]
    np.testing.assert_allclose(place, truth.block.poses["img3"].center_m + ORIGIN_M, atol=1e-4)


def test_geojson_tells_what_is_known_of_images(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    EXPORTERS["geojson"]()(known_block(contents, truth), tmp_path / "g")  # type: ignore[operator]
    text = (tmp_path / "g" / "cameras.geojson").read_text()
    assert "NaN" not in text
    rows = [feature["properties"] for feature in json.loads(text)["features"]]
    check_fields(lambda n, key: rows[n][key], truth)
    assert (rows[0]["time"], rows[1]["time"]) == ("2024-05-01T10:00:07", None)


def test_a_geopackage_tells_what_is_known_of_images(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    import pyogrio

    EXPORTERS["geopackage"]()(known_block(contents, truth), tmp_path / "g")  # type: ignore[operator]
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "g" / "block.gpkg", layer="cameras", read_geometry=False)
    fields = dict(zip(meta["fields"], columns, strict=True))
    check_fields(lambda n, key: None if fields[key][n] != fields[key][n] else fields[key][n], truth)
    assert fields["time"][0] == np.datetime64("2024-05-01T10:00:07")
    assert np.isnat(fields["time"][1])
    info = pyogrio.read_info(tmp_path / "g" / "block.gpkg", layer="cameras")
    assert dict(zip(info["fields"], info["dtypes"], strict=True))["oriented"] == "bool"


def test_footprints_tell_their_image_and_its_scale(contents, truth: Truth, tmp_path: Path) -> None:  # noqa: F811
    class Flat:
        def height_m(self, xy_m: np.ndarray) -> np.ndarray:
            return np.zeros(len(xy_m))

    made = contents()
    level = {i: dataclasses.replace(p, world_rotation=np.diag([1.0, -1.0, -1.0])) for i, p in made.block.poses.items()}
    block = dataclasses.replace(made.block, ground=Flat(), poses=level)
    EXPORTERS["geojson"]()(dataclasses.replace(made, block=block), tmp_path / "g")  # type: ignore[operator]
    features = json.loads((tmp_path / "g" / "footprints.geojson").read_text())["features"]
    assert len(features) == 6
    facts = features[0]["properties"]
    focal_px = sum(truth.block.cameras["a"].params[:2]) / 2
    assert (facts["image"], facts["camera"], facts["oriented"]) == ("flight/0.jpg", "a", True)
    assert facts["gsd_m"] == pytest.approx(truth.block.poses["img0"].center_m[2] / focal_px, rel=0.02)
    assert facts["tilt_deg"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("forward", [True, False])
def test_yaw_pitch_roll_come_back(forward: bool) -> None:
    rng = np.random.default_rng(1)
    for yaw, pitch, roll in rng.uniform([0, -89, -179], [360, 89, 179], (50, 3)):
        found = to_yaw_pitch_roll(from_yaw_pitch_roll(yaw, pitch, roll, forward=forward), forward=forward)
        np.testing.assert_allclose(found, (yaw, pitch, roll), atol=1e-9)
    for pitch in (90.0, -90.0):  # straight down, of a gimbal
        turned = from_yaw_pitch_roll(30.0, pitch, 0.0, forward=forward)
        again = from_yaw_pitch_roll(*to_yaw_pitch_roll(turned, forward=forward), forward=forward)
        np.testing.assert_allclose(again, turned, atol=1e-9)
