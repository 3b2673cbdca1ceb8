"""Growth and memory of whole runs: figures by hand, and a process of known size."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from benchmarks.growth import STAGES, draw_growth, table_of, write_block
from benchmarks.memory import peak_mb


def test_exponents_are_those_of_the_number_of_images(tmp_path: Path) -> None:
    rows = [
        {
            "images": images, "run": run, "seconds": seconds, "peak_mb": 200.0, "pairs": 10 * images, "report_mb": 1.0,
            "processor_seconds": seconds, "workspace_mb": 2.0 * images,
            "stages": dict.fromkeys(STAGES, (images / 100.0) ** 2),
        }
        for images in (100, 1000)
        for run, seconds in (("run", images / 10.0), ("again", 5.0))
    ]  # fmt: skip
    draw_growth(tmp_path / "growth.svg", rows)
    assert "n log n" in (tmp_path / "growth.svg").read_text(encoding="utf-8")
    lines = {line.split("|")[1].strip(): line for line in table_of(rows).splitlines()}
    assert "| 1.0 | 100 (2.00) |" in lines["match, s"]
    assert "| 10.0 | 100 (1.00) |" in lines["whole run, s"]
    assert "| 5.0 | 5.0 (0.00) |" in lines["again, s"]


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
    code, seconds, peak = peak_mb([sys.executable, "-c", text], tmp_path / "log")
    assert code == 0
    assert seconds > 0.6
    assert 150.0 < peak < 200.0
