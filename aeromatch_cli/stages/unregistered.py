"""Why images are not oriented: what they lack, from their keypoints to points in common with oriented images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Pair
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.simulate import degenerate_view
from aeromatch_cli.stages.stage_report import gather_failures
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.words import counted

# An image with fewer keypoints than this share of the median shows hardly any texture, or is blurred.
_FEW_KEYPOINTS = 0.1


def unregistered_reasons(
    context: Context, adjusted: AdjustedBlock, without_results: Sequence[Pair] = (), stopped: str = ""
) -> dict[str, str]:
    """image_id -> why it is not oriented. without_results: pairs beside those of the context, which are not verified
    by the present settings. stopped: why the adjustment has failed, where it has."""
    outside = [i.image_id for i in context.block.images if i.image_id not in adjusted.poses]
    if not outside:
        return {}
    pairs = Counter(image_id for pair in context.pairs for image_id in pair.ids)
    failed = Counter(image_id for pair in without_results for image_id in pair.ids)
    verified: Counter[str] = Counter()
    tied: Counter[str] = Counter()
    for pair, entry in BlockState.of(context).judged_pairs():
        if entry.verdict.state == "verified":
            ends = pair.image_id0, pair.image_id1
            verified.update(ends)
            tied.update(i for i in ends if any(other in adjusted.poses for other in ends if other != i))
    keypoints = {
        image.image_id: len(read_keypoints(path)[0]) if (path := context.workspace.features(image.image_id)).exists()
        else 0 for image in context.block.images
    }  # fmt: skip
    usual = float(np.median(list(keypoints.values())))
    unread = {item: why for stage, item, why in gather_failures(context.workspace) if stage == "extract"}
    reasons = {}
    for image_id in outside:
        count = keypoints[image_id]
        if image_id in unread:
            reasons[image_id] = f"no features: {unread[image_id]}"
        elif count <= _FEW_KEYPOINTS * usual and not context.settings.match.reads_pixels:
            seen = degenerate_view(context.workspace, context.image_by_id[image_id]) or "no texture, or blurred"
            reasons[image_id] = f"{counted(count, 'keypoint')}, the median is {usual:.0f}: {seen}"
        elif not pairs[image_id] and failed[image_id]:
            reasons[image_id] = f"{_none_of(failed[image_id])} be matched and verified: see failures.csv"
        elif not pairs[image_id]:
            reasons[image_id] = "in no pair: it overlaps no other image"
        elif not verified[image_id]:
            reasons[image_id] = f"{_none_of(pairs[image_id])} be verified"
        elif not adjusted.poses:
            pairs_words = counted(verified[image_id], "verified pair")
            reasons[image_id] = stopped or f"no image could be oriented ({pairs_words} of this one)"
        elif verified[image_id] == 1 and not tied[image_id]:
            reasons[image_id] = "its only verified pair is with an image that is not oriented either"
        elif not tied[image_id]:
            reasons[image_id] = f"its {verified[image_id]} verified pairs are with images that are not oriented either"
        else:
            pairs_words = counted(tied[image_id], "verified pair")
            reasons[image_id] = f"too few points in common with oriented images ({pairs_words})"
    return reasons


def _none_of(pairs: int) -> str:
    return "its only pair could not" if pairs == 1 else f"none of its {pairs} pairs could"
