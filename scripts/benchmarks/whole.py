"""Whole commands as a user gives them, each in a process of its own: `aeromatch run`, `aeromatch evaluate`."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import Settings, load, parse_method
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.store.matches import match_points
from aeromatch_cli.store.opened import OpenedBlock
from benchmarks.tables import Row, plain

# Of every judged pair, in what a truth or `evaluate` says of it.
FIGURES = ("possible", "kept", "correct", "median_error_px")


@dataclass(frozen=True)
class Run:
    """code: exit code. answer: the command's last line with --json, empty where it ended with 2 or 3. said: stderr."""

    code: int
    seconds: float
    answer: dict[str, Any]
    said: str


def whole_run(
    command: str,
    preset: str,
    images: Path,
    work: Path,
    *,
    extra: Sequence[str] = (),
    jobs: int = 2,
    settings: Sequence[str] = (),
    start: Path | None = None,
) -> Run:
    """`aeromatch COMMAND PRESET` into an empty workspace, or into a copy of `start`, of which it goes on. extra:
    further options; settings: as in `--set`."""
    shutil.rmtree(work, ignore_errors=True)
    if start is not None:
        shutil.copytree(start, work)
    words = [sys.executable, "-m", "aeromatch_cli.cli", command, preset, "--images", str(images), *extra]
    words += ["--workspace", str(work), "--jobs", str(jobs), "--quiet", "--json"]
    words += [f"--set={setting}" for setting in settings]
    started = time.perf_counter()
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    seconds = time.perf_counter() - started
    finished = done.returncode in (0, 1) and bool(done.stdout.strip())
    answer = json.loads(done.stdout.splitlines()[-1]) if finished else {}
    return Run(done.returncode, seconds, answer, done.stderr.strip())


def chosen_images(source: Path, every: int, folder: Path) -> Path:
    """Folder of links to every k-th image by name. Raises ConfigError where the source is no folder."""
    if not source.is_dir():
        raise ConfigError(f"{source} is no folder: give the folder that holds the real blocks after --data")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in sorted(source.iterdir())[::every]:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def budget_settings(settings: Settings, keypoints: int) -> list[str]:
    """Settings of a preset for so many descriptors per image in every step with features of its own. A grid has points
    of its own number."""
    return [f"extract.keypoints={keypoints}"] if hasattr(settings.extract, "keypoints") else []


def judged_run(
    method: str,
    images: Path,
    poses: Path,
    cameras: Path,
    work: Path,
    keypoints: int,
    *,
    jobs: int,
    start: Path | None = None,
) -> tuple[Mapping[tuple[str, str], Row], float]:
    """Figures of every pair that a preset, with settings in brackets, verifies or that overlaps, by its two images, and
    the run's seconds. images: of a block with its truth beside them. start: a workspace to go on from a copy of.

    SystemExit where the run fails.
    """
    preset, own = parse_method(method)
    given = ["--poses", str(poses), "--cameras", str(cameras), "--crs", "local"]
    settings = [*budget_settings(load(preset, own), keypoints), *own, "run.report=false"]
    run = whole_run("run", preset, images, work, extra=given, jobs=jobs, settings=settings, start=start)
    if not run.answer:
        raise SystemExit(f"aeromatch run {method} on {images.parent} failed with exit code {run.code}:\n{run.said}")
    evaluated(work, images.parent, mapping=False)
    with (work / "evaluation" / "pairs.csv").open(encoding="utf-8", newline="") as stream:
        rows = {
            (row["image0"], row["image1"]): {key: plain(float(row[key] or "nan")) for key in FIGURES}
            for row in csv.DictReader(stream)
        }
    return rows, run.seconds


def matches_of_run(work: Path) -> Mapping[tuple[str, str], tuple[FloatArray, FloatArray, FloatArray]]:
    """Of the verified pairs of a workspace, by their two images: places (M, 2) in both, stored pixels, scores (M,)."""
    block, found = OpenedBlock(work), {}
    for pair in block.pairs:
        entry = block.final(pair)
        if entry is not None and entry.verdict.state == "verified":
            ids = pair.image_id0, pair.image_id1
            places = match_points(entry.matches, *(block.keypoints_px(number) for number in ids))
            found[block.names[ids[0]], block.names[ids[1]]] = (*places, np.asarray(entry.matches.scores, np.float64))
    return found


def evaluated(work: Path, truth: Path, *, mapping: bool) -> dict[str, Any]:
    """Figures of `aeromatch evaluate`. SystemExit where it fails."""
    words = [sys.executable, "-m", "aeromatch_cli.cli", "evaluate", str(work), "--truth", str(truth)]
    words += ["--quiet", "--json", *([] if mapping else ["--no-mapping"])]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"aeromatch evaluate failed with exit code {done.returncode}:\n{done.stderr[-2000:]}")
    facts: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return facts
