"""This module gathers what leaves the workspace: keypoints and verified matches of the pairs that are up to date."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from aeromatch_cli.blocks.crs import LOCAL, geographic_from_grid
from aeromatch_cli.data import AdjustedBlock, FloatArray, PoseResidual
from aeromatch_cli.errors import BrokenFileError, ItemError
from aeromatch_cli.formats.adjusted import read_residuals
from aeromatch_cli.formats.features import read_final_keypoints
from aeromatch_cli.formats.rows import MatchEntry, read_match_row
from aeromatch_cli.geometry.reprojection import with_points
from aeromatch_cli.images.depth import sample_colours
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.sfm.block_figures import images_per_point
from aeromatch_cli.sfm.shutter import at_once
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.state import BlockState, Judged
from aeromatch_cli.stages.tracks import MatchedPair, Tracks, tracks_of
from aeromatch_cli.strategies.exporters import ExportContents, PairContents
from aeromatch_cli.strategies.exporters.contents import Colours

log = logging.getLogger("aeromatch")

_Verified = Callable[[Context], Judged]


def contents_of(
    context: Context,
    adjusted: AdjustedBlock | None = None,
    verified: _Verified = lambda context: BlockState.of(context).judged_pairs(),
    *,
    raw: bool = True,
) -> ExportContents:
    """Return what exporters and mappers get. Read lazily: one row and one image's keypoints at a time.

    adjusted: keypoints are those that its poses see, without what a rolling shutter has moved. verified: where the
    verified matches come from. raw: whether the matches before verification are wanted; else the verified ones stand
    for them.
    """

    def keypoints_px(image_id: str) -> FloatArray:
        # An image whose extraction failed is exported without keypoints, so that ids stay complete.
        return read_final_keypoints(context.workspace.features(image_id), context.workspace.refined(image_id))

    if not context.settings.match.reads_pixels:
        return _contents(context, keypoints_px, _pairs(context, verified, raw=raw), adjusted)
    matched = list(_matched(context, verified))
    tracks = tracks_of(matched, keypoints_px, lambda image_id: context.block.camera(context.image_by_id[image_id]))

    def with_measured_px(image_id: str) -> FloatArray:
        return tracks.keypoints_px[image_id] if image_id in tracks.keypoints_px else keypoints_px(image_id)

    return _contents(context, with_measured_px, _joined(matched, tracks), adjusted)


def _contents(
    context: Context,
    keypoints_px: Callable[[str], FloatArray],
    pairs: Iterable[PairContents],
    adjusted: AdjustedBlock | None,
) -> ExportContents:
    block, given = context.block, context.given.block.poses

    def geographic(world_m: FloatArray) -> FloatArray:
        places_m = world_m + np.array(block.origin_m)
        return np.column_stack([geographic_from_grid(block.crs, places_m[:, :2]), places_m[:, 2]])

    as_stored_px = keypoints_px

    def colours(image_id: str) -> Colours | None:
        try:
            pixels = read_pixels(context.image_path(context.image_by_id[image_id]), colour=True)
        except ItemError as error:
            log.warning("warning: export: the points of an image stay grey: %s", error)
            return None
        places_px = as_stored_px(image_id)
        return sample_colours(pixels, places_px, np.ones(len(places_px)))

    if adjusted is not None:
        keypoints_px = at_once(adjusted, adjusted.cameras_of(block), keypoints_px)
    path = context.workspace.residuals
    residuals = read_residuals(path, block.images) if adjusted is not None and path.is_file() else {}
    known = None if block.crs == LOCAL else geographic
    return ExportContents(
        block, keypoints_px, pairs, context.guessed_cameras, given, adjusted, known, residuals, colours
    )


def residuals_of_points(contents: ExportContents) -> dict[str, PoseResidual]:
    """Return the residuals of the adjusted images with figures of those points that final matches hold."""
    block = contents.adjusted
    if block is None:
        return {}
    seen, cameras = images_per_point(block), block.cameras_of(contents.block)
    return {
        i: with_points(one, block, i, cameras[i], contents.keypoints_px, seen) for i, one in contents.residuals.items()
    }


def _joined(matched: Iterable[MatchedPair], tracks: Tracks) -> Iterator[PairContents]:
    for item in matched:
        key, verdict = (item.pair.image_id0, item.pair.image_id1), item.verified.verdict
        yield PairContents(item.pair, tracks.raw[key], tracks.verified[key], verdict.model_kind, verdict.model)


def _pairs(context: Context, verified: _Verified, *, raw: bool) -> Iterator[PairContents]:
    pairs = _matched(context, verified) if raw else (MatchedPair(pair, e.matches, e) for pair, e in verified(context))
    for item in pairs:
        verdict, kept = item.verified.verdict, item.verified.matches.indices
        # A filter may keep matches of a pair that it cannot verify.
        kept = kept if verdict.state == "verified" else kept[:0]
        yield PairContents(item.pair, item.raw.indices, kept, verdict.model_kind, verdict.model)


def _matched(context: Context, verified: _Verified) -> Iterator[MatchedPair]:
    row_id, row = "", dict[str, MatchEntry]()
    for pair, entry in verified(context):
        if pair.image_id0 != row_id:
            row_id, row = pair.image_id0, read_match_row(context.workspace.matches(pair.image_id0))
        found = row.get(pair.image_id1)
        if found is None:  # the row was rewritten under another configuration while this one ran
            raise BrokenFileError(str(context.workspace.matches(pair.image_id0)), f"no entry {pair.image_id1}")
        yield MatchedPair(pair, found.matches, entry)
