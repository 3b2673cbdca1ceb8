"""docs/workspace.md is the specification of the code, and names what a workspace holds."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import Site

from aeromatch_cli import formats
from aeromatch_cli.formats.tables import read_csv

PAGE = Path(__file__).parent.parent / "docs" / "workspace.md"


def section(name: str) -> str:
    """The text below a heading that begins with this path."""
    found = re.search(rf"^### {re.escape(name)}.*?\n(.*?)(?=^##|\Z)", formats.page(), re.DOTALL | re.MULTILINE)
    assert found, f"no section {name}"
    return found[1]


def test_the_page_is_up_to_date() -> None:
    written = PAGE.read_text(encoding="utf-8")
    assert written == formats.page(), "run: python -m aeromatch_cli.formats > docs/workspace.md"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["images.csv", "cameras.csv", "poses.csv", "pairs.csv", "failures.csv"])
def test_every_column_is_specified(done_site: Site, name: str) -> None:
    header = (done_site.work / name).read_text(encoding="utf-8").splitlines()[0].split(",")
    assert [column for column in header if f"`{column}`" not in section(name)] == []
    read_csv(done_site.work / name)


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["features", "matches", "verified"])
def test_every_array_is_specified(done_site: Site, folder: str) -> None:
    path = sorted((done_site.work / folder).glob("*.npz"))[0]
    with np.load(path, allow_pickle=False) as archive:
        names = archive.files
    assert names
    assert [name for name in names if f"`{name}`" not in section(f"{folder}/")] == []


@pytest.mark.slow
def test_every_file_of_a_finished_workspace_has_a_section(done_site: Site) -> None:
    headings = " ".join(re.findall(r"^### (.*)", formats.page(), re.MULTILINE))
    tops = {path.name for path in done_site.work.iterdir()}
    assert {"config.yaml", "features", "verified", "export"} <= tops
    assert sorted(top for top in tops if top not in headings) == []
