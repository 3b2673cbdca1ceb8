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

from aeromatch_cli.data import FloatArray
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
    with tempfile.TemporaryDirectory() as scratch, pycolmap.Database.open(database) as opened:
        scales = reduced(images, names, Path(scratch), max_size_px)
        started = time.perf_counter()
        scene = Scene("block", Path(scratch), Path(), Path(), {}, ())
        chain: Any = PEERS[CHAIN](scene, Options(keypoints, "image", jobs, 0, weights))
        features: Mapping[str, Described] = {name: chain.features(name) for name in names}
        ids = {name: opened.read_image_with_name(name).image_id for name in names}
        for name, one in features.items():
            opened.write_keypoints(ids[name], corner_places(one.places_px, scales[name]).astype(np.float32))
        pairs = list(combinations(names, 2))
        for first, second in pairs:
            rows, _ = chain.rows(features[first], features[second])
            opened.write_matches(ids[first], ids[second], rows.astype(np.uint32))
        listed = Path(scratch) / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        pycolmap.verify_matches(database, listed, colmap_options(keypoints, jobs)[2])
        return time.perf_counter() - started


def corner_places(places_px: FloatArray, scale: FloatArray) -> FloatArray:
    """Places (N, 2) of a reduced image in the stored one, from the corner of its first pixel, as COLMAP counts.

    scale: (2,) stored pixels in a reduced one, along x and y.
    """
    return np.asarray((places_px + 0.5) * scale)


def reduced(images: Path, names: list[str], folder: Path, max_size_px: int) -> dict[str, FloatArray]:
    """Writes images of at most this size; how much larger each is as stored, (2,) along x and y."""
    import cv2

    scales = {}
    for name in names:
        pixels = cv2.imread(str(images / name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            raise SystemExit(f"cannot decode {images / name}")
        stored = np.array(pixels.shape[1::-1])
        size = np.rint(stored / max(1.0, stored.max() / max_size_px)).astype(int)
        scales[name] = stored / size
        encoded = cv2.imencode(".png", cv2.resize(pixels, size.tolist(), interpolation=cv2.INTER_AREA))[1]
        (folder / name).write_bytes(encoded.tobytes())  # decoders go by the content, whatever the name
    return scales
