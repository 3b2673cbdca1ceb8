"""The detector network: shapes, what it does not see, and the shipped weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.detector import CHANNELS, FIELD_PX, PIECE_PX, REACH_PX, Detector, evened, load_detector
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.precision import Precision


@pytest.fixture(scope="module")
def network() -> Detector:
    torch.manual_seed(0)
    return Detector().eval().requires_grad_(False)


def noise(*size: int) -> torch.Tensor:
    return torch.rand(1, 1, *size, generator=torch.Generator().manual_seed(1))


def test_heat_has_the_size_of_its_picture(network: Detector) -> None:
    assert network(noise(61, 42)).shape == (1, 1, 61, 42)
    with pytest.raises(ValueError, match=r"\(N, 1, H, W\)"):
        network(torch.zeros(1, 3, 8, 8))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_picture_turned_by_half_has_its_heat_turned_by_half(precision: Precision) -> None:
    network = load_detector(precision=precision)
    picture = noise(48, 64)  # whole cells: those of local brightness turn onto themselves
    heat, turned = network(picture), network(picture.flip(2, 3)).flip(2, 3)
    tolerance = {"float32": 1e-4, "bfloat16": 0.1}[precision]
    torch.testing.assert_close(turned, heat, atol=tolerance, rtol=0.0)
    assert (heat - heat.flip(2, 3)).abs().max() > 1.0


def test_a_turned_convolution_is_an_ordinary_one(network: Detector) -> None:
    """Its channels of the second half are those of the first for the turned picture."""
    picture = noise(20, 24)
    found = network.first(picture)
    ordinary = torch.nn.functional.conv2d(picture, *network.first.kernels(), padding=2)
    torch.testing.assert_close(found, ordinary)
    turned = network.first(picture.flip(2, 3)).flip(2, 3)
    torch.testing.assert_close(turned, found.roll(CHANNELS // 2, 1), atol=1e-6, rtol=0.0)
    assert sum(parameter.numel() for parameter in network.parameters()) == 6_153


@pytest.mark.slow
@pytest.mark.parametrize("size", [(PIECE_PX + 1, 3 * PIECE_PX - 5), (2 * PIECE_PX, 7)])
def test_the_pieces_that_the_layers_work_on_change_nothing(size: tuple[int, int]) -> None:
    network = load_detector(precision="float32")
    whole = network._layered(evened(noise(*size)))
    torch.testing.assert_close(network(noise(*size)), whole, atol=1e-4, rtol=0.0)


def test_gain_and_offset_of_the_light_change_nothing() -> None:
    picture = 0.2 + 0.6 * noise(64, 64)
    assert torch.allclose(evened(0.5 * picture + 0.1), evened(picture), atol=2e-3)


def test_what_is_farther_away_than_the_field_changes_nothing(network: Detector) -> None:
    picture = noise(160, 160)
    changed = picture.clone()
    changed[..., 80, 80] = 1.0 - changed[..., 80, 80]
    differs = (network(picture) != network(changed))[0, 0].nonzero()
    assert (differs - 80).abs().max() <= FIELD_PX
    inputs = torch.zeros(1, 1, 64, 64, requires_grad=True)
    x = torch.relu(network.first(inputs))
    for layer in network.layers:
        x = layer(x)  # without rectifiers nothing hides how far it reaches
    network.last(x)[0, 0, 32, 32].backward()
    assert inputs.grad is not None
    assert int((inputs.grad[0, 0].nonzero() - 32).abs().max()) == REACH_PX


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    save_file({"first.weight": torch.zeros(16, 1, 5, 5)}, tmp_path / "half.safetensors")
    with pytest.raises(ConfigError, match=r"half\.safetensors does not fit Detector: missing: first\.bias.*more"):
        load_detector(tmp_path / "half.safetensors")


def test_shipped_weights_are_small_and_shared_by_a_process() -> None:
    assert shipped_path("detector").stat().st_size < 1_000_000
    assert load_detector() is load_detector()
    assert not any(parameter.requires_grad for parameter in load_detector().parameters())


def test_bfloat16_agrees_with_float32() -> None:
    picture = noise(96, 96)
    exact, fast = (load_detector(precision=kind)(picture) for kind in ("float32", "bfloat16"))
    assert exact.dtype == fast.dtype == torch.float32
    assert np.corrcoef(exact.flatten(), fast.flatten())[0, 1] > 0.999
