"""What a run comes to, in words: whether the block is sound, where it is weak, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aeromatch_cli.stages.filter import WEAK_MATCHES
from aeromatch_cli.stages.stage_report import StageReport

_NAMED = 5
# Images with fewer points that three images see hold a block adjustment loosely.
_FEW_POINTS = 20


def closing_lines(reports: Sequence[StageReport], names: Mapping[str, str]) -> list[str]:
    """Of the reports of a whole run, filter to consistency. names: of the files, by image_id."""
    facts = _told(reports)
    if facts is None:
        return []
    faults, weak = _faults(facts, names), _weak(facts, names)
    count = len(names)
    if faults:
        return _said(
            [f"not sound: {faults[0][0]}", *(words for words, _ in faults[1:])],
            [*(remedy for _, remedy in faults), *weak],
        )
    oriented = " and oriented" if facts["adjust"].get("images", 0) == count else "; not oriented, as orient=none asks"
    whole = f"sound: all {count} images are connected{oriented}" if count > 2 else "both images are connected"
    return _said([whole], weak)


def is_sound(reports: Sequence[StageReport], names: Mapping[str, str]) -> bool | None:
    """Whether nothing is wrong with the block as a whole; None of a run without the stages that tell."""
    facts = _told(reports)
    return None if facts is None else not _faults(facts, names)


def _told(reports: Sequence[StageReport]) -> dict[str, Any] | None:
    """By stage; None without those that tell of the block as a whole."""
    facts = {report.stage: report.facts for report in reports if not report.part}
    return facts if {"filter", "adjust"} <= facts.keys() else None


def _said(first: Sequence[str], then: Sequence[str]) -> list[str]:
    lines = ["; ".join(first), *then]
    return [f"{'result' if not row else '':<9} {line}" for row, line in enumerate(lines)]


def _faults(facts: Mapping[str, Any], names: Mapping[str, str]) -> list[tuple[str, str]]:
    """What is wrong with the block as a whole, and what helps."""
    found = []
    groups = _final(facts)["components"]
    if len(groups) > 1:
        sizes = ", ".join(map(str, groups[:_NAMED])) + (", ..." if len(groups) > _NAMED else "")
        found.append(
            (
                f"{len(groups)} groups of images ({sizes}) that no verified pair connects",
                "more overlap between them helps; --set pairs=exhaustive finds pairs that positions hide",
            )
        )
    outside = list(facts["adjust"].get("outside", {}))
    if outside:
        one = names.get(outside[0], outside[0])
        found.append(
            (
                f"not oriented: {_listed(outside, names)}",
                f"the lines of adjust say why; `aeromatch show WORK {one}` shows what it has; images of other places "
                "may be left out",
            )
        )
    # Nothing is said of an orientation that nobody wanted.
    if not facts["adjust"].get("images", 0) and facts["adjust"].get("remarks") and len(names) > 2:
        found.append(
            (
                "no image is oriented",
                "more overlap, or known positions and attitudes (--poses) and cameras (--cameras) help; matches are "
                "exported all the same",
            )
        )
    kinds = [part["kind"] for part in facts["adjust"].get("groups", ())]
    # Those that positions place lie in one frame.
    parts = kinds.count("level") + any(kind != "level" for kind in kinds)
    if parts > 1 and len(groups) == 1:
        found.append(
            (
                f"{parts} parts whose scale and place nothing ties to each other",
                "positions (--poses) place each of them",
            )
        )
    return found


def _final(facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """The stage that says how the final matches connect the images."""
    consistency: Mapping[str, Any] = facts.get("consistency", {})
    return consistency if "components" in consistency else facts["filter"]


def _weak(facts: Mapping[str, Any], names: Mapping[str, str]) -> list[str]:
    """Images that hang loosely on a block."""
    lines = []
    tied = _final(facts)["weakly_tied"]
    if tied:
        lines.append(f"weak: {_listed(tied, names)}, with fewer than {WEAK_MATCHES} verified matches")
    spread = facts.get("consistency", {}).get("spread", {})
    loose = [i for i, (_, _, points) in spread.items() if points < _FEW_POINTS and i not in tied]
    if loose and len(spread) > 2:
        lines.append(f"weak: {_listed(loose, names)}, with fewer than {_FEW_POINTS} points that three images see")
    empty = [i for i, (_, ninths, _) in spread.items() if ninths]
    if empty:
        lines.append(f"parts without a point though other images show them: {_listed(empty, names)}")
    return lines


def _listed(ids: Sequence[str], names: Mapping[str, str]) -> str:
    shown = ", ".join(names.get(i, i) for i in ids[:_NAMED])
    return shown + (f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else "")
