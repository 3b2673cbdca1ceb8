"""COLMAP's steps of `bench blocks`, each in a process of its own: pycolmap ends the whole process on a fault, and takes
over signals."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.colmap import colmap_options, imported_pycolmap
from benchmarks.processes import fresh_process

THRESHOLD_PX = 4.0
Figures = dict[str, Any]


def run_step(step: Callable[..., Figures], *given: Any) -> Figures:
    """Figures of one step in a fresh process. SystemExit where that dies."""
    with fresh_process() as process:
        try:
            return process.submit(step, *given).result()
        except BrokenProcessPool as error:
            raise SystemExit(f"{step.__name__}: its process died ({error})") from error


def colmap_extract(images: Path, reference: Path, database: Path, keypoints: int, jobs: int, cut: bool) -> Figures:
    """COLMAP's SIFT on the CPU with the reference camera. cut: to exactly so many keypoints, untimed."""
    pycolmap = imported_pycolmap()
    block = json.loads((reference / "block.json").read_text(encoding="utf-8"))
    camera = next(iter(block["cameras"].values()))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera["model"]
    reader.camera_params = ",".join(repr(float(p)) for p in camera["params"])
    extraction, _, _ = colmap_options(keypoints, jobs)
    single = pycolmap.CameraMode.SINGLE
    started = time.perf_counter()
    pycolmap.extract_features(
        database, images, camera_mode=single, reader_options=reader, extraction_options=extraction
    )
    seconds = time.perf_counter() - started
    if cut:
        cut_to_budget(database, keypoints)
    return {"seconds": seconds}


def colmap_extract_exif(images: Path, database: Path, keypoints: int, jobs: int) -> Figures:
    """COLMAP's SIFT on the CPU with one camera by EXIF; keypoints cut to the budget, untimed."""
    pycolmap = imported_pycolmap()
    extraction, _, _ = colmap_options(keypoints, jobs)
    started = time.perf_counter()
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction)
    seconds = time.perf_counter() - started
    cut_to_budget(database, keypoints)
    return {"seconds": seconds}


def cut_to_budget(database: Path, budget: int) -> None:
    """Keep the keypoints of the largest scale of every image."""
    with sqlite3.connect(database) as connection:
        for image_id, rows, columns, data in connection.execute("SELECT * FROM keypoints").fetchall():
            if rows <= budget:
                continue
            keypoints = np.frombuffer(data, np.float32).reshape(rows, columns)
            areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
            kept = np.sort(np.argsort(-areas, kind="stable")[:budget])
            query = "SELECT cols, data FROM descriptors WHERE image_id = ?"
            width, descriptors = connection.execute(query, (image_id,)).fetchone()
            described = np.frombuffer(descriptors, np.uint8).reshape(rows, -1)[kept]
            for name, values, cols in (("keypoints", keypoints[kept], columns), ("descriptors", described, width)):
                connection.execute(
                    f"UPDATE {name} SET rows = ?, cols = ?, data = ? WHERE image_id = ?",
                    (budget, cols, np.ascontiguousarray(values).tobytes(), image_id),
                )


def colmap_match(database: Path, jobs: int, guided: bool, pairs: Path | None) -> Figures:
    """COLMAP's matching and verification. pairs: a list of them, or None for all."""
    pycolmap = imported_pycolmap()
    _, matching, verification = colmap_options(1, jobs, guided=guided)
    verification.ransac.max_error = THRESHOLD_PX
    started = time.perf_counter()
    if pairs:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = pairs
        pycolmap.match_image_pairs(database, matching, pairing, verification)
    else:
        pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    return {"seconds": time.perf_counter() - started}
