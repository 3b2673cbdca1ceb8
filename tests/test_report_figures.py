"""Figures of the report page: previews, the map, histograms, against pictures and places known by construction."""

from __future__ import annotations

import base64
import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image as PilImage
from PIL import ImageOps
from read_html import Structure, shapes

from aeromatch_cli.report import figures, previews
from aeromatch_cli.report import map as report_map


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_agrees_with_pillow_and_points_follow(orientation):
    rng = np.random.default_rng(orientation)
    pixels = rng.integers(0, 255, (7, 5), dtype=np.uint8)
    picture = PilImage.fromarray(pixels)
    picture.getexif()[274] = orientation
    expected = np.asarray(ImageOps.exif_transpose(picture))
    turned = previews.turned(pixels, orientation)
    np.testing.assert_array_equal(turned, expected)
    y, x = np.mgrid[0:7, 0:5]
    points = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    moved = previews.turned_points(points, 5, 7, orientation).astype(int)
    np.testing.assert_array_equal(turned[moved[:, 1], moved[:, 0]], pixels.ravel())


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_preview_draws_a_known_match_on_the_turned_picture(orientation):
    """A red spot at stored (900, 240) of a 1200 x 800 raster: the line must end on it, wherever it is displayed."""
    sides = []
    for turn in (1, orientation):
        pixels = np.full((800, 1200, 3), 90, np.uint8)
        pixels[234:247, 894:907] = (255, 0, 0)
        sides.append(previews.Side(pixels, turn, np.array([[900.0, 240.0]])))
    svg = previews.preview(*sides, np.array([0.7]), "pair")
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
        shown = previews.to_colour8(pixels)
        assert shown.shape == pixels.shape
        assert shown.dtype == np.uint8
        assert shown.min() == 0
        assert shown.max() == 255


def test_map_is_true_to_scale_north_up_and_coloured_by_matches():
    stations = [
        report_map.Station("a", "a", "a", 0.0, 0.0),
        report_map.Station("b", "b", "b", 100.0, 0.0, "weak"),
        report_map.Station("c", "<c>", "camera <c>", 0.0, 50.0, "wrong"),
    ]
    links = [
        report_map.Link("a", "b", "verified", 20, "weak tie"),
        report_map.Link("a", "c", "verified", 4000, "strong tie"),
        report_map.Link("b", "c", "rejected", 0, "<no>"),
        report_map.Link("b", "unposed", "verified", 900, ""),
    ]
    square = np.array([[-60.0, -60.0], [60.0, -60.0], [60.0, 60.0], [-60.0, 60.0]])
    figure = report_map.block_map(stations, [square], links)
    places = {}
    for kind, title in (("fine", "a"), ("weak", "b"), ("wrong", "camera <c>")):
        ((found, place),) = shapes(figure.svg, kind)
        assert found == title
        places[kind] = np.array(place)
    east, north = places["weak"] - places["fine"], places["wrong"] - places["fine"]
    assert east[0] > 0
    assert abs(east[1]) < 0.11
    assert abs(north[0]) < 0.11
    assert -north[1] == pytest.approx(east[0] / 2, abs=0.2)
    for css, title, ends in (
        ("k0", "weak tie", ("fine", "weak")),
        ("k5", "strong tie", ("fine", "wrong")),
        ("rejected", "<no>", ("weak", "wrong")),
    ):
        ((found, line),) = shapes(figure.svg, css)
        assert found == title
        np.testing.assert_allclose(np.reshape(line, (2, 2)), [places[end] for end in ends], atol=0.11)
    ((_, outline),) = shapes(figure.svg, "footprints")
    corners = places["fine"] + (square * (1, -1)) * east[0] / 100
    np.testing.assert_allclose(np.reshape(outline[:8], (4, 2)), corners, atol=0.2)
    assert "&lt;no&gt;" in figure.svg
    assert "&lt;c&gt;" in figure.svg
    texts = Structure.of(figure.svg).text
    assert texts.index("20–49") < texts.index("rejected") < texts.index("weakly tied image")
    assert figure.remarks == ("Not drawn: 1 pair has an image without position.",)


def test_map_names_the_images_of_other_groups():
    """c and d hang together in a frame of their own; where e lies is not known at all."""
    stations = [report_map.Station(name, name, name, 100.0 * k, 0.0) for k, name in enumerate("ab")]
    links = [report_map.Link(*ends, "verified", 20, "") for ends in ("ab", "cd", "ae", "ce")]
    figure = report_map.block_map(stations, [], links, in_world=False, aside=frozenset("cd"))
    assert figure.remarks == (
        "Not drawn: 2 images of other groups, whose place beside the first is not known.",
        "Not drawn: 2 pairs have images without position.",
    )
    assert len(shapes(figure.svg, "k0")) == 1


