"""Workspaces that are damaged, half done or of an earlier run: every command says so and takes nothing for a result."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from conftest import PAGE, Site, contents, invoke

pytestmark = pytest.mark.slow


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) * 2 // 3] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["poses.csv", "cameras.csv", "images.csv", "pairs.csv"])
def test_a_damaged_table_is_never_shown_as_a_result(done_site: Site, name: str) -> None:
    expected = contents(done_site.work)
    flip(done_site.work / name)
    for words in (("show", done_site.work), ("evaluate", done_site.work, "--truth", done_site.root, "--no-mapping"),
                  ("compare", done_site.work, done_site.work)):  # fmt: skip
        outcome = invoke(*words)
        assert outcome.code == 3, outcome.stderr
        assert f"{name} is damaged or was edited: run `aeromatch run`" in outcome.stderr
    outcome = done_site("run")
    assert outcome.code == 0
    assert f"{name} is not as it was written: it is made again" in outcome.stderr
    assert contents(done_site.work) == expected


@pytest.mark.parametrize(
    ("name", "command"),
    [("orientation/final.npz", "report"), ("verified/{0}.npz", "report"), ("matches/{0}.npz", "filter")],
)
def test_a_command_leaves_what_it_cannot_make_again(done_site: Site, name: str, command: str) -> None:
    expected = contents(done_site.work)
    path = done_site.work / name.format(done_site.names()[0].replace(".", "_"))
    flip(path)
    damaged = path.read_bytes()
    outcome = done_site(command)
    assert outcome.code == 3
    assert f"{path} is damaged" in outcome.stderr
    assert "run `aeromatch run`, which makes it again" in outcome.stderr
    assert path.read_bytes() == damaged
    assert done_site("run").code == 0
    assert contents(done_site.work) == expected


def test_damaged_settings_are_no_changed_ones(done_site: Site) -> None:
    config = done_site.work / "config.yaml"
    config.write_text(config.read_text().replace("contrast_threshold", "gontrast_threshold"))
    outcome = done_site("run")
    assert "changed " not in outcome.stdout
    assert outcome.code == 0


def test_a_page_of_an_earlier_run_is_named_as_such(done_site: Site) -> None:
    assert "is of an earlier run" not in done_site("run").stdout
    assert done_site("run", *PAGE).code == 0
    outcome = done_site("run")
    assert "is of an earlier run" not in outcome.stdout  # it still is the present one
    outcome = done_site("run", "--set", "extract.keypoints=300")
    assert "index.html is of an earlier run: `aeromatch report` makes it anew" in outcome.stdout


def test_the_report_of_a_block_that_has_only_pairs(site: Site) -> None:
    given = site.options("--set", "orient=none")
    assert invoke("pairs", "auto", *given).code == 0
    outcome = invoke("report", "auto", *given, *PAGE)
    assert outcome.code in (0, 1)
    assert (site.work / "report" / "index.html").is_file()


def test_a_broken_image_is_told_by_the_commands_before_extraction(site: Site) -> None:
    site.image(1).write_bytes(site.image(1).read_bytes()[:-400])
    broken = site.names()[1]
    for command in ("orient", "pairs"):
        outcome = site(command)
        assert outcome.code == 1
        assert site.failures() == [("orient", broken)]
    assert site("run").code == 1
    assert site.failures() == [("extract", broken)]


def test_nothing_is_left_of_a_run_that_could_not_begin(site: Site) -> None:
    (site.root / "empty").mkdir()
    for command in ("run", "report"):
        outcome = invoke(command, "baseline", "--images", site.root / "empty", "--workspace", site.work)
        assert outcome.code in (2, 3)
        assert not site.work.exists()
    given = ("--images", site.images, "--poses", site.poses, "--cameras", site.root / "block.json")
    for wrong in (
        ("--images", site.root / "absent"), ("--poses", site.root / "absent.csv"), ("--crs", "EPSG:1"),
        ("--masks", site.root / "absent"), ("--gcp", site.root / "absent.txt"), ("--ground", "absent.tif"),
        ("--memory", "1MB"),
    ):  # fmt: skip
        deep = site.work / "deep" / "er"
        outcome = invoke("run", "baseline", *given, "--jobs", 1, "--workspace", deep, *wrong, "--quiet")
        assert (outcome.code in (2, 3), outcome.stderr.startswith("error: ")) == (True, True), wrong
        assert not site.work.exists(), wrong
    twin = site.images / "second" / site.names()[0]
    twin.parent.mkdir()
    twin.write_bytes(site.image(1).read_bytes() + b"another")  # else it is a copy, which is left out
    for command in ("check", "run"):
        outcome = invoke(command, "baseline", *given, "--workspace", site.work, "--set", "export=colmap+opensfm")
        assert outcome.code == 2
        assert f"second/{twin.name} and {twin.name} would both be called {twin.name}: rename" in outcome.stderr
        assert not site.work.exists()
    for command in ("filter", "adjust", "export"):
        outcome = invoke(command, "baseline", *given, "--workspace", site.work)
        assert (outcome.code, "does not exist: run `aeromatch run`" in outcome.stderr) == (2, True)
        assert not site.work.exists()
    site.work.mkdir()
    invoke("run", "baseline", "--images", site.root / "empty", "--workspace", site.work)
    assert site.work.is_dir()


def test_a_folder_where_a_file_belongs_is_named(done_site: Site) -> None:
    path = done_site.work / "cameras.csv"
    path.unlink()
    path.mkdir()
    outcome = done_site("run")
    assert outcome.code == 3
    assert "a folder stands where the file belongs; move it away" in outcome.stderr


def test_names_that_spreadsheets_run_are_refused(site: Site) -> None:
    site.image(0).rename(site.images / "=cmd calc.jpg")
    outcome = site("pairs", "--poses", "none", "--set", "orient=none", "--set", "pairs=exhaustive")
    assert outcome.code == 1
    assert "./=cmd calc.jpg: name begins with =, which a spreadsheet runs as a formula: rename" in outcome.stderr
    tables = "".join(path.read_text() for path in site.work.glob("*.csv"))
    assert re.search(r"(^|,)\"?=", tables, re.MULTILINE) is None


@pytest.mark.parametrize("name", ["export", "verified/{0}.npz"])
def test_a_link_out_of_the_workspace_is_refused(done_site: Site, tmp_path: Path, name: str) -> None:
    path = done_site.work / name.format(done_site.names()[0].replace(".", "_"))
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    outcome = done_site("run", "--overwrite")
    assert outcome.code == 3
    assert f"{path} is a link that leads out of the workspace, to {tmp_path / 'elsewhere'}: remove it" in outcome.stderr
    path.unlink()
    assert done_site("run").code == 0


def test_a_link_in_place_of_an_export_goes(done_site: Site) -> None:
    expected = contents(done_site.work)
    export = next(path for path in (done_site.work / "export").iterdir() if path.is_dir())
    export.rename(done_site.work / "moved")
    export.symlink_to(done_site.work / "moved")
    assert done_site("export", "--overwrite").code == 0
    assert not export.is_symlink()
    shutil.rmtree(done_site.work / "moved")
    assert contents(done_site.work) == expected


def test_the_lock_writes_through_no_link(done_site: Site, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept")
    (done_site.work / ".lock").unlink()
    (done_site.work / ".lock").symlink_to(tmp_path / "precious")
    assert done_site("run").code == 0
    assert (tmp_path / "precious").read_text() == "kept"


def test_a_scheduler_is_for_dask_alone(site: Site) -> None:
    outcome = site("run", "--scheduler", "tcp://127.0.0.1:9", "--executor", "serial")
    assert outcome.code == 2
    assert "--scheduler is for --executor dask, not serial" in outcome.stderr
