"""Networks from weights files: what is refused, and with which words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets import files
from aeromatch_cli.nets.context import Context, load_context
from aeromatch_cli.nets.detector import Detector, load_detector
from aeromatch_cli.nets.geodesc import load_geodesc
from aeromatch_cli.nets.loading import check_same_tensors, load_network
from aeromatch_cli.nets.orientation import load_orientation
from aeromatch_cli.nets.shadow import network_weights

LOADERS = {
    "context": (load_context, "Context"),
    "detector": (load_detector, "Detector"),
    "geodesc": (load_geodesc, "GeoDesc"),
    "orientation": (load_orientation, "OrientationNet"),
}


@pytest.mark.parametrize(
    ("name", "load"), [*((name, load) for name, (load, _) in LOADERS.items()), ("shadow", network_weights)]
)
def test_a_missing_shipped_file_is_named(
    name: str, load: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "SHIPPED_FOLDER", tmp_path)
    with pytest.raises(ConfigError, match=rf"{name}\.safetensors is missing: install aeromatch again"):
        load.__wrapped__()  # what the process knows already is no matter


@pytest.mark.parametrize(("load", "network"), LOADERS.values(), ids=LOADERS)
def test_another_networks_file_is_named(load: Callable[..., Any], network: str, tmp_path: Path) -> None:
    path = tmp_path / "linear.safetensors"
    save_file({"weight": torch.zeros(2, 2)}, path)
    with pytest.raises(
        ConfigError, match=rf"linear\.safetensors does not fit {network}: missing: .*unexpected: weight"
    ):
        load(path)


def test_numbers_are_the_files_and_random_ones_stay() -> None:
    before = torch.get_rng_state()
    network = load_network(lambda _: Detector(), files.shipped_path("detector"))
    assert torch.equal(torch.get_rng_state(), before)
    given = files.read_tensors(files.shipped_path("detector"))
    assert all(torch.equal(value, given[name].float()) for name, value in network.state_dict().items())
    assert not network.training


def test_half_of_the_digits_are_enough_for_a_file(tmp_path: Path) -> None:
    network = Context()
    save_file({name: value.half() for name, value in network.state_dict().items()}, tmp_path / "half.safetensors")
    loaded = load_context(tmp_path / "half.safetensors")
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float())


def test_differences_are_counted_and_shapes_given() -> None:
    wanted = nn.Sequential(*(nn.Linear(2, 2) for _ in range(3))).state_dict()
    with pytest.raises(
        ValueError, match=r"^missing: 0\.bias, 0\.weight, 1\.bias, 1\.weight, 2\.bias and 1 more; unexpected: other$"
    ):
        check_same_tensors(wanted, {"other": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"^wrong shape: 0\.weight \(1, 2\) instead of \(2, 2\)$"):
        check_same_tensors(wanted, wanted | {"0.weight": torch.zeros(1, 2)})
    check_same_tensors(wanted, {name: value for name, value in wanted.items() if name != "0.bias"}, ("0.bias",))
