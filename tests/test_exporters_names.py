"""What exporters make of names and of large blocks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_export_colmap import Truth, make_truth

from aeromatch_cli.errors import ItemError
from aeromatch_cli.strategies.exporters import EXPORTERS, ExportContents


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
    with pytest.raises(ItemError) as raised:
        EXPORTERS[exporter]()(contents, tmp_path / "e")  # type: ignore[operator]
    assert f"several are called {same}, {names[0]} and {names[1]}: rename them" in str(raised.value)
    assert not (tmp_path / "e").exists()


def test_micmac_keeps_every_pair_of_names_that_differ(truth: Truth, tmp_path: Path) -> None:
    EXPORTERS["micmac"]()(renamed(truth, "a/b.jpg", "a_c.jpg"), tmp_path / "m")  # type: ignore[operator]
    files = list((tmp_path / "m" / "Homol").rglob("*.txt"))
    assert len(files) == 2 * len(truth.pairs) == 30
    assert len(np.loadtxt(tmp_path / "m" / "Homol" / "Pastisa_b.jpg" / "a_c.jpg.txt")) == len(truth.pairs[0].verified)
