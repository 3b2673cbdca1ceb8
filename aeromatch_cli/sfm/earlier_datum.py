"""This module decides where several models of one block lie: placed ones in the world, on poses found before, the
others beside them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.sfm.georeferencing import similarity
from aeromatch_cli.sfm.mapping import Model

# A model of a grown block is moved onto the poses that it had before, where these agree to a share of its extent.
SAME_SHARE = 0.01
# Groups that nothing ties to each other lie so many times their extent apart, and so many metres more.
_GAP_EXTENTS, _GAP_M = 2.0, 1000.0


@dataclass(frozen=True, eq=False)
class Before:
    """Holds what an earlier run found for images that have not changed: poses, and cameras by camera_id.

    placed: images that positions had placed; the others lay in a frame of their own, or beside these.
    """

    poses: Mapping[str, Pose] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    placed: Collection[str] = frozenset()

    def of(self, kind: str) -> dict[str, Pose]:
        """Poses that a model of this kind may be moved onto: what positions place now stays where they say."""
        return {i: pose for i, pose in self.poses.items() if kind == "level" or i in self.placed}


def arranged(models: Sequence[Model], before: Before) -> list[tuple[Model, dict[str, Pose]]]:
    """Return every model where it is to lie, and those of its images that keep the poses of `before`; in the same
    order.

    Models that no position places ("level") lie east of the placed ones, side by side.
    """
    anchored = [_anchored(model, before.of(model.kind)) for model in models]
    placed = [model for model, kept in anchored if kept or model.kind != "level"]
    ends = [_east(model).max() + _gap_m(model) for model in placed]
    next_m = max(ends, default=0.0)
    found = []
    for model, kept in anchored:
        if model.kind == "level" and not kept:
            shift_m = np.array([next_m - _east(model).min(), 0.0, 0.0])
            next_m += float(np.ptp(_east(model))) + _gap_m(model)
            model = _moved(model, 1.0, np.eye(3), shift_m)
        found.append((model, kept))
    return found


def _east(model: Model) -> FloatArray:
    return np.array([center[0] for center in model.centers_m.values()])


def _gap_m(model: Model) -> float:
    return _GAP_EXTENTS * float(np.ptp(_east(model))) + _GAP_M


def _anchored(model: Model, before: Mapping[str, Pose]) -> tuple[Model, dict[str, Pose]]:
    """The model moved onto poses found before, and those of its images that keep theirs; as it is where they differ."""
    common = sorted(model.centers_m.keys() & before.keys())
    if len(common) < 3:
        return model, {}
    old_m = np.array([before[i].center_m for i in common])
    now = np.array([model.centers_m[i] for i in common])
    moved = _moved(model, *similarity(now, old_m))
    errors_m = np.linalg.norm(np.array([moved.centers_m[i] for i in common]) - old_m, axis=1)
    if errors_m.max() > SAME_SHARE * np.linalg.norm(np.ptp(old_m, axis=0)):
        return model, {}
    return moved, {i: before[i] for i in common}


def _moved(model: Model, scale: float, rotation: FloatArray, shift_m: FloatArray) -> Model:
    return replace(
        model,
        rotations={i: one @ rotation.T for i, one in model.rotations.items()},
        centers_m={i: scale * rotation @ center + shift_m for i, center in model.centers_m.items()},
        points_m=scale * model.points_m @ rotation.T + shift_m,
    )
