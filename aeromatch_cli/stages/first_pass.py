"""The first pass: source images at reduced size, few descriptors, fundamental matrices; a small workspace of its own.

It is cheap, and it leans on nothing that the user says of attitudes and focal lengths: what it finds can judge them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from aeromatch_cli.data import Block, Pair
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.sfm.epipolar_agreement import PairPoints
from aeromatch_cli.sfm.mapping_process import LARGE_BLOCK
from aeromatch_cli.sfm.retrieval import similar_pairs
from aeromatch_cli.stages import extract, filter, match  # noqa: A004
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.strategies.enhancers.none import NoEnhancement
from aeromatch_cli.strategies.extractors.reduction import LEAST_PX
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.filters.poselib import Poselib
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.orienters import FirstPass
from aeromatch_cli.strategies.pairings.neighbours import fallback_pairs
from aeromatch_cli.strategies.simulators.none import SourceOnly

# A look at given poses needs less than finding poses does: reduced size (in pixels, and as a share of the images, but
# no less than so many pixels), share of the keypoints, neighbours.
_LOOK_SIZE_PX, _LOOK_SHARE, _LOOK_LEAST_PX = 1200, 0.6, 400
_LOOK_KEYPOINTS, _LOOK_NEIGHBOURS = 0.5, 8
# So many images are all compared with each other, whatever their positions say.
ALL_PAIRS_UP_TO = _LOOK_NEIGHBOURS + 1
# A block that falls into parts is searched once more with so many times the keypoints, where it has so many pairs at
# most: comparing them takes the square of that as long.
_MORE_KEYPOINTS, _MOST_DEAR_PAIRS = 3, 2000
# In large blocks each image takes fewer neighbours, and small pictures fewer keypoints (one for so
# many pixels): 300 images of 480 x 360 are oriented in half the time, and as exactly.
_LARGE_BLOCK_NEIGHBOURS, _PX_PER_KEYPOINT, _LEAST_KEYPOINTS = 12, 200, 500
# Up to so many pairs of images without position are all compared: less than two minutes on two cores.
_MOST_PAIRS = 12_000


def is_large(block: Block) -> bool:
    """Whether a block has so many images that each one needs less of the first pass."""
    return len(block.images) > LARGE_BLOCK


def fitted(recipe: FirstPass, block: Block) -> FirstPass:
    """Return the first pass as it is made of a block: large ones have ties to spare."""
    if not is_large(block):
        return recipe
    most_px = max(_pixels(recipe, block))
    return recipe.model_copy(
        update={
            "keypoints": min(recipe.keypoints, max(_LEAST_KEYPOINTS, round(most_px / _PX_PER_KEYPOINT))),
            "neighbours": min(recipe.neighbours, _LARGE_BLOCK_NEIGHBOURS),
        }
    )


def look(recipe: FirstPass, block: Block) -> FirstPass:
    """Return the cheaper first pass by which given poses are judged before they are found anew.

    Rendered farmland, flight `cross`, 16 images with right poses: 8 seconds instead of 13.
    """
    longest_px = max(max(image.width_px, image.height_px) for image in block.images)
    size_px = max(_LOOK_LEAST_PX, min(_LOOK_SIZE_PX, round(_LOOK_SHARE * longest_px)))
    return recipe.model_copy(
        update={
            "size_px": min(recipe.size_px, size_px),
            "keypoints": max(100, round(_LOOK_KEYPOINTS * recipe.keypoints)),
            "neighbours": min(recipe.neighbours, _LOOK_NEIGHBOURS),
        }
    )


def thorough(recipe: FirstPass, first: Context) -> FirstPass | None:
    """Return the dearer first pass of a block in parts; None where it would take too long. first: the one that was
    run. A block that needs it: that of tests/test_judged_block.py, with 120 keypoints 3 of 5 images without it."""
    if max(len(first.pairs), count_pairs(first, recipe)) > _MOST_DEAR_PAIRS:
        return None
    return recipe.model_copy(update={"keypoints": _MORE_KEYPOINTS * recipe.keypoints})


def finer(recipe: FirstPass, block: Block) -> FirstPass | None:
    """Return the first pass that halves no image; None where none is halved anyway."""
    most_px = max(_pixels(recipe, block))
    if recipe.pixels_per_keypoint == 0.0 or most_px < max(
        recipe.pixels_per_keypoint * recipe.keypoints, 4.0 * LEAST_PX
    ):
        return None
    return recipe.model_copy(update={"pixels_per_keypoint": 0.0})


def _pixels(recipe: FirstPass, block: Block) -> Iterator[float]:
    """Pixels of the images of a first pass, by size."""
    for w, h in {(image.width_px, image.height_px) for image in block.images}:
        yield w * h * min(1.0, recipe.size_px / max(w, h)) ** 2


def prepared(context: Context, recipe: FirstPass, part: str = "first pass") -> Context:
    """Return the context of the first pass of a block, without pairs; nothing is run yet. part: what is said to be
    done."""
    settings = context.settings
    limit = settings.block.max_size_px
    size_px = min(recipe.size_px, limit) if limit else recipe.size_px
    own = settings.model_copy(
        update={
            "seed": 0,  # another seed of the matching changes no orientation
            "block": settings.block.model_copy(update={"max_size_px": size_px}),
            "run": settings.run.model_copy(update={"keep_images": False}),
            "enhance": NoEnhancement(),
            "simulate": SourceOnly(),
            "extract": Sift(keypoints=recipe.keypoints, pixels_per_keypoint=recipe.pixels_per_keypoint),
            "match": Nearest(),
            "filter": (Poselib(model="fundamental"),),
        }
    )
    # Attitudes and ground are on trial: nothing here may depend on them.
    poses = {i: replace(pose, world_rotation=None) for i, pose in context.block.poses.items()}
    block = replace(context.block, poses=poses, ground=None, gsd_m=None)
    return replace(
        context,
        settings=own,
        workspace=context.workspace.first_pass,
        block=block,
        pairs=(),
        scope=replace(context.scope, shard=None, part=f"{part}: "),
    )


def run(context: Context, recipe: FirstPass, *, by_position: bool = True) -> tuple[Context, list[str]]:
    """Extract, choose pairs, match and filter; the context with the pairs, and the images and rows that failed.

    by_position: pairs lean on the given positions. What fails is left out here and named by the final pass.
    """
    context.workspace.create()
    reports = [extract.run(context)]
    chosen, similar = _pairs(context, recipe, by_position=by_position)
    nan = float("nan")
    pairs = tuple(Pair(id0, id1, nan, nan, "first pass") for id0, id1 in sorted(chosen))
    context = replace(context, pairs=pairs, block=replace(context.block, similar=similar))
    if pairs:
        reports += [match.run(context), filter.run(context)]
    return context, sorted({item for report in reports for item, _ in report.failures})


def mended(context: Context, recipe: FirstPass, failed: Sequence[str]) -> bool:
    """Whether any of what failed in a first pass does so no longer. Images are tried; of pairs nothing is known."""
    images = context.image_by_id.keys() & set(failed)
    if len(images) < len(failed):
        return True
    own = prepared(context, recipe)
    tasks = [extract.task_of(own, image_id) for image_id in sorted(images)]
    tried = context.executor.run(extract.run_task, tasks, "first pass: images that failed")
    return any(outcome.value is not None for outcome in tried)


def _pairs(
    context: Context, recipe: FirstPass, *, by_position: bool
) -> tuple[set[tuple[str, str]], tuple[tuple[str, str], ...]]:
    """Nearest neighbours by position. Of images without position all pairs in a small block, in a large one those that
    look alike. Second: the pairs that look alike, where pairs=similar asks for them."""
    block, asked = context.block, context.settings.similar
    ids = sorted(image.image_id for image in block.images)
    count = len(ids) * (len(ids) - 1) // 2
    candidates = recipe.neighbours if asked is None else asked.candidates
    placed = [i for i in ids if i in block.poses] if by_position and not asked else []
    near = set(fallback_pairs(block, placed, recipe.neighbours))
    if len(placed) == len(ids):
        return near, ()
    if count <= (candidates * len(ids) if asked else _MOST_PAIRS):
        every = set(combinations(ids, 2))
        return every, tuple(sorted(every)) if asked else ()
    with context.executor.step("first pass: image retrieval"):
        similar = similar_pairs({i: context.workspace.features(i) for i in ids}, candidates)
    return near | {pair for pair in similar if not set(pair) <= set(placed)}, tuple(similar) if asked else ()


def count_pairs(context: Context, recipe: FirstPass) -> int:
    """Count the pairs that a first pass compares, or at most as many; nothing is run."""
    block = context.block
    count = len(block.images) * (len(block.images) - 1) // 2
    if len(block.poses) < len(block.images):
        return count if count <= _MOST_PAIRS else recipe.neighbours * len(block.images)
    return len(fallback_pairs(block, list(block.poses), recipe.neighbours))


def verified_points(context: Context) -> Iterator[PairPoints]:
    """Yield verified matches of the first pass, stored pixels."""
    keypoints = {}
    for pair, entry in BlockState.of(context).judged_pairs():
        if entry.verdict.state != "verified":
            continue
        for image_id in (pair.image_id0, pair.image_id1):
            if image_id not in keypoints:
                keypoints[image_id] = read_keypoints(context.workspace.features(image_id))[0].astype(np.float64)
        indices = entry.matches.indices
        points0, points1 = keypoints[pair.image_id0][indices[:, 0]], keypoints[pair.image_id1][indices[:, 1]]
        yield PairPoints(pair.image_id0, pair.image_id1, points0, points1, indices)
