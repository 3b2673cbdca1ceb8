"""Commands that look: show, compare, config, list, init."""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import IMAGES, UNORIENTED, Site, invoke
from make_results import filled
from PIL import Image

from aeromatch_cli.config import load, preset_names
from aeromatch_cli.config.overview import first_settings
from aeromatch_cli.config.schema import FAMILIES
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Pose
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.report.pictures import image_picture, pair_picture
from aeromatch_cli.report.show import _pass_lines, _pose_lines
from aeromatch_cli.report.tiles import aligned
from aeromatch_cli.results.stages import OrientResult
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.workspace import Workspace

SETTINGS = UNORIENTED

GRAY = np.full((60, 80, 3), 128, np.uint8)


def test_keypoints_are_drawn_where_they_lie() -> None:
    """Matched ones green, others pale, in a picture as large as the image."""
    picture = image_picture(GRAY, np.array([[10.0, 20.0], [70.0, 50.0]]), np.array([True, False]))
    assert picture.shape == (60, 80, 3)
    green, pale = picture[20, 10].astype(int), picture[50, 70].astype(int)
    assert green[1] - green[0] > 100
    assert pale.min() > 190
    assert (picture[5, 40] == 128).all()


def test_matches_are_drawn_from_image_to_image_by_their_error() -> None:
    points = np.array([[10.0, 10.0], [10.0, 30.0]]), np.array([[60.0, 10.0], [60.0, 30.0]])
    dropped = np.array([[10.0, 50.0]]), np.array([[60.0, 50.0]])
    picture = pair_picture((GRAY, GRAY[:, :70]), points, np.array([0.0, 5.0]), dropped)
    assert picture.shape == (60, 80 + 8 + 70, 3)
    colours = [picture[y, 75].astype(int) for y in (10, 30, 50)]
    assert colours[0][1] > colours[0][0] + 100  # green
    assert min(colours[1][:2]) > 200 > colours[1][2] + 100  # yellow
    assert colours[2][0] > colours[2][1] + 100  # red
    assert (picture[5, 84] == 255).all()  # between the images


def test_poses_in_a_frame_of_their_own_have_no_origin_and_no_metres(tmp_path: Path) -> None:
    """Image b belongs to a group that no position has placed: the origin of the CRS is none of its frame."""
    workspace = Workspace(tmp_path)
    world = {"crs": "EPSG:32617", "origin_m": [306000.0, 4545000.0, 0.0], "metric": True, "frames": {"b": 2}}
    write_json(workspace.block, world)
    down = np.diag([1.0, -1.0, -1.0])
    places_m = {"a": np.array([10.0, 20.0, 300.0]), "b": np.array([0.0, -4.9561, 100.0])}
    adjusted = replace(
        AdjustedBlock.empty(), frames={"b": 1},
        poses={i: AdjustedPose(place, down, np.full(3, 0.02), np.full(3, 0.1)) for i, place in places_m.items()},
    )  # fmt: skip
    poses = {i: Pose(place + 1.0, down, 0.5, 0.2) for i, place in places_m.items()}
    work: Any = SimpleNamespace(workspace=workspace, poses=poses, adjusted=adjusted)
    of_a, of_b = ([line for line in _pose_lines(work, i) if " x " in line] for i in "ab")
    assert of_a == [
        "given       x 306011.000, y 4545021.000, z 301.000 m, standard deviation 0.5 m",
        "adjusted    x 306010.000, y 4545020.000, z 300.000 m, standard deviation 0.02 m",
    ]
    unit = "units of arbitrary length"
    assert of_b == [
        f"given       x 1.000, y -3.956, z 101.000 {unit} in frame own 2, standard deviation 0.5 {unit}",
        f"adjusted    x 0.000, y -4.956, z 100.000 {unit} in frame own 1, standard deviation 0.02 {unit}",
    ]
    # How exact a pose of the first pass is nobody has estimated.
    found = filled(OrientResult, poses_from="pictures")
    write_json(workspace.stage_report("orient"), StageReport("orient", result=found)._record().as_json())
    assert next(_pose_lines(work, "a")) == "first pass  x 306011.000, y 4545021.000, z 301.000 m"


