"""The verdict on a block, from what its stages have found: in a run, or on file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from aeromatch_cli import graph
from aeromatch_cli.results.stages import BlockResults, ConsistencyResult
from aeromatch_cli.sfm.quality.finding import Quality, QualityInput
from aeromatch_cli.sfm.quality.judgement import judged
from aeromatch_cli.stages.first_pass import ALL_PAIRS_UP_TO
from aeromatch_cli.stages.stage_report import StageReport, result_on_file
from aeromatch_cli.workspace import Workspace

# Tie points count as measured by least squares where at least this share of them was.
_MEASURED = 0.5


def quality_of(results: BlockResults, names: Mapping[str, str]) -> Quality | None:
    """Judge the block; None where the stages that tell have not run. names: of the files, by image_id."""
    adjust, links, refined = results.final_block, results.connection, results.refine
    if results.filter is None or adjust is None or links is None:
        return None
    consistency, unread = results.consistency, links.unread
    # What could not be read is a fault of its own, and none of how the others hang together.
    outside = {image_id: reason for image_id, reason in adjust.outside.items() if image_id not in unread}
    return judged(
        QualityInput(
            images=len(names) - len(unread),
            adjust=adjust.model_copy(update={"outside": outside}),
            orient=results.orient,
            components=tuple(links.components or ()),
            components_before=len(results.filter.components),
            contradicted=None if consistency is None else _contradicted(consistency),
            contradicting=() if consistency is None else tuple(consistency.doubtful),
            refined=refined is not None and (refined.measured or 0) > _MEASURED * (refined.keypoints or 1),
            reduced=adjust.reduced,
            names=dict(names),
            unread=tuple(unread),
            hidden_pairs=_positions_hide_pairs(results, len(names) - len(unread)),
        )
    )


def _positions_hide_pairs(results: BlockResults, images: int) -> bool:
    """Whether given positions have kept pairs from being compared: in small blocks the first pass compares all."""
    if results.pairs is None:
        return False
    block, orient = results.pairs.block, results.orient
    given = block.positioned if orient is None else orient.positions_given
    by_position = bool({"overlap", "position"} & block.pairs_by_reason.keys())
    return bool(given) and by_position and (orient is None or images > ALL_PAIRS_UP_TO)


def _contradicted(consistency: ConsistencyResult) -> float | None:
    """Share of the verified matches that contradict the adjusted block; None where the stage has judged none.

    Those that are only unlikely do not count: how many they are follows from the share that is asked to be right.
    """
    if consistency.verified_matches is None:
        return None
    wrong = consistency.contradicting_matches
    matches = consistency.dropped_matches + consistency.verified_matches
    return (consistency.dropped_matches if wrong is None else wrong) / matches if matches else None


def results_of(workspace: Workspace, reports: Sequence[StageReport] = ()) -> BlockResults:
    """Return the results of a command's own reports, and of other stages those on file."""
    own = {report.stage: report.result for report in reports if not report.part}
    kinds = {stage: graph.BY_NAME[stage].result for stage in BlockResults.model_fields}
    return BlockResults(
        **{stage: own[stage] if stage in own else result_on_file(workspace, kind) for stage, kind in kinds.items()}
    )


def quality_on_file(workspace: Workspace, names: Mapping[str, str]) -> Quality | None:
    """Judge the block by what the stages have left in a workspace."""
    return quality_of(results_of(workspace), names)
