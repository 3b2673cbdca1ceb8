"""Who gives keypoints their angles, and how far two angles of one place disagree."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.rendered import RenderedTruth
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of
from benchmarks.keypoints.correspondence import (
    Keypoints,
    Picture,
    Pictures,
    in_overlap,
    of_one_size,
    partners,
    wrapped_deg,
)
from benchmarks.keypoints.detectors import DETECTORS, MOST, detect_sift
from benchmarks.keypoints.figures import Asked
from benchmarks.peers.base import Options
from benchmarks.peers.kornia_peers import on_patches, orinet
from benchmarks.tables import Row

WITHIN_DEG = (5.0, 10.0, 20.0, 45.0)


class Orienter(Protocol):
    def __call__(self, picture: Picture, keypoints: Keypoints) -> FloatArray:
        """Angles (N, A) in degrees, x towards y, NaN where a keypoint has fewer than A."""
        ...


class OfSift:
    """The angles that SIFT found at these places itself: several, where gradients have several directions."""

    def __init__(self, options: Options) -> None:
        del options

    def __call__(self, picture: Picture, keypoints: Keypoints) -> FloatArray:
        table, _ = detect_sift(picture)
        key = {}
        for x, y, size, angle, _ in table:
            key.setdefault((x, y, size), []).append(angle)
        rows = zip(*keypoints.points_px.T, keypoints.sizes_px, strict=True)
        found = [key[row] for row in rows]
        out = np.full((len(found), max(map(len, found), default=1)), np.nan)
        for row, angles in zip(out, found, strict=True):
            row[: len(angles)] = angles
        return out


class OriNet:
    """OriNet through kornia, on the same patches as this project's network."""

    def __init__(self, options: Options) -> None:
        self.network = orinet(options)

    def __call__(self, picture: Picture, keypoints: Keypoints) -> FloatArray:
        # kornia turns the other way: its patch's rows lie along (cos, -sin).
        return -np.rad2deg(on_patches(self.network, upright_patches(picture, keypoints), 1).astype(np.float64))


class Own:
    """This project's network; weights: a file other than the shipped one."""

    def __init__(self, options: Options, weights: Path | None = None) -> None:
        from aeromatch_cli.nets.orientation import load_orientation

        del options
        self.network: Any = load_orientation(weights) if weights else load_orientation()

    def __call__(self, picture: Picture, keypoints: Keypoints) -> FloatArray:
        from aeromatch_cli.nets.orientation import directions

        cosine, sine = directions(upright_patches(picture, keypoints), self.network).astype(np.float64).T
        return np.rad2deg(np.arctan2(sine, cosine))[:, None]


ORIENTERS: Mapping[str, Callable[..., Orienter]] = {"sift": OfSift, "orinet": OriNet, "ours": Own}


def upright_patches(picture: Picture, keypoints: Keypoints) -> NDArray[np.uint8]:
    """(N, 32, 32), cut at angle 0."""
    count = len(keypoints.points_px)
    return cut_patches(levels_of(picture.gray), keypoints.points_px, keypoints.sizes_px, np.zeros(count))


@dataclass(frozen=True, eq=False)
class Turned:
    """Keypoints (N) of two pictures that are one place at one size, and the turn (N,) from the first to the second."""

    pictures: tuple[Picture, Picture]
    keypoints: tuple[Keypoints, Keypoints]
    turn_deg: FloatArray


def turned_keypoints(truth: RenderedTruth, pictures: tuple[Picture, Picture], most: int, shown: int) -> Turned:
    """Of SIFT.

    most: keypoints of a picture; shown: the strongest of them in the overlap.
    """
    sift, sides = DETECTORS["sift"](None), []
    for picture, other in (pictures, pictures[::-1]):
        found = sift(picture, most)
        rows = np.flatnonzero(in_overlap(truth, picture, found.points_px, other))[:shown]
        sides.append(found.take(rows))
    stored = [picture.stored_px(side.points_px) for picture, side in zip(pictures, sides, strict=True)]
    found = partners(truth, pictures[0].image, stored[0], pictures[1].image, stored[1])
    found, turn = of_one_size(truth, pictures, (sides[0], sides[1]), found)
    return Turned(pictures, (sides[0].take(found.rows0), sides[1].take(found.rows1)), turn)


def disagreement_deg(angles0: FloatArray, angles1: FloatArray, turn_deg: FloatArray) -> FloatArray:
    """(N,) degrees by which angle 1 exceeds angle 0 plus the true turn; of angles (N, A) those that agree best."""
    apart = wrapped_deg(angles1[:, None, :] - angles0[:, :, None] - turn_deg[:, None, None]).reshape(len(turn_deg), -1)
    best = np.nanargmin(np.abs(apart), axis=1) if len(apart) else np.zeros(0, np.int64)
    return apart[np.arange(len(apart)), best]


def orientation_row(errors_deg: FloatArray) -> Row:
    """Figures of one pair. keypoints: how many; within_*: of them."""
    absolute = np.abs(errors_deg)
    row: Row = {"keypoints": len(absolute)}
    row |= {f"within_{limit:g}_deg": int((absolute <= limit).sum()) for limit in WITHIN_DEG}
    return row | {"median_error_deg": float(np.median(absolute)) if len(absolute) else None}


def orientation_figures(truth: RenderedTruth, pictures: Pictures, asked: Asked) -> Callable[..., Row]:
    """How well angles of one place, given by each network, agree with how the picture turns there."""

    @cache
    def shared(images: tuple[str, str], frame: str) -> Turned:
        both = pictures(images[0], frame), pictures(images[1], frame)
        return turned_keypoints(truth, both, MOST, 2 * asked.keypoints)

    def figures(images: tuple[str, str], frame: str, orienter: Orienter) -> Row:
        turned = shared(images, frame)
        angles0, angles1 = map(orienter, turned.pictures, turned.keypoints)
        return orientation_row(disagreement_deg(angles0, angles1, turned.turn_deg))

    return figures
