"""One step of `bench blocks`, in a process of its own: `steps.py TASK.json` prints its figures as JSON.

pycolmap ends the whole process on a fault and takes over signals; so every step has its own.
"""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

RATIO, THRESHOLD_PX, MIN_INLIERS = 0.8, 4.0, 15
Task = Mapping[str, Any]


def run_step(step: str, folder: Path, **task: Any) -> dict[str, Any]:
    """Figures of one step in a fresh process; its task file lies in `folder`. SystemExit where it fails."""
    path = folder / f"{step}.json"
    path.write_text(json.dumps({"step": step} | task, indent=1, default=str) + "\n", encoding="utf-8")
    done = subprocess.run([sys.executable, __file__, str(path)], check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"step {step} of {folder} failed with exit code {done.returncode}:\n{done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def preset(task: Task) -> dict[str, Any]:
    """Extract, match and filter of a preset, timed; then export, untimed. What an earlier, killed run made is kept:
    seconds are null then.

    task: images, reference, work (folders), preset, set, keypoints (or null), jobs, pairs (list of pairs or null).
    """
    from aeromatch_cli.config import load
    from aeromatch_cli.executor import Executor
    from aeromatch_cli.stages import export, extract, filter, match, pairs  # noqa: A004

    work, reference = Path(task["work"]), Path(task["reference"])
    block = {"images": task["images"], "poses": str(reference / "poses.csv"), "cameras": str(reference / "block.json")}
    top: dict[str, Any] = {"workspace": str(work / "workspace"), "run": {"jobs": task["jobs"]}}
    # A grid has points of its own number, no keypoints.
    limited = task["keypoints"] and hasattr(load(task["preset"], task["set"], block, **top).extract, "keypoints")
    own = [f"extract.keypoints={task['keypoints']}"] if limited else []
    own += ["pairs=file", f"pairs.path={task['pairs']}"] if task["pairs"] else []
    settings = load(task["preset"], [*own, *task["set"]], block, **top)
    with Executor("processes", task["jobs"]) as executor:
        context, _ = pairs.prepare(settings, executor)
        started = time.perf_counter()
        reports = [stage.run(context) for stage in (extract, match, filter)]
        seconds = time.perf_counter() - started
        export.run(context)
    fresh = not any(report.skipped for report in reports)
    return {
        "database": str(context.workspace.export("colmap") / "database.db"),
        "seconds": seconds if fresh else None,
        "stages": {report.stage: report.seconds for report in reports},
    }


def colmap_extract(task: Task) -> dict[str, Any]:
    """COLMAP's SIFT on the CPU with the reference camera. task: images, reference, database, keypoints, jobs, cut."""
    pycolmap = _pycolmap()
    block = json.loads((Path(task["reference"]) / "block.json").read_text(encoding="utf-8"))
    camera = next(iter(block["cameras"].values()))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera["model"]
    reader.camera_params = ",".join(repr(float(p)) for p in camera["params"])
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, task["jobs"], 100000
    extraction.sift.max_num_features = task["keypoints"]
    started = time.perf_counter()
    pycolmap.extract_features(
        task["database"],
        task["images"],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    seconds = time.perf_counter() - started
    if task["cut"]:
        cut_to_budget(Path(task["database"]), task["keypoints"])
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


def colmap_match(task: Task) -> dict[str, Any]:
    """COLMAP's matching and verification. task: database, jobs, guided, pairs (a file, or null for all pairs)."""
    pycolmap = _pycolmap()
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads, matching.guided_matching = False, task["jobs"], task["guided"]
    matching.sift.max_ratio, matching.sift.cross_check = RATIO, True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.max_error, verification.min_num_inliers = THRESHOLD_PX, MIN_INLIERS
    verification.ransac.random_seed = 0
    started = time.perf_counter()
    if task["pairs"]:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = task["pairs"]
        pycolmap.match_image_pairs(task["database"], matching, pairing, verification)
    else:
        options = {"matching_options": matching, "verification_options": verification}
        pycolmap.match_exhaustive(task["database"], **options)
    return {"seconds": time.perf_counter() - started}


def mapping(task: Task) -> dict[str, Any]:
    """The largest model of pycolmap's incremental mapping. task: images, database, work."""
    from aeromatch_cli.evaluate.mapping import map_database

    return map_database(Path(task["database"]), Path(task["images"]))


def _pycolmap() -> Any:
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 2
    return pycolmap


STEPS: Mapping[str, Callable[[Task], dict[str, Any]]] = {
    "preset": preset,
    "colmap_extract": colmap_extract,
    "colmap_match": colmap_match,
    "mapping": mapping,
}

if __name__ == "__main__":
    given = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    print(json.dumps(STEPS[given["step"]](given)))
