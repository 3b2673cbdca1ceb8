"""ALIKED with LightGlue, the strongest published chain, as its users run it: source images, all pairs, and COLMAP's own
verification and mapping behind."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.auto.colmap import in_process
from benchmarks.peers.base import Described, Options, Scene
from benchmarks.peers.colmap import colmap_options, imported_pycolmap
from benchmarks.peers.table import PEERS

CHAIN = "aliked+lightglue"


def matched_by_lightglue(
    images: Path, database: Path, *, keypoints: int, max_size_px: int, jobs: int, weights: Path | None
) -> float:
    """Seconds of features, LightGlue on all pairs, and COLMAP's verification; one camera by EXIF."""
    database.unlink(missing_ok=True)
    return in_process(_match, images, database, keypoints, max_size_px, jobs, weights)


def _match(images: Path, database: Path, keypoints: int, max_size_px: int, jobs: int, weights: Path | None) -> float:
    pycolmap = imported_pycolmap()
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.SINGLE)
    names = sorted(path.name for path in images.iterdir())
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch, pycolmap.Database.open(database) as opened:
        scales = reduced(images, names, Path(scratch), max_size_px)
        scene = Scene("block", Path(scratch), Path(), Path(), {}, ())
        chain: Any = PEERS[CHAIN](scene, Options(keypoints, "image", jobs, 0, weights))
        features: Mapping[str, Described] = {name: chain.features(name) for name in names}
        ids = {name: opened.read_image_with_name(name).image_id for name in names}
        for name, one in features.items():
            places = (one.places_px + 0.5) * scales[name]  # COLMAP counts from the corner of the first pixel
            opened.write_keypoints(ids[name], places.astype(np.float32))
        listed = Path(scratch) / "pairs.txt"
        for first, second in combinations(names, 2):
            rows, _ = chain.rows(features[first], features[second])
            opened.write_matches(ids[first], ids[second], rows.astype(np.uint32))
        listed.write_text("".join(f"{a} {b}\n" for a, b in combinations(names, 2)), encoding="utf-8")
        pycolmap.verify_matches(database, listed, colmap_options(keypoints, jobs)[2])
    return time.perf_counter() - started


def reduced(images: Path, names: list[str], folder: Path, max_size_px: int) -> dict[str, float]:
    """Writes images of at most this size; how much larger each is as stored."""
    import cv2

    scales = {}
    for name in names:
        pixels = cv2.imread(str(images / name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            raise SystemExit(f"cannot decode {images / name}")
        scales[name] = max(1.0, max(pixels.shape[:2]) / max_size_px)
        size = tuple(round(side / scales[name]) for side in pixels.shape[1::-1])
        encoded = cv2.imencode(".png", cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))[1]
        (folder / name).write_bytes(encoded.tobytes())  # decoders go by the content, whatever the name
    return scales
