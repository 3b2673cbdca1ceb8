"""Units of work: each writes its rows once, so that a killed run goes on where it was."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.lab.strategies import add_arms
from benchmarks.options import size_px
from benchmarks.processes import fresh_process, limit_threads
from benchmarks.scenes import Judged, render_once, rendered_scenes
from benchmarks.sources import code_digest, library_versions
from benchmarks.tables import Row, write_rows


@dataclass(frozen=True)
class Unit:
    """make(*given) gives the rows, which depend on the arguments that are no paths and on `code`, places of
    `benchmarks.sources`. label: what it is. alone: it needs the memory for itself."""

    label: str
    make: Callable[..., list[Row]]
    given: tuple[Any, ...]
    code: tuple[str, ...]
    alone: bool = False

    def path(self, folder: Path) -> Path:
        plain = [str(value) for value in self.given if not isinstance(value, Path)]
        key = fingerprint(self.label, self.make.__qualname__, plain, code_digest(*self.code), library_versions())
        return folder / f"{self.make.__module__.rpartition('.')[2]}-{key[:16]}.json"


def made(units: Sequence[Unit], folder: Path, jobs: int = 2) -> list[Row]:
    """Rows of all units, in order. Those without a file are made in `jobs` processes of one thread each; those alone
    come last, one after the other, with `jobs` threads."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {unit: unit.path(folder) for unit in units}  # by the code as it is now
    missing = [unit for unit in units if not paths[unit].is_file()]
    limit_threads(1)
    for alone, count, threads in ((False, jobs, 1), (True, 1, jobs)):
        if own := [unit for unit in missing if unit.alone == alone]:
            with fresh_process(count, start, threads) as pool:
                running = {pool.submit(_timed, unit): unit for unit in own}
                for done in as_completed(running):
                    rows, seconds = done.result()
                    unit = running[done]
                    write_rows(paths[unit], rows)
                    print(f"{unit.label}: {seconds:.0f} s of the processor", file=sys.stderr, flush=True)
    return [row for unit in units for row in json.loads(paths[unit].read_text(encoding="utf-8"))]


def start(threads: int = 1) -> None:
    """Initialise a process: settings may name the laboratory's strategies."""
    import cv2
    import torch

    add_arms()
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)


def _timed(unit: Unit) -> tuple[list[Row], float]:
    started = time.process_time()
    return unit.make(*unit.given), time.process_time() - started


def rendered(
    scene: str, flight: str, size: str, images: int, pairs: int, condition: str, seed: int, out: Path
) -> Judged:
    """Judged pairs of a rendered block below OUT/scenes, which is made unless it is there."""
    width_px, height_px = size_px(size)
    asked = {"width_px": width_px, "height_px": height_px, "images": images}
    render_once(out / "scenes", scene, jobs=1, seed=seed, flight=flight, **asked)
    options = {"scenes": [scene], "flights": [flight], "size": size, "images": images, "pairs": pairs, "seed": seed}
    return next(rendered_scenes(argparse.Namespace(**options, out=out), condition))[1]


def prepare(scenes: Sequence[tuple[Any, ...]], jobs: int = 2) -> None:
    """Blocks that units share, made before them. scenes: arguments of `rendered`."""
    limit_threads(1)
    with fresh_process(jobs, start) as pool:
        for done in [pool.submit(_rendered, scene) for scene in scenes]:
            done.result()


def _rendered(scene: tuple[Any, ...]) -> None:
    rendered(*scene)