@pytest.mark.slow
def test_show_says_what_a_workspace_an_image_and_a_pair_hold(done_site: Site) -> None:
    work, names = done_site.work, done_site.names()
    whole = invoke("show", work)
    assert whole.code == 0
    assert f"images      {IMAGES}, {IMAGES} with position" in whole.stdout
    assert "verified matches" in whole.stdout
    with (work / "pairs.csv").open(newline="") as stream:
        partners = [row for row in csv.DictReader(stream) if "suburb_0001_jpg" in row.values()]
    image = invoke("show", work, names[0], "--json")
    assert f"partners    {len(partners)}, " in image.stdout
    assert 0 < image.facts["keypoints"] <= 400
    with Image.open(image.facts["picture"]) as picture:
        assert picture.size == (320, 240)
    pair = invoke("show", work, names[1], Path(names[0]).stem, "--rejected", "--out", work / "p.png", "--json")
    assert pair.facts["pair"] == names[:2]
    assert pair.facts["verified"] > 30
    (share,) = [float(row["overlap"]) for row in partners if "suburb_0002_jpg" in row.values()]
    assert f"overlap     {100 * share:.0f} % of the smaller footprint, view angle " in pair.stdout
    assert "steps" not in pair.stdout
    with Image.open(work / "p.png") as picture:
        assert picture.size == (320 + 8 + 320, 240)


@pytest.mark.slow
def test_figures_of_an_earlier_version_are_not_read(done_site: Site) -> None:
    """Their names may mean something else by now: the verdict is made anew by the next run."""
    path = done_site.work / "reports" / "adjust.json"
    report = read_json(path)
    write_json(path, {**report, "result": {**report["result"], "a_figure_of_old": 3}})
    shown = invoke("show", done_site.work)
    assert shown.code == 0
    assert "result      of an earlier version of aeromatch" in shown.stdout
    assert done_site("adjust").code == 0
    assert read_json(path)["result"] == report["result"]
    assert "of an earlier version" not in invoke("show", done_site.work).stdout


@pytest.mark.slow
def test_matches_of_keypoints_that_were_found_again_are_named_and_not_drawn(done_site: Site, rendered: Path) -> None:
    """`extract` alone with other settings: the matches on file point into features that are gone."""
    work, names = done_site.work, done_site.names()
    assert done_site("extract", "--set", "extract.keypoints=300").code == 0
    for command in (
        ("show", work, names[0]),
        ("show", work, names[0], names[1]),
        ("compare", work, work),
        ("evaluate", work, "--truth", rendered),
    ):
        told = invoke(*command)
        assert told.code == 3, command
        assert "run `aeromatch match` and then `aeromatch filter`" in told.stderr
    assert invoke("report", "--workspace", work).code == 0
    assert "pairs were not judged" in (work / "report" / "index.html").read_text()
    assert done_site("run", "--set", "extract.keypoints=300").code == 0
    assert invoke("show", work, names[0], names[1]).code == 0


@pytest.mark.slow
def test_an_archive_that_nobody_may_write_is_shown_elsewhere(
    done_site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = done_site.names()[:2]
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write all
    refused = invoke("show", done_site.work, *names)
    assert (refused.code, "--out suburb_0001_jpg--suburb_0002_jpg.png" in refused.stderr) == (3, True), refused.stderr
    assert invoke("show", done_site.work, *names, "--out", tmp_path / "p.png").code == 0


@pytest.mark.slow
def test_show_reads_files(done_site: Site) -> None:
    rows = invoke("show", done_site.work / "images.csv").stdout
    assert f"{IMAGES} rows" in rows
    arrays = invoke("show", done_site.work / "verified" / "suburb_0001_jpg.npz").stdout
    assert "errors_px" in arrays
    assert "float32" in arrays
    facts = invoke("show", done_site.work / "block.json").stdout
    assert '"crs": "local"' in facts
    # Other programs' files have no checksum.
    exported = invoke("show", done_site.work / "export" / "colmap" / "world.json")
    assert (exported.code, '"origin_m"' in exported.stdout) == (0, True), exported.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("nothing",), 2, "'nothing' is none of the images"),
        (("suburb_0001.jpg", "suburb_0001"), 2, "both names mean the image suburb_0001.jpg"),
        (("a", "b", "c"), 2, "3 images: name one, or the two of a pair"),
        (("suburb_0001.jpg", "--out", "x.jpg"), 2, "name it FILE.png"),
    ],
)
def test_show_refuses_what_is_not_there(done_site: Site, arguments: tuple[str, ...], code: int, words: str) -> None:
    outcome = invoke("show", done_site.work, *arguments)
    assert (outcome.code, words in outcome.stderr) == (code, True), outcome.stderr


