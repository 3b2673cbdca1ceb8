"""What is said of images that a result does not hold, even where quiet is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from conftest import Site
from make_results import filled

from aeromatch_cli.cli.output import guarded
from aeromatch_cli.errors import ItemError
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.results.stages import BlockResults
from aeromatch_cli.stages import filter  # noqa: A004
from aeromatch_cli.stages.command_result import Result
from aeromatch_cli.stages.lost import lost_images, lost_lines, write_lost
from aeromatch_cli.workspace import Workspace

NAMES = {f"a{k}_jpg": f"a{k}.jpg" for k in range(8)}


def test_images_are_lost_that_were_not_read_or_not_oriented(tmp_path: Path) -> None:
    adjusted = {"images": 6, "outside": {"a7_jpg": "no pair", "a6_jpg": "no texture"}}
    lost = lost_images(filled(BlockResults, adjust=adjusted), [("b.jpg", "file is empty")], NAMES)
    assert lost == [
        ("a6.jpg", "not oriented", "no texture"),
        ("a7.jpg", "not oriented", "no pair"),
        ("b.jpg", "left out", "file is empty"),
    ]
    links = {"unread": ["a6_jpg"], "unconnected": ["a5_jpg"]}
    damaged = lost_images(filled(BlockResults, adjust=adjusted, filter=links), (), NAMES)
    assert [what for _, what, _ in damaged] == ["not read", "not oriented"]
    unadjusted = lost_images(filled(BlockResults, filter=links), (), NAMES)
    assert [(name, what) for name, what, _ in unadjusted] == [("a5.jpg", "not connected"), ("a6.jpg", "not read")]
    workspace = Workspace(tmp_path)
    assert lost_lines(workspace, lost, 9) == [
        "lost      3 of 9 images are not in the result (1 left out, 2 not oriented): a6.jpg, a7.jpg, b.jpg; "
        f"listed in {tmp_path}/lost.csv"
    ]
    write_lost(workspace, lost)
    assert workspace.lost.read_text().splitlines()[1] == "a6.jpg,not oriented,no texture"


def test_without_adjustment_images_are_lost_that_no_pair_holds(tmp_path: Path) -> None:
    found = {"adjust": {"images": 0}, "filter": {"unconnected": ["a0_jpg"]}}
    final = {"components": [6, 1, 1], "unconnected": sorted(NAMES)[:7]}
    assert [name for name, _, _ in lost_images(filled(BlockResults, found), (), NAMES)] == ["a0.jpg"]
    lost = lost_images(filled(BlockResults, found, consistency=final), (), NAMES)
    assert len(lost) == 7
    [line] = lost_lines(Workspace(tmp_path), lost, 8)
    assert "7 of 8 images are not in the result (7 not connected): a0.jpg, a1.jpg, a2.jpg, a3.jpg, a4.jpg and 2" in line
    assert lost_lines(Workspace(tmp_path), (), 8) == []


def test_after_a_failed_adjustment_all_images_are_lost(tmp_path: Path) -> None:
    """Connected ones too; of those that could not be read the reason is another."""
    why = "the bundle adjustment was ended by signal 15 (Terminated)"
    found = {"adjust": {"images": 0, "outside": dict.fromkeys(NAMES, why)}, "filter": {"unread": ["a6_jpg"]}}
    lost = lost_images(filled(BlockResults, found), (), NAMES)
    assert lost[0] == ("a0.jpg", "not oriented", why)
    assert [what for _, what, _ in lost] == ["not oriented"] * 6 + ["not read", "not oriented"]
    [line] = lost_lines(Workspace(tmp_path), lost, 8)
    assert line.startswith("lost      8 of 8 images are not in the result (7 not oriented, 1 not read): a0.jpg, a1.jpg")


@pytest.mark.parametrize("quiet", [False, True])
def test_urgent_lines_are_said_once_on_the_right_stream(quiet: bool, capsys: pytest.CaptureFixture[str]) -> None:
    result = Result(("a summary", "result    bad: so it is"), verdict="bad", urgent=("result    bad: so it is",))
    with pytest.raises(typer.Exit):
        guarded(lambda: result, "run", quiet=quiet, as_json=False, log_file=None)
    shown = capsys.readouterr()
    assert shown.out == ("" if quiet else "a summary\nresult    bad: so it is\n")
    assert shown.err == ("result    bad: so it is\n" if quiet else "")


@pytest.mark.slow
def test_an_image_whose_pairs_all_failed_is_sent_to_the_failures(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    judge = filter._judge

    def broken(task: Any, pair: Any, entry: Any) -> Any:
        if "first_pass" not in task.workspace.root.parts and "suburb_0003_jpg" in pair.geometry.pair.ids:
            raise ItemError("on purpose")
        return judge(task, pair, entry)

    monkeypatch.setattr(filter, "_judge", broken)
    assert site("run", "--executor", "serial").code == 1
    (lost,) = read_csv(site.work / "lost.csv")
    assert lost["image"] == "suburb_0003.jpg"
    assert lost["reason"] == "none of its 4 pairs could be matched and verified: see failures.csv"
