"""The laboratory: what it needs, and how settings come to know its strategies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from conftest import invoke

from aeromatch_cli.config import FAMILIES, dump, load
from aeromatch_cli.config.page import page
from aeromatch_cli.config.text import default_yaml
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.lab.strategies.magsac import Magsac
from aeromatch_cli.lab.synthetic import render_block

NAMES = [f"{family}={name}" for family, table in ARMS.items() for name in table]


def test_rendering_and_exact_truth_say_what_they_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(ConfigError, match=r"needs embreex: pip install 'aeromatch\[lab\]'"):
        render_block(tmp_path / "block", "grass")
    assert not (tmp_path / "block").exists()
    (tmp_path / "truth.json").write_text("{}")
    with pytest.raises(ConfigError, match="rendered block's exact geometry, needs embreex"):
        open_truth(tmp_path)
    (tmp_path / "images.csv").touch()  # a workspace is looked at first
    for command in (("synth", tmp_path / "block"), ("evaluate", tmp_path, "--truth", tmp_path)):
        outcome = invoke(*command)
        assert outcome.code == ConfigError.exit_code
        assert "pip install 'aeromatch[lab]'" in outcome.stderr


@pytest.mark.parametrize("choice", NAMES)
def test_the_product_does_not_know_the_arms(choice: str) -> None:
    with pytest.raises(ConfigError, match="there is no strategy"):
        load("baseline", [choice])
    assert f"### {choice}\n" not in page()
    assert f"name: {choice.partition('=')[2]}\n" not in default_yaml()


@pytest.mark.usefixtures("arms")
@pytest.mark.parametrize("choice", NAMES)
def test_settings_name_the_arms_once_they_are_added(choice: str, tmp_path: Path) -> None:
    family, _, name = choice.partition("=")
    settings = load("baseline", [choice])
    chosen = getattr(settings, family)
    assert (chosen[0] if isinstance(chosen, tuple) else chosen) == ARMS[family][name]()
    path = tmp_path / "settings.yaml"
    path.write_text(dump(settings))
    assert getattr(load(str(path)), family) == chosen


@pytest.mark.usefixtures("arms")
def test_settings_of_an_arm_are_read_and_checked_as_those_of_others() -> None:
    found = load("baseline", ["filter=poselib+magsac", "filter.magsac.threshold_px=2"])
    assert found.filter[1] == Magsac(threshold_px=2.0)
    with pytest.raises(ConfigError, match=r"filter\.magsac\.threshold: unknown key; did you mean 'threshold_px'"):
        load("baseline", ["filter=magsac", "filter.magsac.threshold=2"])
    with pytest.raises(ConfigError, match=r"filter\.magsac\.threshold_px: must be greater than 0"):
        load("baseline", ["filter=magsac", "filter.magsac.threshold_px=-1"])
    assert "magsac" in FAMILIES["filter"]


def test_the_product_runs_without_the_laboratory() -> None:
    """Stages, report, settings and the command line load none of its modules."""
    code = "import sys, aeromatch_cli.cli.app, aeromatch_cli.stages.run, aeromatch_cli.evaluate, aeromatch_cli.report\n"
    code += "print(*(name for name in sys.modules if name.startswith('aeromatch_cli.lab')))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"
