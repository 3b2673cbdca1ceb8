"""Paper C, J. Geo-inf. Sci. 2021(10): learned features of oblique pairs beside SIFT, ASIFT, SuperPoint, GeoDesc,
ContextDesc, at equal descriptors per image, by exact truth.

The real GeoDesc and ContextDesc cannot be had here. Their stand-ins are SIFT's keypoints with this project's
descriptor, without and with context, on the images as taken, as the papers used them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aeromatch_cli.config import Settings, load, parse_method
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.stages import filter as filtering
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from benchmarks.claims.work import Unit, rendered
from benchmarks.peers.base import Options
from benchmarks.peers.ours import Preset
from benchmarks.peers.table import PEERS, method, missing_weights
from benchmarks.scenes import Judged, JudgedPair
from benchmarks.sources import OUR_CODE, PEER_CODE
from benchmarks.tables import Row, plain

CODE = (*OUR_CODE, *PEER_CODE, "lab/synthetic", "evaluate", "benchmarks/claims/features.py")
SCENES = ("city", "hills")
SIZE, IMAGES, KEYPOINTS = "800x600", 20, 2048
OBLIQUE_DEG = 40.0
_AS_TAKEN = "simulate=none,match=bidirectional,match.ratio=0.9"
SUPERPOINT, STEP, RECTIFIED, WHOLE = "SuperPoint", "learned features", "SIFT on rectified views", "oblique"
RIVALS: Mapping[str, str] = {
    "SIFT": "opencv-sift",
    "ASIFT": "opencv-asift",
    SUPERPOINT: "superpoint",
    "GeoDesc, stand-in": f"oblique[{_AS_TAKEN},extract.detector=sift]",
    "ContextDesc, stand-in": f"oblique[{_AS_TAKEN},extract.detector=sift,extract.context=true]",
}
OURS: Mapping[str, str] = {STEP: f"oblique[{_AS_TAKEN}]", RECTIFIED: "opencv-sift@ground", WHOLE: "oblique"}
ABOUT: Mapping[str, str] = {
    "SIFT": "OpenCV's, with the ratio test, on the images as taken",
    "ASIFT": "OpenCV's, the same number of descriptors over all its views",
    SUPERPOINT: "with the published weights, on the images as taken",
    "GeoDesc, stand-in": "SIFT keypoints with this project's descriptor, on the images as taken, the same test",
    "ContextDesc, stand-in": "the same with context in the descriptor",
    STEP: "this project's keypoints and descriptor, on the images as taken, the ratio test from either image",
    RECTIFIED: "OpenCV's SIFT on this project's ground views",
    WHOLE: "the preset, with LightGlue and guided search",
}
RATIOS = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
TWO_WAY, ONE_WAY = "two-way", "one-way"


def units(seed: int, pairs: int, weights: Path | None, out: Path) -> list[Unit]:
    asked = {name: spec for name, spec in {**RIVALS, **OURS}.items() if not missing_weights(spec, weights)}
    found = [
        Unit(f"{scene}: {name}", rows_of, (scene, name, spec, seed, pairs, weights, out), CODE)
        for scene in SCENES
        for name, spec in asked.items()
    ]
    return found + [Unit(f"{scene}: ratio test", ratio_rows, (scene, seed, pairs, out), CODE) for scene in SCENES]


def settings() -> list[Settings]:
    return [load(*parse_method(spec)) for spec in (*RIVALS.values(), *OURS.values()) if spec not in PEERS]


def scenes(seed: int, pairs: int, out: Path) -> list[tuple[object, ...]]:
    """Arguments of `work.rendered`."""
    return [(scene, "oblique", SIZE, IMAGES, 2 * pairs, "angles", seed, out) for scene in SCENES]


def _oblique(scene: str, seed: int, pairs: int, out: Path) -> tuple[Judged, list[JudgedPair]]:
    """A block of a five-camera rig, and those of its pairs that differ by 40 degrees or more: half of them, where it
    has as many."""
    judged = rendered(scene, "oblique", SIZE, IMAGES, 2 * pairs, "angles", seed, out)
    return judged, [pair for pair in judged.pairs if pair.conditions.view_angle_deg >= OBLIQUE_DEG]


def rows_of(scene: str, name: str, spec: str, seed: int, count: int, weights: Path | None, out: Path) -> list[Row]:
    judged, pairs = _oblique(scene, seed, count, out)
    asked = method(spec)(judged.scene, Options(KEYPOINTS, "image", 1, seed, weights))
    known = {image: asked.features(image) for image in sorted({image for pair in pairs for image in pair.images})}
    rows = []
    for pair in pairs:
        found = asked.match(*pair.images, *(known[image] for image in pair.images))
        answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
        score = judged.truth.judge(*pair.images, *answer).row()
        head = {"paper": "C", "section": "features", "method": name, "scene": scene, "pair": " ".join(pair.images)}
        fields = "kept", "correct", "possible", "coverage", "median_error_px"
        rows.append(head | {field: plain(score[field]) for field in fields})
    return rows


def ratio_rows(scene: str, seed: int, count: int, out: Path) -> list[Row]:
    """The ratio test from either image and from one, on the features of the preset, before and after one filter."""
    judged, pairs = _oblique(scene, seed, count, out)
    preset = Preset(
        judged.scene, Options(KEYPOINTS, "image", 1, seed, None), preset="oblique", settings=("match=bidirectional",)
    )
    known = {image: preset.features(image) for image in sorted({image for pair in pairs for image in pair.images})}
    rows = []
    for pair in pairs:
        names = pair.images
        if (preset.id_of[names[0]], preset.id_of[names[1]]) not in preset.pair_of:
            names = names[::-1]
        geometry = preset.context.geometry(preset.pair_of[(preset.id_of[names[0]], preset.id_of[names[1]])])
        features = [known[image] for image in names]
        for ratio in RATIOS:
            for kind, matcher in ((TWO_WAY, Bidirectional(ratio=ratio)), (ONE_WAY, Nearest(ratio=ratio))):
                matches = matcher(*features, geometry)
                found = filtering.candidates(matches, *((side.keypoints_px, side.colours) for side in features))
                errors_px, hidden = judged.truth.errors(*names, found.points0_px, found.points1_px)
                right = ~hidden & (np.where(np.isfinite(errors_px), errors_px, np.inf) <= CORRECT_PX)
                verdict = apply_chain((Epipolar(),), found, geometry, seed)
                keep = verdict.keep & (verdict.state == "verified")
                rows.append({
                    "paper": "C", "section": "ratio", "scene": scene, "pair": " ".join(names), "test": kind,
                    "ratio": ratio, "correct": int(right.sum()), "wrong": int((~right).sum()),
                    "filtered_correct": int((right & keep).sum()), "filtered_wrong": int((~right & keep).sum()),
                })  # fmt: skip
    return rows
