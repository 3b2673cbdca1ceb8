"""Rendered blocks that networks are trained on: scenes, flights, heights and suns drawn from their number."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from aeromatch_cli.lab.synthetic import PRESETS, render_block

ORDER = (
    "city", "suburb", "city", "farmland", "city", "hills", "suburb", "city", "water-edge", "desert", "city", "grass",
)  # fmt: skip
FLIGHTS = ("mixed", "nadir", "mixed", "oblique")
FIRST_SEED, LEFT_OUT = 100, (16, 18)  # a city and a suburb
IMAGES = 8


def render(out: Path, block_idx: int) -> Path:
    """Folder of one block; its settings depend on its number alone."""
    seed, preset = FIRST_SEED + block_idx, ORDER[block_idx % len(ORDER)]
    rng = np.random.default_rng(seed)
    flight = FLIGHTS[int(rng.integers(len(FLIGHTS)))]
    height_m = PRESETS[preset].height_m * float(np.exp(rng.uniform(np.log(0.6), np.log(1.8))))
    sun_deg = float(rng.uniform(0.0, 360.0)), float(rng.uniform(18.0, 70.0))
    if preset in ("grass", "desert") and rng.random() < 0.5:
        sun_deg = sun_deg[0], 88.0  # next to no shadow at all
    folder = out / f"{preset}-{seed}"
    if not (folder / "truth.json").is_file():
        render_block(
            folder, preset, seed=seed, width_px=640, height_px=480, images=IMAGES, flight=flight, height_m=height_m,
            sun_deg=sun_deg,
        )  # fmt: skip
    return folder


def numbers(text: str) -> list[int]:
    """What `0-4,29` means, each once, in order."""
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return sorted(found)


def add_blocks(parser: argparse.ArgumentParser, default: str = "0-47") -> None:
    """The argument --blocks."""
    parser.add_argument("--blocks", type=block_list, default=default, help="rendered blocks by number, as 0-4,29-47")


def block_list(text: str) -> str:
    """For argparse: the text, if `numbers` reads it."""
    try:
        found = numbers(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0-4,29-47") from error
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} names no number: ranges go up, as in 0-4")
    return text
