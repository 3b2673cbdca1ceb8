"""The report's pair viewer: what is stored against the workspace, and what a browser draws of it."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage
from test_report import HEIGHT, WIDTH, features, full, page_of  # noqa: F401 - a fixture

from aeromatch_cli.report import pair_viewer, thumbnails
from aeromatch_cli.report.gathering import gather
from aeromatch_cli.report.pair_viewer import PairData
from aeromatch_cli.report.previews import DrawnMatches
from aeromatch_cli.report.sketch import ground_sketch
from aeromatch_cli.stages.context import Context

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def stored(page: str) -> dict[str, object]:
    text = page.split('<script type="application/json" id="pair-data">')[1].split("</script>")[0]
    return dict(json.loads(text))


def pair_data(context: Context) -> tuple[PairData, dict[tuple[str, str], str]]:
    found = gather(context, pair_viewer.pair_table)
    return pair_viewer.pair_data(context, found.pairs, thumbnails.thumbnails(context), found.drawn)


def test_tables_made_while_pairs_are_gathered_are_those_of_their_files(full: Context) -> None:  # noqa: F811
    found, files = gather(full, pair_viewer.pair_table), DrawnMatches(full.workspace)
    drawn = {(row.image_id0, row.image_id1): row for row in pair_viewer.drawable(found.pairs)}
    assert found.drawn.keys() == drawn.keys() == {("a", "b"), ("a", "c"), ("b", "c")}
    for key, row in drawn.items():
        images = full.image_by_id[key[0]], full.image_by_id[key[1]]
        assert found.drawn[key] == pair_viewer.pair_table(images, *files.of(row))


def test_pairs_of_readable_images_are_stored_with_places_and_errors(full: Context) -> None:  # noqa: F811
    data, keys = pair_data(full)
    # d has no picture, a-d no matches; c-d is neither verified nor rejected.
    assert keys == {("a", "b"): "0,1", ("a", "c"): "0,2", ("b", "c"): "1,2"}
    sizes = [(width, height) for _, width, height in data.pictures]
    assert sizes == [(WIDTH, HEIGHT), (HEIGHT, WIDTH), (WIDTH, HEIGHT)]  # b is shown turned
    for uri, width, height in data.pictures:
        picture = PilImage.open(io.BytesIO(base64.b64decode(uri.partition("base64,")[2])))
        assert picture.size == (width, height)
    table = np.frombuffer(base64.b64decode(data.pairs["0,1"][0]), np.uint8).reshape(-1, 5)
    points = features().keypoints_px[:60].astype(np.float64) + 0.5
    assert np.abs(table[:, :2] - points / [WIDTH, HEIGHT] * 255.0).max() <= 0.5
    # EXIF 6: a quarter turn clockwise, so x is counted from the lower edge.
    assert np.abs(table[:, 2] - (HEIGHT - points[:, 1]) / HEIGHT * 255.0).max() <= 0.5
    assert np.abs(table[:, 3] - points[:, 0] / WIDTH * 255.0).max() <= 0.5
    assert (table[:, 4] == 1).all()  # 0.72 px: above 0.5, up to 1
    rejected = np.frombuffer(base64.b64decode(data.pairs["0,2"][0]), np.uint8).reshape(-1, 5)
    assert (len(rejected), set(rejected[:, 4])) == (12, {9})


def test_a_pair_has_some_of_its_matches(full: Context, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    monkeypatch.setattr(pair_viewer, "MAX_MATCHES", 10)
    data, _ = pair_data(full)
    assert len(base64.b64decode(data.pairs["0,1"][0])) == 50
    assert data.pairs["0,1"][1:] == (60, 80, "verified")
    assert data.pairs["0,2"][1:] == (0, 12, "rejected")


@pytest.fixture
def large(full: Context, monkeypatch: pytest.MonkeyPatch) -> Context:  # noqa: F811
    """Four images, one of them unreadable, are a large block here: three pictures are not."""
    monkeypatch.setattr(thumbnails, "MAX_IMAGES", 3)
    return full


def test_pictures_and_pairs_of_a_large_block_lie_beside_the_page(large: Context) -> None:
    found = stored(page_of(large))
    folder = large.workspace.report.parent
    assert (len(found["names"]), found["pairs"], found["beside"]) == (3, {}, [0, 1])  # type: ignore[arg-type]
    for uri, width, height in found["pictures"]:  # type: ignore[attr-defined]
        with PilImage.open(folder / uri) as picture:
            assert picture.size == (width, height)
    scripts = {path.name: path.read_text() for path in (folder / "pairs").iterdir()}
    assert sorted(scripts) == ["0.js", "1.js"]
    added = json.loads(scripts["0.js"].removeprefix("addPairs(").removesuffix(");\n"))
    assert {key: pair[1:] for key, pair in added.items()} == {"0,1": [60, 80, "verified"], "0,2": [0, 12, "rejected"]}


def test_pictures_beside_the_page_are_made_once_and_stale_files_go(large: Context) -> None:
    page_of(large)
    folder = large.workspace.report.parent
    before = {path: path.stat().st_mtime_ns for path in (folder / "pictures").iterdir()}
    (folder / "pictures" / "old.jpg").write_bytes(b"")
    (folder / "pairs" / "9.js").write_text("")
    next(iter(before)).write_bytes(b"cut")
    page_of(large)
    after = {path: path.stat().st_mtime_ns for path in (folder / "pictures").iterdir()}
    assert after.keys() == before.keys()
    assert sum(after[path] == before[path] for path in before) == len(before) - 1
    assert sorted(path.name for path in (folder / "pairs").iterdir()) == ["0.js", "1.js"]


def test_images_beyond_the_guard_of_pillow_have_thumbnails(full: Context, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    """Pillow refuses more than twice so many pixels; cameras for mapping have frames of 300 megapixels."""
    monkeypatch.setattr(PilImage, "MAX_IMAGE_PIXELS", 100)
    assert thumbnails.small_raster(full.image_path(full.block.images[1]), 32).shape[1] <= 32


def test_a_thumbnail_is_the_raster_as_stored(full: Context) -> None:  # noqa: F811
    pictures = thumbnails.thumbnails(full)
    assert pictures["b"].shape[:2] == (HEIGHT, WIDTH)  # although viewers turn it
    assert pictures.link("b")[1:] == (HEIGHT, WIDTH)


def test_rows_name_their_pair_and_nothing_ends_the_script(full: Context) -> None:  # noqa: F811
    page = page_of(full)
    # a-c is rejected, b-c has fewest matches.
    assert re.findall(r'<tr data-pair="([0-9,]+)"', page) == ["0,2", "1,2", "0,1"]
    assert set(stored(page)) == {"names", "pictures", "pairs", "beside"}
    hostile = pair_viewer.PairData(pictures=[("</script><b>", 1, 1)])
    assert "<" not in hostile.text()
    assert json.loads(hostile.text())["pictures"][0][0] == "</script><b>"


def test_without_readable_images_the_page_is_as_before(full: Context) -> None:  # noqa: F811
    for path in Path(full.settings.block.images).rglob("*.*"):
        path.unlink()
    page = page_of(full)
    assert stored(page) == {"names": [], "pictures": [], "pairs": {}, "beside": []}
    assert "A click on a row" not in page


def test_the_sketch_shows_the_ground_where_its_cameras_see_it(full: Context) -> None:  # noqa: F811
    """Cameras 100 m above level ground, looking down, focal length 200 px: a pixel is 0.5 m. Image a is red left of its
    middle and blue right of it, and is alone."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, : WIDTH // 2, 0], picture[:, WIDTH // 2 :, 2] = 255, 255
    low, high = np.array([-50.0, -40.0]), np.array([50.0, 40.0])
    canvas = ground_sketch(full, {"a": picture}, low, high)
    assert canvas is not None
    assert canvas.shape == (512, 640, 4)
    shown = np.argwhere(canvas[..., 3] == 255)
    # 160 x 128 px of 0.5 m: 80 x 64 m around the camera at (0, 0).
    metres = (shown[:, ::-1] + 0.5) * [100.0 / 640, -100.0 / 640] + [low[0], high[1]]
    assert np.abs(metres.min(axis=0) - [-40.0, -32.0]).max() < 0.6
    assert np.abs(metres.max(axis=0) - [40.0, 32.0]).max() < 0.6
    red = canvas[shown[:, 0], shown[:, 1], 0] == 255
    assert (red == (metres[:, 0] < 0.0)).mean() > 0.99
    assert ground_sketch(full, {}, low, high) is None


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("size", ["small", "large"])
def test_a_browser_draws_the_pair_that_the_address_names(
    full: Context,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    size: str,
) -> None:
    if size == "large":
        monkeypatch.setattr(thumbnails, "MAX_IMAGES", 2)
    page_of(full)
    address = full.workspace.report.resolve().as_uri()
    drawn = {}
    for key in ("", "#pair=b.jpg,a.png", "#pair=b.jpg,z.png"):
        command = [
            str(BROWSER),
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={tmp_path / 'browser'}",
        ]
        command += ["--virtual-time-budget=3000", "--enable-logging=stderr", "--dump-dom", address + key]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        assert "CONSOLE" not in done.stderr  # neither an error of a script nor a refused resource
        drawn[key] = done.stdout.split('<dialog id="pair-viewer"')[1].split("</dialog>")[0]
        if "z.png" in key:
            assert "no picture of z.png" in done.stdout
    assert drawn[""].count('class="tie') == drawn["#pair=b.jpg,z.png"].count('class="tie') == 0
    assert drawn["#pair=b.jpg,a.png"].startswith(' open=""')
    assert drawn["#pair=b.jpg,a.png"].count('class="tie e1"') == 60
    assert "60 of 80 matches verified, 60 drawn; verified" in drawn["#pair=b.jpg,a.png"]
