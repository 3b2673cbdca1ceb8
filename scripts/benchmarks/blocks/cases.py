"""The answer of one method on one block: a COLMAP database, seconds, and what mapping makes of it; kept on disk."""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate.mapping import map_database
from aeromatch_cli.workspace import fingerprint, read_json, write_json, write_text
from benchmarks.blocks import steps
from benchmarks.blocks.series import pairs_across, read_block, two_series
from benchmarks.blocks.steps import run_step
from benchmarks.peers.table import Named
from benchmarks.scenes import brightness_of
from benchmarks.sources import OUR_CODE, code_digest, library_versions

COLMAP = ("pycolmap", "pycolmap-guided", "pycolmap-uncut", "pycolmap-uncut-guided")
_STEPS = ("benchmarks/blocks/steps.py", "benchmarks/peers/colmap.py")
Answer = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """images: folder. pairs: image names, or None for a method's own choice (COLMAP: all). command: by `aeromatch run`,
    start-up, export and report included, instead of stage by stage. keypoints: descriptors per image."""

    images: Path
    reference: Path
    pairs: tuple[tuple[str, str], ...] | None
    keypoints: int
    jobs: int
    command: bool = False
    mapping: bool = True

    @property
    def pictures(self) -> list[tuple[str, int]]:
        """Names and bytes: what tells these pictures from others."""
        return [(path.name, path.stat().st_size) for path in sorted(self.images.iterdir())]


def chosen_images(source: Path, every: int, limit: int, folder: Path) -> Path:
    """Folder of links to every k-th image by name; with a limit, so many of these evenly from first to last."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    paths = sorted(source.iterdir())[::every]
    if 0 < limit < len(paths):
        paths = [paths[i * (len(paths) - 1) // max(1, limit - 1)] for i in range(limit)]
    for path in paths:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def cross_pairs(images: Path, reference: Path) -> tuple[tuple[str, str], ...]:
    """The pairs across a block's darker and brighter series. Raises ConfigError where there is none."""
    found = pairs_across(read_block(images, reference), two_series(brightness_of(images)))
    if not found:
        raise ConfigError(f"{images} has no pair across two series: --blocks takes one that was flown twice")
    return tuple(found)


def answer(case: Case, name: Named, store: Path) -> tuple[Answer, Path]:
    """Figures and database of one method; made unless `store` has them."""
    ours = None if name.spec in COLMAP else load(*parse_method(name.spec)).model_dump(mode="json")
    code = (*_STEPS, *(OUR_CODE if ours else ()))
    basis = [name.spec, ours, case.pictures, case.pairs, case.keypoints, case.jobs, case.command and bool(ours)]
    folder = store / fingerprint(basis, code_digest(*code), library_versions())[:16]
    folder.mkdir(parents=True, exist_ok=True)
    database, facts, mapped = folder / "database.db", folder / "answer.json", folder / "mapping.json"
    if not facts.is_file():
        made = _colmap(case, name.spec, folder, store) if ours is None else _preset(case, name.spec, folder)
        shutil.move(made.pop("database"), database)
        write_json(facts, made)  # last: it says that the rest is there
        shutil.rmtree(folder / "workspace", ignore_errors=True)
    found: Answer = read_json(facts)
    if case.mapping:
        if not mapped.is_file():
            write_json(mapped, map_database(database, case.images))
        found |= read_json(mapped)
    return found, database


def _preset(case: Case, spec: str, folder: Path) -> Answer:
    preset, settings = parse_method(spec)
    if case.command:
        return _run_command(case, preset, settings, folder)
    pairs = _pair_list(case, folder, ",")
    return run_step(
        steps.preset, preset, settings, case.images, case.reference, folder, case.keypoints, case.jobs, pairs
    )


def _run_command(case: Case, preset: str, settings: list[str], folder: Path) -> Answer:
    """Wall clock and processor seconds of `aeromatch run` from a fresh workspace."""
    work = folder / "workspace"
    shutil.rmtree(work, ignore_errors=True)
    command = [sys.executable, "-c", "from aeromatch_cli.cli import main; main()", "run", preset]
    command += ["--images", str(case.images), "--poses", str(case.reference / "poses.csv")]
    command += ["--cameras", str(case.reference / "block.json"), "--workspace", str(work), "--jobs", str(case.jobs)]
    command += ["--quiet", f"--set=extract.keypoints={case.keypoints}", *(f"--set={text}" for text in settings)]
    before, started = _processor_seconds(), time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    seconds, processor = time.perf_counter() - started, _processor_seconds() - before
    if done.returncode:
        raise SystemExit(f"{' '.join(command[3:])} failed with exit code {done.returncode}:\n{done.stderr[-2000:]}")
    database = work / "export" / "colmap" / "database.db"
    return {"database": str(database), "seconds": seconds, "processor_seconds": processor}


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _colmap(case: Case, spec: str, folder: Path, store: Path) -> Answer:
    """Features are made once for guided and unguided matching; their seconds count for both."""
    cut = "uncut" not in spec
    basis = [case.pictures, case.keypoints, case.jobs, cut, code_digest(*_STEPS), library_versions()]
    shared = store / f"features-{fingerprint(basis)[:16]}"
    shared.mkdir(parents=True, exist_ok=True)
    facts, features = shared / "answer.json", shared / "database.db"
    if not facts.is_file():
        features.unlink(missing_ok=True)
        asked = case.images, case.reference, features, case.keypoints, case.jobs, cut
        found = run_step(steps.colmap_extract, *asked)
        write_json(facts, found)
    extracted = read_json(facts)["seconds"]
    database = folder / "matching.db"
    shutil.copy(features, database)
    pairs, guided = _pair_list(case, folder, " "), spec.endswith("-guided")
    found = run_step(steps.colmap_match, database, case.jobs, guided, pairs)
    stages = {"extract": extracted, "match+verify": found["seconds"]}
    return {"database": str(database), "seconds": sum(stages.values()), "stages": stages}


def _pair_list(case: Case, folder: Path, separator: str) -> Path | None:
    if case.pairs is None:
        return None
    path = (folder / "pairs.txt").resolve()
    write_text(path, "".join(f"{a}{separator}{b}\n" for a, b in case.pairs))
    return path
