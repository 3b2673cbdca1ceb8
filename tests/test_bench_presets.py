"""The table of presets on whole blocks: sums, shares and ratios."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest
from benchmarks.presets import given_poses, main, table_of
from benchmarks.quality import draw_quality, quality

ARGS = Namespace(presets=["auto", "baseline"], peers=["aliked"])


def rows(method: str, correct: list[int], kept: list[int], **more: float) -> list[dict[str, object]]:
    block = {"seed": 1, "flight": "mixed", "scene": "city", "method": method}
    pairs = zip(("0-20", "20-40"), correct, kept, strict=True)
    return [
        block | {"angle": angle, "correct": right, "kept": all_, "possible": 200, "median_error_px": 0.5, **more}
        for angle, right, all_ in pairs
    ]


def test_the_best_of_each_kind_stands_beside_auto() -> None:
    found = [
        *rows("auto", [90, 60], [100, 60], seconds=5.0, run_seconds=9.0),
        *rows("baseline", [60, 15], [60, 20], seconds=2.0, run_seconds=4.0),
        *rows("aliked", [30, 20], [40, 20], seconds=3.0),
    ]
    text = table_of(ARGS, found)
    block = "| city:mixed, seed 1 | 150 | 93.8 % | 0.50 | `baseline` 75 | 93.8 % | 2.00 | `aliked` 50 | 83.3 % | 3.00 |"
    assert block in text
    steep = "| 20-40 degrees | 60 | 100.0 % | 0.50 | `baseline` 15 | 75.0 % | 4.00 | `aliked` 20 | 100.0 % | 3.00 |"
    assert steep in text
    assert "| city | 10.0 | `baseline` 4.0 | 2.50 | `baseline` 4.0 | 2.50 |" in text
    assert "| mixed | 10.0 | `baseline` 4.0 | 2.50 | `baseline` 4.0 | 2.50 |" in text
    assert "| `auto` | 150 | 93.8 % | 0.50 | 37.5 % | 2 of 2 | 10 | 18 |" in text
    assert "| `aliked` | 50 | 83.3 % | 0.50 | 12.5 % | 1 of 2 | 6 | - |" in text


def test_a_step_of_auto_is_no_other_preset() -> None:
    found = [
        *rows("auto", [90, 60], [100, 60], seconds=5.0, run_seconds=9.0),
        *rows("auto[cascade=none]", [80, 60], [90, 60], seconds=1.0, run_seconds=2.0),
        *rows("baseline", [60, 15], [60, 20], seconds=2.0, run_seconds=4.0),
    ]
    text = table_of(Namespace(presets=["auto", "auto[cascade=none]", "baseline"], peers=[]), found)
    assert "| 150 | 93.8 % | 0.50 | `baseline` 75 | 93.8 % | 2.00 | - | - | - |" in text
    assert "| city | 10.0 | `baseline` 4.0 | 2.50 | `baseline` 4.0 | 2.50 |" in text


def test_presets_know_as_much_of_the_poses_as_asked_for(tmp_path: Path) -> None:
    noisy = tmp_path / "poses_noisy.csv"
    noisy.write_text("image,x,y,z,omega_deg,phi_deg,kappa_deg,camera\na.jpg,1.5,-2,90,1,2,3,1\n")
    assert given_poses(noisy, "noisy") == ["--poses", str(noisy)]
    for known, place in (("positions", "1.5,-2,90"), ("nothing", ",,")):
        option, path = given_poses(noisy, known)
        assert (option, Path(path).read_text()) == ("--poses", f"image,x,y,z,camera\na.jpg,{place},1\n")


def test_quality_and_seconds_are_per_pair(tmp_path: Path) -> None:
    found = rows("auto", [90, 60], [100, 60], seconds=5.0, run_seconds=9.0)
    found += rows("aliked", [30, 20], [40, 20], seconds=3.0)
    draw_quality(tmp_path / "steps.svg", [*found, *rows("auto[cascade=none]", [80, 9], [90, 60], seconds=1.0)])
    drawn = (tmp_path / "steps.svg").read_text()
    assert "auto's first step" in drawn
    other = "baseline[match.ratio=0.8]"
    draw_quality(tmp_path / "other.svg", [*found, *rows(other, [80, 9], [90, 60], seconds=1.0)])
    assert f"{other}, 59.3 % right" in (tmp_path / "other.svg").read_text()
    assert quality(found) == [("auto", 5.0, 75.0, 0.9375), ("aliked", 3.0, 25.0, 50 / 60)]
    draw_quality(tmp_path / "quality.svg", found)
    again = tmp_path / "again.svg"
    draw_quality(again, found)
    assert again.read_bytes() == (tmp_path / "quality.svg").read_bytes()


def test_what_cannot_be_measured_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in ((["--presets", "baseline"], "must hold auto"), (["--presets", "auto,none"], "none")):
        with pytest.raises(SystemExit) as stopped:
            main([*words, "--out", "nowhere"])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err
