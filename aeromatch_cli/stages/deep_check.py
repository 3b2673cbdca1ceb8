"""check --deep: what of a workspace is not as it was written."""

from __future__ import annotations

import logging
from pathlib import Path

from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.stages.command_result import Result
from aeromatch_cli.store.damage import find_damage
from aeromatch_cli.words import listed
from aeromatch_cli.workspace import Workspace, opened_workspace

log = logging.getLogger("aeromatch")


def run(root: Path) -> Result:
    """Compare every file of a workspace with its checksum. Raises as `opened_workspace`, but for damaged files."""
    try:
        workspace = opened_workspace(root, tables=False)
    except BrokenFileError:  # of block.json: it is named among the damaged
        workspace = Workspace(root)
    found = find_damage(workspace)
    lines = [f"checked          {found.files:,} files, {found.size_bytes / 1e6:,.1f} MB"]
    if found.without_checksum:
        lines.append(f"no checksum      {listed(found.without_checksum)}")
    for name, reason in found.damaged.items():
        log.warning("damaged: %s: %s", root / name, reason)
    if found.damaged:
        remedy = "run the same `aeromatch run` again, which makes them again"
        lines.append(f"damaged          {len(found.damaged)} of them: {remedy}")
    else:
        lines.append("damaged          no file: all others are as they were written")
    facts = {
        "workspace": str(root),
        "files": found.files,
        "megabytes": round(found.size_bytes / 1e6, 1),
        "without_checksum": found.without_checksum,
        "damaged": found.damaged,
    }
    return Result(tuple(lines), facts, tuple(("check", name, reason) for name, reason in found.damaged.items()))