def test_the_steps_of_a_pair_count_before_the_last_drops(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    rows = ["image_id0,image_id1,steps,reasons", "a,b,first+guided,guided: 7 verified matches", "a,c,first,"]
    workspace.steps.write_text("\n".join(rows) + "\n")
    assert list(_pass_lines(workspace, ("a", "b"))) == [
        "steps       first+guided: guided: 7 verified matches (counted before the stage consistency dropped matches)"
    ]
    assert list(_pass_lines(workspace, ("a", "c"))) == ["steps       first"]


def test_a_folder_that_is_no_workspace(tmp_path: Path) -> None:
    for command in (("show", tmp_path), ("compare", tmp_path, tmp_path)):
        outcome = invoke(*command)
        assert outcome.code == 2
        assert "is no workspace of aeromatch (images.csv is missing)" in outcome.stderr
    absent = tmp_path / "absent"
    for command in (("show", absent), ("show", absent, "a.jpg"), ("compare", absent, tmp_path)):
        outcome = invoke(*command)
        words = (
            f"the workspace {absent} does not exist: check its path, and give the folder that an earlier `aeromatch "
            "run --workspace DIR` has filled"
        )
        assert (outcome.code, words in outcome.stderr) == (2, True), outcome.stderr
    (tmp_path / "orientation").mkdir()  # what is there while the orientation is estimated
    outcome = invoke("show", tmp_path)
    assert (outcome.code, "its run is estimating the orientation" in outcome.stderr) == (3, True)


@pytest.mark.slow
def test_compare_names_what_differs(done_site: Site) -> None:
    other = done_site.another_workspace("other")
    assert invoke("run", "baseline", *done_site.options("--set", "match.ratio=0.5", "--workspace", other)).code == 0
    outcome = invoke("compare", done_site.work, other, "--json")
    assert outcome.facts["settings"] == ["match.ratio: 0.8 and 0.5"]
    assert outcome.facts["better"] == "first"
    first, second = outcome.facts["matches"]
    assert 0 < second < first
    assert f"matches     {first:,} and {second:,} ({100 * (second / first - 1):+.1f} %)" in outcome.stdout


def test_config_prints_settings_that_load_again(tmp_path: Path) -> None:
    outcome = invoke("config", "fusion", "--set", "extract.keypoints=123")
    tree = yaml.safe_load(outcome.stdout)
    assert tree["extract"]["keypoints"] == 123
    path = tmp_path / "a.yaml"
    path.write_text(outcome.stdout)
    assert load(str(path)).match == load("fusion").match


def test_list_has_every_preset_and_strategy() -> None:
    lines = invoke("list").stdout.splitlines()
    found = {line.split()[0] for line in lines if line.startswith("  ")}
    assert set(preset_names()) <= found
    assert {name for table in FAMILIES.values() for name in table} <= found
    # What `run` takes without a preset's name.
    for starred in ("nearest", "epipolar", "learned"):
        assert any(line.startswith(f"  {starred} *") for line in lines)
    assert not any(line.startswith("  poselib *") for line in lines)
    matchers = {one["name"]: one["words"] for one in invoke("list", "match", "--json").facts["families"]["match"]}
    for name, features in (("lightglue", "sift"), ("lightglue-learned", "learned")):
        assert matchers[name].startswith("LightGlue, a network")
        assert f"`extract={features}`" in matchers[name]
    every = [one for family in invoke("list", "--json").facts["families"].values() for one in family]
    # Each line says what a strategy is or does, and not only what it is of.
    assert not [one for one in every if one["words"].split()[0] in ("Of", "For", "With") or len(one["words"]) < 25]
    filters = invoke("list", "filter", "--json").facts["families"]["filter"]
    assert [one["name"] for one in filters if one["default"]] == ["epipolar"]
    assert invoke("list", "matcher").code == 2


def test_init_writes_settings_for_what_it_sees(tmp_path: Path) -> None:
    # Longer than a line of YAML.
    tmp_path = tmp_path / "flights of the afternoon, camera one: oblique views" / "and of the evening"
    images = tmp_path / "photos"
    images.mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (40, 30)).save(images / name)
    (tmp_path / "geo.txt").write_text("EPSG:32633\na.jpg 500000 4600000 100\nb.jpg 500010 4600000 100\n")
    path = tmp_path.parent.parent / "block.yaml"
    outcome = invoke("init", path, "--images", images)
    assert outcome.code == 0, outcome.stderr
    assert "2 images" in outcome.stdout
    assert "ODM geo.txt" in outcome.stdout
    settings = load(str(path))
    assert settings.block.images == str(images)
    assert settings.block.poses == str(tmp_path / "geo.txt")
    assert [step.name for step in settings.cascade] == [step.name for step in load("auto").cascade]
    again = invoke("init", path, "--images", images)
    assert again.code == 2
    assert "exists and is not replaced" in again.stderr
    assert invoke("init", tmp_path / "c.yaml", "--images", tmp_path / "none").code in (2, 3)


