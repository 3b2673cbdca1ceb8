"""Damage that is named, and images that are away for a while. What is damaged is made again: test_every_stage.py."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from conftest import Site, contents, invoke

from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.source import Source
from aeromatch_cli.stages import enhance

pytestmark = pytest.mark.slow


def test_a_damaged_adjustment_is_named(done_site):
    path = done_site.work / "orientation" / "adjusted.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    expected = contents(done_site.work)
    outcome = done_site("run")
    assert outcome.code == 0
    assert f"{path} was changed or removed since it was written, and counts as absent" in outcome.stderr
    assert contents(done_site.work) != expected
    data[len(data) // 2] ^= 1
    assert path.read_bytes() == data


def test_a_page_made_while_the_clock_was_ahead_is_made_again(done_site):
    page = ("--set", "run.report=true")
    assert done_site("run", *page).done() == {"report": 1}
    for path in done_site.work.rglob("*"):
        os.utime(path, (time.time() + 1e6, time.time() + 1e6))
    assert done_site("run", *page).done() == {}
    before = (done_site.work / "report" / "index.html").read_text()
    assert done_site("run", *page, "--set", "pairs.min_overlap=0.7").done()["report"] == 1
    assert (done_site.work / "report" / "index.html").read_text() != before


def test_an_image_that_could_not_be_read_for_a_while_leaves_no_trace(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither in the orientation, nor in what steps of a cascade have made together: auto runs all stages of others."""
    calm = site.another_workspace("calm") / "work"
    assert invoke("run", "auto", *site.options("--workspace", calm)).code == 0
    read, absent = enhance.read_source, site.image(1)

    def failing(source: Source, *, colour: bool) -> tuple[np.ndarray, np.ndarray | None]:
        if source.path == absent:
            raise ItemError(f"{source.path} is away")
        return read(source, colour=colour)

    monkeypatch.setattr(enhance, "read_source", failing)
    outcome = invoke("run", "auto", *site.options())
    assert outcome.code == 1
    assert "is away" in outcome.stderr
    monkeypatch.undo()
    assert invoke("run", "auto", *site.options()).code == 0
    found, expected = contents(site.work), contents(calm)
    passing = {name for name in {*found, *expected} if "first_pass" in name or name == "config.yaml"}
    assert {n for n in {*found, *expected} - passing if found.get(n) != expected.get(n)} == set()


def test_a_flipped_byte_inside_an_array_is_noticed(done_site):
    expected = contents(done_site.work)
    for kind in ("features", "matches", "verified"):
        path = sorted((done_site.work / kind).glob("*.npz"))[1]
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    # Features are read only where something is to be matched anew.
    outcome = done_site("run", "--overwrite")
    assert outcome.code == 0
    assert contents(done_site.work) == expected


# --- killed and interrupted ---------------------------------------------------------------------------------------
