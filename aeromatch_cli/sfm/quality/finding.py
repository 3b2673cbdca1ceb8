"""What a verdict on a block is made of: findings with their numbers, and what they are judged by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.results.adjustment import (
    GroupResult,
)
from aeromatch_cli.results.record import Record
from aeromatch_cli.results.stages import AdjustResult, OrientResult
from aeromatch_cli.words import form, listed

Level = Literal["good", "doubtful", "bad"]
LEVELS: tuple[Level, ...] = ("good", "doubtful", "bad")
# Each pair: doubtful beyond the first, bad beyond the second; None: never bad by itself.
Limits = tuple[float, float | None]
# Of the given positions, the share that the pictures contradict: single wrong ones happen.
MANY_WRONG_POSITIONS = 0.3
WRONG_POSITIONS: Limits = (0.05, MANY_WRONG_POSITIONS)
WHOLE_BLOCK = "the block"


@dataclass(frozen=True)
class Finding:
    """what: name of the criterion; value and limit: its figure, and where doubt begins, None where it is no number;
    sentence: both in words and, where it is not good, the remedy."""

    what: str
    value: float | None
    limit: float | None
    level: Level
    sentence: str


@dataclass(frozen=True)
class Quality:
    """findings: of all that was checked, the worst first. unchecked: what could not be, in words."""

    verdict: Level
    findings: tuple[Finding, ...]
    unchecked: tuple[str, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.level != "good")

    def as_facts(self) -> dict[str, Any]:
        """JSON-ready."""
        findings = [asdict(one) | {"value": _rounded(one.value)} for one in self.findings]
        return {"verdict": self.verdict, "findings": findings, "unchecked": list(self.unchecked)}


class QualityInput(Record):
    """Holds what a block is judged by.

    images: of the block. adjust, orient: results of these stages. components: sizes of the groups of images that
    verified pairs connect, the largest first; components_before: how many these were before the stage consistency
    dropped matches, 0 where that is not known. refined: whether tie points were measured by least squares.
    contradicted: share of the verified matches that the adjusted block contradicts, None where it is not known;
    contradicting: ids of images of which it contradicts most. reduced: stored pixels in a pixel of the pictures that
    keypoints were found in. names: of the files, by image_id. unread: ids of images beside these whose pictures could
    not be read. hidden_pairs: whether given positions have kept pairs from being compared.
    """

    images: int
    adjust: AdjustResult
    orient: OrientResult | None = None
    components: tuple[int, ...] = ()
    components_before: int = 0
    refined: bool = False
    contradicted: float | None = None
    contradicting: tuple[str, ...] = ()
    reduced: float = 1.0
    names: dict[str, str] = Field({})
    unread: tuple[str, ...] = ()
    hidden_pairs: bool = False

    @property
    def groups(self) -> Sequence[GroupResult]:
        return self.adjust.groups

    @property
    def held(self) -> Mapping[str, str]:
        """Parameter of cameras -> setting that holds it."""
        return self.adjust.held_by

    def named(self, image_ids: Sequence[str]) -> str:
        """List images by the names of their files."""
        return listed(self.names.get(i, i) for i in image_ids)


def part_words(group: GroupResult, groups: Sequence[GroupResult], names: Mapping[str, str]) -> str:
    """Say which part of a block a group of its images is; parts may have equally many. names: of the files, by
    image_id."""
    if len(groups) == 1:
        return WHOLE_BLOCK
    image = names.get(group.first_image, group.first_image)
    return f"the part of {group.images} images" + (f" with {image}" if image else "")


Found = Iterator[Finding | str]


def level_of(value: float, limits: Limits) -> Level:
    """Return the level of a value of which more is worse."""
    doubtful, bad = limits
    if bad is not None and value > bad:
        return "bad"
    return "doubtful" if value > doubtful else "good"


def finding_of(what: str, value: float, limits: Limits, words: str, remedy: str) -> Finding:
    """Judge a value of which more is worse; the remedy is said where it is not good."""
    level = level_of(value, limits)
    return Finding(what, float(value), limits[0], level, words if level == "good" else f"{words}: {remedy}")


def positions_given(evidence: QualityInput) -> int:
    """Count the images with a given position, those that the orientation has left out as well, of which the adjustment
    does not know."""
    return max(evidence.adjust.positions_given, evidence.orient.positions_given if evidence.orient else 0)


def angles_given(evidence: QualityInput) -> bool:
    """Whether oriented images have given angles."""
    residuals = evidence.adjust.residuals
    return residuals is not None and residuals.rotation_deg_median is not None


def guess_words(camera_ids: Sequence[str]) -> str:
    """Say that a guessed focal length is what the poses do not fit, "" where none was guessed. camera_ids: those whose
    focal length was."""
    if not camera_ids:
        return ""
    of = f"the focal length of {form(len(camera_ids), 'camera')} {listed(camera_ids)}"
    return f"the likely cause is {of}, which is a guess, since EXIF says too little: give --cameras FILE"


def flight_words(name: str) -> str:
    """Names of flights may begin with that word."""
    if not name:
        return "the flight without times"
    return name if name.lower().startswith("flight") else f"flight {name}"


def rms(values: Any) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt((np.asarray(values, np.float64) ** 2).mean()))


def number(value: float) -> str:
    """Write a number with three significant digits, a large one with one decimal."""
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3g}"


def plain(value: float, digits: int = 2) -> str:
    """Write a number with at least so many significant digits, without a power of ten where it is large: 110, 2.9,
    0.034."""
    return f"{value:.0f}" if abs(value) >= 10.0 ** (digits - 1) else f"{value:.{digits}g}"


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(f"{value:.4g}")
