"""Figures of the report page: previews, the map, histograms, against pictures and places known by construction."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image as PilImage
from PIL import ImageOps
from read_html import Structure

from aeromatch_cli.stages import report_figures, report_map


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_agrees_with_pillow_and_points_follow(orientation):
    rng = np.random.default_rng(orientation)
    pixels = rng.integers(0, 255, (7, 5), dtype=np.uint8)
    picture = PilImage.fromarray(pixels)
    picture.getexif()[274] = orientation
    expected = np.asarray(ImageOps.exif_transpose(picture))
    turned = report_figures.turned(pixels, orientation)
    np.testing.assert_array_equal(turned, expected)
    y, x = np.mgrid[0:7, 0:5]
    points = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    moved = report_figures.turned_points(points, 5, 7, orientation).astype(int)
    np.testing.assert_array_equal(turned[moved[:, 1], moved[:, 0]], pixels.ravel())


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_preview_draws_a_known_match_on_the_turned_picture(orientation):
    """A red spot at stored (900, 240) of a 1200 x 800 raster: the line must end on it, wherever it is displayed."""
    sides = []
    for turn in (1, orientation):
        pixels = np.full((800, 1200, 3), 90, np.uint8)
        pixels[234:247, 894:907] = (255, 0, 0)
        sides.append(report_figures.Side(pixels, turn, np.array([[900.0, 240.0]])))
    svg = report_figures.preview(*sides, np.array([0.7]), "pair")
    line = re.search(r'<path class="tie e1" d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)"/>', svg)
    assert line is not None
    ends = np.array(line.groups(), float).reshape(2, 2)
    pattern = r'<image href="data:image/jpeg;base64,([^"]+)" x="(\d+)" y="0" width="(\d+)" height="(\d+)"'
    pictures = re.findall(pattern, svg)
    for (data, left, width, height), end in zip(pictures, ends, strict=True):
        shown = np.asarray(PilImage.open(io.BytesIO(base64.b64decode(data)))).astype(float)
        assert shown.shape[:2] == (int(height), int(width))
        ys, xs = np.nonzero(shown[..., 0] - shown[..., 1] > 80)
        np.testing.assert_allclose(end, [xs.mean() + 0.5 + int(left), ys.mean() + 0.5], atol=0.4)
    assert (int(pictures[1][2]) > int(pictures[1][3])) == (orientation == 1)


def test_deep_pictures_are_stretched_for_display():
    deep = np.linspace(1000, 4000, 600, dtype=np.uint16).reshape(20, 30)
    for pixels in (deep, np.stack([deep] * 3, axis=-1)):
        shown = report_figures.to_colour8(pixels)
        assert shown.shape == pixels.shape
        assert shown.dtype == np.uint8
        assert shown.min() == 0
        assert shown.max() == 255


def test_map_is_true_to_scale_north_up_and_coloured_by_matches():
    stations = [
        report_map.Station("a", "a", "a", 0.0, 0.0),
        report_map.Station("b", "b", "b", 100.0, 0.0, weak=True),
        report_map.Station("c", "<c>", "c", 0.0, 50.0, suspect=True),
    ]
    links = [
        report_map.Link("a", "b", "verified", 20, "weak tie"),
        report_map.Link("a", "c", "verified", 4000, "strong tie"),
        report_map.Link("b", "c", "rejected", 0, "<no>"),
        report_map.Link("b", "unposed", "verified", 900, ""),
    ]
    square = np.array([[-60.0, -60.0], [60.0, -60.0], [60.0, 60.0], [-60.0, 60.0]])
    figure = report_map.block_map(stations, [square], links)
    circles = {
        css: np.array([float(x), float(y)])
        for css, x, y in re.findall(r'<circle class="(\w+)" cx="([\d.]+)" cy="([\d.]+)"', figure.svg)
    }
    east, north = circles["weak"] - circles["fine"], circles["suspect"] - circles["fine"]
    assert east[0] > 0
    assert abs(east[1]) < 0.11
    assert abs(north[0]) < 0.11
    assert -north[1] == pytest.approx(east[0] / 2, abs=0.2)
    weak, strong = (re.search(rf'<g class="{css}"><path d="M([\d.]+) ([\d.]+)L', figure.svg) for css in ("k0", "k5"))
    for line in (weak, strong):
        assert line is not None
        np.testing.assert_allclose([float(v) for v in line.groups()], circles["fine"], atol=0.11)
    assert "&lt;no&gt;" in figure.svg
    assert "&lt;c&gt;" in figure.svg
    assert figure.legend[0][1].startswith("20")
    assert ("refused", "rejected") in figure.legend
    assert figure.remarks == ("1 pairs have an image without position and are not drawn.",)
    Structure.of(figure.svg)


def test_a_view_of_the_horizon_does_not_shrink_the_block():
    stations = [report_map.Station(str(k), str(k), "", 20.0 * k, 0.0) for k in range(6)]
    wide = np.array([[0.0, -1e5], [1e5, -1e5], [1e5, 1e5], [0.0, 1e5]])
    near = np.array([[-20.0, -20.0], [120.0, -20.0], [120.0, 20.0], [-20.0, 20.0]])
    svg = report_map.block_map(stations, [near, near, wide], []).svg
    xs = [float(x) for x in re.findall(r'cx="([\d.]+)"', svg)]
    assert max(xs) - min(xs) > 0.19 * 1022  # the frame is at most five times as wide as the block


@pytest.mark.parametrize(
    ("counts", "expected"),
    [([], ()), ([0], ()), ([40, 40], (40,)), ([15, 2000], (15, 50, 100, 200, 500, 1000)), ([30, 31], (30,))],
)
def test_match_classes_are_round_and_cover_the_range(counts, expected):
    limits = report_map.match_classes(counts)
    assert limits == expected
    for count in counts:
        assert 0 <= report_map.class_of(count, limits) < report_map.MAP_CLASSES


def test_histogram_bars_count_every_value():
    svg = report_figures.histogram([15, 15, 37, 420], "matches", "pairs")
    titles = re.findall(r"<title>(.*?)</title>", svg)
    assert sum(int(title.split(": ")[1].split()[0]) for title in titles) == 4
    assert titles[0] == "0 to 19: 2 pairs"


def test_evenly_chosen_keeps_ends_and_limit():
    chosen = report_figures.evenly_chosen(1000, 150)
    assert len(chosen) == 150
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert set(np.diff(chosen)) <= {6, 7}
    assert list(report_figures.evenly_chosen(3, 150)) == [0, 1, 2]
