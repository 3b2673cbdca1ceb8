"""A preset of this project, with settings in brackets, run stage by stage in one process."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import Features, FloatArray, Matches, Pair
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.stages import extract
from aeromatch_cli.stages import filter as filtering
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.strategies.filters import apply_chain
from benchmarks.peers.base import Candidates, Found, Options, Scene, prepared


class Preset:
    """Poses and cameras of the block are given, everything else is the preset's. Its own pairs of the whole block are
    chosen first, from the same poses: views look where the neighbours look, and an image has more of these than the
    judged pairs. Of all pairs only the judged ones are matched.

    An image's features are made by the extract stage (decoding, enhancement, views, writing and reading of its file
    included), a pair's matches by the preset's matcher and its chain of filters, on verified pairs only. Nothing runs
    in other processes; libraries use the benchmark's threads. Distant ground, which peers on ground views do not see,
    has no keypoints of its own, so that the budget is exact.
    """

    def __init__(self, scene: Scene, options: Options, *, preset: str, settings: tuple[str, ...]) -> None:
        self._folder = tempfile.TemporaryDirectory()  # lives as long as this object
        work = Path(self._folder.name)
        budget = [] if options.budget == "image" else [f"extract.budget={options.budget}"]
        # After the settings: a strategy that they name has its own default of keypoints.
        own = [*settings, f"extract.keypoints={options.keypoints}", *budget]
        if hasattr(load(preset, own).simulate, "far_ground") and not any("far_ground" in one for one in settings):
            own.append("simulate.far_ground=false")
        places = scene.images, scene.poses, scene.block, work / "work"
        chosen = prepared(preset, own, *places, seed=options.seed)
        names = chosen.block.names
        both = {(names[pair.image_id0], names[pair.image_id1]) for pair in chosen.pairs} | set(scene.pairs)
        listed = work / "pairs.txt"
        listed.write_text("".join(f"{a},{b}\n" for a, b in sorted(both)), encoding="utf-8")
        own += ["pairs=file", f"pairs.path={listed}"]
        self.context = prepared(preset, own, *places, seed=options.seed)
        self.id_of = {image.name: image.image_id for image in self.context.block.images}
        self.pair_of = {(pair.image_id0, pair.image_id1): pair for pair in self.context.pairs}

    def features(self, image: str) -> Features:
        task = extract.task_of(self.context, self.id_of[image])
        extract.run_task(task)
        return read_features(task.path)

    def candidates(self, image0: str, image1: str, features0: Features, features1: Features) -> Candidates:
        ids = self.id_of[image0], self.id_of[image1]
        if ids not in self.pair_of:  # ids sort otherwise than names
            points1, points0, scores = self.candidates(image1, image0, features1, features0)
            return points0, points1, scores
        matches = self._matches(self.pair_of[ids], features0, features1)
        rows0, rows1 = matches.indices.T
        points = features0.keypoints_px[rows0].astype(np.float64), features1.keypoints_px[rows1].astype(np.float64)
        return *points, matches.scores.astype(np.float64)

    def _matches(self, pair: Pair, features0: Features, features1: Features) -> Matches:
        return self.context.settings.match(features0, features1, self.context.geometry(pair))

    def match(self, image0: str, image1: str, features0: Features, features1: Features) -> Found:
        ids = self.id_of[image0], self.id_of[image1]
        if ids not in self.pair_of:  # ids sort otherwise than names
            return _turned(self.match(image1, image0, features1, features0))
        pair: Pair = self.pair_of[ids]
        geometry = self.context.geometry(pair)
        matches = self._matches(pair, features0, features1)
        sides = [(features.keypoints_px, features.colours) for features in (features0, features1)]
        candidates = filtering.candidates(matches, *sides)
        seed = BlockState.of(self.context).seed(pair)
        verdict = apply_chain(self.context.settings.filter, candidates, geometry, seed)
        sides_enhanced = [f.view_enhanced[v] for f, v in zip((features0, features1), matches.view_pairs.T, strict=True)]
        enhanced = bool(np.any(sides_enhanced))
        keep = verdict.keep if verdict.state == "verified" else np.zeros_like(verdict.keep)
        return Found(
            points0_px=candidates.points0_px[keep],
            points1_px=candidates.points1_px[keep],
            scores=matches.scores[keep].astype(np.float64),
            keypoints0_px=_entered(features0, enhanced)[0],
            keypoints1_px=_entered(features1, enhanced)[0],
            descriptors=(_entered(features0, enhanced)[1] + _entered(features1, enhanced)[1]) / 2,
        )


def _entered(features: Features, enhanced: bool) -> tuple[FloatArray, int]:
    """Places (K, 2) and number of the descriptors that a pair used: of the enhanced picture or of that as taken."""
    of_picture = features.view_enhanced == (enhanced and bool(features.view_enhanced.any()))
    described = features.descriptor_keypoint_idx[of_picture[features.view_idx]]
    return features.keypoints_px[np.unique(described)].astype(np.float64), len(described)


def _turned(found: Found) -> Found:
    points, keypoints = (found.points1_px, found.points0_px), (found.keypoints1_px, found.keypoints0_px)
    return Found(*points, found.scores, *keypoints, found.descriptors)
