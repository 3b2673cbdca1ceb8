"""Names of files, not image ids, in what leaves the workspace."""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import pytest

from aeromatch_cli.data import Image
from aeromatch_cli.files import write_text
from aeromatch_cli.formats.tables import images_text
from aeromatch_cli.stages.stage_report import StageReport, gather_failures
from aeromatch_cli.store.naming import item_named, names_on_file, with_names
from aeromatch_cli.workspace import Workspace

NAMES = {"flight_a_jpg": "flight/a.jpg", "b_jpg": "b b.jpg"}


def test_items_are_images_pairs_or_something_else() -> None:
    assert item_named("b_jpg", NAMES) == "b b.jpg"
    assert item_named("flight_a_jpg b_jpg", NAMES) == "flight/a.jpg and b b.jpg"
    assert item_named("not read.jpg", NAMES) == "not read.jpg"
    assert item_named("mapping", NAMES) == "mapping"


def test_results_have_names_as_keys_and_values() -> None:
    facts = {"outside": {"b_jpg": "blurred"}, "groups": [{"registered": ["b_jpg", "flight_a_jpg"], "points": 3}],
             "images": 2, "remarks": ["of b_jpg nothing"], "sigma": None}  # fmt: skip
    assert with_names(facts, NAMES) == {
        "outside": {"b b.jpg": "blurred"}, "groups": [{"registered": ["b b.jpg", "flight/a.jpg"], "points": 3}],
        "images": 2, "remarks": ["of b_jpg nothing"], "sigma": None,
    }  # fmt: skip


def test_failures_are_listed_and_told_by_names(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    workspace = Workspace(tmp_path)
    images = [Image(image_id, name, 10, 10, "1") for image_id, name in NAMES.items()]
    report = StageReport("match", failures=[("flight_a_jpg b_jpg", "on purpose"), ("b_jpg", "too dark")])
    assert names_on_file(workspace) == {}
    write_text(workspace.images, images_text(images, dict.fromkeys(NAMES, "")))
    with caplog.at_level(logging.WARNING, "aeromatch"):
        report.write(workspace)
    with workspace.failures.open(newline="") as stream:
        rows = [(row["item"], row["reason"]) for row in csv.DictReader(stream)]
    assert sorted(rows) == [("b b.jpg", "too dark"), ("flight/a.jpg and b b.jpg", "on purpose")]
    assert "match: flight/a.jpg and b b.jpg: on purpose" in caplog.text
    assert "_jpg" not in caplog.text
    # The program's own lists keep ids.
    assert {item for _, item, _ in gather_failures(workspace)} == {"flight_a_jpg b_jpg", "b_jpg"}
