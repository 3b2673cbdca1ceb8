"""This module says in lines for people what stages have found."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from aeromatch_cli.data import Block
from aeromatch_cli.results.adjustment import Control, ControlInGroup, GroupResult, Xyz
from aeromatch_cli.results.stages import (
    AdjustResult,
    ConsistencyResult,
    EnhanceResult,
    ExtractResult,
    FilterResult,
    MatchResult,
    OrientResult,
    RefineResult,
    ViewsResult,
)
from aeromatch_cli.sfm.control import offset_words
from aeromatch_cli.sfm.mapping import Group
from aeromatch_cli.sfm.quality.finding import MANY_WRONG_POSITIONS, guess_words
from aeromatch_cli.stages.filter import WEAK_MATCHES
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.words import MANY, counted, form, listed

# What a control figure is of, in words.
_CHECKED = {"check points": "check points", "leave one out": "each control point, fitted without it"}


def stage_lines(stage: StageReport, names: Mapping[str, str], *, part: bool) -> list[str]:
    """Counts and time of a stage, and what it found. names: of the files, by image_id. part: of a shard."""
    if isinstance(stage.result, RefineResult) and not stage.items:
        return [f"{stage.stage:<11} not done"]
    counts = (
        f"{stage.part + stage.stage:<11} {stage.items:>7} {form(stage.items, 'item')}, {stage.done} done, "
        f"{stage.skipped} up to date, {len(stage.failures)} failed, {stage.seconds:.1f} s"
    )
    return [counts, *(f"          {line}" for line in _found(stage, names, part=part))]


def _found(stage: StageReport, names: Mapping[str, str], *, part: bool) -> list[str]:
    match stage.result:
        case FilterResult() as found:
            return _filter_lines(found, names, part=part)
        case ConsistencyResult() as found:
            return _consistency_lines(found, names)
        case AdjustResult() as found:
            return _adjust_lines(found, stage.items, names)
        case ViewsResult() as found:
            words = "; ".join(_views_words(found))
        case EnhanceResult() as found:
            words = "; ".join([*_skipped_words(found.images_skipped_same_illumination), *filter(None, [found.remark])])
        case MatchResult() as found:
            words = settled_words(found)
        case RefineResult(keypoints=keypoints, measured=measured, shift_px=float(shift_px)):
            words = f"{measured:,} of {keypoints:,} keypoints measured by least squares, by {shift_px:.2f} px (median)"
        case _:
            words = ""
    return [words] if words else []


def _views_words(found: ViewsResult) -> Iterator[str]:
    """Number and size of the views; of features also images that have none, and those that are not enhanced."""
    if found.images:
        views, megapixels = found.views_per_image, found.megapixels_per_image
        yield f"views per image: {views:.3g}, {megapixels:.3g} megapixels together"
    if isinstance(found, ExtractResult):
        if empty := found.images_without_keypoints:
            yield f"{counted(empty, 'image')} without keypoints"
        yield from _skipped_words(found.images_skipped_same_illumination)


def _skipped_words(count: int | None) -> list[str]:
    return [f"{counted(count, 'image')} not enhanced (skipped: same illumination)"] if count else []


def settled_words(found: MatchResult) -> str:
    """Say which steps of a cascade have given how many pairs enough matches, "" without a cascade."""
    if found.not_settled is None:
        return ""
    by, lacking = found.settled_by, found.not_settled
    whole = sum(by.values()) + lacking
    (first, count), *further = by.items()
    words = f"{count:,} of {counted(whole, 'pair')} {form(count, 'has', 'have')} enough matches after step {first}"
    words += "".join(f", {more:,} more after {name}" for name, more in further)
    fewer = f"{form(lacking, 'has', 'have')} fewer matches, or less of the overlap covered, than the last step asks for"
    return f"{words}; {lacking:,} {fewer}" if lacking else words


def _filter_lines(found: FilterResult, names: Mapping[str, str], *, part: bool) -> list[str]:
    """States of the pairs and how images are connected; of a part of the pairs (a shard) the states alone."""
    states = ", ".join(f"{count:,} {state}" for state, count in found.pairs.items()) or "none"
    lines = [f"pairs: {states}; {counted(found.verified_matches, 'verified match', 'verified matches')}"]
    if part:
        return lines
    if found.unread:
        lines.append(f"could not be read: {listed((names[i] for i in found.unread), MANY)}")
    components = found.components
    if len(components) > 1:
        lines.append(f"{len(components)} unconnected groups of images, of sizes {listed(components, MANY)}")
    else:
        lines.append("all images are connected")
    if found.weakly_tied:
        lines.append(f"weakly tied (< {WEAK_MATCHES} matches): {listed((names[i] for i in found.weakly_tied), MANY)}")
    return lines


def orientation_lines(
    found: OrientResult, given: Block, block: Block, guessed_cameras: Collection[str] = ()
) -> list[str]:
    """Say how the block was oriented, and what of the given poses and cameras is wrong. guessed_cameras: those whose
    focal length was a guess."""
    names = block.names
    words = _given_words(found, given) if found.poses_from == "given poses" else _picture_words(found, given, block)
    for camera_id, focal in found.focal_lengths.items():
        kept = ", but the given one is kept" if found.stays else ""
        sizes = f"{focal.found_px:.0f} px instead of {focal.given_px:.0f} px"
        words.append(f"focal length of camera {camera_id}: {sizes}{kept}")
    given_wrongly = ("attitudes", "degrees", found.wrong_attitudes), ("positions", "m", found.wrong_positions)
    for what, unit, wrong in given_wrongly:
        if wrong:
            named = listed((f"{names[i]} ({value:.0f} {unit})" for i, value in wrong.items()), MANY)
            done = "kept, as orient=given asks" if found.stays else "those that the pictures give are used"
            words.append(f"wrong {what} given; {done}: {named}")
    if len(found.wrong_positions) > MANY_WRONG_POSITIONS * len(given.poses):
        words += filter(None, [guess_words(sorted(guessed_cameras))])
    if found.outside:
        words.append(f"not oriented: {listed((names[i] for i in found.outside), MANY)}")
    return [f"{'orientation' if not row else '':<16} {line}" for row, line in enumerate(words)]


def _explained_words(found: OrientResult) -> str:
    return f"given poses explain the matches of {found.given_poses_explained} of {found.images_matched} images"


def _has_attitudes(given: Block) -> bool:
    return any(pose.world_rotation is not None for pose in given.poses.values())


def _given_words(found: OrientResult, given: Block) -> list[str]:
    if found.images_matched:
        return [_explained_words(found) if _has_attitudes(given) else "no attitudes were given"]
    return ["no matches to judge the given poses by" if _has_attitudes(given) else "no matches to find it by"]


def _picture_words(found: OrientResult, given: Block, block: Block) -> list[str]:
    sizes = [str(model.images) for model in found.models] or ["none"]
    groups = sizes[0] if len(sizes) == 1 else f"groups of {', '.join(sizes[:-1])} and {sizes[-1]}"
    words = [f"from the pictures: {groups} of {len(block.images)} images"]
    words += single_pair_words(found, block.names)
    words += [_explained_words(found)] if _has_attitudes(given) else []
    words += [
        f"by a further first pass, with {one.change}: a group of {one.images_then} images, not {one.images}"
        for one in found.further_first_passes
        if one.used
    ]
    if found.frame == "own" and given.crs != block.crs:
        words.append(f"in a local frame, not in {given.crs}")
    elif found.frame == "own" and given.poses:
        words.append("in a frame of its own, not that of the given positions")
    return words


def single_pair_words(found: OrientResult, names: Mapping[str, str]) -> list[str]:
    """Name the images that hang on the others by a single pair, and what tells their distance."""
    ways = (found.by_one_pair, "the given position"), (found.by_ground, "the height of the ground beside")
    return [
        f"{len(tied)} by a single pair each; {told} tells how far off they lie, less exactly than points of three "
        f"images: {listed([names[i] for i in tied])}"
        for tied, told in ways
        if tied
    ]


def frame_remarks(found: OrientResult, groups: Sequence[Group]) -> list[str]:
    """Say which groups of images nothing ties to the world. groups: images that were oriented together."""
    beside = sum(len(group.images) for group in groups if group.kind == "level")
    if not beside:
        return []
    given = found.positions_given
    why = "without usable positions" + (f" ({given} given, none places a group of oriented images)" if given else "")
    if found.frame == "own" and len(groups) > 1:
        return [
            f"{why} each of {len(groups)} groups of images is in a frame of its own: scale, north "
            "and place are arbitrary, and so is the distance between the groups"
        ]
    if found.frame == "own":
        return [f"{why} the result is in a frame of its own: scale, north and place are arbitrary"]
    what = counted(beside, "image is tied to no position and lies", "images are tied to no position and lie")
    return [f"{what} beside the others: scale, north and place are arbitrary, unless final matches tie them"]


def _adjust_lines(found: AdjustResult, images: int, names: Mapping[str, str]) -> list[str]:
    """Figures of the bundle adjustment, and images that it could not tie. images: of the block."""
    if not found.points:
        return found.remarks
    error_px = "unknown" if found.reprojection_error_px is None else f"{found.reprojection_error_px:.2f} px"
    words = [
        f"{found.images:,} of {images:,} images oriented, {counted(found.points, 'point')} in "
        f"{found.track_length:.1f} images each, reprojection error {error_px}"
    ]
    if len(found.groups) > 1:
        sizes = listed((group.images for group in found.groups), MANY)
        words.append(f"{len(found.groups)} groups of images, each oriented by itself: {sizes}")
    words += control_words(found.control, control_of(found.groups))
    words += found.remarks
    outside = list(found.outside.items())
    words += [f"not oriented: {names.get(image_id, image_id)}: {reason}" for image_id, reason in outside[:10]]
    words += [f"not oriented: {len(outside) - 10} more, listed in the report"] if len(outside) > 10 else []
    return words


def _consistency_lines(found: ConsistencyResult, names: Mapping[str, str]) -> list[str]:
    """Say what was dropped, and which images the adjusted block seems to hold in a wrong place."""
    doubtful = listed([names[i] for i in found.doubtful])
    lines = [f"too many matches contradict the adjusted poses of {doubtful}"] if doubtful else []
    if found.spread:
        lines += _final_lines(found)
    if found.remark:
        lines.append(found.remark)
    if not found.dropped_matches and not found.rejected_pairs:
        return lines
    rejected, expected, left = found.rejected_pairs, found.expected_right, found.verified_matches or 0
    pairs = f", all of {counted(rejected, 'pair')} among them" if rejected else ""
    right = "" if expected is None else f", of which {100 * expected:.1f} % are expected to be right to 3 px"
    words = f"{_dropped_words(found)}{pairs}"
    return [f"{words}; {counted(left, 'verified match is', 'verified matches are')} left{right}", *lines]


def _dropped_words(found: ConsistencyResult) -> str:
    """Say how many matches were dropped, and why."""
    dropped = found.dropped_matches
    # Those of earlier versions do not know the share of the one and of the other.
    contradicting = dropped if found.contradicting_matches is None else found.contradicting_matches
    unlikely = dropped - contradicting
    words = f"dropped {counted(dropped, 'match', 'matches')}"
    contradict = form(contradicting, "contradicts", "contradict")
    likely = f"{form(unlikely, 'is', 'are')} not likely to be right"
    if not unlikely:
        return f"{words} that {contradict} the adjusted block"
    if not contradicting:
        return f"{words} that {likely}"
    return f"{words}: {contradicting:,} {contradict} the adjusted block, {unlikely:,} {likely}"


def _final_lines(found: ConsistencyResult) -> Iterator[str]:
    """Say how many points final matches hold, and how evenly the images have them."""
    if found.points_left:
        length, error_px = found.observations_left / found.points_left, found.reprojection_error_px
        error = "" if error_px is None else f", reprojection error {error_px:.2f} px"
        yield f"{found.points_left:,} of {found.points:,} points are left, in {length:.1f} images each{error}"
    spread = found.spread.values()
    held, empty = sum(parts.held for parts in spread), sum(parts.empty for parts in spread)
    many = sorted(parts.points for parts in spread)[len(spread) // 2]
    have = form(empty, "has", "have")
    lacking = f", and {empty:,} {have} none though other images show the same ground" if empty else ""
    yield (
        f"{held:,} of {9 * len(spread):,} parts of images (3 x 3 each) have points{lacking}; "
        f"an image has {many:,} points that three or more images see (median)"
    )


def control_of(groups: Sequence[GroupResult]) -> list[ControlInGroup]:
    """Return what control points did in the adjustment of every group that has some."""
    return [group.control for group in groups if group.control is not None]


def control_words(control: Control | None, adjusted: Sequence[ControlInGroup] = ()) -> list[str]:
    """Say in words how large the errors at surveyed points are. adjusted: what control points did in the adjustment of
    every group."""
    if control is None:
        return []
    counts = f"control: {counted(control.control, 'control point')}, {counted(control.check, 'check point')}"
    if control.points and len(control.not_measured_in_two_images) == control.points:
        return [f"{counts}: none is measured in two oriented images: are its image names those of the block?"]
    apart = control.rays_do_not_meet
    wrong = [f"rays do not meet of {listed(apart)}: measured at another place in one image?"] if apart else []
    if once := control.not_measured_in_two_images:
        wrong.append(f"warning: points that are not measured in two oriented images are left out: {listed(once)}")
    taking_part = [words for one in adjusted for words in _adjusted_words(one)]
    if any(one.used for one in adjusted) or (taking_part and not control.control):
        return [counts, *wrong, *taking_part]
    if control.control_rmse_m is None:
        few = f"{counts}: fewer than 3 control points are measured in two oriented images; a transformation needs 3"
        return [few, *wrong, *taking_part]
    words = [counts, *wrong, *taking_part, offset_words(control)]
    words.append(
        f"after a similarity transformation onto the control points: RMSE at these {_axes(control.control_rmse_m)} m"
    )
    if control.check_rmse_m is not None and control.check_kind is not None:
        words[-1] += f", at {_CHECKED[control.check_kind]} {_axes(control.check_rmse_m)} m"
    if control.doubtful:
        words.append(f"control points that the others contradict: {listed(control.doubtful)}")
    return words


def _axes(errors_m: Xyz) -> str:
    return ", ".join(f"{axis} {error:.3f}" for axis, error in zip("xyz", errors_m, strict=True))


def _adjusted_words(control: ControlInGroup) -> Iterator[str]:
    """Yield in words what control points did in the adjustment of a group."""
    if control.fault:
        yield f"warning: the control points fit the block if {control.fault}: correct the list"
    if control.exchanged:
        yield f"names of control points that are exchanged: {listed(control.exchanged)}; they were left out"
    if control.wrong:
        yield f"control points that the others contradict: {listed(control.wrong)}; they were left out"
    with_m, without_m = control.held_out_rms_m, control.without_rms_m
    held_out = "check points" if control.held_out == "check points" else "control points left out in turn"
    errors = "" if with_m is None else f"; RMSE at {held_out}: {_axes(with_m)} m"
    errors += "" if with_m is None or without_m is None else f", without any control {_axes(without_m)} m"
    if control.kept and not control.used:
        yield f"the block as it is: RMSE at check points {_axes(with_m)} m" if with_m else "no check points"
    elif control.kept:
        used = counted(len(control.used), "control point takes", "control points take")
        yield f"{used} part in the adjustment{errors}"
    else:
        yield f"the control points were left out of the adjustment, since they make it no better{errors}"
