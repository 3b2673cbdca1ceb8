"""Exports for GIS: GeoJSON and GeoPackage."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from test_export_colmap import ORIGIN_M, Truth
from test_exporters import CRS, contents, geographic, truth  # noqa: F401 - fixtures

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
