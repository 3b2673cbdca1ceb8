"""What a stage of the whole block is made of: the fingerprint of all files that it is declared to read.

A test compares the declarations with the files that stages open, so that nothing is forgotten here.
"""

from __future__ import annotations

from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.files import read_json
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import pair_fingerprint


def inputs_fingerprint(context: Context, stage: str) -> str:
    """Return the fingerprint of what a stage of the whole block reads from the workspace.

    What stages make of images and pairs is told by the fingerprints that the verdicts of the context's pairs must
    carry, in which those of features and matches are; what stages of the whole block make, by the SHA-256 of the files.
    """
    kinds = graph.BY_NAME[stage].reads
    makers = [one for one in graph.STAGES if set(one.writes) & set(kinds)]
    parts: list[Any] = [
        (one.name, _files(context, one.name)) for one in makers if one.unit == "block" or one.name == "refine"
    ]
    if any(one.unit == "pair" for one in makers):
        parts.append([(p.image_id0, p.image_id1, pair_fingerprint(context, p)) for p in context.pairs])
    return fingerprint(parts)


def _files(context: Context, stage: str) -> dict[str, str]:
    """Return the SHA-256 of the files that a stage has left, by their names in the workspace."""
    path = context.workspace.stage_report(stage)
    return dict(read_json(path).get("files", {})) if path.is_file() else {}
