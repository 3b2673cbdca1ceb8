"""What stages have found, in lines for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from aeromatch_cli.data import Block
from aeromatch_cli.orientation.control import offset_words
from aeromatch_cli.stages import enhance, filter  # noqa: A004
from aeromatch_cli.stages.stage_report import StageReport

# What a control figure is of, in words.
_CHECKED = {"check points": "check points", "leave one out": "each control point, fitted without it"}


def stage_lines(stage: StageReport, names: Mapping[str, str], *, part: bool) -> list[str]:
    """Counts and time of a stage, and what it found. names: of the files, by image_id. part: of a shard."""
    counts = (
        f"{stage.part + stage.stage:<11} {stage.items:>7} items, {stage.done} done, {stage.skipped} up to date, "
        f"{len(stage.failures)} failed, {stage.seconds:.1f} s"
    )
    if stage.stage == "filter":
        return [counts, *_filter_lines(stage, names, part=part)]
    if stage.stage == "consistency":
        return [counts, *_consistency_lines(stage, names)]
    return [counts, *(_adjust_lines(stage, names) if stage.stage == "adjust" else _picture_lines(stage))]


def _picture_lines(stage: StageReport) -> list[str]:
    """Number and size of the views, and images that are not enhanced."""
    facts, words = stage.facts, []
    if "views_per_image" in facts:
        views, megapixels = facts["views_per_image"], facts["view_megapixels_per_image"]
        words.append(f"views per image: {views:.3g}, {megapixels:.3g} megapixels together")
    if facts.get("images_without_keypoints"):
        words.append(f"{facts['images_without_keypoints']} images without keypoints")
    if facts.get(enhance.SKIPPED):
        words.append(f"{facts[enhance.SKIPPED]} images not enhanced (skipped: same illumination)")
    if "settled_by" in facts:
        words.append(settled_words(facts))
    if facts.get("shift_px") is not None:
        words.append(
            f"{facts['measured']} of {facts['keypoints']} keypoints measured by least squares, by "
            f"{facts['shift_px']:.2f} px (median)"
        )
    if "remark" in facts:
        words.append(facts["remark"])
    return [f"          {'; '.join(words)}"] if words else []


def settled_words(facts: Mapping[str, Any]) -> str:
    """Which steps of a cascade have given how many pairs enough matches. facts: of the stage match."""
    by, lacking = facts["settled_by"], facts["not_settled"]
    whole = sum(by.values()) + lacking
    counts = ", ".join(f"{count} by {name}" for name, count in by.items())
    lack = f"; {lacking} with fewer matches, or less of the overlap covered, than asked for" if lacking else ""
    return f"of {whole} pairs settled: {counts}{lack}"


def _filter_lines(stage: StageReport, names: Mapping[str, str], *, part: bool) -> list[str]:
    """States of the pairs and how images are connected; of a part of the pairs (a shard) the states alone."""
    facts = stage.facts
    states = ", ".join(f"{count} {state}" for state, count in facts["pairs"].items()) or "none"
    lines = [f"          pairs: {states}; {facts['verified_matches']} verified matches"]
    if part:
        return lines
    components = facts["components"]
    if len(components) > 1:
        shown = ", ".join(str(size) for size in components[:8]) + (", ..." if len(components) > 8 else "")
        lines.append(f"          {len(components)} unconnected groups of images, of sizes {shown}")
    else:
        lines.append("          all images are connected")
    if facts["weakly_tied"]:
        weak = [names[i] for i in facts["weakly_tied"]]
        lines.append(f"          weakly tied (< {filter.WEAK_MATCHES} matches): {_listed(weak)}")
    return lines


def orientation_lines(facts: Mapping[str, Any], given: Block, block: Block) -> list[str]:
    """How the block was oriented, and what of that which was given is wrong. facts: of the stage orient."""
    if "poses_from" not in facts:
        return []
    names = {image.image_id: image.name for image in block.images}
    matched, explained = facts["images_matched"], facts["given_poses_explained"]
    attitudes = sum(pose.world_rotation is not None for pose in given.poses.values())
    explains = f"given poses explain the matches of {explained} of {matched} images"
    if facts["poses_from"] == "given poses":
        unjudged = "no matches to judge the given poses by" if attitudes else "no matches to find it by"
        words = [(explains if attitudes else "no attitudes were given") if matched else unjudged]
    else:
        sizes = [str(model["images"]) for model in facts["models"]] or ["none"]
        found = sizes[0] if len(sizes) == 1 else f"groups of {', '.join(sizes[:-1])} and {sizes[-1]}"
        more = len(facts["by_one_pair"])
        also = f", {more} more by their positions and a pair each" if more else ""
        words = [f"from the pictures: {found} of {len(block.images)} images{also}", *([explains] if attitudes else [])]
        words += [
            f"by a further first pass, with {one['with']}: a group of {one['images_then']} images, not {one['images']}"
            for one in facts["further_first_passes"]
            if one["used"]
        ]
        if facts["frame"] == "own" and given.crs != block.crs:
            words.append(f"in a local frame, not in {given.crs}")
        elif facts["frame"] == "own" and given.poses:
            words.append("in a frame of its own, not that of the given positions")
    for camera_id, (before, found) in facts["focal_lengths"].items():
        kept = ", but the given one is kept" if facts["stays"] else ""
        words.append(f"focal length of camera {camera_id}: {found:.0f} px instead of {before:.0f} px{kept}")
    for what, unit in (("wrong_attitudes", "degrees"), ("wrong_positions", "m")):
        if facts[what]:
            named = _listed([f"{names[i]} ({value:.0f} {unit})" for i, value in facts[what].items()])
            done = "kept, as orient=given asks" if facts["stays"] else "those that the pictures give are used"
            words.append(f"{what.replace('_', ' ')} given; {done}: {named}")
    if facts["outside"]:
        words.append(f"not oriented: {_listed([names[i] for i in facts['outside']])}")
    return [f"{'orientation' if not row else '':<16} {line}" for row, line in enumerate(words)]


def frame_remarks(record: Mapping[str, Any]) -> list[str]:
    """What nothing ties to the world. record: orientation.json."""
    beside = sum(len(group["images"]) for group in record["groups"] if group["kind"] == "level")
    if not beside:
        return []
    several = len(record["groups"])
    if record["facts"]["frame"] == "own" and several > 1:
        return [
            f"without usable positions each of {several} groups of images is in a frame of its own: scale, north and "
            "place are arbitrary, and so is the distance between the groups"
        ]
    if record["facts"]["frame"] == "own":
        return ["without usable positions the result is in a frame of its own: scale, north and place are arbitrary"]
    return [
        f"{beside} images are tied to no position and lie beside the others: scale, north and place are arbitrary, "
        "unless final matches tie them"
    ]


def _adjust_lines(stage: StageReport, names: Mapping[str, str]) -> list[str]:
    """Figures of the bundle adjustment, and images that it could not tie."""
    facts = stage.facts
    if not facts.get("points"):
        return [f"          {line}" for line in facts.get("remarks", ())]
    words = [
        f"{facts['images']} of {stage.items} images oriented, {facts['points']} points in {facts['track_length']:.1f} "
        f"images each, reprojection error {facts['reprojection_error_px']:.2f} px"
    ]
    if len(facts["groups"]) > 1:
        sizes = ", ".join(str(group["images"]) for group in facts["groups"])
        words.append(f"{len(facts['groups'])} groups of images, each oriented by itself: {sizes}")
    words += control_words(facts["control"], [group.get("control") or {} for group in facts["groups"]])
    words += facts["remarks"]
    outside = list(facts["outside"].items())
    words += [f"not oriented: {names.get(image_id, image_id)}: {reason}" for image_id, reason in outside[:10]]
    words += [f"not oriented: {len(outside) - 10} more, listed in the report"] if len(outside) > 10 else []
    return [f"          {line}" for line in words]


def _consistency_lines(stage: StageReport, names: Mapping[str, str]) -> list[str]:
    """What was dropped, and images that the adjusted block seems to hold in a wrong place."""
    facts = stage.facts
    doubtful = _listed([names[i] for i in facts["doubtful"]])
    lines = [f"          too many matches contradict the adjusted poses of {doubtful}"] if doubtful else []
    if facts.get("spread"):
        spread = facts["spread"].values()
        held, empty = (sum(row[place] for row in spread) for place in range(2))
        many = sorted(row[2] for row in spread)[len(spread) // 2]
        lacking = f", none in {empty} that other images show" if empty else ""
        left = f"{facts['points_left']} of {facts['points']} points are left, " if facts["points_left"] else ""
        lines.append(
            f"          {left}in {held} ninths of the images (3 x 3 each){lacking}; "
            f"{many} points per image are seen by three or more (median)"
        )
    if "remark" in facts:
        lines.append(f"          {facts['remark']}")
    if not facts["dropped_matches"] and not facts["rejected_pairs"]:
        return lines
    rejected = facts["rejected_pairs"]
    pairs = f", all of {rejected} {'pair' if rejected == 1 else 'pairs'} among them" if rejected else ""
    expected = facts["expected_right"]
    why = ["contradict the adjusted block"] if facts["points"] or expected is None else []
    why += [] if expected is None else ["are not likely to be right"]
    right = "" if expected is None else f", of which {100 * expected:.1f} % are expected to be right to 3 px"
    words = f"{facts['dropped_matches']} matches {' or '.join(why)}{pairs}"
    return [f"          {words}; {facts['verified_matches']} verified matches are left{right}", *lines]


def control_words(control: Mapping[str, Any] | None, adjusted: Sequence[Mapping[str, Any]] = ()) -> list[str]:
    """Errors at surveyed points. adjusted: what control points did in the adjustment of every group."""
    if control is None:
        return []
    counts = f"control: {control['control']} control points, {control['check']} check points"
    if control["points"] and len(control["not_measured_in_two_images"]) == control["points"]:
        return [f"{counts}: none is measured in two oriented images: are its image names those of the block?"]
    apart = control.get("rays_do_not_meet")  # of earlier versions not
    wrong = [f"rays do not meet of {_listed(apart)}: measured at another place in one image?"] if apart else []
    if once := control["not_measured_in_two_images"]:
        wrong.append(f"warning: points that are not measured in two oriented images are left out: {_listed(once)}")

    def shown(errors_m: list[float]) -> str:
        return ", ".join(f"{axis} {error:.3f}" for axis, error in zip("xyz", errors_m, strict=True))

    taking_part = _adjusted_words([one for one in adjusted if one], shown)
    if any(one.get("used") for one in adjusted) or (taking_part and not control["control"]):
        return [counts, *wrong, *taking_part]
    if control["control_rmse_m"] is None:
        few = f"{counts}: fewer than 3 control points are measured in two oriented images, no similarity to them"
        return [few, *wrong, *taking_part]
    words = [counts, *wrong, *taking_part, offset_words(control)]
    words.append(f"after a similarity to the control points: RMSE of the fit {shown(control['control_rmse_m'])} m")
    if control["check_rmse_m"] is not None:
        words[-1] += f", at {_CHECKED[control['check_kind']]} {shown(control['check_rmse_m'])} m"
    if control["doubtful"]:
        words.append(f"control points that the others contradict: {_listed(control['doubtful'])}")
    return words


def _adjusted_words(control: Sequence[Mapping[str, Any]], shown: Callable[[list[float]], str]) -> list[str]:
    """What control points did in the adjustment."""
    words = []
    for one in control:
        if one.get("fault"):
            words.append(f"warning: the control points fit the block if {one['fault']}: correct the list")
        if one["exchanged"]:
            words.append(f"names of control points that are exchanged: {_listed(one['exchanged'])}; they were left out")
        if one["wrong"]:
            words.append(f"control points that the others contradict: {_listed(one['wrong'])}; they were left out")
        held_out = "check points" if one["held_out"] == "check points" else "each control point, adjusted without it"
        with_m, without_m = one["held_out_rms_m"], one["without_rms_m"]
        errors = f": RMSE at {held_out} {shown(with_m)} m, {shown(without_m)} m without control" if with_m else ""
        if one["kept"] and not one["used"]:
            words.append(f"the block as it is: RMSE at check points {shown(with_m)} m" if with_m else "no check points")
        elif one["kept"]:
            words.append(f"{len(one['used'])} control points take part in the adjustment{errors}")
        else:
            words.append(f"control points do not take part in the adjustment, which they do not make better{errors}")
    return words


def _listed(names: list[str], shown: int = 10) -> str:
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")
