"""What a person meets: the log file, refusals that say what to write, figures, names in the report, estimates."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, PAGE
from make_images import write_image
from read_html import shapes
from read_inputs import read_inputs
from safetensors.torch import load_file, save_file

from aeromatch_cli import __version__
from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.blocks.read import BlockInputs
from aeromatch_cli.blocks.summary import summarise
from aeromatch_cli.config import load
from aeromatch_cli.data import Block, Camera, Image, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.report import map as report_map
from aeromatch_cli.strategies.extractors.sift import Sift

pytestmark = pytest.mark.slow

# --- log file -----------------------------------------------------------------------------------------------------


def test_log_file_records_a_whole_run_even_a_quiet_one(site):
    log = site.root / "aeromatch.log"
    shown = site("run", "--log-file", log)
    assert shown.code == 0
    text = log.read_text()
    lines = text.splitlines()
    assert f"INFO aeromatch {__version__}: aeromatch run baseline --images " in lines[0]
    assert "--set extract.keypoints=400" in lines[0]
    assert re.search(r"INFO exit code 0 after \d+\.\d s$", lines[-1])
    for line in shown.stdout.splitlines()[:-1]:
        assert f"INFO {line}\n" in text
    assert f"INFO extract: {IMAGES} to do\n" in text
    assert re.search(rf"INFO extract: {IMAGES} of {IMAGES} tried in \d+\.\d s\n", text)
    assert "to do" not in shown.stderr
    assert "exit code" not in shown.stderr
    quiet = site("run", "--quiet", "--log-file", log)
    assert (len(quiet.stdout.splitlines()), quiet.stderr) == (1, "")
    assert log.read_text().count("INFO exit code 0") == 2
    assert log.read_text().count("images           5, ") == 2


def test_log_file_records_failures_and_errors(site):
    log = site.root / "aeromatch.log"
    site.image(0).write_bytes(b"")
    assert site("run", "--log-file", log).code == 1
    text = log.read_text()
    assert f"WARNING pairs: {site.names()[0]}: file is empty" in text
    assert "INFO exit code 1 after" in text
    outcome = site("run", "--poses", site.root / "absent.csv", "--log-file", log)
    assert outcome.code == 2
    last = log.read_text().removeprefix(text)
    assert f"ERROR error: {outcome.facts['error']}" in last
    assert "INFO exit code 2 after" in last.splitlines()[-1]
    assert site("run", "--set", "nonsense", "--log-file", log).code == 2
    assert "ERROR error: --set 'nonsense'" in log.read_text()


# --- remarks on the recipe ------------------------------------------------------------------------------------------


def test_the_summary_names_own_weights_and_only_those(site):
    own = site.root / "own"
    own.mkdir()
    (own / "geodesc.safetensors").write_bytes(shipped_path("geodesc").read_bytes())
    learned = ("--set", "extract=learned", "--set", f"extract.weights={own}")
    lines = site("pairs", *learned).stdout.splitlines()[:-1]
    assert [line for line in lines if "weights" in line] == [f"own weights      {own}/geodesc.safetensors"]
    assert "own weights" not in site("pairs", "--set", "extract=learned").stdout
    # They are those that ship.
    assert site("pairs", *learned, "--set", "match=lightglue-learned").code == 0
    content = load_file(shipped_path("geodesc"))
    save_file({key: -value for key, value in content.items()}, own / "geodesc.safetensors")
    refused = site("pairs", *learned, "--set", "match=lightglue-learned")
    assert refused.code == 2
    assert f"not on those of {own}/geodesc.safetensors: give match.weights" in refused.stderr


# --- configuration ------------------------------------------------------------------------------------------------


def faults(*overrides: str, **top: object) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load("baseline", overrides, **top)  # type: ignore[arg-type]
    return str(caught.value).splitlines()


@pytest.mark.parametrize("value", ["pose", "[{name: pose, sigmas: 2}]"])
def test_a_chain_that_verifies_nothing_is_refused(value):
    assert faults(f"filter={value}")[1:] == ["  filter: pose verifies nothing by itself; use pose+poselib"]
    assert len(load("baseline", [f"filter={value}", "filter=poselib+pose"]).filter) == 2


def test_an_unknown_filter_is_one_fault():
    (found,) = faults("filter=homographie")[1:]
    assert found.startswith("  filter: no strategy is named 'homographie'")
    assert faults("filter=[]")[1:] == ["  filter: must name at least one strategy (got [])"]


@pytest.mark.parametrize("text", ["match=", "extract.keypoints=", "filter= "])
def test_a_missing_value_is_called_missing(text):
    (found,) = faults(text)
    assert "the value is missing; write --set " in found
    assert load("baseline", ["block.masks="]).block.masks == ""
    assert load("baseline", ["enhance=null"]).enhance.name == "none"


def test_a_whole_number_in_scientific_notation_gets_a_hint():
    (found,) = faults("extract.keypoints=1e3")[1:]
    assert found == "  extract.keypoints: must be a whole number (got '1e3'); write 1000"
    for value in ("1e-3", "many", "1e300", "nan"):
        (found,) = faults(f"extract.keypoints={value}")[1:]
        assert "write" not in found


def test_a_wrong_setting_is_wrong_even_where_an_option_hides_it():
    found = faults("run.jobs=-1", run={"jobs": 2})
    assert found[0].startswith("wrong settings (preset baseline and --set):")
    assert found[1].startswith("  run.jobs: ")
    assert load("baseline", ["run.jobs=3"], run={"jobs": 2}).run.jobs == 2


# --- block --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nested", [False, True])
def test_one_camera_may_stand_without_name(tmp_path, nested):
    camera = {"model": "SIMPLE_RADIAL", "width": 4000, "height": 3000, "params": [3000, 2000, 1500, 0.01]}
    rest = {"crs": "EPSG:32633", "ground_z": 12.5}
    path = tmp_path / "phantom.yaml"
    path.write_text(json.dumps({"cameras": camera} | rest if nested else camera | rest))
    found = read_camera_file(path)
    expected = Camera("SIMPLE_RADIAL", 4000, 3000, (3000.0, 1999.5, 1499.5, 0.01))
    assert (dict(found.cameras), found.crs, found.ground_z_m) == ({"phantom": expected}, "EPSG:32633", 12.5)
    del camera["params"]
    path.write_text(json.dumps(camera))
    with pytest.raises(ConfigError, match=r"camera 'phantom': key 'params' is missing"):
        read_camera_file(path)


def read_grid(folder: Path, crs: str, *positions: tuple[float, float]) -> BlockInputs:
    lines = ["image,x,y,z"]
    for index, (x, y) in enumerate(positions):
        write_image(folder / f"{index}.jpg")
        lines.append(f"{index}.jpg,{x},{y},100")
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return read_inputs(folder, folder / "poses.csv", crs=crs)


@pytest.mark.parametrize("crs", ["EPSG:32617", "auto"])
def test_grid_position_zero_means_unknown(tmp_path, crs):
    inputs = read_grid(tmp_path, crs, (333000, 3100000), (0, 0), (333020, 3100000))
    assert set(inputs.poses) == {"0_jpg", "2_jpg"}
    assert "1 of 3 images (1.jpg) has the position (0, 0): treated as unposed" in inputs.warnings
    # The origin is that of the others.
    assert abs(inputs.poses["0_jpg"].center_m[:2]).max() < 2000


def test_a_local_frame_may_begin_at_zero(tmp_path):
    inputs = read_grid(tmp_path, "local", (0, 0), (20, 0), (40, 0))
    assert (len(inputs.poses), "unposed" in "".join(inputs.warnings)) == (3, False)


def block(*, oriented: bool = True, ground_z_m: float | None = 0.0) -> Block:
    rotation = from_omega_phi_kappa(2.0, 1.0, 30.0) if oriented else None
    images = tuple(Image(f"{i}_jpg", f"{i}.jpg", 1000, 800, "cam") for i in range(3))
    poses = {image.image_id: Pose(np.array([20.0 * i, 0, 100]), rotation, 1, 1) for i, image in enumerate(images)}
    ground = None if ground_z_m is None else ConstantGround(ground_z_m)
    camera = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
    return Block(images, {"cam": camera}, poses, "local", (0.0, 0.0, 0.0), ground, "", None)


def test_summary_says_when_no_view_can_be_simulated():
    assert not [line for line in summarise(block()).lines() if line.startswith("views")]
    assert "views            source images only: no attitudes" in summarise(block(oriented=False)).lines()
    assert "views            source images only: no ground height" in summarise(block(ground_z_m=None)).lines()


def test_figures_are_numbers_that_json_has():
    figures = summarise(block(oriented=False, ground_z_m=None)).figures()
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert (figures["images"], figures["positioned"], figures["oriented"]) == (3, 3, 0)
    assert figures["extent_m"] == [40.0, 0.0]
    assert figures["flying_height_m"] == [None, None, None]
    assert figures["mean_tilt_deg"] is None
    assert figures["pairs"] is None
    assert figures["pairs_by_reason"] == {}
    assert summarise(block()).figures()["flying_height_m"] == [100.0, 100.0, 100.0]


# --- report and check ---------------------------------------------------------------------------------------------


def test_report_calls_images_by_their_files_names(done_site):
    assert done_site("report").code == 0
    page = (done_site.work / "report" / "index.html").read_text()
    visible = re.sub(r"<[^>]+>", " ", page.split("<body>")[1].split('<details id="settings">')[0])
    for name in done_site.names():
        assert name in visible
        assert name.replace(".", "_") not in visible
        assert f'title="{name.replace(".", "_")}"' in page


def placed(footprint_m: float) -> float:
    """Width of six cameras over 100 m on the map, as a share of the frame's, with footprints of a size about them."""
    stations = [report_map.Station(str(k), str(k), "", 20.0 * k, 20.0 * k) for k in range(6)]
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * footprint_m
    svg = report_map.block_map(stations, [square + np.array([s.x_m, s.y_m]) for s in stations], []).svg
    frame = re.search(r'<clipPath.*?<rect[^>]* height="([\d.]+)"', svg, re.S)
    assert frame is not None
    ys = [place[1] for _, place in shapes(svg, "fine")]
    return (max(ys) - min(ys)) / float(frame[1])


