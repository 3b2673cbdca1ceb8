"""scripts/bench speed: sizes and cameras of enlarged blocks, ratios and shares by hand, known rows made no more."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from benchmarks import speed


def row(chain: str, seconds: float, processor: float, repeat: int = 0, **stages: float) -> dict[str, Any]:
    head = {"scene": "easy", "megapixels": 3, "images": 8, "chain": chain, "repeat": repeat}
    head |= {"keypoints": 4000, "jobs": 2, "seed": 1}
    made = {"seconds": seconds, "processor_seconds": processor, "peak_mb": 800.0, "oriented": 7}
    return {**head, **made, "stages": stages}


def test_sizes_are_those_of_the_megapixels() -> None:
    assert speed.size_of(3) == (2000, 1500)
    assert speed.size_of(12) == (4000, 3000)


def test_an_enlarged_block_has_its_camera_enlarged(tmp_path: Path) -> None:
    source = tmp_path / "small"
    (source / "images").mkdir(parents=True)
    cv2.imwrite(str(source / "images" / "a.jpg"), np.full((30, 40), 120, np.uint8))
    (source / "poses_gps.csv").write_text("image,x,y,z\na.jpg,0,0,100\n", encoding="utf-8")
    lens = {"model": "SIMPLE_RADIAL", "width": 40, "height": 30, "params": [36.0, 20.5, 15.0, -0.03]}
    (source / "block.json").write_text(json.dumps({"crs": "local", "cameras": {"1": lens}}), encoding="utf-8")
    out = speed.enlarged(source, tmp_path / "large", (80, 60))
    assert cv2.imread(str(out / "images" / "a.jpg")).shape[:2] == (60, 80)
    found = json.loads((out / "block.json").read_text(encoding="utf-8"))["cameras"]["1"]
    assert (found["width"], found["height"], found["params"]) == (80, 60, pytest.approx([72.0, 41.0, 30.0, -0.03]))
    assert (out / "poses_gps.csv").read_bytes() == (source / "poses_gps.csv").read_bytes()


def test_ratios_are_of_processor_seconds_and_shares_of_wall_seconds() -> None:
    rows = [
        row("baseline", 50.0, 80.0, orient=5.0, extract=20.0, match=10.0),
        row("auto", 60.0, 100.0, orient=6.0, extract=30.0),
        row("pycolmap", 120.0, 200.0, extract=60.0, match=30.0, adjust=30.0),
    ]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in speed.table_of(rows).splitlines()]
    auto = dict(zip(lines[0], lines[3], strict=True))
    assert (auto["x `baseline`"], auto["x pycolmap"], auto["oriented"]) == ("1.25 x", "0.50 x", "7 of 8")
    assert (auto["orient"], auto["extract"], auto["match"], auto["rest"]) == ("10 %", "50 %", "-", "40 %")
    assert dict(zip(lines[0], lines[4], strict=True))["rest"] == "-"


def test_repeated_runs_are_medians_with_their_ranges() -> None:
    rows = [row("baseline", 50.0, processor, repeat) for repeat, processor in enumerate((80.0, 100.0))]
    rows += [row("auto", seconds, 2.0 * seconds, repeat) for repeat, seconds in enumerate((60.0, 66.0))]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in speed.table_of(rows).splitlines()]
    auto = dict(zip(lines[0], lines[3], strict=True))
    assert len(lines) == 4
    assert (auto["wall, s"], auto["processor, s"]) == ("63", "126 (120 to 132)")
    assert auto["x `baseline`"] == "1.40 x (1.20 to 1.65)"


def test_rows_that_are_known_are_not_made_again(tmp_path: Path) -> None:
    known = [row(chain, 1.0, 1.0) for chain in ("baseline", "pycolmap")]
    asked = {"scenes": ["easy"], "megapixels": [3], "images": [8], "chains": ["baseline", "pycolmap"], "seed": 1}
    args = argparse.Namespace(**asked, keypoints=4000, jobs=2, repeats=1, out=tmp_path / "nowhere", keep=False)
    assert list(speed.rows_of(args, known)) == known
    assert not args.out.exists()


def test_a_command_answers_with_its_last_object(tmp_path: Path) -> None:
    text = "import sys, time; time.sleep(0.3); print('said'); print('{\"stages\": 1}'); sys.exit(1)"
    found, answer = speed.timed([sys.executable, "-c", text], tmp_path / "said.log")
    assert answer == {"stages": 1}
    assert found["seconds"] >= 0.3
    assert found["processor_seconds"] > 0.0
    with pytest.raises(SystemExit, match="exit code 2"):
        speed.timed([sys.executable, "-c", "import sys; sys.exit(2)"], tmp_path / "said.log")
