"""Patches as a step of training sees them: cropped anew from what is stored, developed anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor
from torch.nn import functional

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.strategies.extractors.pyramid import PATCH_PX
from trainings.patches.tracks import STORED_PX, Tracks

# Sigmas of what a detector and an orientation network leave: place in pixels of the patch, octaves, degrees.
PLACE_PX, OCTAVES = 0.8, 0.13
UPRIGHT_DEG, ALIGNED_DEG, FAR_DEG, FAR_SHARE = 4.0, 8.0, 20.0, 0.1
# Share of a batch by where tracks come from.
SHARES = {"block": 0.65, "homographies": 0.15, "reference": 0.2}
# What cameras and their software do to a picture: sigma of softness (1: as blurred as a mean over [1 2 1] / 4, below 0:
# sharpened), share of patches that were compressed, and the coarsest step of their coefficients.
SOFTNESS, COMPRESSED, COARSEST = 0.6, 0.3, 0.04
_BLOCK_PX = 8
_WINDOW = 4  # tracks of like reach from which a group draws one in so many


@dataclass(frozen=True, eq=False)
class Group:
    """N pairs of patches of one set of tracks. rows0, rows1: (N,) patches. track: (N,). angle_deg: (N,) between both
    rays."""

    tracks: Tracks
    upright: bool
    rows0: IntArray
    rows1: IntArray
    track: IntArray
    angle_deg: FloatArray


@dataclass(frozen=True, eq=False)
class Source:
    """Tracks to draw from. order: (T,) in which neighbours are of like reach, or of one scene where there are many."""

    tracks: Tracks
    upright: bool
    weight: float
    order: IntArray
    starts: IntArray


def sources_of(known: Mapping[str, Tracks]) -> list[Source]:
    """known: by names NAME.ground and NAME.source; weights are SHARES, by tracks within a share."""
    found, sums = [], dict.fromkeys(SHARES, 0.0)
    for name, tracks in known.items():
        sums[_share_of(name)] += len(tracks.place_m)
    for name, tracks in known.items():
        share = _share_of(name)
        order = np.lexsort((tracks.reach_m, tracks.scene))
        weight = SHARES[share] * len(order) / sums[share]
        found.append(Source(tracks, name.endswith(".ground"), weight, order, tracks.starts))
    return found


def _share_of(name: str) -> str:
    start = name.split("-")[0]
    return start if start in SHARES else "reference"


def drawn(source: Source, count: int, hardness: float, rng: np.random.Generator) -> Group:
    """`count` tracks of like reach, two patches of each; hardness > 0 favours large view angles, < 0 small ones."""
    span = min(len(source.order), _WINDOW * count)
    first = int(rng.integers(len(source.order) - span + 1))
    track = rng.permutation(source.order[first : first + span])[:count]
    begin, length = source.starts[track], source.starts[track + 1] - source.starts[track]
    # Of four pairs the one with the largest hardness times angle, by Gumbel's trick.
    row0 = rng.integers(length, size=(4, len(track)))
    row1 = (row0 + rng.integers(1, length, size=(4, len(track)))) % length
    ray = source.tracks.ray
    cosine = (ray[begin + row0] * ray[begin + row1]).sum(axis=2)
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    best = np.argmax(hardness * angle / 30.0 + rng.gumbel(size=angle.shape), axis=0)
    pick = best, np.arange(len(track))
    return Group(source.tracks, source.upright, begin + row0[pick], begin + row1[pick], track, angle[pick])


def jitters_deg(upright: bool, count: int, rng: np.random.Generator) -> FloatArray:
    """(N,) by how much patches are cut askew: after pose noise where upright, else after an orientation network."""
    if upright:
        return rng.normal(0.0, UPRIGHT_DEG, count)
    far = rng.random(count) < FAR_SHARE
    return rng.normal(0.0, 1.0, count) * np.where(far, FAR_DEG, ALIGNED_DEG)


def cropped(patches: Tensor, turns_deg: FloatArray, flips: FloatArray, rng: np.random.Generator) -> Tensor:
    """(N, 1, 32, 32) float32 in 0-1 of stored patches (N, S, S) uint8, cut along turns (N,), mirrored where flips (N,)
    are -1, place and scale off by what a detector leaves."""
    count = len(patches)
    scale = PATCH_PX / STORED_PX * 2.0 ** np.clip(rng.normal(0.0, OCTAVES, count), -0.4, 0.4)
    shift = rng.normal(0.0, PLACE_PX, (count, 2)) * 2.0 / STORED_PX
    angle = np.deg2rad(turns_deg)
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    theta = np.stack([cosine * flips, -sine, shift[:, 0], sine * flips, cosine, shift[:, 1]], axis=1)
    matrices = _beside(theta.reshape(count, 2, 3), patches)
    grid = functional.affine_grid(matrices, [count, 1, PATCH_PX, PATCH_PX], align_corners=False)
    pixels = patches[:, None].float() / 255.0
    return functional.grid_sample(pixels, grid, padding_mode="border", align_corners=False)


def developed(patches: Tensor, rng: np.random.Generator) -> Tensor:
    """Patches (N, 1, 32, 32) in 0-1 through other tone curves, some with the edge of a cast shadow, with noise."""
    count = len(patches)
    gamma = _beside(np.exp(rng.normal(0.0, 0.3, (count, 1, 1, 1))), patches)
    values = patches.clamp(min=1e-3) ** gamma
    angle, offset = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-12.0, 12.0, count)
    lines = _beside(np.stack([np.cos(angle), np.sin(angle), offset]), patches)[..., None, None]
    axis = torch.arange(PATCH_PX, device=patches.device) - (PATCH_PX - 1) / 2.0
    beyond = torch.sigmoid((lines[0] * axis + lines[1] * axis[:, None] - lines[2]) * 1.5)
    depth = np.where(rng.random(count) < 0.15, rng.uniform(0.3, 0.7, count), 0.0)
    values = values * (1.0 - _beside(depth, patches)[:, None, None] * beyond)[:, None]
    spread = values.std(dim=(1, 2, 3), keepdim=True) * _beside(rng.uniform(0, 0.15, (count, 1, 1, 1)), patches)
    # Drawn where the patches are: a million numbers a step.
    draws = torch.Generator(patches.device).manual_seed(int(rng.integers(2**62)))
    return values + torch.randn(values.shape, generator=draws, device=patches.device) * spread


def photographed(patches: Tensor, rng: np.random.Generator) -> Tensor:
    """Patches (N, 1, 32, 32) in 0-1 as different cameras write them: blurred or sharpened, some compressed."""
    count = len(patches)
    taps = torch.tensor([0.25, 0.5, 0.25], device=patches.device)
    around = functional.pad(patches, (1, 1, 1, 1), mode="replicate")
    blurred = functional.conv2d(around, (taps[:, None] * taps)[None, None])
    softness = _beside(rng.normal(0.0, SOFTNESS, (count, 1, 1, 1)), patches).clamp(-1.5, 1.0)
    values = (patches + softness * (blurred - patches)).clamp(0.0, 1.0)
    steps = np.where(rng.random(count) < COMPRESSED, rng.uniform(0.01, COARSEST, count), 0.0)
    return compressed(values, _beside(steps, patches), tuple(rng.integers(_BLOCK_PX, size=2).tolist()))


def compressed(patches: Tensor, steps: Tensor, shift: tuple[int, int]) -> Tensor:
    """Patches (N, 1, S, S) whose cosine coefficients, in blocks of 8 px, are rounded to multiples of steps (N,), higher
    ones to coarser ones, as in JPEG; 0 leaves a patch as it is. shift: where blocks begin, y and x."""
    count, side = len(patches), patches.shape[-1]
    place = torch.arange(_BLOCK_PX, device=patches.device)
    basis = torch.cos(torch.pi / _BLOCK_PX * (place + 0.5) * place[:, None]) * (2.0 / _BLOCK_PX) ** 0.5
    basis[0] /= 2.0**0.5
    rolled = patches.roll(shift, (2, 3))
    parts = side // _BLOCK_PX
    blocks = rolled.reshape(count, parts, _BLOCK_PX, parts, _BLOCK_PX).transpose(2, 3)
    coefficients = basis @ blocks @ basis.T
    coarseness = steps[:, None, None, None, None] * (1.0 + (place[:, None] + place) / 2.0)
    rounded = torch.where(coarseness > 0.0, (coefficients / coarseness.clamp(min=1e-6)).round() * coarseness, 0.0)
    kept = torch.where(coarseness > 0.0, rounded, coefficients)
    back = (basis.T @ kept @ basis).transpose(2, 3).reshape(count, 1, side, side)
    return back.roll((-shift[0], -shift[1]), (2, 3))


def _beside(values: FloatArray, patches: Tensor) -> Tensor:
    """As float32 where the patches are."""
    return torch.from_numpy(np.asarray(values, np.float32)).to(patches.device)


def stored_of(group: Group) -> tuple[Tensor, Tensor]:
    """Both sides (N, S, S) uint8 of a group as they are stored."""
    first, second = (torch.from_numpy(group.tracks.patches[rows]) for rows in (group.rows0, group.rows1))
    return first, second


def looked_at(group: Group, stored: tuple[Tensor, Tensor], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Both sides (N, 1, 32, 32) of a group, `stored_of` it, as they are described in use; made where these are.

    The whole group is turned, and perhaps mirrored, alike: by a right angle where upright, else at will.
    """
    count = len(group.track)
    turn = 90.0 * rng.integers(4) if group.upright else rng.uniform(0.0, 360.0)
    flips = np.full(count, -1.0 if rng.random() < 0.5 else 1.0)
    sides = []
    for side in stored:
        turns = turn + jitters_deg(group.upright, count, rng)
        sides.append(photographed(developed(cropped(side, turns, flips, rng), rng), rng))
    return sides[0], sides[1]


def distinct(groups: list[Group]) -> Tensor:
    """(B, B) bool: which pairs of tracks surely show different places: of other sets or scenes, or farther apart than
    what a patch shows."""
    total = sum(len(group.track) for group in groups)
    out, first = np.ones((total, total), bool), 0
    for group in groups:
        tracks, rows = group.tracks, slice(first, first + len(group.track))
        place, reach = tracks.place_m[group.track], tracks.reach_m[group.track]
        apart = cdist(place, place)
        scene = tracks.scene[group.track]
        far = apart > np.maximum(reach[:, None], reach[None])
        out[rows, rows] = far | (scene[:, None] != scene[None])
        first += len(group.track)
    return torch.from_numpy(out)
