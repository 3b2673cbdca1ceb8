"""This module sums up a run in words: how good the block is, where it is weak, and what to do."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.results.stages import FEW_POINTS, BlockResults
from aeromatch_cli.sfm.quality.finding import Quality
from aeromatch_cli.stages.filter import WEAK_MATCHES
from aeromatch_cli.words import listed, of_images


def closing_lines(quality: Quality, results: BlockResults, names: Mapping[str, str]) -> list[str]:
    """Say the verdict with what speaks against the block, and where it is weak. names: of the files, by image_id."""
    count = len(names)
    whole = f"all {count} images are connected" if count > 2 else "both images are connected"
    if results.adjust is not None and results.adjust.images:
        whole += " and oriented"
    lines = verdict_lines(quality, whole)
    others = [f"not checked: {'; '.join(quality.unchecked)}"] if quality.unchecked else []
    return [*lines, *(f"{'':<9} {line}" for line in (*others, *_weak(results, names)))]


def verdict_lines(quality: Quality, whole: str = "") -> list[str]:
    """Say the verdict with what speaks against the block; whole: what is said where nothing does."""
    first, *others = [one.sentence for one in quality.faults] or [whole]
    return [f"{'result':<9} {quality.verdict}: {first}", *(f"{'':<9} {line}" for line in others)]


def _weak(results: BlockResults, names: Mapping[str, str]) -> list[str]:
    """Images that hang loosely on a block."""
    lines = []
    tied = [] if results.connection is None else results.connection.weakly_tied
    if tied:
        lines.append(f"weak: {listed(names.get(i, i) for i in tied)}, with fewer than {WEAK_MATCHES} verified matches")
    spread = {} if results.consistency is None else results.consistency.spread
    loose = [i for i, ninths in spread.items() if ninths.points < FEW_POINTS and i not in tied]
    if loose and len(spread) > 2:
        named = listed(names.get(i, i) for i in loose)
        lines.append(f"weak: {named}, with fewer than {FEW_POINTS} points that three images see")
    empty = [i for i, ninths in spread.items() if ninths.empty]
    if empty:
        lacking = of_images((names.get(i, i) for i in empty), spread, "has", "have")
        lines.append(
            f"{lacking} no point in one or more of the 3 x 3 parts of the picture whose ground other images show: "
            "less evenly tied, which does not change the verdict"
        )
    return lines
