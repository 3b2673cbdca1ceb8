"""Files that a user names: pipes and devices, whose reading may never end, and numbers that are none."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Site

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.control_files import read_survey
from aeromatch_cli.blocks.ground import open_dem
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.poses import _text as table_text
from aeromatch_cli.config import load
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies.pairings.file import PairFile

READERS: dict[str, Callable[[Path], object]] = {
    "cameras": read_camera_file,
    "control": lambda path: read_survey(path, None),
    "dem": lambda path: open_dem(path, "local", (0.0, 0.0, 0.0), [[0.0, 0.0, 0.0]]),
    "pairs": lambda path: PairFile(path=str(path)).check_files(128),
    "poses": lambda path: read_pose_file(path, "auto"),
    "settings": lambda path: load(str(path)),
    "table": table_text,
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("reader", READERS)
def test_pipes_and_devices_are_refused_and_not_read(reader: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    for name in ("pipe.yaml", "zero.yaml"):
        with pytest.raises(ConfigError, match=f"{name}.*it is a pipe or a device"):
            READERS[reader](tmp_path / name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: " + "9" * 5000, "number of too many digits"),
        ("[" * 1000, "nested too deeply"),
        ("a: 2024-13-45", "too many digits, or a date that no calendar has"),
    ],
)
def test_settings_that_yaml_cannot_hold(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "odd.yaml").write_text(text)
    with pytest.raises(ConfigError, match=rf"odd\.yaml .*{said}"):
        load(str(tmp_path / "odd.yaml"))


def test_a_camera_file_with_an_endless_number(tmp_path: Path) -> None:
    (tmp_path / "odd.yaml").write_text("a: " + "9" * 5000)
    with pytest.raises(ConfigError, match=r"odd\.yaml holds a number of too many digits"):
        read_camera_file(tmp_path / "odd.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("ground", ["nan", "inf", "1e300", "-200000"])
def test_heights_that_are_none(ground: str, site: Site) -> None:
    outcome = site("pairs", "--ground", ground)
    assert outcome.code == 2
    assert outcome.stderr.endswith(
        f"error: --ground {ground}: no height of any ground, in metres; give one, a DEM or auto\n"
    )


def test_more_jobs_than_any_machine_has(site: Site) -> None:
    assert site("pairs", "--jobs", "100000").code == 2
    outcome = site("pairs", "--set", "run.jobs=" + "9" * 30)
    assert outcome.code == 2
    assert "run.jobs" in outcome.stderr


def test_a_workspace_without_its_settings_is_no_folder_of_images(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    with pytest.raises(ConfigError, match="workspace whose run has not got as far"):
        load(str(tmp_path))


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1/100000000000", "\u00b2/3", "-1/2", "1/2/3"])
def test_shards_that_are_none_are_refused(site: Site, shard: str) -> None:
    outcome = site("run", "--shard", shard)
    assert (outcome.code, "write i/n" in outcome.stderr) == (2, True)


def test_a_cell_of_megabytes_is_not_echoed(site: Site) -> None:
    site.poses.write_text(f"image,x,y,z\n{site.names()[0]},{'7x' * 50_000},0,0\n")
    outcome = site("run")
    assert outcome.code == 2
    assert "is not a number" in outcome.stderr
    assert len(outcome.stderr) < 2000
