"""What a consumer gets from an exported database: pycolmap's mapping, incremental or global.

Run as a module: DATABASE IMAGES OUT.json MAPPER. A process of its own, since pycolmap stops the whole process on a
fault.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any, Literal

Mapper = Literal["incremental", "global"]


def map_both(database: Path, images_folder: Path | None) -> dict[str, Any]:
    """Figures of incremental mapping, and under `global` those of global mapping."""
    found = map_database(database, images_folder)
    return found if "skipped" in found else found | {"global": map_database(database, images_folder, "global")}


def map_database(
    database: Path, images_folder: Path | None, mapper: Mapper = "incremental", *, attitudes: bool = False
) -> dict[str, Any]:
    """Figures of the largest model: registered, models, points, track_length, reprojection_error_px; and seconds.

    attitudes: also `attitudes`, image name -> rotation (3, 3) cam_from_world of its registered images.

    registered: images that see a point. Global mapping places others, too, by a single pair, at any distance.

    The database is copied first. {"skipped": reason} where there is no database or mapping fails.
    """
    if not database.is_file():
        return {"skipped": f"no {database.name} in {database.parent}: run `aeromatch export` with the colmap exporter"}
    with tempfile.TemporaryDirectory() as scratch:
        copy, out = Path(scratch) / "database.db", Path(scratch) / "mapping.json"
        shutil.copy(database, copy)
        command = [sys.executable, "-m", __name__, str(copy), str(images_folder or scratch), str(out), mapper]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode or not out.is_file():
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            return {"skipped": f"pycolmap's mapping failed with exit code {done.returncode}: {' '.join(said)}"}
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    rotations = found.pop("attitudes", {})
    return found | {"attitudes": rotations} if attitudes else found


def _map(database: Path, images_folder: Path, out: Path, mapper: str) -> None:
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 3
    sparse = out.with_name("sparse")
    sparse.mkdir()
    started = time.perf_counter()
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = options.mapper.random_seed = 0
        models = pycolmap.global_mapping(database, images_folder, sparse, options)
    else:
        one_by_one = pycolmap.IncrementalPipelineOptions()
        one_by_one.random_seed = 0
        models = pycolmap.incremental_mapping(database, images_folder, sparse, options=one_by_one)
    seconds = time.perf_counter() - started
    facts: dict[str, Any] = {"registered": 0, "models": len(models), "seconds": seconds}
    if models:
        best = max(models.values(), key=lambda model: model.num_reg_images())
        seen = [image for image in best.images.values() if image.has_pose and image.num_points3D > 0]
        facts = {
            "registered": len(seen),
            "attitudes": {image.name: image.cam_from_world().rotation.matrix().tolist() for image in seen},
            "models": len(models),
            "seconds": seconds,
            "points": best.num_points3D(),
            "track_length": best.compute_mean_track_length(),
            "reprojection_error_px": best.compute_mean_reprojection_error(),
        }
    out.write_text(json.dumps(facts), encoding="utf-8")


if __name__ == "__main__":
    _map(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4])
