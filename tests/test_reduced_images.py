"""Images worked on at reduced size: what is found lies at its true place in the stored raster."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import IMAGES, WIDTH

from aeromatch_cli.config import validate
from aeromatch_cli.data import Block, Camera, Features, FloatArray, Image
from aeromatch_cli.executor import Executor
from aeromatch_cli.fingerprints import image_fingerprint
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.stages import extract
from aeromatch_cli.stages.context import Context, Given
from aeromatch_cli.workspace import Workspace

pytestmark = pytest.mark.slow

WIDTH_PX, HEIGHT_PX = 640, 480
SIGMA_PX = 10.0


def blob_centers_px() -> FloatArray:
    """Sub-pixel places (24, 2), all fractions, no two close to each other."""
    rng = np.random.default_rng(4)
    cells = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2)
    return (cells + 0.5) * [WIDTH_PX / 6, HEIGHT_PX / 4] + rng.uniform(-8, 8, (24, 2))


def blobs() -> np.ndarray:
    """Bright Gaussian spots (H, W) uint8; pixel (x, y) is sampled at its centre (x, y)."""
    y, x = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX].astype(float)
    picture = np.full((HEIGHT_PX, WIDTH_PX), 40.0)
    for center_x, center_y in blob_centers_px():
        picture += 170.0 * np.exp(-((x - center_x) ** 2 + (y - center_y) ** 2) / (2.0 * SIGMA_PX**2))
    return np.rint(picture).astype(np.uint8)


def extracted(root: Path, max_size_px: int) -> Features:
    """Features of the picture of blobs, through the task that `extract` runs."""
    (root / "images").mkdir(parents=True)
    cv2.imwrite(str(root / "images" / "blobs.png"), blobs())
    block = {"images": str(root / "images"), "max_size_px": max_size_px}
    settings = validate({"block": block, "simulate": "none", "extract": {"name": "sift", "keypoints": 400}})
    camera = Camera("SIMPLE_PINHOLE", WIDTH_PX, HEIGHT_PX, (600.0, 319.5, 239.5))
    image = Image("blobs", "blobs.png", WIDTH_PX, HEIGHT_PX, "cam")
    known = Block((image,), {"cam": camera}, {}, "local", (0.0, 0.0, 0.0), None, "unknown", None)
    workspace = Workspace(root / "work")
    workspace.create()
    prints = {"blobs": image_fingerprint(root / "images" / "blobs.png")}
    context = Context(settings, workspace, Executor("serial"), Given(known, prints), known)
    task = extract.make_task(context, image)
    assert extract.run_task(task).features.keypoints > 0
    return read_features(task.path)


def nearest_to_blobs(features: Features) -> tuple[FloatArray, FloatArray]:
    """Offset (24, 2) and size (24,) of the keypoint closest to each blob."""
    offsets = features.keypoints_px.astype(float)[None] - blob_centers_px()[:, None]
    closest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
    return offsets[np.arange(24), closest], features.sizes_px[closest]


# By 2 and 4, and once (0.39) such that no size comes out whole. Without the half pixel: off by 0.5 (1 / scale - 1).
@pytest.mark.parametrize("max_size_px", [320, 250, 160])
def test_blobs_of_a_reduced_image_are_found_where_they_are(tmp_path, max_size_px):
    _, full_sizes = nearest_to_blobs(extracted(tmp_path / "full", 0))
    reduced = extracted(tmp_path / "reduced", max_size_px)
    offsets, sizes = nearest_to_blobs(reduced)
    assert np.abs(offsets.mean(axis=0)).max() < 0.05
    assert np.linalg.norm(offsets, axis=1).max() < 0.2
    np.testing.assert_allclose(sizes / full_sizes, 1.0, atol=0.02)
    # What the matcher sees stays in the reduced view.
    scale = max_size_px / WIDTH_PX
    assert reduced.view_sizes_px.tolist() == [[max_size_px, round(HEIGHT_PX * scale)]]
    assert reduced.view_keypoints_px.max() < max_size_px


def test_the_half_pixel_in_numbers():
    rows = np.array([[-0.5, -0.5], [0.0, 1.0], [79.5, 59.5]], np.float32)
    sizes = np.array([2.0, 3.0, 4.0], np.float32)
    empty = np.zeros(3, np.float32)
    plain = Features(
        rows, sizes, empty, np.zeros((3, 128), np.uint8), np.arange(3, dtype=np.int32), np.zeros(3, np.int32),
        rows, sizes, empty, np.array([[80, 60]], np.int32), np.zeros(1, np.float32),
        np.full((1, 3), np.nan, np.float32), np.full(1, np.nan, np.float32), np.zeros(1, bool),
    )  # fmt: skip
    moved = extract.in_stored_frame(plain, 0.25)
    # The upper left corner stays the corner; pixel 0 of four times the size has its centre at 1.5.
    np.testing.assert_allclose(moved.keypoints_px, [[-0.5, -0.5], [1.5, 5.5], [319.5, 239.5]], atol=1e-5)
    np.testing.assert_allclose(moved.sizes_px, [8.0, 12.0, 16.0], atol=1e-5)
    np.testing.assert_array_equal(moved.view_keypoints_px, rows)
    np.testing.assert_array_equal(extract.in_stored_frame(plain, 1.0).keypoints_px, rows)


def test_reduced_images_give_keypoints_in_stored_pixels(site):
    assert site("run", "--max-size", WIDTH // 2).code == 0
    with np.load(sorted((site.work / "features").glob("*.npz"))[0]) as archive:
        assert archive["keypoints_px"][:, 0].max() > WIDTH * 0.75
    assert site("run").counts("extract")[0] == IMAGES
