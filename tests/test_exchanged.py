"""Positions whose columns are exchanged, or of another sign, are told by the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_orientation import flight
from test_soundness import model_of

from aeromatch_cli.blocks.crs import grid_from_geographic, utm_crs
from aeromatch_cli.data import Block, Pose
from aeromatch_cli.stages.swapped_axes import fitting_reading

TRUTH = flight()
ZONE = "EPSG:32633"
ORIGIN_M = (500_000.0, 5_300_000.0, 0.0)


def block_of(crs: str, places_m: dict[str, np.ndarray], origin_m: tuple[float, float, float]) -> Block:
    poses = {i: Pose(place, None, 2.0, 180.0) for i, place in places_m.items()}
    return Block((), {}, poses, crs, origin_m, None, "constant", None)


def pictures():
    """A level model with points below its images."""
    centers = np.array([pose.center_m for pose in TRUTH.values()])
    rng = np.random.default_rng(0)
    below = np.column_stack([rng.uniform(-20, 100, (300, 2)), rng.uniform(-5, 5, 300)])
    assert centers[:, 2].min() > 50.0
    return replace(model_of(TRUTH), points_m=below)


def exchanged_places(swap: bool) -> Block:
    """The flight at 47.8 N, 15 E, as a list with or without latitudes in the column of longitudes."""
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(ZONE, "EPSG:4326", always_xy=True)
    centers = np.array([pose.center_m for pose in TRUTH.values()])
    longitudes, latitudes = to_degrees.transform(centers[:, 0] + ORIGIN_M[0], centers[:, 1] + ORIGIN_M[1])
    first, second = (longitudes, latitudes) if swap else (latitudes, longitudes)
    crs = utm_crs(first, second)
    xy_m = grid_from_geographic(crs, first, second)
    origin = np.floor(xy_m.min(axis=0) / 1000.0) * 1000.0
    places = np.column_stack([xy_m - origin, centers[:, 2]])
    return block_of(crs, dict(zip(TRUTH, places, strict=True)), (float(origin[0]), float(origin[1]), 0.0))


def test_latitudes_in_the_place_of_longitudes_are_named() -> None:
    swapped = exchanged_places(swap=True)
    assert swapped.crs != ZONE
    assert fitting_reading(swapped, pictures()) == "exchanged"


@pytest.mark.parametrize("mirror", [[[0, 1], [1, 0]], [[-1, 0], [0, 1]], [[1, 0], [0, -1]]])
def test_x_in_the_place_of_y_or_a_wrong_sign_is_a_mirror_image(mirror: list[list[int]]) -> None:
    places = {i: np.array([*(mirror @ pose.center_m[:2]), pose.center_m[2]]) for i, pose in TRUTH.items()}
    assert fitting_reading(block_of("local", places, (0.0, 0.0, 0.0)), pictures()) == "mirrored"


@pytest.mark.parametrize("seed", range(5))
def test_places_of_other_images_are_not(seed: int) -> None:
    ids = list(TRUTH)
    mixed = np.random.default_rng(seed).permutation(ids)
    places = {i: TRUTH[str(other)].center_m for i, other in zip(ids, mixed, strict=True)}
    assert fitting_reading(block_of("local", places, (0.0, 0.0, 0.0)), pictures()) == ""
