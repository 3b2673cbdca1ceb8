"""The verdict on a block, from what its stages have found: in a run, or on file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aeromatch_cli.orientation.quality import Evidence, Quality, judged
from aeromatch_cli.stages.stage_report import StageReport, facts_on_file
from aeromatch_cli.workspace import Workspace

# Stages whose facts a verdict rests on; without those that are needed there is none.
_STAGES = ("orient", "pairs", "filter", "refine", "adjust", "consistency")
_NEEDED = {"filter", "adjust"}
# Tie points count as measured by least squares where at least this share of them was.
_MEASURED = 0.5


def quality_of(facts: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Quality | None:
    """facts: by stage. names: of the files, by image_id. None where the stages that tell have not run."""
    if not facts.keys() >= _NEEDED or "components" not in final_links(facts):
        return None
    refined = facts.get("refine", {})
    return judged(
        Evidence(
            images=len(names),
            adjust=facts["adjust"],
            orient=facts.get("orient", {}),
            components=final_links(facts)["components"],
            contradicted=_contradicted(facts.get("consistency", {})),
            contradicting=facts.get("consistency", {}).get("doubtful", ()),
            refined=(refined.get("measured") or 0) > _MEASURED * (refined.get("keypoints") or 1),
            reduced=facts["adjust"].get("reduced", 1.0),
            names=names,
        )
    )


def _contradicted(consistency: Mapping[str, Any]) -> float | None:
    """Share of the verified matches that the stage has dropped."""
    dropped, left = consistency.get("dropped_matches", 0), consistency.get("verified_matches", 0)
    return dropped / (dropped + left) if dropped + left and "points_left" in consistency else None


def facts_told(workspace: Workspace, reports: Sequence[StageReport]) -> dict[str, Mapping[str, Any]]:
    """By stage: those of a command's own reports, and of other stages those on file."""
    facts = {stage: facts_on_file(workspace, stage) for stage in _STAGES}
    return {stage: found for stage, found in facts.items() if found} | {
        report.stage: report.facts for report in reports if not report.part
    }


def quality_on_file(workspace: Workspace, names: Mapping[str, str]) -> Quality | None:
    """From what the stages have left in a workspace."""
    return quality_of(facts_told(workspace, ()), names)


def final_links(facts: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    """Facts of the stage that says how the final matches connect the images."""
    consistency = facts.get("consistency", {})
    return consistency if "components" in consistency else facts.get("filter", {})
