"""Registration of one pair: a start, least squares from coarse to fine, and whether to believe it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.frames import apply_homography, closest_similarity, homography_jacobians
from aeromatch_cli.strategies.matchers.polar.evidence import RegistrationQuality, cell_size_px, evidence
from aeromatch_cli.strategies.matchers.polar.fit import Fit, fit, shared_places
from aeromatch_cli.strategies.matchers.polar.level import Level
from aeromatch_cli.strategies.matchers.polar.pyramid import FINEST_PX, Pyramid, rescaled
from aeromatch_cli.strategies.matchers.polar.start import LEAST_EXPECTED_OVERLAP, Search, candidates, everywhere


@dataclass(frozen=True)
class _Effort:
    """size_px: longer side of the pictures searched. turn_step_deg, scales: tried. followed: candidates, at most.
    hopeless: share of the best's score below which none is followed. ways: to follow each. rivals: most that are looked
    at closely. samples: of the fits, a third of them on the coarse level.
    """

    size_px: float
    turn_step_deg: float
    scales: int
    followed: int
    hopeless: float
    ways: int
    rivals: int
    samples: int


# Most pairs are clear at once. The rest is searched as if time did not matter.
_EFFORTS = (_Effort(48.0, 8.0, 5, 3, 0.75, 1, 2, 6000), _Effort(96.0, 4.0, 9, 8, 0.0, 2, 6, 9000))
# Longer side of the pictures at each step of refinement, px.
_COARSE_PX, _FIRST_PX = 90.0, 180.0
SECOND_PX = 400.0
SCALES = (0.78, 1.28)  # of side 1 over side 0, without a prior: the asked 0.8 to 1.25, and what a search is off
_LEAST_CORRELATION = 0.1
_LARGEST_CONDITION = 1e3  # right ones have 4 to 17
_LEAST_CELLS = 12
_LEAST_AGREEING = 0.5  # over rows alone up to 0.35 do by chance
_LEAST_PREFERRED = 0.8
_CLEAR, _CLEARLY_PREFERRED = 0.75, 0.95
_CREDIBLE = 0.4
# What a prior allows in the end: so much more than its reach, a share of the longer side, and what relief makes.
_STRETCH, _ROUGH = 1.25, 0.01
_ROUGH_TURN_RAD, _ROUGH_LOG_SCALE = np.deg2rad(5.0), 0.1
# What is searched at most, however little a prior says: beyond half a turn turns repeat, and canvases grow with the
# range of scales. A pair that differs by more than a factor of two shares hardly any texture.
_WIDEST_TURN_RAD, _WIDEST_LOG_SCALE = np.pi, np.log(2.0)
# On the finest level: a similarity that is off by more, in the mean, holds in a part of the overlap only.
_BENT_PX = 0.5
_ASTRAY_PX = 5.0  # on the finest level, from what the one before says
_APART, _APART_RAD = 0.035, np.deg2rad(5.0)
_LOST = "the overlap was lost on the way to finer pictures"


@dataclass(frozen=True, eq=False)
class Registration:
    """matrix: (3, 3) similarity, frame px1 from frame px0; of tilted pictures the closest to warp over the overlap.
    warp: (3, 3) homography, the same with tilt. fit: of a similarity on the finest level, in its px; None where that
    was not reached. scale: of that level. reason: why it is not to be believed, "" where it is. preferred: share of the
    overlap that fits no rival better.
    """

    matrix: FloatArray
    warp: FloatArray
    fit: Fit | None
    evidence: RegistrationQuality | None
    scale: float
    reason: str
    preferred: float = 1.0

    @property
    def accepted(self) -> bool:
        return not self.reason

    def turned(self) -> Registration:
        """The same from frame 1; the fit and its evidence stay as they were found."""
        matrices = [np.linalg.inv(matrix) for matrix in (self.matrix, self.warp)]
        return replace(self, matrix=matrices[0], warp=matrices[1] / matrices[1][2, 2])

    @property
    def clear(self) -> bool:
        """Whether there is no need to look elsewhere."""
        proof = self.evidence
        return self.accepted and proof is not None and proof.share >= _CLEAR and self.preferred >= _CLEARLY_PREFERRED


@dataclass(frozen=True, eq=False)
class Prior:
    """expected: (3, 3) frame px1 from frame px0. turn_rad, log_scale, reach_px: how far off it may be."""

    expected: FloatArray
    turn_rad: float
    log_scale: float
    reach_px: float

    def search(self, scale: float, turn_step_deg: float, scale_ratio: float) -> Search:
        """For pictures reduced to `scale`."""
        turns = int(np.ceil(np.rad2deg(min(self.turn_rad, _WIDEST_TURN_RAD)) / turn_step_deg))
        scales = int(np.ceil(min(self.log_scale, _WIDEST_LOG_SCALE) / np.log(scale_ratio)))
        return Search(
            np.deg2rad(turn_step_deg) * np.arange(-turns, turns + 1),
            scale_ratio ** np.arange(-scales, scales + 1.0),
            opposites=False,
            expected=rescaled(self.expected, 1.0, scale),
            reach_px=self.reach_px * scale + 3.0,
            least_overlap=LEAST_EXPECTED_OVERLAP,
        )

    def allows(self, item: Fit, scale: float, longest_px: float) -> bool:
        """Whether a fit of pictures at `scale` says what may be: least squares may slide along rows, out of reach."""
        expected = rescaled(self.expected, 1.0, scale)
        places = [apply_homography(matrix, item.middle_px[None])[0] for matrix in (expected, item.matrix)]
        off_px = float(np.linalg.norm(places[0] - places[1])) / scale
        change = np.log(_factor(item.matrix, item.middle_px) / _factor(expected, item.middle_px))
        return (
            off_px <= _STRETCH * self.reach_px + _ROUGH * longest_px
            and abs(change.imag) <= _STRETCH * self.turn_rad + _ROUGH_TURN_RAD
            and abs(change.real) <= _STRETCH * self.log_scale + _ROUGH_LOG_SCALE
        )


def register(levels: Pyramid, prior: Prior | None = None, scales: tuple[float, float] = SCALES) -> Registration:
    """Similarity between the frames of both sides. scales: smallest and largest, without a prior."""
    best: Registration | None = None
    warps: list[FloatArray] = []
    for effort in _EFFORTS:
        if prior is not None:
            ratio = (SCALES[1] / SCALES[0]) ** (1.0 / (effort.scales - 1))
            search = prior.search(levels.scale(effort.size_px), effort.turn_step_deg, ratio)
        else:
            search = everywhere(effort.turn_step_deg, effort.scales, *scales)
        warps = _ranked(levels, effort, _searched(levels, effort, search), warps, prior)
        best = _refined(levels, warps, prior)
        if best.clear:
            break
    assert best is not None
    return best


def _searched(levels: Pyramid, effort: _Effort, search: Search) -> list[FloatArray]:
    """Similarities (3, 3) between frames that are worth following, best first."""
    scale = levels.scale(effort.size_px)
    (first, valid0), (second, valid1) = levels.pictures(scale)
    found = candidates((first, second), (valid0, valid1), search)[: effort.followed]
    return [rescaled(item.matrix, scale, 1.0) for item in found if item.score >= effort.hopeless * found[0].score]


def _refined(levels: Pyramid, ranked: Sequence[FloatArray], prior: Prior | None) -> Registration:
    """The first of some homographies (3, 3) between frames, followed to the finest level, beside its rivals."""
    if not ranked:
        return Registration(np.eye(3), np.eye(3), None, None, 1.0, "no overlap found")
    second, scale = levels.at(SECOND_PX, even=True), levels.scale(SECOND_PX)
    starts = [rescaled(warp, 1.0, scale) for warp in ranked]
    followed = [fit(*second, start, samples=15_000, still_px=0.01, tilted=True) for start in starts]
    apart = _apart(_allowed(followed, prior, levels, scale), SECOND_PX)
    if not apart:
        return Registration(ranked[0], ranked[0], None, None, scale, _LOST)
    cell = cell_size_px(second[0], apart[0].share)
    judged = [(evidence(*second, item.matrix, cell), item) for item in apart]
    judged.sort(key=lambda item: -item[0].agreeing)
    proof, best = judged[0]
    # What hardly agrees with itself is no rival.
    rivals = [other for other, _ in judged[1:] if other.share > _CREDIBLE * proof.share]
    preferred = min((proof.preferred_to(other) for other in rivals), default=1.0)
    return _finished(levels, best, scale, proof, preferred)


def _finished(levels: Pyramid, best: Fit, scale: float, proof: RegistrationQuality, preferred: float) -> Registration:
    """The best fit of pictures at `scale` on the finest level, unless there is a doubt already."""
    warp = rescaled(best.matrix, scale, 1.0)
    similar = _similar(warp, best.middle_px / scale)
    doubt = _doubt(best, proof, preferred)
    if doubt:
        return Registration(similar, warp, None, proof, scale, doubt, preferred)
    finest, finer = levels.at(FINEST_PX, even=False), levels.scale(FINEST_PX)
    start = rescaled(warp, 1.0, finer)
    tilted = _finest(levels, start)
    if tilted is None:
        return Registration(similar, warp, None, proof, finer, _LOST, preferred)
    found = fit(*finest, rescaled(similar, 1.0, finer), samples=20_000)
    matrix, warp = _straight(*finest, found, tilted), rescaled(tilted.matrix, finer, 1.0)
    doubt = _doubt(tilted, proof, preferred)
    return Registration(rescaled(matrix, finer, 1.0), warp, found, proof, finer, doubt, preferred)


def _finest(levels: Pyramid, start: FloatArray) -> Fit | None:
    """A homography (3, 3) fitted on the finest level. On gray values, which say most; where light differs too much for
    that to converge near where it began, on contrast made even. None where neither does.
    """
    for even in (False, True):
        finest = levels.at(FINEST_PX, even=even)
        found = fit(*finest, start, samples=15_000, still_px=0.01, tilted=True)
        if found is not None and found.converged:
            places = shared_places(*finest, start)
            off = np.linalg.norm(apply_homography(found.matrix, places) - apply_homography(start, places), axis=1)
            if float(np.median(off)) < _ASTRAY_PX:
                return found
    return None


def _straight(level0: Level, level1: Level, found: Fit | None, tilted: Fit) -> FloatArray:
    """The similarity of a pair: as fitted, or the closest to the homography where tilt makes more of it than that."""
    places = shared_places(level0, level1, tilted.matrix)
    there = apply_homography(tilted.matrix, places)
    if found is not None:
        off = np.linalg.norm(apply_homography(found.matrix, places) - there, axis=1)
        if float(np.sqrt(np.mean(off**2))) < _BENT_PX:
            return found.matrix
    return closest_similarity(places, there)


def _ranked(
    levels: Pyramid,
    effort: _Effort,
    starts: Sequence[FloatArray],
    others: Sequence[FloatArray],
    prior: Prior | None,
) -> list[FloatArray]:
    """Homographies (3, 3) between frames: what a coarse level makes of starts and says different things, in order.

    starts: similarities (3, 3) between frames. others: homographies that are to be compared too.
    """
    first, scale = levels.at(_FIRST_PX, even=True), levels.scale(_FIRST_PX)
    fits = [_risen(levels, start, effort) for start in starts]
    fits += [fit(*first, rescaled(warp, 1.0, scale), samples=effort.samples, tilted=True) for warp in others]
    apart = _apart(_allowed(fits, prior, levels, scale), _FIRST_PX)
    return [rescaled(item.matrix, scale, 1.0) for item in apart[: effort.rivals + len(others)]]


def _risen(levels: Pyramid, start: FloatArray, effort: _Effort) -> Fit | None:
    """A start (3, 3) between frames fitted on the coarse level and on the next, with tilt.

    What is fitted with tilt at once may slide along rows, what is not may be too far off: thorough is to try both.
    """
    coarse, scale = levels.at(_COARSE_PX, even=True), levels.scale(_COARSE_PX)
    first, finer = levels.at(_FIRST_PX, even=True), levels.scale(_FIRST_PX)
    plain = fit(*coarse, rescaled(start, 1.0, scale), samples=effort.samples // 3, still_px=0.05)
    bent = plain and fit(*coarse, plain.matrix, samples=effort.samples // 3, still_px=0.05, tilted=True)
    # What shares a tenth is too small on the coarse level: the search has found it to a pixel or two there.
    ways = [item.matrix for item in (bent, plain) if item is not None] or [rescaled(start, 1.0, scale)]
    starts = [rescaled(way, scale, finer) for way in ways[: effort.ways]]
    fits = [fit(*first, way, samples=effort.samples, still_px=0.03, tilted=True) for way in starts]
    return max((item for item in fits if item is not None), key=_significance, default=None)


def _significance(item: Fit) -> float:
    """Correlation in deviations of chance, but for a factor: samples that resemble their neighbours."""
    return item.correlation * float(np.sqrt(item.samples))


def _allowed(fits: list[Fit | None], prior: Prior | None, levels: Pyramid, scale: float) -> list[Fit | None]:
    """Those of pictures at `scale` that a prior does not rule out."""
    if prior is None:
        return fits
    return [item for item in fits if item is not None and prior.allows(item, scale, levels.longest_px)]


def _apart(fits: Sequence[Fit | None], side_px: float) -> list[Fit]:
    """In order, without those that say the same as one before."""
    kept: list[Fit] = []
    for item in fits:
        if item is not None and item.correlation > 0.0 and all(_differs(item, other, side_px) for other in kept):
            kept.append(item)
    return kept


def _differs(first: Fit, second: Fit, side_px: float) -> bool:
    """At the middle of either's overlap, by a share of the longer side: what is nearer, `evidence` looks after."""
    for middle in (first.middle_px, second.middle_px):
        places = [apply_homography(item.matrix, middle[None])[0] for item in (first, second)]
        if not np.linalg.norm(places[0] - places[1]) < _APART * side_px:
            return True
    turns = [np.arctan2(item.matrix[1, 0], item.matrix[0, 0]) for item in (first, second)]
    return abs((turns[0] - turns[1] + np.pi) % (2.0 * np.pi) - np.pi) > _APART_RAD