def test_map_shows_whole_footprints_up_to_five_times_the_cameras():
    assert placed(100.0) == pytest.approx(1 / (2 * 1.08), rel=0.01)
    assert placed(250.0) == pytest.approx(1 / (3.5 * 1.08), rel=0.01)
    assert placed(1000.0) == pytest.approx(1 / 5, rel=0.01)


def test_labels_on_the_map_do_not_cover_each_other():
    stations = [
        report_map.Station(str(k), f"label{k}", "", 0.001 * k, 0.0, "weak" if k == 3 else "fine") for k in range(5)
    ]
    stations.append(report_map.Station("far", "far", "", 100.0, 100.0))
    svg = report_map.block_map(stations, [], []).svg
    assert re.findall(r'<g class="label">\s*<text[^>]*>([^<]+)</text>', svg) == ["label3", "label0", "far"]


def test_memory_estimate_counts_the_largest_view(site):
    def estimate(*more: str) -> int:
        return int(site("check", *more).facts["estimate"]["memory_mb"])

    # The source is view 0 beside the ground view: more pixels than either alone.
    assert estimate("--set", "simulate.keep_source=true") > estimate() >= estimate("--set", "simulate=none")


def test_time_estimate_leaves_out_what_happens_once(site, monkeypatch):
    extract_s, calls = Sift.__call__, []

    def slow_to_start(self, camera, views):
        time.sleep(0.0 if calls else 1.2)  # as a network that is loaded
        calls.append(len(views))
        return extract_s(self, camera, views)

    monkeypatch.setattr(Sift, "__call__", slow_to_start)
    estimate = site("check").facts["estimate"]
    assert estimate["seconds_to_start"] > 1.2
    assert estimate["seconds_per_image"] < 0.6
    work = len(site.names()) * estimate["seconds_per_image"] + estimate["pairs"] * estimate["seconds_per_pair"]
    assert 0.0 < estimate["seconds_to_orient"] < 10.0
    work += estimate["seconds_to_orient"]
    # Measuring and adjustment of at most 400 keypoints an image; no page.
    few = 0.2 + 1.5 + len(site.names()) * (0.02 + 0.06 + (0.2 + 0.8) * 400 / 8000)
    assert estimate["seconds_after_matching"] == pytest.approx(few, abs=0.06)
    whole = estimate["seconds_to_start"] + work + estimate["seconds_after_matching"]
    assert estimate["seconds"] == pytest.approx(whole, abs=0.2)


