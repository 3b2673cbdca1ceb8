"""Start-up: parsing a command line imports nothing heavy, and help answers at once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import invoke

HEAVY = {
    *("cv2", "torch", "kornia", "scipy", "matplotlib", "rasterio", "pyproj", "shapely", "poselib", "pycolmap", "PIL"),
    *("jinja2", "embreex", "safetensors", "distributed"),
}


def imported_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stdout.split()}


def test_the_command_line_imports_nothing_heavy() -> None:
    found = imported_by("import aeromatch_cli.cli")
    assert not found & {*HEAVY, "numpy", "pydantic", "yaml", "rich"}


def test_configuration_and_stages_import_nothing_heavy() -> None:
    """Reading a configuration, and refusing a wrong one, costs numpy and pydantic only."""
    assert not imported_by("from aeromatch_cli.config import load; load('baseline')") & HEAVY
    assert not imported_by("import aeromatch_cli.stages.run") & HEAVY


def test_networks_that_nothing_asks_load_no_torch() -> None:
    """Whatever device they are for: the default takes CUDA where there is one."""
    statement = (
        "from aeromatch_cli.config import load; load('fusion').match.check_files(128); "
        "load('oblique').extract.check_files(128)"
    )
    assert "torch" not in imported_by(statement)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["run", "--help"]])
def test_help_answers_in_half_a_second(arguments: list[str]) -> None:
    """In seconds of the processor, as other tests may keep it busy: nothing here waits for anything else. Best of
    several, since others share its caches, through the installed script where there is one."""
    script = Path(sys.executable).with_name("aeromatch")
    command = [str(script)] if script.exists() else [sys.executable, "-m", "aeromatch_cli.cli"]
    seconds = []
    for _ in range(15):
        before = os.times()
        done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
        after = os.times()
        seconds.append(after.children_user + after.children_system - before.children_user - before.children_system)
        assert done.returncode == 0
        assert done.stdout.strip()
        if len(seconds) >= 3 and min(seconds) < 0.5:
            break
    assert min(seconds) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "expected", "as_a_process"),
    [
        (["run", "baselin"], "did you mean 'baseline'?", True),
        (["run", "nowhere.yaml"], "cannot read configuration nowhere.yaml", False),
        (["pairs", "baseline", "--set", "extract.keypointz=1"], "extract.keypointz: unknown key; did you mean", False),
        (["check", "baseline", "--set", "nonsense"], "write key.sub=value", False),
        (["run", "baseline", "--executor", "threads"], "run.executor: must be 'serial', 'processes' or 'dask'", False),
        (["run", "baseline", "--set", "pairs=file", "--set", "pairs.path=gone.txt", "--images", "."], "gone.txt", True),
    ],
)
def test_wrong_configurations_leave_with_code_2_and_no_traceback(
    tmp_path: Path, arguments: list[str], expected: str, as_a_process: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from make_images import write_image

    write_image(tmp_path / "a.jpg")
    write_image(tmp_path / "b.jpg")
    monkeypatch.chdir(tmp_path)
    words = arguments if arguments[0] == "check" else [*arguments, "--workspace", str(tmp_path / "work")]
    found = invoke(*words)
    assert (found.code, found.stdout) == (2, "")
    assert expected in found.stderr
    if as_a_process:
        command = [sys.executable, "-m", "aeromatch_cli.cli", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", found.stderr)