def test_map_of_many_pairs_joins_its_lines_and_says_what_is_left_out(monkeypatch):
    monkeypatch.setattr(report_map, "MAX_TITLED_LINES", 5)
    monkeypatch.setattr(report_map, "MAX_LINES", 8)
    monkeypatch.setattr(report_map, "MAX_FOOTPRINTS", 2)
    stations = [report_map.Station(str(k), str(k), "", 10.0 * k, 5.0 * (k % 2)) for k in range(11)]
    links = [report_map.Link(str(k), str(k + 1), "verified", 40, "") for k in range(10)]
    square = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]])
    figure = report_map.block_map(stations, [square + k for k in range(4)], links)
    ((title, line),) = shapes(figure.svg, "k0")
    assert (title, len(line)) == ("", 8 * 4)
    places = np.array([place for _, place in shapes(figure.svg, "fine")])
    np.testing.assert_allclose(np.reshape(line, (8, 2, 2))[0], places[:2], atol=0.11)
    assert figure.remarks == (
        "8 of 10 pair lines are drawn, evenly chosen.",
        "2 of 4 footprints are drawn, evenly chosen.",
    )


def test_figures_are_well_formed_equal_and_in_the_colours_of_the_page():
    """Equal input gives equal text; no colour or font of its own, so that dark and printed pages keep theirs."""
    stations = [report_map.Station(str(k), f"label {k}", "", 20.0 * k, 0.0) for k in range(3)]
    links = [report_map.Link("0", "1", "verified", 20, "")]
    for draw in (
        lambda: report_map.block_map(stations, [], links).svg,
        lambda: figures.histogram([15, 400], "matches", "pairs"),
    ):
        svg = draw()
        assert svg == draw()
        root = ElementTree.fromstring(svg)
        assert (root.tag, root.get("role")) == ("svg", "img")
        assert not {element.tag for element in root.iter()} & {"metadata", "style", "script", "image"}
        assert not re.search(r"#[0-9a-f]{6}|font-family|https?:", svg)
        references = re.findall(r"(?:url\(#|href=\"#)(\w+)", svg)
        assert references
        assert set(references) <= {element.get("id") for element in root.iter()}
        assert "matches" in Structure.of(svg).words().lower()


def test_labels_of_a_dense_block_lie_on_nothing_else():
    rng = np.random.default_rng(2)
    places = rng.uniform((0.0, 0.0), (200.0, 120.0), (55, 2))
    kinds = ["weak" if k % 6 == 0 else "fine" for k in range(55)]
    stations = [
        report_map.Station(str(k), f"DJI_2024_{k:04}_V", "", *map(float, place), kinds[k])
        for k, place in enumerate(places)
    ]
    axes = figures.new_axes(9.0, 6.0)
    axes.set(xlim=(-5.0, 205.0), ylim=(-5.0, 125.0))
    report_map._draw_labels(axes, stations)
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) > 15
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    assert not any(box.count_contains(axes.transData.transform(places)) for box in boxes)
    frame = axes.get_window_extent()
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)


def test_a_view_of_the_horizon_does_not_shrink_the_block():
    stations = [report_map.Station(str(k), str(k), "", 20.0 * k, 0.0) for k in range(6)]
    wide = np.array([[0.0, -1e5], [1e5, -1e5], [1e5, 1e5], [0.0, 1e5]])
    near = np.array([[-20.0, -20.0], [120.0, -20.0], [120.0, 20.0], [-20.0, 20.0]])
    svg = report_map.block_map(stations, [near, near, wide], []).svg
    xs = [place[0] for _, place in shapes(svg, "fine")]
    (frame,) = (float(width) for width in re.findall(r'<clipPath.*?<rect[^>]* width="([\d.]+)"', svg, re.S))
    assert max(xs) - min(xs) > 0.19 * frame  # the frame is at most five times as wide as the block


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
    svg = figures.histogram([15, 15, 37, 420], "matches", "pairs")
    bars = shapes(svg, "bar")
    assert [title for title, _ in bars] == ["0 to 19: 2 pairs", "20 to 39: 1 pair", "420 to 439: 1 pair"]
    heights = [np.ptp(np.reshape(corners, (-1, 2))[:, 1]) for _, corners in bars]
    assert heights[0] == pytest.approx(2 * heights[1], abs=0.05)
    assert heights[1] == pytest.approx(heights[2], abs=0.05)
    assert {"matches", "pairs"} <= set(Structure.of(svg).text)


def test_evenly_chosen_keeps_ends_and_limit():
    chosen = figures.evenly_chosen(1000, 150)
    assert len(chosen) == 150
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert set(np.diff(chosen)) <= {6, 7}
    assert list(figures.evenly_chosen(3, 150)) == [0, 1, 2]
