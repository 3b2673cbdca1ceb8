"""The answer of one method on one block: a COLMAP database, seconds, and what mapping makes of it, kept on disk; its
verified matches against reference poses; and the pairs across the two series of a block that was flown twice."""

from __future__ import annotations

import math
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.data import Block, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate.mapping import map_both
from aeromatch_cli.evaluate.metrics import GRID_CELLS, thin
from aeromatch_cli.evaluate.reference import load_reference
from aeromatch_cli.evaluate.scores import CORRECT_PX, WITHIN_PX
from aeromatch_cli.files import read_json, write_json, write_text
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.strategies.pairings import PAIRINGS
from benchmarks.blocks import steps
from benchmarks.blocks.steps import run_step
from benchmarks.orient.cases import worsened
from benchmarks.peers.base import MIN_INLIERS, prepared
from benchmarks.peers.table import Named
from benchmarks.processes import children_seconds
from benchmarks.scenes import MIN_OVERLAP, brightness_of
from benchmarks.sources import OUR_CODE, code_digest, library_versions
from benchmarks.whole import budget_settings, whole_run

COLMAP = ("pycolmap", "pycolmap-guided", "pycolmap-uncut", "pycolmap-uncut-guided")
_STEPS = ("benchmarks/blocks/steps.py", "benchmarks/peers/colmap.py")
# What presets are given: --poses of a benchmark -> case of the benchmark of orientation.
GIVEN = {"reference": "reference", "positions": "noise", "nothing": "nothing"}
# Stages whose seconds count as those of a preset.
TIMED = ("orient", "pairs", "extract", "match", "filter")
Answer = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """images: folder. pairs: image names, or None for a method's own choice (COLMAP: all). command: seconds are those
    of the whole command with start-up, export and report, not of its stages. keypoints: descriptors per image. poses:
    of GIVEN; cameras are the reference's."""

    images: Path
    reference: Path
    pairs: tuple[tuple[str, str], ...] | None
    keypoints: int
    jobs: int
    command: bool = False
    mapping: bool = True
    poses: str = "reference"

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
    basis = [name.spec, ours, case.pictures, case.pairs, case.keypoints, case.jobs]
    basis += [case.command, case.poses] if ours else []
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
            write_json(mapped, map_both(database, case.images))
        found = read_json(mapped) | found  # seconds are those of matching
    return found, database


def _preset(case: Case, spec: str, folder: Path) -> Answer:
    """By `aeromatch run` into a fresh workspace; with its report where the whole command is timed."""
    preset, own = parse_method(spec)
    pairs = _pair_list(case, folder, ",")
    settings = budget_settings(load(preset, own), case.keypoints)
    settings += [] if case.command else ["run.report=false"]
    settings += ["pairs=file", f"pairs.path={pairs}"] if pairs else []
    work, before = folder / "workspace", children_seconds()
    extra, settings = _given(case, folder), [*settings, *own]
    run = whole_run("run", preset, case.images, work, extra=extra, jobs=case.jobs, settings=settings)
    if not run.answer:
        raise SystemExit(f"aeromatch run {preset} failed with exit code {run.code}:\n{run.said[-2000:]}")
    stages = {name: found["seconds"] for name, found in run.answer["stages"].items()}
    return {
        "tried_pairs": run.answer["stages"]["pairs"]["items"],
        "database": str(work / "export" / "colmap" / "database.db"),
        "seconds": run.seconds if case.command else sum(stages.get(stage, 0.0) for stage in TIMED),
        "processor_seconds": children_seconds() - before,
        "stages": stages,
    }


def _given(case: Case, folder: Path) -> list[str]:
    """Options of the command: poses as asked; the reference's cameras, its ground height beside its own poses alone."""
    if case.poses == "reference":
        return ["--poses", str(case.reference / "poses.csv"), "--cameras", str(case.reference / "block.json")]
    names = [name for name, _ in case.pictures]
    made, _ = worsened(GIVEN[case.poses], case.reference, names, folder)
    return [*made, "--cameras", str(folder / "block.json")]  # the last one counts


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
    tried = len(case.pairs) if case.pairs is not None else math.comb(len(case.pictures), 2)
    return {"tried_pairs": tried, "database": str(database), "seconds": sum(stages.values()), "stages": stages}


def _pair_list(case: Case, folder: Path, separator: str) -> Path | None:
    if case.pairs is None:
        return None
    path = (folder / "pairs.txt").resolve()
    write_text(path, "".join(f"{a}{separator}{b}\n" for a, b in case.pairs))
    return path


def two_series(brightness: Mapping[str, float]) -> tuple[set[str], set[str]]:
    """Names of the darker and of the brighter series: cut where brightness rises by the largest factor."""
    names = sorted(brightness, key=lambda name: brightness[name])
    levels = np.maximum([brightness[name] for name in names], 1.0)
    cut = 1 + int(np.argmax(levels[1:] / levels[:-1]))
    return set(names[:cut]), set(names[cut:])


