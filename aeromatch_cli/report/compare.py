"""Two workspaces side by side: settings that differ, pairs, matches, images and poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import differing, load
from aeromatch_cli.formats.rows import read_verified_row
from aeromatch_cli.formats.tables import read_images, read_pairs
from aeromatch_cli.report.rows import STAGE_ORDER, seconds_by_stage
from aeromatch_cli.stages.changes import said_value
from aeromatch_cli.stages.consistency import FinalEntries
from aeromatch_cli.stages.stage_report import facts_on_file
from aeromatch_cli.workspace import opened_workspace

_LISTED = 10
# Settings that change no result.
_OUTWARD = ("workspace", "run")


@dataclass(frozen=True)
class _Side:
    """matches: verified ones by pair of image names. seconds: by stage. facts: of the adjustment."""

    settings: Mapping[str, Any]
    images: frozenset[str]
    matches: Mapping[tuple[str, str], int]
    seconds: Mapping[str, float]
    adjusted: Mapping[str, Any]


def compare(first: Path, second: Path) -> tuple[list[str], dict[str, Any]]:
    """In words, and as facts. Raises InputError where a folder is no workspace."""
    one, two = _side(first), _side(second)
    lines = [f"first       {first}", f"second      {second}"]
    apart = differing(one.settings, two.settings)
    changed = [
        f"{key}: {said_value(old)} and {said_value(new)}"
        for key, old, new in apart
        if key.partition(".")[0] not in _OUTWARD
    ]
    lines += [f"setting     {words}" for words in changed] or ["settings    the same"]
    lines.append(_counts("images", len(one.images), len(two.images)))
    for words, names in (
        ("only in the first", one.images - two.images),
        ("only in the second", two.images - one.images),
    ):
        if names:
            lines.append(f"            {words}: {', '.join(sorted(names)[:_LISTED])}")
    verified = [{pair for pair, count in side.matches.items() if count} for side in (one, two)]
    lines.append(_counts("pairs", len(one.matches), len(two.matches)))
    lines.append(_counts("verified", len(verified[0]), len(verified[1])))
    for words, pairs in (("lost", verified[0] - verified[1]), ("gained", verified[1] - verified[0])):
        if pairs:
            shown = "; ".join(" and ".join(pair) for pair in sorted(pairs)[:_LISTED])
            lines.append(f"            {len(pairs)} {words}: {shown}")
    totals = [sum(side.matches.values()) for side in (one, two)]
    lines.append(_counts("matches", *totals))
    both = sorted(verified[0] & verified[1])
    ratios = [two.matches[pair] / one.matches[pair] for pair in both]
    if ratios:
        lines.append(f"            of {len(both)} pairs in both: {np.median(ratios):.2f} x as many (median)")
    for key, words in (("images", "oriented"), ("points", "points"), ("reprojection_error_px", "error px")):
        first_value, second_value = one.adjusted.get(key), two.adjusted.get(key)
        if first_value is not None and second_value is not None:
            lines.append(_counts(words, first_value, second_value))
    for stage in (stage for stage in STAGE_ORDER if stage in one.seconds and stage in two.seconds):
        lines.append(f"seconds     {stage}: {one.seconds[stage]:.1f} and {two.seconds[stage]:.1f}")
    facts = {"settings": changed, "pairs": [len(one.matches), len(two.matches)], "verified": list(map(len, verified)),
             "matches": totals}  # fmt: skip
    return lines, facts


def _counts(words: str, first: float, second: float) -> str:
    change = f" ({100.0 * (second / first - 1.0):+.1f} %)" if first and second != first else ""
    shown = [f"{value:.2f}" if isinstance(value, float) else f"{value:,}" for value in (first, second)]
    return f"{words:<11} {shown[0]} and {shown[1]}{change}"


def _side(root: Path) -> _Side:
    workspace = opened_workspace(root)
    names = {image.image_id: image.name for image in read_images(workspace.images)}
    final = FinalEntries(workspace)
    matches: dict[tuple[str, str], int] = {}
    rows: dict[str, Any] = {}
    for pair in read_pairs(workspace.pairs) if workspace.pairs.is_file() else []:
        if pair.image_id0 not in rows:
            rows = {pair.image_id0: read_verified_row(workspace.verified(pair.image_id0))}
        found = rows[pair.image_id0].get(pair.image_id1)
        entry = None if found is None else final(pair.image_id0, found)
        good = entry is not None and entry.verdict.state == "verified"
        matches[names[pair.image_id0], names[pair.image_id1]] = len(entry.matches.indices) if good and entry else 0
    return _Side(
        settings=load(str(workspace.config)).model_dump(mode="json"),
        images=frozenset(names.values()),
        matches=matches,
        seconds=seconds_by_stage(workspace),
        adjusted=facts_on_file(workspace, "adjust"),
    )
