"""Matches of a rendered block, judged by its exact geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.evaluate.metrics import coverage, pose_error_deg, thin
from aeromatch_cli.evaluate.overlap import OverlapFinder, place_on
from aeromatch_cli.evaluate.scores import CORRECT_PX, WITHIN_PX, Conditions, PairScore
from aeromatch_cli.lab.surfaces import surfaces
from aeromatch_cli.lab.synthetic.write import IN_SHADOW_BELOW
from aeromatch_cli.recent import recent

if TYPE_CHECKING:
    from aeromatch_cli.lab.synthetic.truth import Truth

BORDER_PX = 8.0
# Keypoints closer than this are one place (a detector may give a place two orientations).
_SAME_PLACE_PX = 0.01
_LIGHTS_KEPT = 12  # images: 24 MB each at 12 megapixels


@dataclass(frozen=True, eq=False)
class _RenderedSight:
    """What images show, asked of the scene."""

    truth: Truth

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self.truth.cameras

    @property
    def poses(self) -> Mapping[str, Pose]:
        return self.truth.poses

    def surface_points(self, image: str, points_px: FloatArray) -> FloatArray:
        return self.truth.surface_points(image, points_px)

    def project(self, image: str, points_m: FloatArray) -> FloatArray:
        return self.truth.project(image, points_m)

    def unblocked(self, image: str, points_m: FloatArray) -> BoolArray:
        return self.truth.in_open_view(image, points_m)


@dataclass(frozen=True, eq=False)
class _Places:
    """Where points (N,) of one image may truly be in another: places_px (N, 9, 2), on_image and visible (N, 9)."""

    places_px: FloatArray
    on_image: BoolArray
    visible: BoolArray


@dataclass(frozen=True, eq=False)
class _Light:
    """Shadow of one image: in_shadow (H, W), and at_border (H, W), within 8 px of a pixel of the other kind."""

    in_shadow: BoolArray
    at_border: BoolArray


class RenderedTruth:
    """Judges pairs of a rendered block by the scene that it was rendered from.

    images_folder: where the pictures lie, for their texture; None leaves it unknown.
    """

    kind = "rendered"

    def __init__(self, truth: Truth, images_folder: Path | None = None) -> None:
        self.truth, self.images_folder = truth, images_folder
        self._sight = _RenderedSight(truth)
        self._overlaps = OverlapFinder(self._sight, images_folder)
        self._lights: dict[str, _Light] = {}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Camera of every image, by name."""
        return self.truth.cameras

    def near(self, name: str, others: Sequence[str]) -> BoolArray:
        """Which of the others (N,) may show some of the same ground; the rest share nothing."""
        return self._overlaps.near(name, others)

    def overlap_at_most(self, name0: str, name1: str) -> float:
        """An upper estimate of the overlap, occlusion ignored: a quick way to pass over pairs that share nothing."""
        return self._overlaps.at_most(name0, name1)

    def conditions(self, name0: str, name1: str) -> Conditions:
        """How hard a pair is, whatever matches it."""
        found = self._overlaps.between(name0, name1)
        sides = ((name0, found.samples0_px), (name1, found.samples1_px))
        dark0, dark1 = (float(self._in_shadow(name, px).mean()) if len(px) else np.nan for name, px in sides)
        texture = self._overlaps.texture(name0, name1)
        return Conditions(found.view_angle_deg, found.overlap, float(np.fmax(dark0, dark1)), texture)

    def judge(
        self,
        name0: str,
        name1: str,
        keypoints0_px: FloatArray,
        keypoints1_px: FloatArray,
        points0_px: FloatArray,
        points1_px: FloatArray,
        scores: FloatArray,
    ) -> PairScore:
        """How matches did that join stored pixels points0_px and points1_px (M, 2), of scores (M,), larger is better.

        keypoints (K, 2): all that each image offered to the matcher; recall is counted of them.
        """
        all0, all1 = (np.asarray(p, dtype=np.float64).reshape(-1, 2) for p in (keypoints0_px, keypoints1_px))
        points0, points1 = (np.asarray(p, dtype=np.float64).reshape(-1, 2) for p in (points0_px, points1_px))
        kept = thin(points0, points1, scores)
        points0, points1 = points0[kept], points1[kept]
        errors_px, hidden = self.errors(name0, name1, points0, points1)
        seen = np.isfinite(errors_px)
        true = seen & ~hidden
        correct = true & (np.where(seen, errors_px, np.inf) <= CORRECT_PX)
        poses, cameras = self.truth.poses, self.truth.cameras
        rotation_deg, translation_deg = pose_error_deg(
            points0, points1, cameras[name0], cameras[name1], poses[name0], poses[name1]
        )
        dark = self._in_shadow(name0, points0) | self._in_shadow(name1, points1)
        at_border = self._at_border(name0, points0) | self._at_border(name1, points1)
        return PairScore(
            keypoints0=len(all0),
            keypoints1=len(all1),
            possible=self.possible(name0, name1, all0, all1),
            kept=len(kept),
            correct=int(correct.sum()),
            within_5px=int((true & (np.where(seen, errors_px, np.inf) <= WITHIN_PX)).sum()),
            hidden=int(hidden.sum()),
            unseen=int((~seen).sum()),
            coverage=coverage(points0[correct], self._overlaps.between(name0, name1).samples0_px),
            rotation_error_deg=rotation_deg,
            translation_error_deg=translation_deg,
            keypoints_in_shadow=int(self._in_shadow(name0, all0).sum() + self._in_shadow(name1, all1).sum()),
            kept_in_shadow=int(dark.sum()),
            correct_in_shadow=int((dark & correct).sum()),
            wrong_at_border=int((at_border & ~correct).sum()),
            errors_px=errors_px,
            kept_idx=kept,
            correct_idx=kept[correct],
        )

    def errors(
        self, name0: str, name1: str, points0_px: FloatArray, points1_px: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Errors (M,) of matches between stored pixels (M, 2), and whether (M,) either side is hidden from the other.

        The larger of both directions, each the minimum over the surfaces visible within 1 px of the keypoint; those
        that the other image sees come first, and where it sees none the error is measured to the projection that
        ignores the occlusion. NaN where a keypoint shows sky or nothing that lies on the other image.
        """
        sides = []
        for a, points_a, b, points_b in (
            (name0, points0_px, name1, points1_px),
            (name1, points1_px, name0, points0_px),
        ):
            true = self._places(a, points_a, b)
            apart = np.linalg.norm(true.places_px - np.asarray(points_b)[:, None], axis=2)
            seen = np.asarray(true.visible.any(axis=1))
            chosen = np.where(seen[:, None], true.visible, true.on_image)
            nearest = np.where(chosen, apart, np.inf).min(axis=1, initial=np.inf)
            sides.append((np.where(np.isfinite(nearest), nearest, np.nan), true.on_image.any(axis=1) & ~seen))
        (errors0, hidden0), (errors1, hidden1) = sides
        errors_px = np.asarray(np.maximum(errors0, errors1))  # NaN wins
        return errors_px, (hidden0 | hidden1) & np.isfinite(errors_px)

    def possible(self, name0: str, name1: str, keypoints0_px: FloatArray, keypoints1_px: FloatArray) -> int:
        """How many distinct places among keypoints (K0, 2) have one of keypoints (K1, 2) within 3 px of their truth."""
        from scipy.spatial import cKDTree

        if not len(keypoints1_px):
            return 0
        _, first = np.unique(np.round(keypoints0_px / _SAME_PLACE_PX), axis=0, return_index=True)
        true = self._places(name0, keypoints0_px[first], name1)
        nearest, _ = cKDTree(keypoints1_px).query(true.places_px[true.visible], distance_upper_bound=CORRECT_PX + 1e-9)
        within = np.zeros(true.visible.shape, dtype=bool)
        within[true.visible] = nearest <= CORRECT_PX
        return int(within.any(axis=1).sum())

    def _places(self, name: str, points_px: FloatArray, other: str) -> _Places:
        """A surface counts as seen by the other image if it sees the very place where the first one met it."""
        found = surfaces(self.truth, name, points_px)
        places_px, on_image = place_on(self._sight, other, found.meant_m.reshape(-1, 3))
        visible = on_image.copy()
        asked = np.flatnonzero(on_image)
        visible[asked] = self.truth.in_open_view(other, found.met_m.reshape(-1, 3)[asked])
        shape = found.meant_m.shape[:2]
        return _Places(places_px.reshape(*shape, 2), on_image.reshape(shape), visible.reshape(shape))

    def _in_shadow(self, name: str, points_px: FloatArray) -> BoolArray:
        return _at(self._light(name).in_shadow, points_px)

    def _at_border(self, name: str, points_px: FloatArray) -> BoolArray:
        return _at(self._light(name).at_border, points_px)

    def _light(self, name: str) -> _Light:
        return recent(self._lights, name, lambda: self._lit(name), _LIGHTS_KEPT)

    def _lit(self, name: str) -> _Light:
        return _light_of(self.truth.sun(name), self.truth.surface(name))


def _light_of(sun: NDArray[np.uint8], surface: NDArray[np.uint32]) -> _Light:
    """Shadow and its border in a map (H, W) of the sun's share x 255; sky (surface 0) is neither lit nor in shadow."""
    import cv2

    lit, in_shadow = np.asarray(sun >= IN_SHADOW_BELOW), np.asarray((sun < IN_SHADOW_BELOW) & (surface > 0))
    at_border = np.zeros(sun.shape, dtype=bool)
    if lit.any() and in_shadow.any():
        for kind, other in ((lit, in_shadow), (in_shadow, lit)):
            apart = cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            at_border |= kind & (apart <= BORDER_PX)
    return _Light(in_shadow, at_border)


def _at(picture: BoolArray, points_px: FloatArray) -> BoolArray:
    """Values (N,) of the pixels that points (N, 2) lie on."""
    column, row = np.rint(np.clip(points_px, 0, np.array(picture.shape[1::-1]) - 1)).astype(int).T
    return np.asarray(picture[row, column])
