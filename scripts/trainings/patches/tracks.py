"""Patches of one ground point in several pictures, cut with a margin so that training can jitter and turn them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.strategies.extractors.pyramid import PATCH_PX, SUPPORT, Level, cut_patches
from trainings.patches.sights import Picture, Sight

MARGIN = 1.5  # a stored patch shows so much more than a patch of 32 px, as finely
STORED_PX = round(MARGIN * PATCH_PX)
LEAST, MOST = 2, 6  # patches of a track
# What is not worth learning: hardly any of the texture is common then.
_MOST_STRETCH, _SMALLEST_PX, _LARGEST_PX = 4.5, 2.5, 64.0


@dataclass(frozen=True, eq=False)
class Spots:
    """N ground points as one picture shows them.

    points_m: (N, 3). tangents_m: (N, 3, 2), what a pixel to the right and one down mean on the surface. sizes_px: (N,).
    """

    points_m: FloatArray
    tangents_m: FloatArray
    sizes_px: FloatArray

    def take(self, which: IntArray | BoolArray) -> Spots:
        return Spots(self.points_m[which], self.tangents_m[which], self.sizes_px[which])


@dataclass(frozen=True, eq=False)
class Tracks:
    """P patches of T ground points. One track's patches lie side by side.

    patches: (P, STORED_PX, STORED_PX) uint8. track: (P,) int32. picture: (P,) int32, which of the scene's. size_px:
    (P,) float32 keypoint diameters. turn_deg: (P,) float32, by how much the content is turned, x towards y, against the
    track's others, after it was cut. ray: (P, 3) float32 unit, from the camera. sun: (P,) int8. place_m: (T, 3)
    float32. reach_m: (T,) float32, half the side of what a patch shows. scene: (T,) int32: places of one scene only
    can be compared.
    """

    patches: NDArray[np.uint8]
    track: IntArray
    picture: IntArray
    size_px: FloatArray
    turn_deg: FloatArray
    ray: FloatArray
    sun: IntArray
    place_m: FloatArray
    reach_m: FloatArray
    scene: IntArray

    @property
    def starts(self) -> IntArray:
        """(T + 1,) first patch of each track, and the number of patches."""
        return np.searchsorted(self.track, np.arange(len(self.place_m) + 1))


@dataclass(frozen=True, eq=False)
class Look:
    """N places in one picture: points_px (N, 2), scale and turn_deg (N,) against the picture where they were found,
    stretch (N,) >= 1."""

    points_px: FloatArray
    scale: FloatArray
    turn_deg: FloatArray
    stretch: FloatArray

    @classmethod
    def of(cls, points_px: FloatArray, jacobians: FloatArray) -> Look:
        """jacobians: (N, 2, 2). The turn is that of the polar decomposition."""
        known = np.isfinite(jacobians).all(axis=(1, 2))
        determinant = np.linalg.det(np.where(known[:, None, None], jacobians, 0.0))
        known &= determinant > 0
        scale = np.where(known, np.sqrt(np.where(known, determinant, 1.0)), np.nan)
        turn = np.arctan2(jacobians[:, 1, 0] - jacobians[:, 0, 1], jacobians[:, 0, 0] + jacobians[:, 1, 1])
        largest = np.linalg.norm(np.nan_to_num(jacobians), ord=2, axis=(1, 2))
        return cls(points_px, scale, np.rad2deg(turn), largest**2 / np.where(known, determinant, np.nan))

    def take(self, which: IntArray | BoolArray) -> Look:
        return Look(*(value[which] for value in vars(self).values()))

    def usable(self, sizes_px: FloatArray) -> BoolArray:
        size = sizes_px * self.scale
        with np.errstate(invalid="ignore"):
            return np.asarray((size >= _SMALLEST_PX) & (size <= _LARGEST_PX) & (self.stretch <= _MOST_STRETCH))


def look(sight: Sight, spots: Spots) -> Look:
    """Where a picture has the spots, by differences over a quarter of their diameter on the tangent plane."""
    step = 0.25 * spots.sizes_px[:, None]
    columns = []
    for axis in range(2):
        along = step * spots.tangents_m[:, :, axis]
        ahead, behind = (sight.places_px(spots.points_m + sign * along) for sign in (1.0, -1.0))
        columns.append((ahead - behind) / (2.0 * step))
    return Look.of(sight.places_px(spots.points_m), np.stack(columns, axis=2))


def cut(levels: Sequence[Level], seen: Look, sizes_px: FloatArray, *, aligned: bool) -> NDArray[np.uint8]:
    """Stored patches (N, STORED_PX, STORED_PX); aligned: along the true turn, else along the picture's rows."""
    angles = seen.turn_deg if aligned else np.zeros(len(sizes_px))
    return cut_patches(levels, seen.points_px, MARGIN * sizes_px * seen.scale, angles, STORED_PX)


