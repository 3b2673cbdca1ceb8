"""Paper A, J. Geo-inf. Sci. 2025(6): shadow enhancement, simulated views, SIFT and LightGlue, clustered RANSAC.

Every arm's matches are made once and given to every chain of filters. Errors are against exact truth; matches are
thinned to 2 px after the chain. The arms but the whole differ in one or two strategies and have the same matcher:
LightGlue on every pair, on all keypoints, without guidance.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import Settings, load, parse_method
from aeromatch_cli.data import BoolArray, Candidates, FloatArray, PairGeometry
from aeromatch_cli.evaluate.metrics import thin
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.lab.strategies.homography import Homography
from aeromatch_cli.lab.synthetic.write import IN_SHADOW_BELOW
from aeromatch_cli.stages import filter as filtering
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.colour import Colour
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from benchmarks.claims.work import Unit, rendered
from benchmarks.exposure import write_under_exposed
from benchmarks.peers.base import Options
from benchmarks.peers.ours import Preset
from benchmarks.scenes import Judged
from benchmarks.sources import OUR_CODE
from benchmarks.tables import Row

CODE = (*OUR_CODE, "lab/synthetic", "evaluate", "benchmarks/claims/shadow.py", "benchmarks/exposure.py")
SCENES = ("city", "suburb")
SIZE, IMAGES, KEYPOINTS = "800x600", 12, 2048
# LightGlue on every pair, on all keypoints, without guided search: no pair has so many matches that it goes without.
_MATCHER = (
    "match.guided=false,match.only_overlap=false,match.network_below_matches=100000,match.guide_below_matches=100000"
)
PAPER, SHADOW, VIEWS, STEP = "paper", "enhancement", "views", "enhancement + views"
WHOLE, PLAIN = "fusion", "fusion, not enhanced"
ARMS: Mapping[str, str] = {
    PAPER: f"fusion[enhance=none,simulate=none,{_MATCHER}]",
    SHADOW: f"fusion[simulate=none,{_MATCHER}]",
    VIEWS: f"fusion[enhance=none,{_MATCHER}]",
    STEP: f"fusion[{_MATCHER}]",
    WHOLE: "fusion",
    PLAIN: "fusion[enhance=none]",
}
ABOUT: Mapping[str, str] = {
    PAPER: "the paper's baseline: SIFT on the images as taken, LightGlue on every pair, all keypoints, not guided",
    SHADOW: "the same, features of pictures with enhanced shadow, too",
    VIEWS: "the baseline on simulated views",
    STEP: "the baseline with both",
    WHOLE: "the preset, with guided search, and LightGlue where matches are few",
    PLAIN: "the preset without enhancement",
}
# On under-exposed pictures the question is what enhancement brings.
DARK_ARMS = (PAPER, SHADOW, WHOLE, PLAIN)
_LIFTED = "enhance=shadow,enhance.keep_source=false,extract.colours=true"
EXPONENTS: Mapping[str, str] = {
    "not enhanced": "baseline",
    **{f"exponent {value}": f"baseline[{_LIFTED},enhance.region_exponent={value}]" for value in (0.0, 0.25, 1.0)},
}
# Direct RANSAC is swept over thresholds: beside clustered RANSAC stands the one that keeps as many correct matches.
SWEPT_PX = (2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 30, 50)
THRESHOLD_PX = 3
CLUSTERED, CHAIN, DIRECT = "clustered-ransac", "colour + clustered-ransac + epipolar", "homography {} px"
OWN = "of the preset"
_EVERYTHING = 1e300  # false alarms that no pair reaches: direct RANSAC is not held to the test of chance
# Share of the light of a well exposed picture: skylight alone, 8 bits.
UNDER_EXPOSED = 0.06
_STREAM = 211


def units(seed: int, pairs: int, out: Path) -> list[Unit]:
    found = []
    for scene in SCENES:
        for dark in (False, True):
            arms = {name: ARMS[name] for name in (DARK_ARMS if dark else ARMS)}
            for name, spec in {**arms, **EXPONENTS}.items():
                label = f"{scene}{', under-exposed' if dark else ''}: {name}"
                found.append(Unit(label, rows_of, (scene, dark, name, spec, seed, pairs, out), CODE))
    return found


def settings() -> list[Settings]:
    return [load(*parse_method(spec)) for spec in (*ARMS.values(), *EXPONENTS.values())]


def scenes(seed: int, pairs: int, out: Path) -> list[tuple[object, ...]]:
    """Arguments of `work.rendered`."""
    return [(scene, "mixed", SIZE, IMAGES, pairs, "hard", seed, out) for scene in SCENES]


def scene_of(scene: str, seed: int, pairs: int, out: Path, *, dark: bool = False) -> Judged:
    """Hard pairs of a block of two sorties with two suns; rendered unless it is there."""
    judged = rendered(scene, "mixed", SIZE, IMAGES, pairs, "hard", seed, out)
    return under_exposed(judged, seed) if dark else judged


def under_exposed(judged: Judged, seed: int) -> Judged:
    """The same pairs of pictures taken with 0.06 of the light."""
    source = judged.scene.images
    images = source.parent / "under_exposed"
    if not images.is_dir():
        scratch = source.parent / "under_exposed.tmp"
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        for order, path in enumerate(sorted(source.iterdir())):
            rng = np.random.default_rng([seed, _STREAM, order])
            write_under_exposed(path, scratch / path.name, UNDER_EXPOSED, rng)
        scratch.rename(images)
    return replace(judged, scene=replace(judged.scene, images=images), key=f"{judged.key} under-exposed")


@dataclass(frozen=True, eq=False)
class Given:
    """Matches of one pair. errors_px: (M,) against truth, NaN where there is none. correct, dark: (M,) bool, dark where
    either side lies in cast shadow."""

    candidates: Candidates
    geometry: PairGeometry
    scores: FloatArray
    errors_px: FloatArray
    correct: BoolArray
    dark: BoolArray
    chain: tuple[Any, ...]


def rows_of(scene: str, dark: bool, arm: str, spec: str, seed: int, pairs: int, out: Path) -> list[Row]:
    """Of one arm on one scene: a row for every pair and chain of filters."""
    judged = scene_of(scene, seed, pairs, out, dark=dark)
    rows = []
    for pair, given in _given(judged, spec, seed):
        suns = len({judged.truth.truth.sorties[name] for name in pair})
        head = {"paper": "A", "arm": arm, "scene": scene, "pair": " ".join(pair), "suns": suns, "under_exposed": dark}
        # One homography for all, or planes: what makes the matches decides nothing about it.
        asked = chains(given) if arm in ARMS and not dark else {OWN: (given.candidates, given.chain)}
        for name, (candidates, chain) in asked.items():
            rows.append(head | {"chain": name, "input": len(candidates)} | _judged(given, candidates, chain, seed))
    return rows


def _given(judged: Judged, spec: str, seed: int) -> Iterator[tuple[tuple[str, str], Given]]:
    name, own = parse_method(spec)
    preset = Preset(judged.scene, Options(KEYPOINTS, "image", 1, seed, None), preset=name, settings=tuple(own))
    known: dict[str, Any] = {}
    for pair in judged.pairs:
        for image in pair.images:
            if image not in known:
                known[image] = preset.features(image)
        names = pair.images
        if (preset.id_of[names[0]], preset.id_of[names[1]]) not in preset.pair_of:
            names = names[::-1]
        features = [known[image] for image in names]
        geometry = preset.context.geometry(preset.pair_of[(preset.id_of[names[0]], preset.id_of[names[1]])])
        matches = preset.context.settings.match(*features, geometry)
        found = filtering.candidates(matches, *((side.keypoints_px, side.colours) for side in features))
        errors_px, hidden = judged.truth.errors(*names, found.points0_px, found.points1_px)
        correct = ~hidden & (np.where(np.isfinite(errors_px), errors_px, np.inf) <= CORRECT_PX)
        sides = zip(names, (found.points0_px, found.points1_px), strict=True)
        dark = np.logical_or(*(in_shadow(judged, image, points) for image, points in sides))
        scores = matches.scores.astype(np.float64)
        yield pair.images, Given(found, geometry, scores, errors_px, correct, dark, preset.context.settings.filter)


def in_shadow(judged: Judged, image: str, points_px: FloatArray) -> BoolArray:
    """(N,) which stored pixels lie in cast shadow."""
    truth = judged.truth.truth
    sun, surface = truth.sun(image), truth.surface(image)
    x, y = np.rint(np.clip(points_px, 0, np.array(sun.shape[1::-1]) - 1)).astype(int).T
    return np.asarray((sun[y, x] < IN_SHADOW_BELOW) & (surface[y, x] > 0))


def chains(given: Given) -> dict[str, tuple[Candidates, tuple[Any, ...]]]:
    """Matches and filters by name: direct and clustered RANSAC, the whole chain, and what single steps of it bring."""
    full, gray = given.candidates, replace(given.candidates, colours0=None, colours1=None)
    clustered = ClusteredRansac(threshold_px=THRESHOLD_PX)
    found: dict[str, tuple[Candidates, tuple[Any, ...]]] = {OWN: (full, given.chain)}
    for threshold in SWEPT_PX:
        direct = Homography(threshold_px=threshold, max_false_alarms=_EVERYTHING)
        found[DIRECT.format(threshold)] = full, (direct,)
    found[CLUSTERED] = full, (clustered,)
    found[CHAIN] = full, (Colour(), clustered, Epipolar())
    found["clustered-ransac + epipolar"] = full, (clustered, Epipolar())
    found["epipolar"] = full, (Epipolar(),)
    found["colour + epipolar"] = full, (Colour(), Epipolar())
    found["K by count"] = gray, (clustered,)
    for fixed in (1, 4, 8, 16):
        found[f"K = {fixed}"] = full, (ClusteredRansac(threshold_px=THRESHOLD_PX, clusters=fixed),)
    return found


def _judged(given: Given, candidates: Candidates, chain: Sequence[Any], seed: int) -> Row:
    verdict = apply_chain(chain, candidates, given.geometry, seed)
    keep = verdict.keep if verdict.state == "verified" else np.zeros_like(verdict.keep)
    kept = np.flatnonzero(keep)
    kept = kept[thin(candidates.points0_px[kept], candidates.points1_px[kept], given.scores[kept])]
    errors = given.errors_px[kept][np.isfinite(given.errors_px[kept])]
    correct, dark = given.correct[kept], given.dark[kept]
    return {
        "kept": len(kept), "correct": int(correct.sum()), "wrong": int((~correct).sum()),
        "correct_in_shadow": int((correct & dark).sum()), "errors": len(errors),
        "error_sum_px": round(float(errors.sum()), 3),
    }  # fmt: skip
