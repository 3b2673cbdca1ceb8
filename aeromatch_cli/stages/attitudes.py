"""Which images' attitudes are ignored because their matches contradict them: judged by filter, kept between runs.

An image with a wrong attitude has no matches with north-up views of its neighbours, so that no match contradicts the
attitude. Images without verified pairs although poses predict overlap are therefore *isolated*: they and the images
that they are paired with are also matched as source images, and judged by those matches. Only a filter that gives a
relative rotation allows a judgement; a fundamental matrix or a homography does not.

A judgement holds as long as the image, its given pose and the settings stay the same. Images that are added later do
not revoke it by themselves; matches that agree with the attitude do.
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

# With this overlap (share of the smaller footprint) and no verified pair, one of two images is isolated.
_ISOLATED_OVERLAP = 0.3
Rotations = Sequence[tuple[str, str, FloatArray, int]]


def without_ignored_attitudes(context: Context) -> Context:
    """The context with its isolated images, in which images whose attitude is ignored keep only their position."""
    record = _on_file(context)
    wrong = _still_ignored(context, record)
    context = replace(context, isolated=_still_isolated(context, record))
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
    kept = {i: a for i, a in _still_ignored(context, before).items() if unchanged or i not in seen}
    angles = dict(sorted({**found, **kept}.items()))
    images = {i: {"angle_deg": angle, "facts": _facts(context, i)} for i, angle in angles.items()}
    isolated = _still_isolated(context, before) | (_isolated(context, root) - angles.keys())
    facts = {i: _facts(context, i) for i in sorted(isolated)}
    record = {"fingerprint": evidence, "settings": _settings(context), "images": images, "isolated": facts}
    write_json(context.workspace.ignored_attitudes, record)
    return angles


def _isolated(context: Context, root: Mapping[str, str] | None) -> set[str]:
    """Images with attitude that overlap with a larger component of verified pairs but belong to none, or a smaller."""
    if root is None or not context.settings.extract.north_up_only:
        return set()
    sizes = Counter(root.values())
    found = set()
    for pair in context.pairs:
        ids = pair.image_id0, pair.image_id1
        if root[ids[0]] == root[ids[1]] or not pair.overlap >= _ISOLATED_OVERLAP:
            continue
        small, large = sorted(ids, key=lambda i: (sizes[root[i]], root[i]))
        pose = context.pose(small)
        if sizes[root[large]] > 1 and pose is not None and pose.world_rotation is not None:
            found.add(small)
    return found


def _still_isolated(context: Context, record: dict[str, Any]) -> frozenset[str]:
    if not record or record.get("settings") != _settings(context):
        return frozenset()
    known = {i: facts for i, facts in record.get("isolated", {}).items() if i in context.given_poses}
    return frozenset(i for i, facts in known.items() if facts == _facts(context, i))


def _on_file(context: Context) -> dict[str, Any]:
    path = context.workspace.ignored_attitudes
    return read_json(path) if path.is_file() and not context.overwrite else {}


def _still_ignored(context: Context, record: dict[str, Any]) -> dict[str, float]:
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