def pairs_across(block: Block, series: tuple[set[str], set[str]]) -> list[tuple[str, str]]:
    """Image names of the pairs across both series whose footprints share a fifth of the smaller one, whatever the angle
    between both views; sorted.
    """
    everything = {"min_overlap": MIN_OVERLAP, "max_view_angle_deg": 180.0, "max_neighbours": max(1, len(block.images))}
    names = {image.image_id: image.name for image in block.images}
    found = []
    for pair in PAIRINGS["overlap"](**everything)(block):
        first, second = sorted((names[pair.image_id0], names[pair.image_id1]))
        if pair.overlap >= MIN_OVERLAP and (first in series[0]) != (second in series[0]):
            found.append((first, second))
    return sorted(found)


def read_block(images: Path, reference: Path) -> Block:
    """A block with its reference poses, cameras and ground height."""
    with tempfile.TemporaryDirectory() as scratch:
        places = images, reference / "poses.csv", reference / "block.json", Path(scratch)
        return prepared("baseline", ["pairs=exhaustive"], *places, dry=True).block


MAX_IMAGE_ID = 2147483647  # COLMAP's pair_id = id1 * MAX_IMAGE_ID + id2
NamePair = tuple[str, str]


def count_matches(database: Path, reference: Path, only: Collection[NamePair] | None = None) -> dict[str, Any]:
    """Sums over the pairs with at least 15 verified matches; only: those of these image names, sorted within a pair.

    matches: rows. unique_matches: each pair of places once (COLMAP counts a place with two orientations twice).
    within_3px, within_5px: unique ones by symmetric epipolar distance from the reference poses, on undistorted pixels.
    thinned*: of the unique ones, those left one-to-one at 2 px spacing in both images, as in every other table.
    filled_cells, filled_ninths: share of the 16 x 16, 3 x 3 cells of all images that hold one within 3 px.
    """
    truth = load_reference(reference)
    sums = dict.fromkeys(
        ("pairs", "matches", "unique_matches", "within_3px", "within_5px", "thinned", "thinned_3px", "thinned_5px"), 0
    )
    sizes = GRID_CELLS, 3
    filled = {(name, n): np.zeros((n, n), bool) for name in truth.cameras for n in sizes}
    with sqlite3.connect(database) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        points_px = {image_id: _stored_px(*rest) for image_id, *rest in connection.execute(_KEYPOINTS)}
        query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows >= ?"
        for pair_id, rows, data in connection.execute(query, (MIN_INLIERS,)):
            id0, id1 = divmod(pair_id, MAX_IMAGE_ID)
            pair = names[id0], names[id1]
            if only is not None and tuple(sorted(pair)) not in only:
                continue
            idx = np.frombuffer(data, np.uint32).reshape(rows, 2)
            sides = points_px[id0][idx[:, 0]], points_px[id1][idx[:, 1]]
            places = np.unique(np.hstack(sides), axis=0)
            errors_px = np.nan_to_num(truth.errors(*pair, places[:, :2], places[:, 2:]), nan=np.inf)
            for name, side in zip(pair, (places[:, :2], places[:, 2:]), strict=True):
                camera = truth.cameras[name]
                within_image = (side[errors_px <= CORRECT_PX] + 0.5) / [camera.width_px, camera.height_px]
                for n in sizes:
                    filled[name, n][tuple(np.clip((within_image * n).astype(int), 0, n - 1).T)] = True
            kept = errors_px[thin(places[:, :2], places[:, 2:], np.zeros(len(places)))]
            found = (1, rows, len(places), *_within(errors_px), len(kept), *_within(kept))
            sums = {key: total + value for (key, total), value in zip(sums.items(), found, strict=True)}
    counts = [len(places_px) for places_px in points_px.values()]
    shares = [float(np.mean([filled[name, n].mean() for name in names.values()])) for n in sizes]
    return sums | {
        "keypoints_mean": float(np.mean(counts)), "keypoints_max": max(counts),
        "filled_cells": shares[0], "filled_ninths": shares[1],
    }  # fmt: skip


_KEYPOINTS = "SELECT image_id, rows, cols, data FROM keypoints"


def _stored_px(rows: int, columns: int, data: bytes | None) -> FloatArray:
    """Places (K, 2) of COLMAP's keypoints; its origin is the corner."""
    return np.frombuffer(data or b"", np.float32).reshape(rows, columns)[:, :2].astype(np.float64) - 0.5


def _within(errors_px: FloatArray) -> tuple[int, int]:
    return int((errors_px <= CORRECT_PX).sum()), int((errors_px <= WITHIN_PX).sum())
