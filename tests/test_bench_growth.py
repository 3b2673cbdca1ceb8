"""Growth and memory of whole runs: figures by hand, and a process of known size."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from benchmarks.growth import STAGES, table_of, write_block
from benchmarks.processes import run_watched


def test_exponents_are_those_of_the_number_of_images() -> None:
    rows = [
        {
            "images": images, "repeat": repeat, "run": run, "seconds": seconds, "peak_mb": 200.0, "pairs": 10 * images,
            "report_mb": 1.0, "processor_seconds": seconds + repeat, "workspace_mb": 2.0 * images,
            "stages": dict.fromkeys(STAGES, (images / 100.0) ** 2),
        }
        for images, repeats in ((100, 3), (1000, 1))
        for repeat in range(repeats)
        for run, seconds in (("run", images / 10.0), ("again", 5.0))
    ]  # fmt: skip
    text = table_of(rows)
    assert text.splitlines()[0] == "|  | 100 images | 1000 images | exponent to 1000 |"
    lines = {line.split("|")[1].strip(): line for line in text.splitlines()}
    assert lines["runs"] == "| runs | 3 | 1 |  |"
    assert lines["match, s"] == "| match, s | 1.0 (1.0 to 1.0) | 100 | 2.00 (2.00 to 2.00) |"
    assert lines["whole run, s"] == "| whole run, s | 10.0 (10.0 to 10.0) | 100 | 1.00 (1.00 to 1.00) |"
    assert lines["processor, s"] == "| processor, s | 11.0 (10.0 to 12.0) | 100 | 0.96 (0.92 to 1.00) |"
    assert lines["again, s"] == "| again, s | 5.0 (5.0 to 5.0) | 5.0 | 0.00 (0.00 to 0.00) |"


def test_neighbours_of_a_block_share_their_ground(tmp_path: Path) -> None:
    write_block(tmp_path, 4, seed=1)
    first, second, below, _ = (cv2.imread(str(p), 0) for p in sorted((tmp_path / "images").iterdir()))
    assert np.array_equal(first[:, 48:], second[:, :-48])
    assert np.array_equal(first[48:], below[:-48])
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert lines[1:3] == ["00000.png,40.0,-30.0,100.0,0,0,0", "00001.png,64.0,-30.0,100.0,0,0,0"]


def test_memory_of_a_process_and_its_child_is_summed(tmp_path: Path) -> None:
    child = "import time; held = bytearray(60 << 20); time.sleep(0.6)"
    text = f"import subprocess, sys; held = bytearray(90 << 20); subprocess.run([sys.executable, '-c', {child!r}])"
    code, seconds, peak = run_watched([sys.executable, "-c", text], tmp_path / "log")
    assert code == 0
    assert seconds > 0.6
    assert 150.0 < peak < 200.0
