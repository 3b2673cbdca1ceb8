"""Black frames of pictures of 16 bits and more: exact zeros alone, in colour and in gray."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from make_images import write_bands

from aeromatch_cli.fingerprints import image_fingerprint, picture_fingerprint
from aeromatch_cli.images.depth import in_16_bits
from aeromatch_cli.images.files import read_raster

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SIZE = 100, 300


def dark_below() -> np.ndarray:
    """(H, W) uint16 of a 12-bit sensor whose last row, 1 % of the picture, is its darkest."""
    pixels = np.random.default_rng(1).integers(900, 4000, SIZE).astype(np.uint16)
    pixels[-1] = 300
    return pixels


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("bands", [1, 3])
@pytest.mark.parametrize("suffix", ["tif", "png"])
def test_a_dark_border_is_no_frame(tmp_path: Path, colour: bool, bands: int, suffix: str) -> None:
    stored = np.repeat(dark_below()[None], bands, axis=0)
    path = tmp_path / f"a.{suffix}"
    for framed in (False, True):
        if framed:
            stored[:, :5] = 0
        if suffix == "tif":
            write_bands(path, stored)
        else:
            cv2.imwrite(str(path), np.moveaxis(stored, 0, 2).squeeze())
        pixels, valid = read_raster(path, colour=colour)
        assert pixels.dtype == (np.uint16 if colour else np.uint8)
        if not framed:
            assert valid is None
        else:
            assert valid is not None
            assert np.flatnonzero(~valid.any(axis=1)).tolist() == [0, 1, 2, 3, 4]
            assert valid[5:].all()


def test_the_coldest_of_a_thermal_picture_is_no_frame() -> None:
    cold = np.random.default_rng(1).uniform(-5.0, 30.0, (500, 640)).astype(np.float32)
    cold[0, :330] = -20.0
    found = in_16_bits(cold)
    assert (found[0, :330] == 1).all()
    assert in_16_bits(np.where(cold < -19.0, np.nan, cold))[0, :330].max() == 0


def test_pictures_of_eight_bits_keep_their_fingerprints(tmp_path: Path) -> None:
    deep = dark_below()
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    cv2.imwrite(str(tmp_path / "plain.png"), (deep >> 4).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "plain.jpg"), (deep >> 4).astype(np.uint8))
    for name, dtype in {"deep": np.uint16, "deeper": np.float32, "plain": np.uint8}.items():
        write_bands(tmp_path / f"{name}.tif", (deep[None] >> 4).astype(dtype))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    same = {path.name for path in tmp_path.iterdir() if picture_fingerprint(path) == image_fingerprint(path)}
    assert same == {"plain.png", "plain.jpg", "plain.tif", "broken.tif"}
