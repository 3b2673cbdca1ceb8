"""adjust: the bundle adjustment of the verified matches, from the orientation that the first pass gave.

Poses, cameras and points go to the workspace's orientation folder, for the exporters and for people.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock
from aeromatch_cli.errors import InputError
from aeromatch_cli.formats.adjusted import orientation_text, read_adjusted, write_adjusted
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.orientation.control import control_figures
from aeromatch_cli.orientation.mapping import Group, refine_block
from aeromatch_cli.stages import orient
from aeromatch_cli.stages.contents import contents_of, with_current_pairs
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import pair_fingerprint, verified_pairs
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.orienters import FirstPass
from aeromatch_cli.workspace import (
    file_digest,
    fingerprint,
    translated_os_errors,
    whole_record,
    write_atomically,
    write_json,
    write_text,
)

VERSION = 9
# An image with fewer keypoints than this share of the median shows hardly any texture, or is blurred.
_FEW_KEYPOINTS = 0.1


def run(context: Context) -> StageReport:
    """Write adjusted.npz, adjusted.json and orientation.csv where they are not up to date."""
    report = StageReport("adjust", items=len(context.block.images))
    recipe = context.settings.orient
    groups = orient.groups(context) if isinstance(recipe, FirstPass) else []
    if not groups:
        report.items, report.facts = 0, {"images": 0}
        _remove(context)
        return report.write(context.workspace)
    context, _ = with_current_pairs(context)
    report.fingerprint = _fingerprint(context, groups)
    record = _on_file(context)
    if record.get("fingerprint") == report.fingerprint:
        report.skipped, report.facts = report.items, record["facts"]
        return report.write(context.workspace)
    _remove(context)
    try:
        with context.executor.step("adjust"):
            fixed = isinstance(recipe, FirstPass) and not recipe.replaces
            adjusted, figures = refine_block(contents_of(context), context.observed, groups, fixed=fixed)
    except InputError as error:  # matches and export stand without it
        report.failures.append(("all images", str(error)))
        return report.write(context.workspace)
    report.facts = _facts(context, adjusted, figures)
    report.done = report.items
    _write(context, adjusted, report)
    return report.write(context.workspace)


def adjusted_block(context: Context) -> AdjustedBlock | None:
    """What is on file for the present results; None without orientation."""
    groups = orient.groups(context) if isinstance(context.settings.orient, FirstPass) else []
    made_now = replace(context, overwrite=False)
    if not groups or _on_file(made_now).get("fingerprint") != _fingerprint(context, groups):
        return None
    return read_adjusted(context.workspace.adjusted)


def _fingerprint(context: Context, groups: Sequence[Group]) -> str:
    given = {i: (pose.center_m, pose.sigma_position_m) for i, pose in context.given.poses.items()}
    block = context.block
    state = [sorted(block.cameras.items()), sorted(block.poses.items()), sorted(given.items())]
    pairs = [(p.image_id0, p.image_id1, pair_fingerprint(context, p)) for p in context.pairs]
    versions = VERSION, library_version("pycolmap")
    held = [(group.kind, group.images) for group in groups]
    control = [(p.name, p.position_m, p.check, sorted(p.pixels.items())) for p in context.control]
    known = sorted(context.focal_sigmas.items()), sorted(context.angles.items())
    return fingerprint(versions, context.settings.orient, held, state, known, pairs, control)


def _on_file(context: Context) -> Mapping[str, Any]:
    """The record of an earlier run whose files are as they were written, else nothing."""
    return {} if context.overwrite else whole_record(context.workspace.orientation / "adjusted.json")


def _remove(context: Context) -> None:
    folder = context.workspace.orientation
    for name in ("adjusted.json", "adjusted.npz", "orientation.csv"):
        with translated_os_errors(folder / name):
            (folder / name).unlink(missing_ok=True)


def _write(context: Context, adjusted: AdjustedBlock, report: StageReport) -> None:
    """The record comes last: it vouches for the others."""
    folder = context.workspace.orientation
    write_atomically(context.workspace.adjusted, lambda stream: write_adjusted(stream, adjusted))
    write_text(folder / "orientation.csv", orientation_text(adjusted, context.block))
    files = {name: file_digest(folder / name) for name in ("adjusted.npz", "orientation.csv")}
    record = {"fingerprint": report.fingerprint, "facts": report.facts, "files": files}
    write_json(folder / "adjusted.json", record)


def _facts(context: Context, adjusted: AdjustedBlock, figures: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of the whole and of every group, and why images are not oriented."""
    observations = sum(len(track) for track in adjusted.tracks.values())
    sigmas = np.array([(np.mean(p.sigmas_m), np.mean(p.sigmas_deg)) for p in adjusted.poses.values()]).reshape(-1, 2)
    known = len(sigmas) > 0 and bool(np.isfinite(sigmas).any())
    return {
        "images": len(adjusted.poses),
        "points": len(adjusted.points_m),
        "track_length": round(observations / max(1, len(adjusted.points_m)), 3),
        "reprojection_error_px": round(float(np.mean(adjusted.errors_px)), 4) if len(adjusted.errors_px) else None,
        "sigma_position_m": float(np.nanmedian(sigmas[:, 0])) if known else None,
        "sigma_angle_deg": float(np.nanmedian(sigmas[:, 1])) if known else None,
        "groups": [dict(one) for one in figures],
        "outside": _reasons(context, adjusted),
        "control": _control(context, adjusted),
    }


def _control(context: Context, adjusted: AdjustedBlock) -> dict[str, Any] | None:
    if not context.control:
        return None
    cameras = {image.image_id: adjusted.cameras[image.camera_id] for image in context.block.images}
    return control_figures(adjusted, cameras, context.control)


def _reasons(context: Context, adjusted: AdjustedBlock) -> dict[str, str]:
    """image_id -> why it is not oriented."""
    outside = [i.image_id for i in context.block.images if i.image_id not in adjusted.poses]
    if not outside:
        return {}
    pairs = Counter(i for p in context.pairs for i in (p.image_id0, p.image_id1))
    verified: Counter[str] = Counter()
    for pair, entry in verified_pairs(context):
        if entry.verdict.state == "verified":
            verified.update((pair.image_id0, pair.image_id1))
    keypoints = {
        image.image_id: len(read_keypoints(path)[0]) if (path := context.workspace.features(image.image_id)).exists()
        else 0 for image in context.block.images
    }  # fmt: skip
    usual = float(np.median(list(keypoints.values())))
    reasons = {}
    for image_id in outside:
        count = keypoints[image_id]
        if count <= _FEW_KEYPOINTS * usual:
            reasons[image_id] = f"{count} keypoints, the median is {usual:.0f}: no texture, or blurred"
        elif not pairs[image_id]:
            reasons[image_id] = "in no pair: it overlaps no other image"
        elif not verified[image_id]:
            reasons[image_id] = f"none of its {pairs[image_id]} pairs could be verified"
        else:
            reasons[image_id] = f"too few points in common with oriented images ({verified[image_id]} verified pairs)"
    return reasons
