"""consistency: drops verified matches that contradict the adjusted block.

The verified rows stay as they are; which of their matches are dropped is written to the workspace's orientation folder,
for all who read final results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from aeromatch_cli.data import AdjustedBlock, BoolArray, FloatArray, Pair
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.adjusted import Dropped, read_adjusted, write_adjusted, write_dropped
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.geometry.coverage import CELLS, cells_of, shared_cells, shown_ninths
from aeromatch_cli.geometry.reprojection import with_errors
from aeromatch_cli.results.stages import ConsistencyResult, FilterResult, Ninths
from aeromatch_cli.sfm.block_figures import images_per_point, mean_error_px
from aeromatch_cli.sfm.outlier_rejection import Limits, MatchedKeypoints, contradicting
from aeromatch_cli.sfm.track_pruning import without_dropped
from aeromatch_cli.sfm.two_view_poses import placed_alone
from aeromatch_cli.stages import adjust
from aeromatch_cli.stages.contents import contents_of
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import connection
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState, Judged
from aeromatch_cli.store.matches import FinalEntries
from aeromatch_cli.strategies.consistencies import BlockConsistency

VERSION = 8


def run(context: Context) -> StageReport:
    """Write dropped.npz and final.npz where they are not up to date."""
    report = StageReport("consistency")
    recipe = context.settings.rejection
    adjusted = None
    if recipe is not None and context.workspace.adjusted.is_file():
        context, _ = BlockState.of(context).with_current_pairs()
        adjusted = adjust.adjusted_block(context)
    path = context.workspace.dropped
    if adjusted is None and _judges_pairs(context):
        context, _ = BlockState.of(context).with_current_pairs()
        adjusted = AdjustedBlock.empty()
    if adjusted is None or recipe is None:
        words = f"not done: match {context.settings.match.name} measures points without keypoints"
        report.result = ConsistencyResult(remark=words if context.settings.match.reads_pixels else "")
        context.workspace.withdraw("consistency", [path, context.workspace.final])
        return report.write(context.workspace)
    report.items = len(context.pairs)
    report.fingerprint = fingerprint(
        VERSION, recipe, BlockState.of(context).inputs_fingerprint("consistency"), bool(adjusted.poses)
    )
    if report.take_if_up_to_date(context):
        return report.write(context.workspace)
    context.workspace.forget("consistency", [context.workspace.final])
    with context.executor.step("consistency"):
        cameras = adjusted.cameras_of(context.block)
        entries = [
            (pair, entry) for pair, entry in BlockState.of(context).judged_pairs() if entry.verdict.state == "verified"
        ]
        keypoints_px = contents_of(context, adjusted).keypoints_px
        pairs = [_matched(context, adjusted, keypoints_px, pair.image_id0, entry) for pair, entry in entries]
        found = contradicting(adjusted, cameras, keypoints_px, pairs, limits_of(recipe))
    dropped: Dropped = {
        (pair.image_id0, pair.image_id1): (entry.fingerprint, np.flatnonzero(mask).astype(np.int32))
        for (pair, entry), mask in zip(entries, found.masks, strict=True)
        if mask.any()
    }
    write_atomically(path, lambda stream: write_dropped(stream, dropped, recipe.min_matches))
    block, files = _left_of(context, adjusted, entries), [path]
    if block is not adjusted:
        write_atomically(context.workspace.final, lambda stream: write_adjusted(stream, block))
        files.append(context.workspace.final)
    report.record_files(context, files)
    left = _connection_left(context, entries)
    matches = sum(len(before.matches.indices) for _, before in entries)
    report.result = ConsistencyResult(
        verified_matches=left.verified_matches,
        dropped_matches=matches - left.verified_matches,
        contradicting_matches=found.by_distance,
        rejected_pairs=left.pairs.get("rejected", 0),
        components=left.components,
        weakly_tied=left.weakly_tied,
        unconnected=left.unconnected,
        unread=left.unread,
        expected_right=found.expected_right,
        doubtful=found.doubtful,
        points=len(adjusted.points_m),
        points_left=len(block.points_m),
        observations=adjusted.observations,
        observations_left=block.observations,
        reprojection_error_px=mean_error_px(block),
        spread=_spread(context, block),
    )
    report.done = report.items
    return report.write(context.workspace)


def _judges_pairs(context: Context) -> bool:
    """Whether pairs are judged that no adjusted block holds."""
    recipe = context.settings.rejection
    return recipe is not None and limits_of(recipe).by_probability


def limits_of(recipe: BlockConsistency) -> Limits:
    """Return what the settings say, for `contradicting`."""
    return Limits(
        recipe.epipolar_px,
        recipe.medians,
        recipe.third_image_px,
        recipe.min_probability,
        recipe.min_expected_right,
        recipe.most_given_up,
        recipe.min_matches,
    )


def _matched(
    context: Context,
    adjusted: AdjustedBlock,
    keypoints_px: Callable[[str], FloatArray],
    image_id0: str,
    entry: VerifiedEntry,
) -> MatchedKeypoints:
    """The matches of a verified pair; with its own geometry where the adjusted block lacks one of its images."""
    alone = None
    if _judges_pairs(context):
        cameras = {i: context.block.cameras[context.image_by_id[i].camera_id] for i in (image_id0, entry.image_id1)}
        pose0 = context.block.poses.get(image_id0)
        alone = placed_alone(adjusted, image_id0, entry, cameras, keypoints_px, pose0)
    return MatchedKeypoints(image_id0, entry.image_id1, entry.matches.indices, entry.matches.scores, alone)


def _connection_left(context: Context, entries: Sequence[tuple[Pair, VerifiedEntry]]) -> FilterResult:
    """Return what is left of the verified entries, and how it connects the images."""
    final = FinalEntries(context.workspace)
    left = [(pair, final.left(pair.image_id0, entry)) for pair, entry in entries]
    judged = ((p.image_id0, p.image_id1, after.verdict.state, len(after.matches.indices)) for p, after in left)
    return connection(context, judged)


def final_block(context: Context) -> AdjustedBlock | None:
    """Return the adjusted block with those points and observations that final matches hold; None as for
    `adjusted_block`. Of a workspace whose stage consistency is up to date."""
    adjusted = adjust.adjusted_block(context)
    path = context.workspace.final_or_adjusted
    return adjusted if adjusted is None or path == context.workspace.adjusted else read_adjusted(path)


def _left_of(context: Context, adjusted: AdjustedBlock, entries: Iterable[tuple[Pair, VerifiedEntry]]) -> AdjustedBlock:
    """Return what final matches hold of a block. entries: all verified ones."""
    final = FinalEntries(context.workspace)
    pairs = (
        (pair.image_id0, pair.image_id1, entry.matches.indices, final.kept(pair.image_id0, entry))
        for pair, entry in entries
    )
    left = without_dropped(adjusted, pairs)
    if left is adjusted:
        return adjusted
    return with_errors(left, left.cameras_of(context.block), contents_of(context, left).keypoints_px)


def _spread(context: Context, adjusted: AdjustedBlock) -> dict[str, Ninths]:
    """image_id -> ninths of the image (of 3 x 3) that hold a point of the adjusted block, ninths without any though
    another image of its pairs shows them, and its points that three or more images see: a block adjustment wants points
    everywhere, and in many images."""
    shown, places_px = _shown_ninths(context), contents_of(context).keypoints_px
    seen = images_per_point(adjusted)
    found = {}
    for image_id, track in sorted(adjusted.tracks.items()):
        image = context.image_by_id[image_id]
        places = places_px(image_id)[track[:, 0]]
        cells = cells_of((image.width_px, image.height_px), places, 3)
        held = np.zeros((3, 3), dtype=bool)
        held[cells[:, 0], cells[:, 1]] = True
        empty = shown[image_id] & ~held
        found[image_id] = Ninths(int(held.sum()), int(empty.sum()), int((seen[track[:, 1]] > 2).sum()))
    return found


def _shown_ninths(context: Context) -> dict[str, BoolArray]:
    """image_id -> the ninths (3, 3) that the other images of its pairs show, by poses and ground."""
    cells = {image.image_id: np.zeros((CELLS, CELLS), dtype=bool) for image in context.block.images}
    for pair in context.pairs:
        shared = shared_cells(context.geometry(pair))
        if shared is not None:
            cells[pair.image_id0] |= shared.cells0
            cells[pair.image_id1] |= shared.cells1
    return {image_id: shown_ninths(seen) for image_id, seen in cells.items()}


def final_pairs(context: Context, features: Callable[[str], str] | None = None) -> Judged:
    """Return judged pairs in the order of pairs.csv, without the matches that contradict the adjusted block. features:
    as `judged_pairs` has them."""
    final = FinalEntries(context.workspace)
    for pair, entry in BlockState.of(context).judged_pairs(features):
        yield pair, final.left(pair.image_id0, entry)  # of present keypoints: stale ones are none of those pairs
