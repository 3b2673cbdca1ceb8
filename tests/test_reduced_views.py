"""Ground views of reduced images (--max-size): one ground sampling distance over several flying heights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.config import validate
from aeromatch_cli.data import Block, Camera, Image, Pair, Pose
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.stages import simulate
from aeromatch_cli.stages.block import with_gsd
from aeromatch_cli.stages.context import Context, Given
from aeromatch_cli.workspace import Workspace

HEIGHTS_M = (60.0, 80.0, 100.0, 120.0, 140.0)  # 0.06 to 0.14 m per stored pixel
CAMERA = Camera("SIMPLE_PINHOLE", 1600, 1200, (1000.0, 799.5, 599.5))


def block() -> Block:
    images = tuple(Image(f"i{k}", f"{k}.jpg", 1600, 1200, "cam") for k in range(len(HEIGHTS_M)))
    down = from_omega_phi_kappa(0.0, 0.0, 0.0)
    poses = {f"i{k}": Pose(np.array([8.0 * k, 0.0, z]), down, 0.1, 0.1) for k, z in enumerate(HEIGHTS_M)}
    ground = ConstantGround(0.0)
    return Block(images, {"cam": CAMERA}, poses, "local", (0.0, 0.0, 0.0), ground, "constant", None)


def context_of(root: Path, max_size_px: int, simulator: str = "ground", before_m=(None, None)) -> Context:
    settings = validate({"block": {"images": str(root), "max_size_px": max_size_px}, "simulate": simulator})
    known = with_gsd(block(), before_m, max_size_px)
    ids = [image.image_id for image in known.images]
    pairs = tuple(Pair(a, b, 0.5, 5.0, "overlap") for k, a in enumerate(ids) for b in ids[k + 1 :])
    return Context(
        settings, Workspace(root / "work"), Executor("serial"), Given(known, dict.fromkeys(ids, "")), known, pairs
    )


def view_scales(context: Context) -> list[float]:
    """Ground sampling distance of every image's ground view."""
    found = []
    for image in context.block.images:
        (view,) = simulate.views_of(simulate.make_task(context, image))
        assert view.gsd_m is not None
        found.append(view.gsd_m)
    return found


@pytest.mark.parametrize(("max_size_px", "factor"), [(0, 1.0), (1600, 1.0), (800, 2.0), (500, 3.2)])
@pytest.mark.parametrize("simulator", ["ground", "neighbours"])
def test_images_up_to_the_median_height_share_a_scale_however_they_are_reduced(
    tmp_path: Path, max_size_px: int, factor: float, simulator: str
) -> None:
    context = context_of(tmp_path, max_size_px, simulator)
    assert context.block.gsd_m == pytest.approx(0.1)
    assert context.block.views_gsd_m == pytest.approx(0.1 * factor)
    assert (context.block.reduced_gsd_m is None) == (factor == 1.0)
    scales = view_scales(context)
    assert scales == pytest.approx(np.array([0.1, 0.1, 0.1, 0.12, 0.14]) * factor)
    assert scales[0] == scales[1] == context.block.views_gsd_m


def test_neighbours_have_the_cameras_that_are_worked_on(tmp_path: Path) -> None:
    (first, *_) = context_of(tmp_path, 800, "neighbours").neighbours("i0")
    assert (first.camera.width_px, first.camera.height_px, first.camera.params[0]) == (800, 600, 500.0)
    (first, *_) = context_of(tmp_path, 0, "neighbours").neighbours("i0")
    assert first.camera == CAMERA


def test_the_scale_of_reduced_images_is_kept_while_it_fits(tmp_path: Path) -> None:
    assert context_of(tmp_path, 800, before_m=(0.1, 0.19)).block.views_gsd_m == 0.19
    assert context_of(tmp_path, 800, before_m=(0.1, 0.1)).block.views_gsd_m == pytest.approx(0.2)
    assert context_of(tmp_path, 0, before_m=(0.098, 0.19)).block.views_gsd_m == 0.098
    assert replace(context_of(tmp_path, 800).block, gsd_m=None).views_gsd_m is None
