"""What the exporters of maps draw of a block: where images were taken, what is known of them, and how they hang
together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock, FloatArray
from aeromatch_cli.formats.adjusted import orientation_fields, residual_fields
from aeromatch_cli.geometry.footprints import Footprint, block_footprints
from aeromatch_cli.geometry.rotations import to_yaw_pitch_roll
from aeromatch_cli.strategies.exporters.contents import ExportContents
from aeromatch_cli.strategies.exporters.solution import Matched, Solution, unplaced

# Images with fewer verified matches hang loosely on the block.
WEAK_MATCHES = 50


@dataclass(frozen=True, eq=False)
class Links:
    """positions: image_id -> centre in the world. ties: image_id -> verified matches. lines: pairs of placed images,
    with their matches."""

    positions: Mapping[str, FloatArray]
    ties: Counter[str]
    lines: Sequence[tuple[tuple[str, str], int]]

    @classmethod
    def of(cls, contents: ExportContents, solution: Solution, found: Matched) -> Links:
        # Images that lay in frames of their own have a place in the world only where the adjustment gave them one.
        beside = unplaced(contents) | (contents.block.frames.keys() if contents.block.metric else set())
        # In frames of their own it is not known of images without adjusted pose to which group they belong.
        known = {} if beside and not contents.block.metric else contents.block.poses
        positions = {i: pose.center_m for i, pose in known.items() if i not in beside}
        positions |= {i: center_m for i, (_, center_m) in solution.poses.items()}
        ties: Counter[str] = Counter()
        for id0, id1, rows in found.pairs:
            ties.update({id0: len(rows), id1: len(rows)})
        placed = [((a, b), len(rows)) for a, b, rows in found.pairs if a in positions and b in positions]
        return cls(positions, ties, placed)


def camera_fields(contents: ExportContents, solution: Solution, links: Links) -> list[tuple[str, dict[str, Any]]]:
    """image_id and attributes of every image that has a place, by image_id: those of orientation.csv and, of an
    adjusted block, of residuals.csv, with yaw, pitch and roll (0, 0, 0 looks straight down, its top to the north of the
    grid). Every image has the same attributes; NaN stands for what is not known, None for
    an unknown time."""
    block, adjusted = contents.block, contents.adjusted or AdjustedBlock.empty()
    found = []
    for image in sorted(block.images, key=lambda one: one.image_id):
        image_id = image.image_id
        known = orientation_fields(adjusted, block, image)
        if known is None or image_id not in links.positions:
            continue
        rotation = solution.poses[image_id][0] if image_id in solution.poses else block.poses[image_id].world_rotation
        turned = [np.nan] * 3 if rotation is None else np.round(to_yaw_pitch_roll(rotation, forward=False), 6).tolist()
        fields = {
            **known, **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), turned, strict=True)), "time": image.time or None,
            "oriented": image_id in solution.poses, "matches": links.ties[image_id],
            "weak": links.ties[image_id] < WEAK_MATCHES,
        }  # fmt: skip
        if contents.residuals:
            fields |= residual_fields(contents.residuals.get(image_id))
        found.append((image_id, fields))
    return found


def footprint_fields(
    contents: ExportContents, solution: Solution, links: Links
) -> list[tuple[Footprint, dict[str, Any]]]:
    """Footprints and their attributes, by image_id, of images that have a place: by poses before the adjustment, which
    of images in frames of their own say nothing of the world."""
    images = {image.image_id: image for image in contents.block.images}
    found = []
    for image_id, footprint in sorted(block_footprints(contents.block).items()):
        if image_id not in links.positions or (contents.block.metric and image_id in contents.block.frames):
            continue
        image = images[image_id]
        fields = {
            "image": image.name, "camera": image.camera_id, "time": image.time or None,
            "oriented": image_id in solution.poses, "matches": links.ties[image_id],
            "gsd_m": round(footprint.gsd_m, 6), "tilt_deg": round(footprint.tilt_deg, 4),
        }  # fmt: skip
        found.append((footprint, fields))
    return found
