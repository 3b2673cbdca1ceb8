"""What `aeromatch evaluate` found, for the report: its summary and its plots."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

from aeromatch_cli.workspace import Workspace, read_json


@dataclass(frozen=True)
class EvaluationFigures:
    """summary: (name, value). pictures: (name, data URI of a PNG). outdated: matches were verified since."""

    summary: Sequence[tuple[str, str]]
    pictures: Sequence[tuple[str, str]]
    outdated: bool


def evaluation_figures(workspace: Workspace) -> EvaluationFigures | None:
    """None where the workspace was never evaluated."""
    stated = workspace.evaluation / "evaluation.json"
    if not stated.is_file():
        return None
    pictures = []
    for path in sorted(workspace.evaluation.glob("*.png")):
        coded = base64.b64encode(path.read_bytes()).decode("ascii")
        pictures.append((path.stem.replace("_", " "), f"data:image/png;base64,{coded}"))
    filtered = workspace.stage_report("filter")
    outdated = filtered.is_file() and filtered.stat().st_mtime > stated.stat().st_mtime
    summary = [(str(name), str(value)) for name, value in read_json(stated)["summary"]]
    return EvaluationFigures(summary, pictures, outdated)
