"""check: a dry run. Decodes every image, times a sample, and says what a run would need; writes nothing."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.data import Pair, Pose
from aeromatch_cli.sfm.epipolar_agreement import EXPLAINED_SHARE, MIN_MATCHES, PairPoints, explained_share
from aeromatch_cli.stages import cascade, extract, first_pass, simulate
from aeromatch_cli.stages.block import with_gsd
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.memory import command_mb, runs_network
from aeromatch_cli.stages.models import thresholds_px
from aeromatch_cli.stages.timing import (
    ImageTrial,
    Tried,
    TriedPair,
    adjusting_s,
    duration,
    mean,
    measuring_s,
    page_s,
    time_pairs,
    tried_pair,
    try_image,
)
from aeromatch_cli.strategies.orienters import FirstPass
from aeromatch_cli.words import counted

# Of what the stages write, measured on blocks of 8 and 9 images of 0.75 megapixels. A match is written before and after
# verification, and with a cascade once more by its step.
_BYTES_PER_DESCRIPTOR, _BYTES_PER_MATCH = 170.0, 34.0
# What a cascade has found together, per keypoint; and refined keypoints, with what they were measured from.
_BYTES_PER_UNITED, _BYTES_PER_REFINED = 18.0, 20.0
# Per match: the adjusted block, and what an exporter writes of its observations.
_BYTES_PER_ADJUSTED, _BYTES_PER_EXPORTED = 25.0, 90.0
# The page, and the reduced pictures on it, by the pixels of the images up to where these are reduced.
_BYTES_OF_PAGE, _BYTES_PER_PIXEL, _BYTES_PER_PICTURE = 0.8e6, 0.16, 0.12e6
# How many pairs are tried.
_SAMPLED_PAIRS = 3
# From where images look at the ground in trials, as nothing is known of them.
_TRIAL_HEIGHT_M = 100.0
# Seconds of mapping, and per image: measured 0.04 (300 images of 480 x 360) to 0.4 (8 images, and ochota).
_MAPPING_S, _MAPPING_S_PER_IMAGE = 1.5, 0.15


@dataclass(frozen=True)
class Check:
    """Lines for people, estimate for machines, images that cannot be read."""

    lines: tuple[str, ...]
    estimate: dict[str, Any]
    failures: tuple[tuple[str, str], ...]


def run(context: Context, reading_s: float, lost: int, *, oriented: bool) -> Check:
    """Try every image, and the strategies on a few pairs.

    reading_s: what it took to read the block. lost: images that were found but are not part of it. oriented: whether
    the orientation is on file, or is not wanted.
    """
    images = list(context.block.images)
    sampled = _sample(context)
    seen = context if oriented else _looking_down(context)
    ids = {image_id for pair in sampled for image_id in (pair.image_id0, pair.image_id1)}
    trials = [ImageTrial(extract.make_task(seen, image), image.image_id in ids) for image in images]
    largest_px = max(map(_pixels, trials))
    outcomes = context.executor.run(try_image, trials, "check")
    failures = tuple((i.name, o.error) for i, o in zip(images, outcomes, strict=True) if o.value is None)
    timed = {
        image.image_id: outcome.value
        for image, outcome in zip(images, outcomes, strict=True)
        if outcome.value is not None and image.image_id in ids
    }
    features = {image_id: tried.features for image_id, tried in timed.items() if tried.features is not None}
    estimate = _estimate(context, largest_px, timed, time_pairs(context, sampled, features), reading_s)
    estimate["readable_images"] = len(images) - len(failures)
    estimate["seconds_to_orient"] = 0.0
    if not oriented:
        estimate["seconds_to_orient"], first_keypoints = _orientation(context, sampled)
        estimate["disk_mb"] = round(
            estimate["disk_mb"] + len(images) * first_keypoints * _BYTES_PER_DESCRIPTOR / 1e6, 1
        )
    estimate["seconds_of_further_steps"] = _further_s(seen, sampled)
    if estimate["seconds"] is not None:
        own_s = estimate["seconds"] - estimate["seconds_to_start"] + (estimate["seconds_to_orient"] or 0.0)
        keypoints = mean([len(found.keypoints_px) for found in features.values()])
        estimate["seconds_after_matching"] = round(_later_s(context, keypoints), 1)
        estimate["seconds"] = round(estimate["seconds_to_start"] + own_s + estimate["seconds_after_matching"], 1)
    return Check(_lines(context, estimate, len(images) + lost), estimate, failures)


def _looking_down(context: Context) -> Context:
    """The block as `orient` may find it, where no image has an attitude: their views and neighbours cost as much as
    those of images that look straight down from one height. Only for trials."""
    block = context.block
    found = context.settings.first_pass is not None and not context.settings.match.reads_pixels
    if not found or any(pose.world_rotation is not None for pose in block.poses.values()):
        return context
    nowhere = Pose(np.zeros(3), None, math.inf, math.inf)
    poses = {
        image.image_id: replace(
            pose, center_m=np.array([*pose.center_m[:2], _TRIAL_HEIGHT_M]), world_rotation=np.diag([1.0, -1.0, -1.0])
        )
        for image in block.images
        for pose in [block.poses.get(image.image_id, nowhere)]
    }
    block = replace(block, poses=poses, ground=ConstantGround(0.0))
    return replace(context, block=with_gsd(block, (None, None), context.settings.block.max_size_px))


def _later_s(context: Context, keypoints: float) -> float:
    """Seconds of what follows matching. keypoints: of an image, on average."""
    return measuring_s(context, keypoints) + adjusting_s(context, keypoints) + page_s(context)


def _orientation(context: Context, sampled: Sequence[Pair]) -> tuple[float | None, int]:
    """Seconds that the first pass and the mapping take, by trials of sampled pairs, None where their images cannot be
    read; and keypoints of each image in the first pass that stays on file. Workers are ready by then. Given poses are
    looked at, and found anew where they do not explain the sampled pairs."""
    recipe, block = context.settings.first_pass, context.block
    if recipe is None or not sampled:
        return None, 0
    recipe, seconds = first_pass.fitted(recipe, block), 0.0
    if sum(pose.world_rotation is not None for pose in block.poses.values()) == len(block.images):
        look = first_pass.look(recipe, block)
        looking = first_pass.prepared(context, look)
        tried = [tried_pair(looking, pair) for pair in sampled]
        known = [one for one in tried if one is not None]
        if not known:
            return None, look.keypoints
        seconds = _pass_s(context, look, known[0])
        if _explained(context, looking, list(zip(sampled, tried, strict=True))) or not recipe.replaces:
            return round(seconds, 1), look.keypoints
    found = tried_pair(first_pass.prepared(context, recipe), sampled[0])
    if found is None:
        return None, recipe.keypoints
    mapping_s = _MAPPING_S + _MAPPING_S_PER_IMAGE * len(block.images)
    return round(seconds + _pass_s(context, recipe, found) + mapping_s, 1), recipe.keypoints


def _pass_s(context: Context, recipe: FirstPass, tried: TriedPair) -> float:
    """Seconds of a first pass."""
    count, pairs = len(context.block.images), first_pass.count_pairs(context, recipe)
    return (count * tried.image_s + pairs * tried.pair_s) / context.executor.jobs


def _explained(context: Context, first: Context, tried: Sequence[tuple[Pair, TriedPair | None]]) -> bool:
    """Whether given poses explain the matches of all sampled pairs that have enough of them."""
    block = context.block
    cameras = {image.image_id: block.camera(image) for image in block.images}
    points = [
        PairPoints(pair.image_id0, pair.image_id1, *one.verified, np.zeros((len(one.verified[0]), 2), np.int64))
        for pair, one in tried
        if one is not None and len(one.verified[0]) >= MIN_MATCHES
    ]
    shares = [explained_share(pair, block.poses, cameras, thresholds_px(first)) for pair in points]
    return all(share >= EXPLAINED_SHARE for share in shares)


def _further_s(context: Context, sampled: Sequence[Pair]) -> float | None:
    """Seconds that the further steps of a cascade take where every pair needs them; None where that is unknown."""
    every_s = 0.0
    for step in cascade.further_steps(context):
        tried = tried_pair(step.context, sampled[0]) if sampled else None
        if tried is None:
            return None
        every_s += step.own_features * len(context.block.images) * tried.image_s + len(context.pairs) * tried.pair_s
    return round(every_s / context.executor.jobs, 1)


def _sample(context: Context) -> list[Pair]:
    """Pairs at even distances in the list: those of steep and of oblique images cost differently."""
    count = min(_SAMPLED_PAIRS, len(context.pairs))
    return [context.pairs[(2 * k + 1) * len(context.pairs) // (2 * count)] for k in range(count)]


def _pixels(trial: ImageTrial) -> int:
    """Return the number of pixels that an image is worked on with: its own, reduced as the settings ask, or those of
    all its views."""
    views = simulate.views_of(trial.task.views)
    enhancing = trial.task.views.enhance
    if enhancing.enhancer.keep_source and not enhancing.skipped:
        views *= 2
    working = enhancing.source.working_camera
    return max(working.width_px * working.height_px, sum(view.width_px * view.height_px for view in views))


def _estimate(
    context: Context, largest_px: int, images: Mapping[str, Tried], pairs: Sequence[Tried], reading_s: float
) -> dict[str, Any]:
    """largest_px: of the image, or its views, that needs most memory. images, pairs: the sampled ones."""
    count, jobs = len(context.block.images), context.executor.jobs
    stored_px = max(image.width_px * image.height_px for image in context.block.images)
    seconds_image = mean([tried.seconds for tried in images.values()])
    seconds_pair = mean([tried.seconds for tried in pairs])
    found = [tried.features for tried in images.values() if tried.features]
    descriptors = max((len(features.descriptors) for features in found), default=0)
    keypoints = max((len(features.keypoints_px) for features in found), default=0)
    matches = mean([tried.matches for tried in pairs])
    disk = _disk_bytes(context, count * keypoints, count * descriptors, len(context.pairs) * matches)
    # Workers start side by side; the pairs of one image are one task.
    starts = sum(max((tried.start_s for tried in group), default=0.0) for group in (images.values(), pairs))
    longest = max((len(row) for row in context.rows().values()), default=0)
    turns = max(len(context.pairs) / jobs, longest)
    seconds = reading_s + starts + math.ceil(count / jobs) * seconds_image + turns * seconds_pair
    return {
        "pairs": len(context.pairs),
        "seconds_to_start": round(reading_s + starts, 3),
        "seconds_per_image": round(seconds_image, 3) if images else None,
        "seconds_per_pair": round(seconds_pair, 4),
        "seconds": round(seconds, 1) if images else None,
        "memory_mb": round(
            command_mb(jobs, largest_px / 1e6, network=runs_network(context.settings), stored=stored_px / 1e6)
        ),
        "disk_mb": round(disk / 1e6, 1),
        "disk_free_mb": round(shutil.disk_usage(_existing(context.workspace.root)).free / 1e6),
    }


def _disk_bytes(context: Context, keypoints: float, descriptors: float, matches: float) -> float:
    """Estimate the size of the finished workspace without the first pass, bytes. keypoints, descriptors: of all images;
    matches: of all pairs, before verification."""
    settings = context.settings
    total = descriptors * _BYTES_PER_DESCRIPTOR + matches * _BYTES_PER_MATCH * (2 if settings.cascade else 1)
    total += matches * _BYTES_PER_EXPORTED * len(settings.export)
    if settings.cascade:
        total += keypoints * _BYTES_PER_UNITED
    if settings.first_pass is not None:
        total += keypoints * _BYTES_PER_REFINED + matches * _BYTES_PER_ADJUSTED
    if settings.run.report:
        pixels = [image.width_px * image.height_px for image in context.block.images]
        total += _BYTES_OF_PAGE + sum(min(_BYTES_PER_PICTURE, count * _BYTES_PER_PIXEL) for count in pixels)
    return total


def _existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


def _lines(context: Context, estimate: dict[str, Any], images: int) -> tuple[str, ...]:
    seconds = estimate["seconds"]
    needed = "unknown (the sample could not be read)" if seconds is None else f"about {duration(seconds)}"
    further_s, names = estimate["seconds_of_further_steps"], " and ".join(s.name for s in context.settings.cascade)
    orient_s = estimate["seconds_to_orient"] or 0.0
    workers = counted(context.executor.jobs, "job")
    orienting = (
        f"orient    about {duration(orient_s)} of that, more where the first pass is poor; pairs above are those of "
        "the poses as they are given"
    )
    return (
        f"images    {estimate['readable_images']} of {images} can be used",
        f"pairs     {estimate['pairs']}",
        f"time      {needed} with {workers}",
        *([orienting] if seconds is not None and orient_s else []),
        *([f"further   {names}: up to {duration(further_s)} more, where all pairs need it"] if further_s else []),
        f"memory    about {estimate['memory_mb']} MB with {workers}",
        f"disk      about {estimate['disk_mb']} MB needed, {estimate['disk_free_mb']} MB free",
    )
