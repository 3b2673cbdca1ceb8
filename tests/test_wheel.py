"""What pip installs: the wheel holds the presets and every data file, and runs without the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, offline, with the setuptools that is installed: the checkout stays clean."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    for name in ("aeromatch_cli", "configs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-q"]
    done = subprocess.run([*command, "-w", "dist", "."], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (found,) = (folder / "dist").glob("aeromatch-*.whl")
    return found


def test_wheel_holds_every_module_and_data_file(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    sources = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "aeromatch_cli").rglob("*")
        if path.suffix in (".py", ".jinja", ".safetensors", ".md")
    }
    presets = {f"aeromatch_cli/configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml")}
    assert sources | presets <= names
    assert not {name.split("/")[0] for name in names} & {"tests", "scripts", "configs"}


def test_installed_wheel_finds_presets_by_name(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import aeromatch_cli\nfrom aeromatch_cli.config import Settings, load, preset_names\n"
        "assert aeromatch_cli.__file__.startswith(sys.argv[1]), aeromatch_cli.__file__\n"
        "assert load('default') == load('baseline') == Settings()\nprint(*preset_names())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(site)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) == {path.stem for path in (ROOT / "configs").glob("*.yaml")} - {"default"}


def test_installed_wheel_answers_on_the_command_line(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    done = subprocess.run(
        [sys.executable, "-m", "aeromatch_cli.cli", "check", "baseline", "--set", "extract.keypointz=1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(site)},
    )
    assert done.returncode == 2
    assert "did you mean 'keypoints'?" in done.stderr
    assert "Traceback" not in done.stderr
