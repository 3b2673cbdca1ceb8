"""Every command, through the runner and once as a real process: output, files, exit codes."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import IMAGES, PAGE, UNORIENTED, Site, contents, invoke
from typer.testing import CliRunner

from aeromatch_cli import __version__
from aeromatch_cli.cli import app, output
from aeromatch_cli.cli.stage_commands import COMMAND_HELP
from aeromatch_cli.stages.shard import Shard

SETTINGS = UNORIENTED

PAIRS = IMAGES * (IMAGES - 1) // 2
OPTIONS = (
    "--images", "--poses", "--cameras", "--crs", "--ground", "--masks", "--exclude", "--workspace", "--set",
    "--max-size", "--jobs", "--executor", "--shard", "--overwrite", "--keep-images", "--log-file", "--json",
    "--progress", "--quiet",
)  # fmt: skip


def run_process(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "aeromatch_cli.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)  # type: ignore[call-overload,no-any-return]


def test_help_has_its_options_in_groups():
    text = CliRunner().invoke(app, ["run", "--help"]).output
    parts = re.split(r"^(\S[^:\n]*):$", text, flags=re.MULTILINE)
    groups = dict(zip(parts[1::2], parts[2::2], strict=True))
    assert list(groups) == ["Arguments", "Block", "Results and settings", "How it runs", "Messages"]
    for option, group in (
        ("--poses", "Block"),
        ("--set", "Results and settings"),
        ("--shard", "How it runs"),
        ("--json", "Messages"),
    ):
        assert [name for name, part in groups.items() if re.search(rf"^  (-\w, )?{option}\b", part, re.MULTILINE)] == [
            group
        ]
    own = CliRunner().invoke(app, ["evaluate", "--help"]).output
    assert own.index("Options:") < own.index("--truth") < own.index("Messages:") < own.index("--help")


def test_help_names_every_command_and_option():
    for arguments in ([], ["--help"]):
        text = CliRunner().invoke(app, arguments).output
        for name in (*COMMAND_HELP, "synth", "weights"):
            assert re.search(rf"^\s+{name}\s", text, re.MULTILINE)
    for name in COMMAND_HELP:
        text = CliRunner().invoke(app, [name, "--help"]).output
        assert [option for option in OPTIONS if option not in text] == []


def test_version():
    outcome = invoke("--version")
    assert (outcome.code, outcome.stdout.strip()) == (0, __version__)


@pytest.mark.slow
def test_stage_by_stage_gives_what_run_gives(done_site):
    work = done_site.root / "stages"
    made = {}
    for command in ("pairs", "enhance", "simulate", "extract", "match", "filter", "export", "report"):
        outcome = done_site(command, "--workspace", work)
        assert outcome.code == 0
        made[command] = outcome.counts(command)[0]
    assert made == {
        "pairs": PAIRS, "enhance": 0, "simulate": IMAGES, "extract": IMAGES, "match": PAIRS, "filter": PAIRS,
        "export": 1, "report": 1,
    }  # fmt: skip
    expected, found = contents(done_site.work), contents(work)
    kinds = ("features/", "matches/", "verified/", "export/")
    assert {k: v for k, v in found.items() if k.startswith(kinds)} == {
        k: v for k, v in expected.items() if k.startswith(kinds)
    }
    assert done_site("run", "--workspace", work).done().keys() <= {"report"}


@pytest.mark.usefixtures("arms")
@pytest.mark.parametrize("command", ["pairs", "enhance", "simulate", "extract", "match"])
def test_commands_that_make_what_they_need(site, command):
    outcome = site(command, "--set", "enhance=clahe")
    assert outcome.code == 0
    assert outcome.facts["stages"][command]["done"] > 0
    assert (site.work / "failures.csv").read_text() == "stage,item,reason\n"


def test_no_enhancement_writes_no_pictures(site):
    outcome = site("enhance")
    assert (outcome.code, outcome.counts("enhance")) == (0, (0, IMAGES, 0))
    assert "enhance=none changes nothing" in outcome.stdout
    assert site("extract", "--keep-images").code == 0
    assert not list(site.work.glob("enhanced/*"))
    assert len(list(site.work.glob("simulated/*/*.png"))) == IMAGES


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "extract", "run"])
def test_the_summary_tells_what_views_cost(site, command):
    stage = "simulate" if command == "simulate" else "extract"
    more = ("--set", "simulate.keep_source=true")
    for _ in range(2):  # the second time it is up to date
        outcome = site(command, *more)
        found = outcome.facts["stages"][stage]["result"]
        assert found["views"] == 2 * found["images"]
        line = f"views per image: 2, {found['view_megapixels'] / found['images']:.3g} megapixels together"
        assert outcome.stdout.count(line) == 1


def test_commands_that_need_an_earlier_one_say_so(site):
    outcome = site("filter")
    assert (outcome.code, "does not exist: run `aeromatch run`" in outcome.stderr) == (2, True)
    assert site("pairs").code == 0
    outcome = site("filter")
    assert (outcome.code, "run `aeromatch match` first" in outcome.stderr) == (3, True)
    outcome = site("export")
    assert (outcome.code, "run `aeromatch match` and then `aeromatch filter`" in outcome.stderr) == (3, True)
    assert not (site.work / "export").exists()
    assert site("match").code == 0
    assert site("filter").code == 0
    assert site("export").code == 0


@pytest.mark.slow
def test_report_alone_shows_an_empty_block(site):
    assert site("report").code == 0
    assert "No pair is verified" in (site.work / "report" / "index.html").read_text()


@pytest.mark.slow
def test_outdated_results_are_not_used(done_site):
    more = ("--set", "extract.keypoints=300")
    assert done_site("extract", *more).counts("extract")[0] == IMAGES
    # Matches on file point into other keypoints now, whatever settings are given.
    for options in ((), more):
        for command in ("filter", "export"):
            assert done_site(command, *options).code == 3
    assert done_site("match", *more).code == 0
    outcome = done_site("export", *more)
    assert (outcome.code, "run `aeromatch match` and then `aeromatch filter`" in outcome.stderr) == (3, True)
    assert done_site("filter", *more).code == 0
    assert done_site("export", *more).code == 0


def test_part_of_the_shards_is_said_to_be_a_part(site):
    rows = [name.replace(".", "_") for name in site.names()[:-1]]
    count = next(n for n in range(2, 9) if {Shard(1, n).owns(row) for row in rows} == {True, False})
    for command in ("match", "filter"):
        assert site(command, "--shard", f"1/{count}").code == 0
    outcome = site("filter")
    assert outcome.code == 1
    assert "results of match" in outcome.stderr
    assert "`aeromatch run`" in outcome.stderr
    assert {stage for stage, _ in site.failures()} == {"filter"}
    for command in ("match", "filter"):
        for index in range(2, count + 1):
            assert site(command, "--shard", f"{index}/{count}").code == 0
    assert site("filter").code == 0
    assert site.failures() == []


def test_check_writes_nothing(site):
    outcome = site("check")
    assert outcome.code == 0
    assert f"images    {IMAGES} of {IMAGES} can be used" in outcome.stdout
    assert outcome.facts["estimate"]["pairs"] == PAIRS
    assert outcome.facts["estimate"]["memory_mb"] > 0
    assert not site.work.exists()
    site.image(0).write_bytes(site.image(0).read_bytes()[:3000])
    outcome = site("check")
    assert (outcome.code, outcome.facts["failures"]) == (1, 1)
    assert not site.work.exists()


@pytest.mark.slow
def test_check_of_a_finished_workspace_writes_nothing(done_site):
    before = {path: path.stat().st_mtime_ns for path in done_site.root.rglob("*")}
    assert done_site("check").code == 0
    assert {path: path.stat().st_mtime_ns for path in done_site.root.rglob("*")} == before


def test_results_go_to_stdout_and_messages_to_stderr(site):
    outcome = invoke("run", "baseline", *site.options())
    assert f"workspace {site.work}" in outcome.stdout
    assert "verified matches" in outcome.stdout
    assert "100 %" in outcome.stderr
    assert "100 %" not in outcome.stdout


def test_quiet_leaves_errors_and_json(site):
    site.image(0).write_bytes(b"")
    outcome = invoke("run", "baseline", *site.options("--quiet"))
    assert (outcome.code, outcome.stdout) == (1, "")
    name, reason = site.names()[0], "file is empty: copy it again"
    first, *others = outcome.stderr.splitlines()
    assert first == f"{name}: {reason}"
    lost = f"lost      1 of {IMAGES} images is not in the result (1 left out): {name}; listed in {site.work}/lost.csv"
    assert others[-2:] == [lost, f"1 failed, listed in {site.work}/failures.csv"]
    assert (site.work / "lost.csv").read_text() == f"image,what,reason\n{name},left out,{reason}\n"
    outcome = invoke("run", "baseline", *site.options("--quiet", "--json"))
    assert len(outcome.stdout.splitlines()) == 1
    outcome = invoke("run", "baseline", *site.options("--quiet", "--shard", "0/1"))
    assert (outcome.code, outcome.stdout) == (2, "")
    assert outcome.stderr.startswith("error: --shard")


def test_log_file_takes_every_message(site):
    log = site.root / "logs" / "aeromatch.log"
    site.image(0).write_bytes(b"")
    assert site("run", "--quiet", "--log-file", log).code == 1
    assert site("run", "--log-file", log).code == 1
    lines = [line for line in log.read_text().splitlines() if f"{site.names()[0]}: file is empty" in line]
    assert len(lines) == 2
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} WARNING ", lines[0])
    outcome = site("run", "--log-file", site.images)
    assert (outcome.code, "cannot be written" in outcome.stderr) == (2, True)


def test_json_is_the_last_line_even_of_errors(site):
    assert site("run", "--shard", "x").facts == {
        "command": "run",
        "error": "--shard 'x': write i/n with 1 <= i <= n < 1,000,000, for example 1/4",
        "exit_code": 2,
    }
    for arguments in (("run", "--json"), ("run", "baseline", "--jobs", "many", "--json"), ("nonsense", "--json")):
        assert invoke(*arguments).facts["exit_code"] == 2


def test_the_environment_asks_for_json_as_the_option_does(monkeypatch):
    monkeypatch.setenv("AEROMATCH_JSON", "1")
    for arguments in (("run", "--job", "3"), ("run", "baseline", "--jobs", "many")):
        assert json.loads(invoke(*arguments).stdout.splitlines()[-1])["exit_code"] == 2
    monkeypatch.setenv("AEROMATCH_JSON", "0")
    assert invoke("run", "--job", "3").stdout == ""


def test_a_place_that_a_script_left_empty_is_not_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {"--workspace": ("run", "--workspace", ""), "--poses": ("check", "--images", ".", "--poses", "")}
    for option, words in (given | {"--masks": ("pairs", "--masks=")}).items():
        outcome = invoke(*words, "--json")
        assert (outcome.code, f"{option} is empty" in outcome.facts["error"]) == (2, True)
    assert not any(tmp_path.iterdir())


def test_a_defect_is_no_success_and_leaves_a_traceback_in_the_log(site, monkeypatch):
    from aeromatch_cli.stages import run

    def broken(*arguments, **options):
        raise RuntimeError("on purpose")

    monkeypatch.setattr(run, "execute", broken)
    log = site.root / "log.txt"
    result = CliRunner().invoke(app, ["run", "baseline", "--json", "--log-file", str(log)])
    assert result.exit_code == 3
    assert "unexpected RuntimeError" in result.stderr
    assert "Traceback" not in result.stderr
    assert json.loads(result.stdout.splitlines()[-1])["exit_code"] == 3
    assert "Traceback" in log.read_text()


def test_numbers_that_json_lacks_become_null():
    assert output._finite({"a": [float("nan"), 1.5, {"b": float("inf")}], 3: "x"}) == {
        "a": [None, 1.5, {"b": None}],
        "3": "x",
    }


def test_no_handler_is_left_behind(site):
    before = list(logging.getLogger("aeromatch").handlers)
    site("pairs", "--log-file", site.root / "log.txt")
    assert logging.getLogger("aeromatch").handlers == before


@pytest.mark.slow
def test_synth_and_its_arguments(tmp_path):
    few = ("--preset", "grass", "--size", "160x120", "--images", "3", "--jobs", 1)
    outcome = invoke("synth", tmp_path / "block", *few, "--json")
    assert outcome.code == 0
    assert len(list((tmp_path / "block" / "images").iterdir())) == 3
    outcome = invoke("synth", tmp_path / "other", "--size", "big", "--json")
    assert (outcome.code, "WIDTHxHEIGHT" in outcome.stderr) == (2, True)
    outcome = invoke("synth", tmp_path / "other", "--preset", "nowhere", "--json")
    assert (outcome.code, "nowhere" in outcome.stderr) == (2, True)


def test_weights_commands(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert invoke("weights", "list", "--json").code == 0
    assert invoke("weights", "verify", "--json").code == 0
    outcome = invoke("weights", "add", tmp_path / "absent.pth", "--json")
    assert outcome.code == 2
    assert "absent.pth" in outcome.stderr


@pytest.mark.slow
def test_settings_come_from_a_file_and_options_win(site):
    config = site.root / "my.yaml"
    config.write_text(
        "workspace: from-file\n"
        "block: {images: images, poses: poses.csv, cameras: block.json}\n"
        "extract: {keypoints: 350}\nrun: {jobs: 1}\n"
    )
    outcome = invoke("extract", config, "--set", "extract.keypoints=200", "--json")
    assert outcome.code == 0
    assert outcome.facts["workspace"] == str(site.root / "from-file")
    assert 100 < outcome.facts["stages"]["extract"]["result"]["keypoints"] <= 200 * IMAGES
    assert "keypoints: 200" in (site.root / "from-file" / "config.yaml").read_text()


# --- real processes -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_run_as_a_process(site: Site):
    done = run_process("run", "baseline", *site.options("--json", "--jobs", "2", *PAGE), cwd="/")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout.splitlines()[-1])
    assert facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}
    assert "Traceback" not in done.stderr
    for name in ("config.yaml", "images.csv", "cameras.csv", "poses.csv", "pairs.csv", "failures.csv", "block.json"):
        assert (site.work / name).is_file()
    assert (site.work / "export" / "colmap" / "database.db").is_file()
    assert (site.work / "report" / "index.html").is_file()


@pytest.mark.slow
def test_every_other_command_as_a_process(done_site: Site, tmp_path: Path):
    for command in ("pairs", "match", "filter", "check"):  # as processes these differ from the next two by nothing
        assert invoke(command, "baseline", *done_site.options()).code == 0
    for command in ("extract", "export"):
        done = run_process(command, "baseline", *done_site.options())
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = run_process("extract", "baseline", "--images", tmp_path / "fehlt-ü", "--json", env=environment)
    assert done.returncode == 2
    assert "does not exist" in json.loads(done.stdout)["error"]


def test_help_of_synth_names_every_scene_and_flight() -> None:
    from aeromatch_cli.cli import commands
    from aeromatch_cli.lab.synthetic import PRESETS
    from aeromatch_cli.lab.synthetic.flight_plans import FLIGHTS

    assert commands._SCENES.split(", ") == list(PRESETS)
    assert commands._FLIGHTS.split(", ") == list(FLIGHTS)


def test_options_are_taken_from_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("AEROMATCH_IMAGES", str(tmp_path / "nothing"))
    monkeypatch.setenv("AEROMATCH_QUIET", "1")
    outcome = invoke("check")
    assert outcome.code in (2, 3)
    assert str(tmp_path / "nothing") in outcome.stderr
    assert outcome.stdout == ""


def test_a_key_without_its_section_is_told_where_it_belongs():
    outcome = invoke("config", "--set", "keypoints=8000")
    assert outcome.code == 2
    assert "did you mean 'orient.keypoints', 'extract.keypoints' or 'cascade.learned.keypoints'?" in outcome.stderr