def _similar(warp: FloatArray, middle_px: FloatArray) -> FloatArray:
    """The similarity (3, 3) that a homography is at a place of side 0."""
    there, factor = apply_homography(warp, middle_px[None])[0], _factor(warp, middle_px)
    linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return np.vstack([np.column_stack([linear, there - linear @ middle_px]), [0.0, 0.0, 1.0]])


def _factor(warp: FloatArray, middle_px: FloatArray) -> complex:
    """Turn and scale of a homography at a place of side 0: what it multiplies x + iy with."""
    places = middle_px[None]
    linear = homography_jacobians(warp, places, apply_homography(warp, places))[0]
    return complex(linear[0, 0] + linear[1, 1], linear[1, 0] - linear[0, 1]) / 2.0


def _doubt(found: Fit, proof: RegistrationQuality, preferred: float) -> str:
    """Why not to believe it, "" for nothing."""
    if not found.converged:
        return f"least squares did not converge: still moving {found.moved_px:.2g} px"
    if found.condition > _LARGEST_CONDITION:
        return f"the overlap tells shift, turn and scale badly apart (condition number {found.condition:.0f})"
    if proof.cells < _LEAST_CELLS:
        return f"only {proof.cells} parts of the overlap can be compared"
    if proof.correlation < _LEAST_CORRELATION:
        return f"the pictures correlate by {proof.correlation:.2f} only"
    if proof.share < _LEAST_AGREEING:
        return f"{proof.agreeing} of {proof.cells} parts of the overlap agree (by chance {proof.by_chance:.0f})"
    if preferred < _LEAST_PREFERRED:
        return f"{1.0 - preferred:.0%} of the overlap fits another place better: a repeated pattern"
    return ""
