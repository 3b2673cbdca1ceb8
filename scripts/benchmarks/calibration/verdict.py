"""What the verdict on a simulated block rests on: figures as stage `adjust` has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera
from aeromatch_cli.geometry.components import connected_groups
from aeromatch_cli.results.adjustment import GroupResult
from aeromatch_cli.results.stages import AdjustResult
from aeromatch_cli.sfm.block_figures import block_figures, residual_figures, residuals_of
from aeromatch_cli.sfm.control import control_figures
from aeromatch_cli.sfm.mapping import Observed
from aeromatch_cli.sfm.outlier_rejection import Contradictions, MatchedKeypoints, contradicting
from aeromatch_cli.sfm.quality.finding import QualityInput
from aeromatch_cli.stages.consistency import limits_of
from aeromatch_cli.strategies.consistencies import BlockConsistency
from aeromatch_cli.strategies.exporters.contents import ExportContents


def of_adjusted(
    contents: ExportContents,
    observed: Observed,
    adjusted: AdjustedBlock,
    groups: Sequence[GroupResult],
    *,
    metric: bool,
) -> QualityInput:
    """groups: results of `adjust_block`. metric: whether the world frame's lengths are metres."""
    images = contents.block.images
    tied = connected_groups([(p.pair.image_id0, p.pair.image_id1) for p in contents.pairs])
    alone = len(images) - sum(map(len, tied))
    residuals = residuals_of(adjusted, observed.poses, images, contents.keypoints_px)
    cameras = {image.image_id: adjusted.cameras[image.camera_id] for image in images}
    control = control_figures(adjusted, cameras, observed.control, metric=metric) if observed.control else None
    result = AdjustResult(
        **block_figures(adjusted, images, groups),
        positions_given=len(observed.poses),
        outside={i.image_id: "" for i in images if i.image_id not in adjusted.poses},
        control=control,
        residuals=residual_figures(residuals, {}),
        remarks=[] if adjusted.poses else ["no image could be oriented"],
    )
    components = (*map(len, tied), *[1] * alone)
    evidence = QualityInput(images=len(images), adjust=result, components=components, refined=True)
    if not adjusted.poses or not contents.pairs:
        return evidence
    found = _contradictions(contents, adjusted, cameras)
    share = float(np.concatenate(found.masks).mean())
    return evidence.model_copy(update={"contradicted": share, "contradicting": tuple(found.doubtful)})


def _contradictions(contents: ExportContents, adjusted: AdjustedBlock, cameras: Mapping[str, Camera]) -> Contradictions:
    """Of the stage `consistency` as it is set by default."""
    pairs = [
        MatchedKeypoints(p.pair.image_id0, p.pair.image_id1, p.verified, np.zeros(len(p.verified)))
        for p in contents.pairs
    ]
    return contradicting(adjusted, cameras, contents.keypoints_px, pairs, limits_of(BlockConsistency()))