def tracks_of(
    sights: Sequence[Sight],
    spots: Spots,
    origins: IntArray,
    visible: Callable[[Sight, FloatArray], BoolArray],
    rng: np.random.Generator,
) -> Tracks:
    """Tracks of spots found in the sights `origins` (N,) of one kind, each with LEAST to MOST patches.

    visible: whether nothing hides world points (N, 3) in a sight. Ground views are cut upright, pictures as taken along
    the true turn. Points in few pictures are left out.
    """
    looks, usable = [], np.zeros((len(sights), len(origins)), bool)
    for index, sight in enumerate(sights):
        seen = look(sight, spots)
        fit = np.flatnonzero(seen.usable(spots.sizes_px) & sight.shows(seen.points_px, spots.sizes_px * seen.scale))
        usable[index, fit] = visible(sight, spots.points_m[fit])
        looks.append(seen)
    chosen = _chosen(usable, origins, rng)
    parts = []
    for index, sight in enumerate(sights):
        rays = spots.points_m - sight.pose.center_m
        parts.append(part(sight, looks[index], spots.sizes_px, rays, np.flatnonzero(chosen[index]), index))
    pixel_m = np.sqrt(np.linalg.norm(np.cross(spots.tangents_m[:, :, 0], spots.tangents_m[:, :, 1]), axis=1))
    return assembled(parts, spots.points_m, SUPPORT / 2.0 * spots.sizes_px * pixel_m)


def part(
    picture: Picture, seen: Look, sizes_px: FloatArray, rays: FloatArray, rows: IntArray, index: int
) -> dict[str, NDArray[Any]]:
    """What Tracks keeps of some rows of N places in picture number `index`, tracks numbered by row.

    sizes_px: (N,) where they were found. rays: (N, 3) from the camera, of any length.
    """
    seen, upright = seen.take(rows), picture.upright
    return {
        "patches": cut(picture.levels, seen, sizes_px[rows], aligned=not upright),
        "track": rows.astype(np.int32),
        "picture": np.full(len(rows), index, np.int32),
        "size_px": (sizes_px[rows] * seen.scale).astype(np.float32),
        "turn_deg": (seen.turn_deg if upright else np.zeros(len(rows))).astype(np.float32),
        "ray": (rays[rows] / np.linalg.norm(rays[rows], axis=1, keepdims=True)).astype(np.float32),
        "sun": np.full(len(rows), picture.light, np.int8),
    }


def assembled(parts: Sequence[dict[str, NDArray[Any]]], places_m: FloatArray, reach_m: FloatArray) -> Tracks:
    """Tracks of one scene, those of fewer than LEAST patches left out. places_m: (N, 3), reach_m: (N,)."""
    merged = {key: np.concatenate([one[key] for one in parts]) for key in parts[0]}
    order = np.argsort(merged["track"], kind="stable")
    order = order[np.bincount(merged["track"], minlength=1)[merged["track"][order]] >= LEAST]
    numbers, track = np.unique(merged.pop("track")[order], return_inverse=True)
    return Tracks(
        **{key: value[order] for key, value in merged.items()},
        track=track.astype(np.int32),
        place_m=places_m[numbers].astype(np.float32),
        reach_m=reach_m[numbers].astype(np.float32),
        scene=np.zeros(len(numbers), np.int32),
    )


def _chosen(usable: BoolArray, origins: IntArray, rng: np.random.Generator) -> BoolArray:
    """(V, N) at most MOST pictures of every point, its origin among them; none of points in too few or hidden there."""
    priority = rng.random(usable.shape)
    priority[origins, np.arange(len(origins))] = 2.0
    priority[~usable] = -1.0
    rank = np.argsort(np.argsort(-priority, axis=0, kind="stable"), axis=0, kind="stable")
    there = usable[origins, np.arange(len(origins))] & (usable.sum(axis=0) >= LEAST)
    return np.asarray(usable & (rank < MOST) & there)


def joined(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of several scenes as one, scenes and tracks numbered on."""
    values = {key: np.concatenate([getattr(part, key) for part in parts]) for key in vars(parts[0])}
    counts = np.cumsum([0] + [len(part.place_m) for part in parts])
    scenes = np.cumsum([0] + [int(part.scene.max(initial=-1)) + 1 for part in parts])
    values["track"] = np.concatenate([part.track + first for part, first in zip(parts, counts, strict=False)])
    values["scene"] = np.concatenate([part.scene + first for part, first in zip(parts, scenes, strict=False)])
    return Tracks(**values)
