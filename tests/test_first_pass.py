"""How much of a first pass a block takes."""

from __future__ import annotations

import pytest

from aeromatch_cli.data import Block, Image
from aeromatch_cli.stages.first_pass import finer, fitted
from aeromatch_cli.strategies.orienters import GlobalMapping


def block(count: int, width_px: int, height_px: int) -> Block:
    ids = [f"i{number:03d}" for number in range(count)]
    return Block(
        tuple(Image(i, i, width_px, height_px, "1") for i in ids), {}, {}, "local", (0.0, 0.0, 0.0), None, "", None
    )


@pytest.mark.parametrize(
    ("images", "size_px", "keypoints", "neighbours"),
    [
        (100, (480, 360), 2000, 20),
        (101, (480, 360), 864, 12),
        (101, (160, 120), 500, 12),
        (101, (6000, 4000), 2000, 12),
    ],
)
def test_imagesof_large_blocks_take_less(
    images: int, size_px: tuple[int, int], keypoints: int, neighbours: int
) -> None:
    recipe = fitted(GlobalMapping(), block(images, *size_px))
    assert (recipe.keypoints, recipe.neighbours) == (keypoints, neighbours)


@pytest.mark.parametrize(
    ("size_px", "recipe", "halved"),
    [
        ((6000, 4000), GlobalMapping(), True),  # 1600 x 1067, 853 pixels per keypoint
        ((1600, 1200), GlobalMapping(), True),
        ((1600, 1200), GlobalMapping(keypoints=6000), False),  # 320
        ((1600, 900), GlobalMapping(), False),  # small ones are never halved
        ((1600, 1200), GlobalMapping(pixels_per_keypoint=0.0), False),
    ],
)
def test_a_finer_pass_is_made_of_images_that_were_halved(
    size_px: tuple[int, int], recipe: GlobalMapping, halved: bool
) -> None:
    found = finer(recipe, block(5, *size_px))
    assert (found is not None) == halved
    if found is not None:
        assert found == recipe.model_copy(update={"pixels_per_keypoint": 0.0})


def test_what_was_asked_for_is_not_exceeded() -> None:
    recipe = fitted(GlobalMapping(keypoints=300, neighbours=6), block(200, 4000, 3000))
    assert (recipe.keypoints, recipe.neighbours) == (300, 6)
