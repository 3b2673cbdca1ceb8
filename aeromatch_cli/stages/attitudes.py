"""Which images' attitudes are not used because their pictures contradict them: judged by filter, kept between runs.

A picture that an attitude turns the wrong way matches nothing, so that nothing contradicts the attitude. Images that no
verified pair ties to the rest although poses promise overlap are therefore suspects: they and those paired with them
are also compared as they were taken, wherever the poses say, and judged by what that finds. Matches speak of attitudes
where the filter that verified them gives a relative rotation: with a fundamental matrix or a homography none is judged.

A judgement on an image holds as long as nothing changes that can be laid at its door: the image, its given pose and
the settings. Images that come later do not revoke it by themselves; matches that vindicate the image do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from aeromatch_cli.data import FloatArray, Pose
from aeromatch_cli.orientation.attitudes import contradicting_images
from aeromatch_cli.stages.context import Context
from aeromatch_cli.workspace import fingerprint, read_json, write_json

# Images that share this much of their ground and are not tied make one of them a suspect.
_SUSPICIOUS_OVERLAP = 0.3
Rotations = Sequence[tuple[str, str, FloatArray, int]]


def without_ignored_attitudes(context: Context) -> Context:
    """The context with its suspects, in which images whose attitude pictures contradict keep only their position."""
    record = _on_file(context)
    wrong = _standing(context, record)
    context = replace(context, suspects=_standing_suspects(context, record))
    poses: dict[str, Pose] = {
        i: replace(pose, world_rotation=None) if i in wrong else pose for i, pose in context.given_poses.items()
    }
    return replace(context, block=replace(context.block, poses=poses)) if wrong else context


def judge(context: Context, rotations: Rotations, root: Mapping[str, str] | None) -> dict[str, float]:
    """image_id -> degrees for every image whose attitude is not to be used; written to ignored_attitudes.json.

    rotations: (id0, id1, cam1_from_cam0, matches) of the verified pairs. root: image_id -> the image that names the
    connected component of verified pairs that it is part of, None while pairs wait to be judged. An attitude that was
    ignored before stays so in an unchanged block, whatever is found without its attitude: otherwise runs could swing
    between two results.
    """
    found, before = contradicting_images(context.given_poses, rotations), _on_file(context)
    evidence = fingerprint(_settings(context), [(i, _facts(context, i)) for i in sorted(context.given_poses)])
    seen = {image_id for id0, id1, _, _ in rotations for image_id in (id0, id1)}
    unchanged = before.get("fingerprint") == evidence
    kept = {i: a for i, a in _standing(context, before).items() if unchanged or i not in seen}
    angles = dict(sorted({**found, **kept}.items()))
    images = {i: {"angle_deg": angle, "facts": _facts(context, i)} for i, angle in angles.items()}
    suspects = _standing_suspects(context, before) | (_untied(context, root) - angles.keys())
    facts = {i: _facts(context, i) for i in sorted(suspects)}
    record = {"fingerprint": evidence, "settings": _settings(context), "images": images, "suspects": facts}
    write_json(context.workspace.ignored_attitudes, record)
    return angles


def _untied(context: Context, root: Mapping[str, str] | None) -> set[str]:
    """Images with attitude that overlap with a larger component of verified pairs but belong to none, or a smaller."""
    if root is None or not context.settings.extract.follows_north:
        return set()
    sizes = Counter(root.values())
    found = set()
    for pair in context.pairs:
        ids = pair.image_id0, pair.image_id1
        if root[ids[0]] == root[ids[1]] or not pair.overlap >= _SUSPICIOUS_OVERLAP:
            continue
        small, large = sorted(ids, key=lambda i: (sizes[root[i]], root[i]))
        pose = context.pose(small)
        if sizes[root[large]] > 1 and pose is not None and pose.world_rotation is not None:
            found.add(small)
    return found


def _standing_suspects(context: Context, record: dict[str, Any]) -> frozenset[str]:
    if not record or record.get("settings") != _settings(context):
        return frozenset()
    known = {i: facts for i, facts in record.get("suspects", {}).items() if i in context.given_poses}
    return frozenset(i for i, facts in known.items() if facts == _facts(context, i))


def _on_file(context: Context) -> dict[str, Any]:
    path = context.workspace.ignored_attitudes
    return read_json(path) if path.is_file() and not context.overwrite else {}


def _standing(context: Context, record: dict[str, Any]) -> dict[str, float]:
    """image_id -> degrees of the judgements that still hold."""
    if not record or record.get("settings") != _settings(context):
        return {}
    images = {i: entry for i, entry in record["images"].items() if i in context.given_poses}
    return {i: entry["angle_deg"] for i, entry in images.items() if entry["facts"] == _facts(context, i)}


def _settings(context: Context) -> str:
    settings = context.settings
    parts = (settings.pairs, settings.enhance, settings.simulate, settings.extract, settings.match, settings.filter)
    return fingerprint(parts, settings.block.max_size_px, settings.seed)


def _facts(context: Context, image_id: str) -> str:
    pose = context.given_poses[image_id]
    seen = context.geometry_fingerprint(image_id, frozenset({"camera", "ground"}))
    return fingerprint(context.image_fingerprints[image_id], pose.center_m, pose.world_rotation, seen)
