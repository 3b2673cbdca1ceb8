"""The schema of --json: the file in docs is that of the code, and what commands print fits it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Site, invoke
from pydantic import ValidationError
from typer.testing import CliRunner

from aeromatch_cli.cli import app
from aeromatch_cli.cli.outcome import Error, any_outcome, schema


def test_the_file_is_up_to_date() -> None:
    path = Path(__file__).parents[1] / "docs" / "outcome.schema.json"
    assert path.read_text(encoding="utf-8") == schema()
    assert json.loads(schema())["title"] == "aeromatch --json"


@pytest.mark.slow
def test_results_and_errors_fit_the_schema(site: Site) -> None:
    outcome, line = invoke("run", *site.options("--quiet", "--json")), any_outcome()
    found = line.validate_python(outcome.facts)
    assert found.stages.match.done == outcome.facts["stages"]["match"]["done"] > 0
    left = outcome.facts["stages"]["consistency"]["result"]["verified_matches"]
    assert found.stages.consistency.result.verified_matches == left
    for arguments in (("run", "nowhere.yaml"), ("pairs", "baseline", "--images", str(site.root / "absent"))):
        error = Error.model_validate(invoke(*arguments, "--json").facts)
        assert (error.exit_code in (2, 3), bool(error.error)) == (True, True)
    wrong = CliRunner().invoke(app, ["run", "--jobs", "many", "--json"])
    stated = Error.model_validate_json(wrong.stdout.splitlines()[-1])
    assert (stated.exit_code, stated.command) == (2, "run")
    assert stated.error.startswith("Invalid value for '--jobs'")
    with pytest.raises(ValidationError):
        line.validate_python(outcome.facts | {"more": 1})


@pytest.mark.slow
def test_every_other_command_fits_it(done_site: Site, rendered: Path, tmp_path: Path) -> None:
    work, names = done_site.work, done_site.names()
    commands: list[tuple[str, tuple[object, ...]]] = [
        ("Checked", ("check", *done_site.options())),
        ("Evaluated", ("evaluate", work, "--truth", rendered, "--no-mapping")),
        ("Rendered", ("synth", tmp_path / "s", "--size", "64x48", "--images", 1, "--preset", "grass")),
        ("Weights", ("weights", "list")),
        ("Weights", ("weights", "verify")),
        ("Shown", ("show", work)),
        ("Shown", ("show", work, names[0])),
        ("Shown", ("show", work, names[0], names[1])),
        ("Shown", ("show", work / "images.csv")),
        ("Compared", ("compare", work, work)),
        ("Configured", ("config", "fusion")),
        ("Listed", ("list",)),
        ("Listed", ("list", "presets")),
        ("Begun", ("init", tmp_path / "a.yaml", "--images", done_site.images)),
        ("Error", ("show", tmp_path)),
    ]
    for kind, arguments in commands:
        found = any_outcome().validate_python(invoke(*arguments, "--json").facts)
        assert type(found).__name__ == kind, arguments
