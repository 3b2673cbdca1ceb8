"""The table of a CUDA device from rows of another machine, and the refusal without one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from benchmarks import device

from aeromatch_cli.errors import ConfigError

ROWS = [
    {"part": "limit", "device": "GPU X", "tflops": 800.0},
    {"part": "LightGlue", "device": "GPU X", "unit": "pairs", "rate": 400.0, "tflops": 20.0, "of_limit": 0.025},
    {"part": "learned, whole", "device": "cuda", "unit": "images", "rate": 1.75},
    {"part": "learned, whole", "device": "cpu", "unit": "images", "rate": 0.5},
]


def test_rows_of_another_machine_make_the_table(tmp_path: Path) -> None:
    (tmp_path / "device.json").write_text(json.dumps(ROWS), encoding="utf-8")
    device.main(["--rows", str(tmp_path / "device.json"), "--out", str(tmp_path)])
    text = (tmp_path / "device.md").read_text(encoding="utf-8")
    assert "Limit: 800 TFLOP/s of GPU X. Images of 2000 x 1500." in text
    assert "| LightGlue | GPU X | 400.0 pairs | 20.0 | 2.5 % |" in text
    assert "| learned, whole | processor | 0.5 images | - | - |" in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_device_nothing_is_measured(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no CUDA device"):
        device.main(["--out", str(tmp_path)])
