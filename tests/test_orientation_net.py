"""The orientation network: its shapes, folding and precision; and that turning a patch turns what ships."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from trainings.patches import sources
from trainings.patches.turns import TurnedPairs, errors_deg, gradient_peaks, table, unseen_pairs, wrapped_deg

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.orientation import OrientationNet, directions, load_orientation
from aeromatch_cli.nets.patches import SIDE_PX, fold
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of


@pytest.fixture(scope="module")
def unseen(rendered: Path) -> TurnedPairs:
    """Two patches each of SIFT's places in a small block, which these weights learned from, turned at will."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "DETECTORS", ("sift",))
        patch.setattr(sources, "TRACKS", 1800)
        found = {f"block.{kind}": tracks for kind, tracks in sources.rendered(rendered).items()}
    return unseen_pairs(found, 10_000)  # all there are: of 600 the figures below vary by 0.02


def degrees(patches: np.ndarray, network: OrientationNet | None = None) -> FloatArray:
    found = directions(patches, network)
    return np.rad2deg(np.arctan2(found[:, 1], found[:, 0]))


def test_answers_are_directions() -> None:
    patches = np.random.default_rng(0).integers(0, 256, (130, SIDE_PX, SIDE_PX), dtype=np.uint8)
    found = directions(patches)
    assert found.shape == (130, 2)
    assert found.dtype == np.float32
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.array_equal(found[129:], directions(patches[129:]))


def test_folded_answers_as_unfolded() -> None:
    torch.manual_seed(0)
    network = OrientationNet().train()
    patches = torch.rand(64, 1, SIDE_PX, SIDE_PX)
    with torch.no_grad():
        network(patches)
        expected = network.eval()(patches)
        assert fold(network, OrientationNet(folded=True))(patches) == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_turning_a_patch_by_a_right_angle_turns_its_orientation(unseen: TurnedPairs) -> None:
    # numpy's rot90 turns against x towards y.
    turned = np.ascontiguousarray(np.rot90(unseen.patches0, -1, axes=(1, 2)))
    off = np.abs(wrapped_deg(degrees(turned) - degrees(unseen.patches0) - 90.0))
    # By construction, unless two directions are as high as each other.
    assert np.percentile(off, 98) < 1.0


@pytest.mark.slow
def test_a_patch_cut_along_its_orientation_is_upright(unseen: TurnedPairs) -> None:
    """The angle means what `cut_patches` means by it."""
    first = degrees(unseen.patches0)
    middle = np.array([[15.5, 15.5]])
    again = [
        cut_patches(levels_of(patch), middle, np.array([5.0]), np.array([angle]))[0]
        for patch, angle in zip(unseen.patches0[:150], first[:150], strict=True)
    ]
    off = np.abs(wrapped_deg(degrees(np.stack(again))))
    assert np.median(off) < 10.0


@pytest.mark.slow
def test_bfloat16_is_close_to_float32(unseen: TurnedPairs) -> None:
    patches = unseen.patches0[:400]
    exact, quick = (degrees(patches, load_orientation(precision=kind)) for kind in ("float32", "bfloat16"))
    assert np.percentile(np.abs(wrapped_deg(exact - quick)), 95) < 5.0


def test_another_networks_weights_are_refused(tmp_path: Path) -> None:
    tensors = load_file(shipped_path("orientation"))
    assert shipped_path("orientation").stat().st_size <= 3_000_000
    tensors["out.weight"] = tensors["out.weight"][:1].clone()
    save_file(tensors, tmp_path / "one.safetensors")
    with pytest.raises(ConfigError, match=r"does not fit OrientationNet: wrong shape: out\.weight"):
        load_orientation(tmp_path / "one.safetensors")


@pytest.mark.slow
def test_the_shipped_weights_find_turns_again(unseen: TurnedPairs) -> None:
    ours, gradients = table(degrees, unseen)["all"], table(gradient_peaks, unseen)["all"]
    # 7.0 degrees and 0.752; the histogram's are 5.5 and 0.745.
    assert ours["median_deg"] < 7.3
    assert ours["within_20"] > gradients["within_20"]
    assert np.median(errors_deg(degrees, unseen)) == pytest.approx(ours["median_deg"], abs=0.01)