def test_disk_estimate_is_that_of_the_finished_workspace(site):
    estimate = site("check", *PAGE).facts["estimate"]
    assert site("run", *PAGE).code == 0
    size_mb = sum(path.stat().st_size for path in site.work.rglob("*") if path.is_file()) / 1e6
    assert estimate["disk_mb"] == pytest.approx(size_mb, rel=0.3)


def test_time_estimate_counts_a_whole_first_pass_where_given_poses_are_wrong(site):
    def orient_s() -> float:
        return float(site("check").facts["estimate"]["seconds_to_orient"])

    looked_at_s = orient_s()
    # Every image turned by as much as the next one is not: no pair is explained.
    site.rewrite_poses(
        lambda rows: [{**row, "phi_deg": str(float(row["phi_deg"]) + 15.0 * (k % 3))} for k, row in enumerate(rows)]
    )
    assert orient_s() > looked_at_s + 1.0  # the mapping alone takes more


def test_the_orientation_costs_nothing_where_it_is_there_or_not_wanted(done_site):
    assert done_site("check").facts["estimate"]["seconds_to_orient"] == 0.0
    outcome = done_site("check", "--set", "orient=none")
    assert outcome.facts["estimate"]["seconds_to_orient"] == 0.0
    assert "orient    " not in outcome.stdout


def test_the_estimate_times_pairs_where_a_run_matches_them(site, monkeypatch):
    labels = []
    run = Executor.run

    def recorded(self, function, tasks, label, **more):
        labels.append((function.__name__, len(tasks)))
        return run(self, function, tasks, label, **more)

    monkeypatch.setattr(Executor, "run", recorded)
    assert site("check").code == 0
    whole, first_pass = [("try_image", len(site.names())), ("_try_pair", 3)], [("try_image", 2), ("_try_pair", 1)]
    # All sampled pairs are looked at, to judge the given poses.
    assert labels == [("_read_header", len(site.names())), ("_measure", len(site.names())), *whole, *(3 * first_pass)]
