"""pycolmap's own chain, each step in a process of its own: a fault of it ends the whole process."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from benchmarks.peers.colmap import colmap_options, imported_pycolmap
from benchmarks.processes import fresh_process


def matched_by_colmap(images: Path, database: Path, *, keypoints: int, max_size_px: int, jobs: int) -> float:
    """Seconds of COLMAP's SIFT, one camera by EXIF, and exhaustive guided matching. Its limit of keypoints keeps whole
    scale levels, up to 45 % more than asked for."""
    database.unlink(missing_ok=True)
    seconds = in_process(_extract, images, database, keypoints, max_size_px, jobs)
    return seconds + in_process(_match, database, keypoints, jobs)


def in_process(step: Callable[..., float], *given: Any) -> float:
    """What a step returns that runs in a fresh process; SystemExit where that dies."""
    with fresh_process() as process:
        try:
            return process.submit(step, *given).result()
        except BrokenProcessPool as error:
            raise SystemExit(f"the process of {step.__module__}.{step.__name__.strip('_')} died ({error})") from error


def _extract(images: Path, database: Path, keypoints: int, max_size_px: int, jobs: int) -> float:
    pycolmap = imported_pycolmap()
    extraction, _, _ = colmap_options(keypoints, jobs)
    extraction.max_image_size = max_size_px
    started = time.perf_counter()
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction)
    return time.perf_counter() - started


def _match(database: Path, keypoints: int, jobs: int) -> float:
    pycolmap = imported_pycolmap()
    _, matching, verification = colmap_options(keypoints, jobs, guided=True)
    started = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    return time.perf_counter() - started
