"""scripts/bench auto: conditions, under-exposed pictures, the rule for strategies and the tables, by hand; a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from benchmarks import __main__ as launcher
from benchmarks.auto import blocks, command, lightglue, real, rendered, runs, strategies

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, Image
from aeromatch_cli.formats.adjusted import write_adjusted
from aeromatch_cli.formats.tables import images_text
from aeromatch_cli.workspace import Workspace

Row = dict[str, Any]


def rows(method: str, place: str, correct: list[int], kept: list[int]) -> list[Row]:
    block = blocks.Block(place, 1)
    head = {"block": block.name, "conditions": block.conditions, "method": method, "seconds": 2.0}
    return [head | {"correct": c, "kept": k, "median_error_px": 0.5} for c, k in zip(correct, kept, strict=True)]


def test_every_block_is_of_its_conditions() -> None:
    assert blocks.Block("farmland:nadir", 3).conditions == ["texture-poor", "rows and facades", "all"]
    assert blocks.Block("city:exposed", 1).nadir
    assert not blocks.Block("city:oblique", 1).nadir
    assert len(blocks.PLACES) == len(set(blocks.PLACES))


def test_every_second_picture_gets_an_eighth_of_the_light(tmp_path: Path) -> None:
    block = tmp_path / "grass"
    (block / "images").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        cv2.imwrite(str(block / "images" / name), np.full((64, 64, 3), 180, np.uint8))
    (block / "truth.json").write_text("{}")
    out = blocks.darker_block(block)
    means = [cv2.imread(str(path)).mean() for path in sorted((out / "images").iterdir())]
    # sRGB 180 is 0.4564 of full light, an eighth of that is stored as level 67.6.
    assert means == pytest.approx([180.0, 67.6, 180.0], abs=1.0)
    assert (out / "truth.json").read_text() == "{}"
    assert blocks.darker_block(block) == out  # made once
    assert cv2.imread(str(block / "images" / "b.jpg")).mean() == pytest.approx(180.0, abs=1.0)


def test_methods_stand_beside_auto_on_the_blocks_that_they_have() -> None:
    found = [
        *rows("auto", "suburb:nadir", [90, 60], [100, 60]), *rows("auto", "city:mixed", [40, 50], [50, 50]),
        *rows("polar", "suburb:nadir", [30, 20], [40, 20]),
        *rows("baseline", "suburb:nadir", [45, 30], [50, 30]), *rows("baseline", "city:mixed", [20, 25], [20, 30]),
    ]  # fmt: skip
    lines = rendered.table_of(found).splitlines()
    whole = "| all | `auto` | 2 | 4 | 240 | 92.3 % (82.4 to 98.0) | 90.0 % (city:mixed, seed 1) | 0.50 |  | 8 |"
    assert [line.split("(")[0] for line in lines if line.startswith("| all | `auto`")] == [whole.split("(")[0]]
    polar = next(line for line in lines if line.startswith("| all | `polar`"))
    assert polar.startswith("| all | `polar` | 1 | 2 | 50 | 83.3 % ")
    assert polar.endswith("| 0.50 | 3.00 (3.00 to 3.00) | 4 |")
    suns = next(line for line in lines if line.startswith("| two suns | `baseline`"))
    assert suns.endswith("| 90.0 % (city:mixed, seed 1) | 0.50 | 2.00 (2.00 to 2.00) | 4 |")


@pytest.mark.parametrize(
    ("correct", "kept", "expected"),
    [
        (1020, 1071, strategies.ACCEPTED),  # 2 % more at the same correctness
        (1019, 1070, strategies.NOT_ACCEPTED),
        (1100, 1200, strategies.NOT_ACCEPTED),  # more, and more of them wrong
        (990, 1030, strategies.ACCEPTED),  # 40 instead of 50 wrong ones
        (990, 1031, strategies.NOT_ACCEPTED),
        (980, 1000, strategies.NOT_ACCEPTED),  # fewer wrong ones, 2 % fewer correct ones
    ],
)
def test_the_rule_for_strategies(correct: int, kept: int, expected: str) -> None:
    ours = [{"correct": 1000, "kept": 1050, "wrong": 50}]
    assert strategies.verdict(ours, [{"correct": correct, "kept": kept, "wrong": kept - correct}]) == expected


def test_a_gain_within_its_interval_is_none() -> None:
    """Two wrong matches less in 4 of 20 pairs, and two more in one."""
    ours = [{"correct": 100, "kept": 102, "wrong": 2}] * 4 + [{"correct": 100, "kept": 100, "wrong": 0}] * 16
    arm = [{"correct": 100, "kept": 100, "wrong": 0}] * 19 + [{"correct": 100, "kept": 102, "wrong": 2}]
    assert strategies.verdict(ours, arm) == strategies.NOT_ACCEPTED
    assert strategies.verdict(ours, [{"correct": 100, "kept": 100, "wrong": 0}] * 20) == strategies.ACCEPTED


def test_strategies_have_a_verdict_by_condition() -> None:
    found = [*rows("auto", "suburb:nadir", [90, 60], [100, 70]), *rows("auto", "city:mixed", [40, 50], [50, 50])]
    better, worse = [90, 60], [95, 65]
    found += rows("auto[x=y]", "suburb:nadir", better, worse) + rows("auto[x=y]", "city:mixed", [10, 50], [50, 50])
    lines = strategies.table_of(found).splitlines()[2:]
    assert lines[0].startswith(
        "| `auto[x=y]` | one sun | 1 | 1.00 (1.00 to 1.00) | 0.50 (0.50 to 0.50) | 93.8 % | 88.2 %"
    )
    assert [line.rsplit("|", 2)[1].strip() for line in lines] == ["accepted", "not accepted", "not accepted"]
    assert strategies.asked_of(["cascade=guided", "auto[a=b,c=d]"]) == ["auto[cascade=guided]", "auto[a=b,c=d]"]


def test_images_of_the_model_stand_beside_the_most_of_any_mapper() -> None:
    def mapped(images: int, points: int) -> Row:
        return {"registered": images, "points": points, "correct": images, "reprojection_error_px": 0.5, "seconds": 9.0}

    own = {"registered": 8, "correct": 8, "points": 300, "reprojection_error_px": 0.7, "seconds": 20.0}
    head = {"block": "lewis", "every": 4, "preset": "auto", "images": 9, **own}
    first = head | {"given": "nothing", "by_incremental": 7, "by_global": 9}
    second = head | {"given": "positions", "by_incremental": 8, "by_global": 8}
    peer = {"incremental": mapped(6, 100), "global": mapped(8, 150)}
    text = real.table_of([first | {"pycolmap": peer}, second | {"pycolmap": peer}])
    assert (
        "all cases: 2.00; where it registers as many images by itself: 2.00. Images" in text
    )  # one thinned block has no interval, however often something is given
    assert ": 0.94; fewer in 1 of 2 cases." in text
    other = [row | {"every": 3, "points": 150, "pycolmap": peer} for row in (first, second)]
    text = real.table_of([*(row | {"pycolmap": peer} for row in (first, second)), *other])
    assert "all cases: 1.50 (1.00 to 2.00); where it registers as many images by itself: 1.50 (1.00 to 2.00)." in text
    assert ": 0.94 (0.94 to 0.94); fewer in 2 of 4 cases." in text
    alone = {name: one | {"registered": 5} for name, one in peer.items()}
    assert "by itself: -. Images" in real.table_of([first | {"pycolmap": alone}])
    line = "| lewis / 4 | nothing | `auto` | 9 | 8 | 8 | 300 | 0.70 | 20 | 7 / 9 | 6 / 8 | 8 | 150 | 0.50 | 9 |"
    assert f"{line}  |  |  |  |  |" in text  # the published chain was not run
    chain = {"incremental": mapped(9, 400), "global": mapped(5, 80)}
    text = real.table_of([one | {"pycolmap": peer, "aliked+lightglue": chain} for one in (first, second)])
    assert f"{line} 9 / 5 | 9 | 400 | 0.50 | 9 |" in text
    assert "Points over those of aliked+lightglue, all cases: 0.75; where it registers as many" in text
    assert "Fewer images than it in 2, fewer points in 2 of 2 cases." in text


def test_places_of_reduced_images_are_those_of_the_stored_ones(tmp_path: Path) -> None:
    """What the published chain sees of an image of 41 x 30 pixels, 20 at most: its corners stay corners."""
    pixels = np.random.default_rng(0).integers(0, 255, (30, 41, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "large.png"), pixels)
    cv2.imwrite(str(tmp_path / "small.png"), pixels[:12, :16])
    (tmp_path / "out").mkdir()
    names = ["large.png", "small.png"]
    scales = lightglue.reduced(tmp_path, names, tmp_path / "out", 20)
    half, same = (cv2.imread(str(tmp_path / "out" / name)) for name in names)
    assert half.shape == (15, 20, 3)
    corners = lightglue.corner_places(np.array([[-0.5, -0.5], [19.5, 14.5]]), scales["large.png"])
    np.testing.assert_allclose(corners, [[0.0, 0.0], [41.0, 30.0]])
    np.testing.assert_allclose(lightglue.corner_places(np.zeros((1, 2)), scales["small.png"]), [[0.5, 0.5]])
    np.testing.assert_array_equal(same, pixels[:12, :16])
    with pytest.raises(SystemExit, match="absent"):
        lightglue.reduced(tmp_path, ["absent.png"], tmp_path / "out", 20)


def test_one_model_of_ours_is_compared_with_one_of_pycolmap(tmp_path: Path) -> None:
    camera = Camera("PINHOLE", 40, 30, (40.0, 40.0, 20.0, 15.0))
    pose = AdjustedPose(np.zeros(3), np.eye(3), np.ones(3), np.ones(3))
    names = ["a", "b", "c", "d", "e", "alone"]
    # a, b and c share points 0 to 2 by b, and d and e three others; `alone` sees none, and point 6 is seen by none.
    seen = {"a": [0, 1], "b": [0, 1, 2], "c": [2], "d": [3, 4, 5], "e": [3, 4, 5], "alone": []}
    tracks = {k: np.array([(n, p) for n, p in enumerate(own)], np.int32).reshape(-1, 2) for k, own in seen.items()}
    errors_px = np.array([0.1, 0.2, 0.6, 5.0, 5.0, 5.0, 5.0])
    block = AdjustedBlock({"k": camera}, dict.fromkeys(names, pose), np.zeros((7, 3)), errors_px, tracks)
    workspace = Workspace(tmp_path)
    assert real.largest_group(workspace) == ([], {"registered": 0})
    workspace.orientation.mkdir()
    with workspace.final.open("wb") as stream:
        write_adjusted(stream, block)
    images = [Image(name, f"{name}.jpg", 40, 30, "k") for name in names]
    workspace.images.write_text(images_text(images, dict.fromkeys(names, ""), {}), encoding="utf-8")
    held, figures = real.largest_group(workspace)
    assert sorted(held) == ["a.jpg", "b.jpg", "c.jpg"]
    assert figures == {"registered": 3, "points": 3, "track_length": 2.0, "reprojection_error_px": 0.3}


def test_what_cannot_be_measured_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["rendered", "--methods", "baseline"], "must hold auto"),
        (["rendered", "--places", "moon:nadir"], "moon:nadir"),
        (["real", "--data", "d", "--given", "all"], "all are none"),
        (["real", "--data", "d", "--blocks", "moon"], "moon not found in d"),
    ):
        with pytest.raises(SystemExit) as stopped:
            command.main([*words, "--out", "nowhere"])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_strategy_goes_on_from_the_workspace_of_auto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Path | None] = []
    run = runs.judged_run

    def watched(*given: Any, **more: Any) -> Any:
        started.append(more["start"])
        return run(*given, **more)

    monkeypatch.setattr(runs, "judged_run", watched)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_LOG_LEVEL"):
        monkeypatch.setenv(name, "1")
    asked = ["auto", "strategies", "--quick", "--places", "suburb:nadir", "--jobs", "1", "--out", str(tmp_path)]
    asked += ["--strategies", "filter=epipolar+graph"]
    assert launcher.main(asked) == 0
    assert [start is not None and start.parent.name for start in started] == [False, "auto"]
    found = json.loads((tmp_path / "strategies.json").read_text(encoding="utf-8"))
    correct = {name: sum(r["correct"] for r in found if r["method"] == name) for name in {r["method"] for r in found}}
    assert correct["auto"] > 500
    assert 0.8 * correct["auto"] < correct["auto[filter=epipolar+graph]"] <= correct["auto"]
    assert launcher.main(asked) == 0
    assert len(started) == 2  # nothing was run again
