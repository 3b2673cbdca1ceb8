"""Masks of any depth and bands, and how often one for all images is read."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Picture

from aeromatch_cli import fingerprints
from aeromatch_cli.fingerprints import image_fingerprint, mask_fingerprint
from aeromatch_cli.images.files import read_mask

LABELS = np.arange(12, dtype=np.uint16).reshape(3, 4)


@pytest.mark.parametrize("top", [11, 255, 256, 65535])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_labels_of_sixteen_bits_are_used_but_for_zero(tmp_path: Path, top: int, suffix: str) -> None:
    labels = LABELS.copy()
    labels[2, 3] = top
    path = tmp_path / f"m.{suffix}"
    cv2.imwrite(str(path), labels)
    found = read_mask(path, 4, 3)
    np.testing.assert_array_equal(found, labels > 0)
    assert found.sum() == 11
    assert read_mask(path, 8, 6).sum() == 44


def test_faint_colours_are_used_and_alpha_is_no_band(tmp_path: Path) -> None:
    coloured = np.zeros((3, 4, 4), np.uint8)
    coloured[..., 3] = 255
    coloured[0, 1, 2] = coloured[1, 2, 0] = coloured[2, 3, 1] = 1
    Picture.fromarray(coloured).save(tmp_path / "m.png")
    found = read_mask(tmp_path / "m.png", 4, 3)
    assert np.argwhere(found).tolist() == [[0, 1], [1, 2], [2, 3]]
    coloured[..., 3] = 0
    Picture.fromarray(coloured).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png", 4, 3), found)


def test_only_masks_that_were_read_wrongly_have_another_fingerprint(tmp_path: Path) -> None:
    gray = (LABELS > 3).astype(np.uint8) * 255
    for name, pixels in {
        "gray.png": gray,
        "gray.jpg": gray,
        "deep.png": LABELS,
        "rgb.png": np.dstack([gray] * 3),
    }.items():
        cv2.imwrite(str(tmp_path / name), pixels)
    Picture.fromarray(gray > 0).save(tmp_path / "bits.png")
    same = {p.name for p in tmp_path.iterdir() if mask_fingerprint(p) == image_fingerprint(p)}
    assert same == {"gray.png", "gray.jpg", "bits.png"}


def test_one_mask_for_all_images_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.png"
    cv2.imwrite(str(path), LABELS)
    read = []

    def counted(of: Path) -> str:
        read.append(of)
        return image_fingerprint(of)

    monkeypatch.setattr(fingerprints, "image_fingerprint", counted)
    first = {mask_fingerprint(path) for _ in range(1000)}
    assert (len(first), len(read)) == (1, 1)
    os.utime(path, ns=(1, 1))
    assert mask_fingerprint(path) not in first
    assert len(read) == 2
