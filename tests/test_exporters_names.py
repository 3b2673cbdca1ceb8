"""What exporters make of names and of large blocks."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import pytest
from test_export_colmap import Truth, make_truth

from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies.exporters import EXPORTERS, ExportContents
from aeromatch_cli.strategies.exporters.solution import rows_of_images


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


def renamed(truth: Truth, *names: str) -> ExportContents:
    """Contents whose first images are called like this."""
    images = list(truth.block.images)
    for number, name in enumerate(names):
        images[number] = dataclasses.replace(images[number], name=name)
    return dataclasses.replace(truth.contents(), block=dataclasses.replace(truth.block, images=tuple(images)))


@pytest.mark.parametrize(
    ("exporter", "names", "same"),
    [
        ("micmac", ("a/b.jpg", "a_b.jpg"), "a_b.jpg"),
        ("hloc", ("a/b.jpg", "a-b.jpg"), "a-b.jpg"),
        ("opensfm", ("a/b.jpg", "c/b.jpg"), "b.jpg"),
        ("openmvg", ("a/b.jpg", "c/b.tif"), "b"),
    ],
)
def test_two_images_whose_files_would_be_one_are_refused(
    truth: Truth, tmp_path: Path, exporter: str, names: tuple[str, str], same: str
) -> None:
    if exporter == "hloc":
        pytest.importorskip("h5py")
    contents = renamed(truth, *names)
    with pytest.raises(ConfigError) as refused:
        EXPORTERS[exporter]().check_images(contents.block.images)
    with pytest.raises(ConfigError) as raised:
        EXPORTERS[exporter]()(contents, tmp_path / "e")  # type: ignore[operator]
    assert f"{names[0]} and {names[1]} would both be called {same}: rename one" in str(raised.value)
    assert str(refused.value) == str(raised.value)
    assert not (tmp_path / "e").exists()


def test_micmac_keeps_every_pair_of_names_that_differ(truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["micmac"]()(renamed(truth, "a/b.jpg", "a_c.jpg"), tmp_path / "m")  # type: ignore[operator]
    files = list((tmp_path / "m" / "Homol").rglob("*.txt"))
    assert len(files) == 2 * len(truth.pairs) == 30
    assert len(np.loadtxt(tmp_path / "m" / "Homol" / "Pastisa_b.jpg" / "a_c.jpg.txt")) == len(truth.pairs[0].verified)


def test_bingos_rows_are_sorted_once_for_all_images() -> None:
    image_idx = np.random.default_rng(4).integers(0, 20_000, 500_000)
    image_idx[image_idx == 7] = 8
    started = time.process_time()
    rows = rows_of_images(image_idx, 20_001)
    assert time.process_time() - started < 2.0  # looked for by every image: 7 s
    assert len(rows) == 20_001
    assert len(rows[7]) == len(rows[20_000]) == 0
    for number in (0, 8, 19_999):
        np.testing.assert_array_equal(rows[number], np.flatnonzero(image_idx == number))
    assert [len(part) for part in rows_of_images(np.zeros(0, np.int64), 3)] == [0, 0, 0]


class Counted(tuple[Image, ...]):
    """How often all images were passed over."""

    passes: ClassVar[int] = 0

    def __iter__(self) -> Iterator[Image]:
        type(self).passes += 1
        return super().__iter__()


def test_blocks_exchange_passes_over_the_images_a_few_times_however_many_cameras(truth: Truth, tmp_path: Path) -> None:
    block, count = truth.block, 300
    images = [dataclasses.replace(block.images[k % 6], image_id=f"i{k:03}", camera_id=f"c{k}") for k in range(count)]
    cameras = {f"c{k}": block.cameras["ab"[k % 2]] for k in range(count)}
    large = dataclasses.replace(block, images=Counted(images), cameras=cameras, poses={})
    none = np.zeros((0, 2), np.float32)
    contents = dataclasses.replace(truth.contents(), block=large, pairs=(), keypoints_px=lambda _: none)
    Counted.passes = 0
    EXPORTERS["blocks-exchange"]()(contents, tmp_path / "b")  # type: ignore[operator]
    assert Counted.passes < 10
    root = ElementTree.parse(tmp_path / "b" / "blocks.xml").getroot()
    groups = root.findall(".//Photogroup")
    assert len(groups) == count
    cameras_sorted = sorted(cameras)
    assert [int(group.findtext("Photo/Id", "")) for group in groups] == [int(name[1:]) for name in cameras_sorted]
