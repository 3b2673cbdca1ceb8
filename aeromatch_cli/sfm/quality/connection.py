"""Criteria of how the images of a block hang together: groups, unregistered images, parts, rejected matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from aeromatch_cli.results.stages import OrientResult
from aeromatch_cli.sfm.quality.finding import (
    WRONG_POSITIONS,
    Finding,
    Found,
    Limits,
    QualityInput,
    finding_of,
    plain,
    positions_given,
    rms,
)
from aeromatch_cli.words import MANY, counted, form, listed

# Share of the images that are not oriented, or not in the largest part: none is as it should be.
_LEFT_OUT: Limits = (0.0, 0.2)
# Parts of so many images and more that share too few points with the others to be tied by them.
_PART_IMAGES = 3
# Share of the verified matches that the adjusted block contradicts. Sound blocks have 1 to 16 %.
_CONTRADICTED: Limits = (0.25, 0.6)
# Share of the images of which it contradicts so many that these are no exceptions.
_CONTRADICTING: Limits = (0.05, 0.5)
# Share of the images whose matches kept poses (orient=given) do not explain.
_UNEXPLAINED: Limits = (0.1, 0.5)
# So many positions, or points, hold a block.
_HOLDING = 3


def connection(evidence: QualityInput) -> Iterator[Finding]:
    """Judge whether verified pairs connect all images."""
    sizes = list(evidence.components)
    if not sizes:
        return
    beside = 1.0 - max(sizes) / max(evidence.images, 1)
    if len(sizes) == 1:
        yield Finding("connection", 0.0, 0.0, "good", "all images are connected")
        return
    words = f"{len(sizes)} groups of images ({listed(sizes, MANY)}) that no verified pair connects"
    if 0 < evidence.components_before < len(sizes):
        before = "one" if evidence.components_before == 1 else f"{evidence.components_before}"
        words += f", {before} before the stage consistency dropped matches"
    hidden = "; --set pairs=exhaustive finds pairs that positions hide" if evidence.hidden_pairs else ""
    yield finding_of("connection", beside, _LEFT_OUT, words, f"more overlap between them helps{hidden}")


def unread(evidence: QualityInput) -> Iterator[Finding]:
    """Judge how many images could not be read."""
    if not evidence.unread:
        return
    lacking, images = len(evidence.unread), evidence.images + len(evidence.unread)
    verb = form(lacking, "is", "are")
    words = f"{lacking} of {images} images {verb} not in the block, since the pictures could not be read"
    remedy = f"replace or remove {evidence.named(evidence.unread)}; failures.csv says why"
    yield finding_of("unread images", lacking / images, _LEFT_OUT, words, remedy)


def left_out(evidence: QualityInput) -> Found:
    """Judge how many images are not registered."""
    outside = list(evidence.adjust.outside)
    missing = max(len(outside), evidence.images - evidence.adjust.images)
    oriented = evidence.images - missing
    readable = " that could be read" if evidence.unread else ""
    words = f"{oriented} of {evidence.images} images{readable} {form(oriented, 'is', 'are')} oriented"
    if outside:
        one = evidence.names.get(outside[0], outside[0])
        remedy = (
            f"not oriented: {evidence.named(outside)}; lost.csv says why; `aeromatch show WORK {one}` shows "
            "what it has; images of other places may be left out"
        )
    else:
        remedy = "the others have too few points in common with them; more overlap helps"
    yield finding_of("oriented images", missing / max(evidence.images, 1), _LEFT_OUT, words, remedy)


def frames(evidence: QualityInput) -> Found:
    """Parts of frames of their own, and whether anything ties the block to the ground."""
    kinds = [group.kind for group in evidence.groups]
    parts = kinds.count("level") + any(kind != "level" for kind in kinds)  # those that positions place lie in one frame
    if parts > 1 and len(evidence.components) <= 1:
        words = (
            f"{parts} parts whose scale and place nothing ties to each other: positions (--poses) place each of them"
        )
        yield Finding("parts", float(parts), 1.0, "bad", words)
    elif parts > 1:
        loose = [group.images for group in evidence.groups if group.kind == "level"]
        yield _loose_parts(loose if len(loose) < len(kinds) else loose[1:])  # the largest is the first
    yield from _placed_parts(evidence)
    given = positions_given(evidence)
    used = sum(group.positions.used for group in evidence.groups if group.positions)
    kept = any(kind == "given" for kind in kinds)
    # Control points that took no part show how the block is to be moved; they do not hold it.
    surveyed = sum(len(group.control.used) for group in evidence.groups if group.control)
    if used >= _HOLDING or surveyed >= _HOLDING or kept:
        return
    orient = evidence.orient
    if given >= _HOLDING and orient is not None and not any(model.contradiction for model in orient.models):
        words = (
            f"none of the {given} given positions is used: too few are of images that are oriented together, or they "
            "are all of one place"
        )
        yield Finding("positions", 1.0, WRONG_POSITIONS[0], "bad", words)
    elif given >= _HOLDING:
        yield Finding("positions", 1.0, WRONG_POSITIONS[0], "bad", _contradicted_words(given, orient))
    else:
        what = "the given position is" if given == 1 else f"the {given} given positions are"
        enough = f"{what} not enough, those (--poses) of three images that are oriented together are"
        words = (
            "shape only: nothing ties the block to the ground, place, north and scale are arbitrary: "
            f"{enough if given else 'positions (--poses) do'}; control points alone show how the block is to be moved"
        )
        yield Finding("ground", None, None, "doubtful", words)


def _contradicted_words(given: int, orient: OrientResult | None) -> str:
    """Say that the pictures contradict all given positions, and what to look at. An orientation by single pairs, which
    no third image checks, may be the wrong one of both."""
    words = f"none of the {given} given positions is used, the pictures contradict them"
    tied = 0 if orient is None else len({*orient.by_ground, *orient.by_one_pair})
    if orient is not None and 2 * tied > orient.images_matched:
        return (
            f"{words}, though {tied} of {counted(orient.images_matched, 'image')} are oriented by a single pair each, "
            "which no third image checks: more overlap tells which of both is wrong; orient=given keeps the given poses"
        )
    return f"{words}: check the coordinate system, the order of x and y, and which position belongs to which image"


def weak_ties(evidence: QualityInput) -> Found:
    """Parts of a block that is one by single points; several parts are judged by `_placed_parts`."""
    parts = [size for size in evidence.adjust.tied_parts if size >= _PART_IMAGES]
    if len(parts) > 1 and len(evidence.groups) == 1:
        words = (
            f"{_sizes(parts)} share fewer than 20 points: single points, or their positions, put them to each other; "
            "more overlap between them helps"
        )
        yield Finding("weakly tied parts", float(len(parts)), 1.0, "doubtful", words)


def contradicted(evidence: QualityInput) -> Found:
    """Matches that the block contradicts, and images of which it contradicts most."""
    if evidence.contradicted is None:
        return
    remedy = (
        "many of them are wrong, or poses and cameras are: `aeromatch show WORK IMAGE IMAGE --rejected` shows those of "
        "a pair; repeated patterns, water and moving shadows need other settings or --masks"
    )
    words = f"the adjusted block contradicts {100.0 * evidence.contradicted:.0f} % of the verified matches"
    yield finding_of("contradicted matches", evidence.contradicted, _CONTRADICTED, words, remedy)
    count = len(evidence.contradicting)
    words = f"most matches of {count} of {evidence.images} images contradict the adjusted block"
    if count:
        words += f" ({evidence.named(evidence.contradicting)})"
    yield finding_of("contradicting images", count / max(evidence.images, 1), _CONTRADICTING, words, remedy)


def _placed_parts(evidence: QualityInput) -> Iterator[Finding]:
    placed = [(group, group.positions) for group in evidence.groups if group.kind == "positions" and group.positions]
    pixel_m = evidence.adjust.ground_pixel_m
    if len(placed) < 2 or not pixel_m:
        return
    # Of a part of N images by the square root of N better; that of the smallest counts.
    exact_m = max(rms(positions.stated_m) / np.sqrt(max(positions.used, 1)) for _, positions in placed)
    sizes = _sizes([group.images for group, _ in placed])
    words = (
        f"{sizes} share too few points and lie to each other as their positions put them, to {plain(exact_m)} m "
        f"({exact_m / pixel_m:.1f} ground pixels): more overlap between them, better positions, or control points in "
        "each tie them"
    )
    yield Finding("parts", float(exact_m / pixel_m), None, "doubtful", words)


def _loose_parts(images: Sequence[int]) -> Finding:
    """Say that parts which no pair ties to the others lie in frames of their own. images: of each."""
    if len(images) == 1:
        words, them = f"1 part ({counted(images[0], 'image')}) has a frame of its own", "it"
    else:
        words, them = f"{_sizes(images)} have frames of their own", "each"
    words += (
        f": scale, north and place are arbitrary there; export=colmap writes a model of {them}, and "
        f"positions (--poses) of its images place {them}"
    )
    return Finding("parts", float(len(images) + 1), 1.0, "doubtful", words)


def _sizes(parts: Sequence[int]) -> str:
    return f"{len(parts)} parts (images: {listed(parts, MANY)})"


def kept_poses(evidence: QualityInput) -> Found:
    """Judge whether poses that were kept as they were given explain the matches."""
    orient = evidence.orient
    if orient is None or not orient.stays or not orient.images_matched:
        return
    matched, explained = orient.images_matched, orient.given_poses_explained
    words = f"given poses explain the matches of {explained} of {matched} images"
    remedy = "they are kept because of orient=given; orient=global finds better ones"
    yield finding_of("kept poses", 1.0 - explained / matched, _UNEXPLAINED, words, remedy)
