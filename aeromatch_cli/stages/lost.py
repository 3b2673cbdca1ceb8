"""lost: images that a result does not hold, and why. A result that lacks images must never look like a whole one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from aeromatch_cli.files import write_text
from aeromatch_cli.formats.tables import csv_text
from aeromatch_cli.results.stages import BlockResults
from aeromatch_cli.words import form, listed
from aeromatch_cli.workspace import Workspace

# What becomes of an image that is lost; also the column `what` of lost.csv.
_LEFT_OUT, _FAILED, _UNORIENTED, _UNCONNECTED = "left out", "not read", "not oriented", "not connected"

Lost = tuple[str, str, str]


def lost_images(results: BlockResults, left_out: Sequence[tuple[str, str]], names: Mapping[str, str]) -> list[Lost]:
    """Name, what became of it, and the reason, of every image that the result does not hold.

    left_out: images that are not part of the block, with the reason. names: of the files, by image_id.
    """
    lost = [(name, _LEFT_OUT, reason) for name, reason in left_out]
    links = results.connection
    failed = [] if links is None else links.unread
    if results.adjust is not None and (results.adjust.images or results.adjust.outside):
        outside = results.adjust.outside.items()
        lost += [(names.get(i, i), _FAILED if i in failed else _UNORIENTED, reason) for i, reason in outside]
    elif links is not None:
        lost += [(names.get(i, i), _FAILED, "failures.csv says why") for i in failed]
        lost += [(names.get(i, i), _UNCONNECTED, "no pair of it is verified") for i in links.unconnected]
    return sorted(lost)


def lost_lines(workspace: Workspace, lost: Sequence[Lost], images: int) -> list[str]:
    """Say in lines which images the result does not hold. images: number of those in the whole folder."""
    if not lost:
        return []
    counts = ", ".join(f"{count} {what}" for what, count in sorted(Counter(what for _, what, _ in lost).items()))
    return [
        f"lost      {len(lost)} of {images} images {form(len(lost), 'is', 'are')} not in the result ({counts}): "
        f"{listed(name for name, _, _ in lost)}; listed in {workspace.lost}"
    ]


def write_lost(workspace: Workspace, lost: Sequence[Lost]) -> None:
    """Write lost.csv, also where no image is lost."""
    write_text(workspace.lost, csv_text(("image", "what", "reason"), lost))
