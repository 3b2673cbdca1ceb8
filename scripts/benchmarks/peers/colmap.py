"""Peers `pycolmap` and `pycolmap-guided`."""

from __future__ import annotations

import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import colmap_camera
from benchmarks.peers.base import MIN_INLIERS, Described, Found, Options, Scene, found, read_gray
from benchmarks.peers.matching import RATIO
from benchmarks.peers.opencv import CONTRAST_THRESHOLD

PEAK_THRESHOLD = CONTRAST_THRESHOLD / 3  # OpenCV divides by its octave layers inside


class Colmap:
    """COLMAP's CPU SIFT (RootSIFT), its matcher (mutual, ratio 0.8, distance 0.7) and its two-view verification.

    Known cameras with prior focal length, so that it verifies by E, F and H as COLMAP does for calibrated images, at
    4 px. The peak threshold is halved to 0.0033, the contrast of `opencv-sift`, so that weak texture reaches the budget
    (rendered grass: 1.4 times the correct matches; city: the same). Its own limit keeps whole scale levels (up to 45 %
    more than asked): the largest scales are kept up to exactly B, by its own rule. Extraction is called per image (one
    thread: its SIFT has no more), matching and verification per pair through its database, whose matcher is 20 times as
    fast as `FeatureMatcher`.
    `pycolmap-guided` adds COLMAP's guided matching.
    """

    def __init__(self, scene: Scene, options: Options, *, guided: bool = False) -> None:
        pycolmap = imported_pycolmap()
        self.scene, self.options = scene, options
        extraction, self.matching, self.verification = colmap_options(
            options.keypoints, options.threads, guided=guided, seed=options.seed
        )
        extraction.sift.peak_threshold = PEAK_THRESHOLD
        self.extractor = pycolmap.FeatureExtractor.create(extraction, pycolmap.Device.cpu)
        self._folder = tempfile.TemporaryDirectory()  # lives as long as this object
        self.list, self.path = Path(self._folder.name) / "pair.txt", Path(self._folder.name) / "database.db"
        self.database = pycolmap.Database.open(self.path)
        self.ids = {name: self._register(name, camera) for name, camera in scene.cameras.items()}

    def _register(self, image: str, camera: Camera) -> int:
        import pycolmap

        size = {"width": camera.width_px, "height": camera.height_px}
        model, params = colmap_camera(camera)
        lens = pycolmap.Camera(model=model, params=list(params), has_prior_focal_length=True, **size)
        entry = pycolmap.Image(name=image, camera_id=self.database.write_camera(lens))
        return int(self.database.write_image(entry))

    def features(self, image: str) -> Described:
        import pycolmap

        keypoints, descriptors = self.extractor.extract_from_uint8_array(read_gray(self.scene, image))
        table = np.array([(k.x, k.y, k.a11, k.a12, k.a21, k.a22) for k in keypoints], np.float32).reshape(-1, 6)
        areas = np.abs(table[:, 2] * table[:, 5] - table[:, 3] * table[:, 4])
        order = np.argsort(-areas, kind="stable")[: self.options.keypoints]
        rows = np.ascontiguousarray(descriptors.data[order])
        if not self.database.exists_keypoints(self.ids[image]):
            self.database.write_keypoints(self.ids[image], table[order])
            own = pycolmap.FeatureDescriptors(descriptors.type, rows)
            self.database.write_descriptors(self.ids[image], own)
        return Described(table[order, :2].astype(np.float64) - 0.5, rows.astype(np.float32))

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        import pycolmap

        self.list.write_text(f"{image0} {image1}\n", encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self.list
        self.database.clear_matches()  # else a pair that was matched before is passed over
        self.database.clear_two_view_geometries()
        pycolmap.match_image_pairs(self.path, self.matching, pairing, self.verification)
        geometry = self.database.read_two_view_geometry(self.ids[image0], self.ids[image1])
        kept = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        points0, points1 = features0.places_px[kept[:, 0]], features1.places_px[kept[:, 1]]
        return found(features0, features1, points0, points1, np.ones(len(kept)))


def imported_pycolmap() -> Any:
    """The module, its messages on errors alone."""
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 2
    return pycolmap


def colmap_options(keypoints: int, threads: int, *, guided: bool = False, seed: int = 0) -> tuple[Any, Any, Any]:
    """Of extraction, matching and verification, on the CPU."""
    pycolmap = imported_pycolmap()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, threads, 100_000
    extraction.sift.max_num_features = keypoints
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads, matching.guided_matching = False, threads, guided
    matching.sift.max_ratio, matching.sift.cross_check = RATIO, True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers, verification.ransac.random_seed = MIN_INLIERS, seed
    return extraction, matching, verification