def test_init_takes_the_pose_file_of_these_images_and_no_control_points(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (40, 30)).save(images / name)
    points = [(500000, 4600000, 10, 12.5, 8.5, "a.jpg", "p"), (500000, 4600000, 10, 22.5, 8.5, "b.jpg", "p")]
    (images / "gcp_list.txt").write_text("EPSG:32633\n" + "".join(" ".join(map(str, row)) + "\n" for row in points))
    (images / "earlier.csv").write_text("image,x,y,z\nx.jpg,1,2,3\ny.jpg,4,5,6\n")  # of another flight
    (images / "part.csv").write_text("image,x,y,z\na.jpg,500000,4600000,100\n")
    (tmp_path / "rest.csv").write_text(
        "image,x,y,z\n" + "".join(f"{k}.jpg,50000{n},4600000,100\n" for n, k in enumerate("abc"))
    )
    text, found = first_settings(images, tmp_path)
    block = yaml.safe_load(text)["block"]
    assert (block["poses"], block["gcp"]) == ("rest.csv", "images/gcp_list.txt")
    assert [line.rpartition("/")[2] for line in found if line.startswith(("pose", "control"))] == [
        "rest.csv: list with named columns, 3 of 3 images",
        "part.csv: list with named columns, 1 of 3 images",
        "gcp_list.txt",
    ]
    (tmp_path / "rest.csv").unlink()
    (images / "part.csv").unlink()
    text, _ = first_settings(images, tmp_path)
    assert yaml.safe_load(text)["block"]["poses"] == "none"


def test_show_takes_the_workspace_of_the_environment(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AEROMATCH_WORKSPACE", str(done_site.work))
    assert invoke("show", "--json").facts["workspace"] == str(done_site.work)
    assert invoke("show", done_site.names()[0], "--json").facts["image"] == done_site.names()[0]
    # A file of that name, in the folder of the images, is no file of the workspace.
    monkeypatch.chdir(done_site.images)
    assert invoke("show", done_site.names()[0], "--json").facts["image"] == done_site.names()[0]


def test_init_proposes_the_camera_file_that_lies_there(site: Site, tmp_path: Path) -> None:
    out = site.root / "a.yaml"
    assert "camera file" in invoke("init", out, "--images", site.images).stdout
    assert yaml.safe_load(out.read_text())["block"]["cameras"] == "block.json"


def test_images_are_laid_on_each_other_by_the_plane_of_their_matches() -> None:
    """The second picture is the first, moved by 12 and 5 pixels: laid on it, both are the same where both see."""
    noise = np.random.default_rng(5).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    big = np.kron(noise, np.ones((6, 6, 1), np.uint8))
    first, second = big[:160, :220], big[5:165, 12:232]
    places = np.random.default_rng(6).uniform(20, 140, (40, 2))
    laid = aligned((first, second), (places, places - (12.0, 5.0)))
    assert laid is not None
    assert laid.other is not None
    assert (laid.picture[20:140, 20:200] == laid.other[20:140, 20:200]).mean() > 0.99
    assert (laid.picture[:4] == laid.other[:4]).all()  # what one alone sees does not change
    assert aligned((first, second), (places[:3], places[:3])) is None


@pytest.mark.slow
def test_show_draws_steps_as_a_sheet_a_page_and_a_changing_picture(done_site: Site) -> None:
    work, names = done_site.work, done_site.names()
    shadow = done_site("run", "--set", "enhance=shadow")
    assert shadow.code == 0
    page = work / "image.html"
    told = invoke("show", work, names[0], "--views", "--out", page)
    assert told.code == 0
    assert "; enhanced, shadow mask, view ground" in told.stdout
    text = page.read_text()
    assert text.count("<figure>") == text.count('src="data:image/jpeg') >= 4
    assert "view ground-enhanced" in text
    sheet = invoke("show", work, names[0], "--views", "--out", work / "image.png")
    assert sheet.code == 0
    with Image.open(work / "image.png") as picture:
        assert picture.size[0] > 3 * 320
    assert invoke("show", work, names[0], names[1], "--out", work / "pair.gif").code == 0
    with Image.open(work / "pair.gif") as picture:
        assert (picture.size, picture.n_frames) == ((320, 240), 2)
    refused = invoke("show", work, names[0], "--out", work / "image.gif")
    assert refused.code == 2
    assert "name it FILE.png or FILE.html" in refused.stderr
