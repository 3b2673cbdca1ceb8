"""The LightGlue network: strict loading of every key style, and the same numbers as kornia's forward."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from make_lightglue import SIFT, features, seeded_tensors, write
from torch import Tensor

from aeromatch_cli.data import Features
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.lightglue import Dimensions, Side, attended, log_assignment, normalised
from aeromatch_cli.nets.lightglue_file import canonical_keys, load_lightglue

PLAIN = Dimensions(input_dim=32, descriptor_dim=32, n_layers=2, num_heads=1, add_scale_ori=False)


def old_style(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {re.sub(r"^transformers\.(\d+)\.(self|cross)_attn", r"\2_attn.\1", k): v for k, v in tensors.items()}


STYLES = {
    "kornia and new": lambda tensors: tensors,
    "old": old_style,
    "prefixed": lambda tensors: {f"matcher.{key}": value for key, value in tensors.items()},
    "prefixed old": lambda tensors: {f"matcher.{key}": value for key, value in old_style(tensors).items()},
    "without thresholds": lambda tensors: {k: v for k, v in tensors.items() if k != "confidence_thresholds"},
}


@pytest.mark.parametrize("dimensions", [SIFT, PLAIN], ids=["sift", "plain"])
@pytest.mark.parametrize("style", STYLES)
def test_every_key_style_gives_the_same_network(dimensions: Dimensions, style: str, tmp_path: Path) -> None:
    tensors = seeded_tensors(dimensions)
    network = load_lightglue(write(tmp_path / "weights.pth", STYLES[style](tensors)))
    assert network.dimensions == dimensions
    loaded = network.state_dict()
    assert loaded.keys() == tensors.keys() - {"confidence_thresholds"}
    assert all(torch.equal(loaded[key], tensors[key]) for key in loaded)
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())


def as_image(sift: Features, shift_px: float = 0.0) -> dict[str, Tensor]:
    """As kornia wants it."""
    return {
        "keypoints": torch.from_numpy(sift.view_keypoints_px)[None] + shift_px,
        "descriptors": torch.nn.functional.normalize(torch.from_numpy(sift.descriptors).float(), dim=-1)[None],
        "scales": torch.from_numpy(sift.view_size_px / 2)[None],
        "oris": torch.from_numpy(np.deg2rad(sift.view_orientation_deg))[None],
        "image_size": torch.tensor([[650.0, 490.0]]),
    }


def as_side(image: dict[str, Tensor]) -> Side:
    places = [normalised(image["keypoints"], image["image_size"]), image["scales"][..., None], image["oris"][..., None]]
    return Side(torch.cat(places, dim=-1), image["descriptors"])


@pytest.mark.parametrize(
    ("depth", "width", "exits", "prunes"),
    [(-1.0, -1.0, False, False), (0.5, -1.0, True, False), (-1.0, 0.9, False, True), (0.9999, 0.9, False, True)],
    ids=["all", "exit", "pruned", "pruned where certain"],
)
def test_matches_equal_kornias(tmp_path: Path, depth: float, width: float, exits: bool, prunes: bool) -> None:
    from kornia.feature import LightGlue as KorniaLightGlue

    tensors = seeded_tensors(SIFT)
    for layer in range(SIFT.n_layers - 1):  # confident and not, so that exits and pruning happen to some keypoints
        tensors[f"token_confidence.{layer}.token.0.bias"] += 2.2
        tensors[f"log_assignment.{layer}.matchability.bias"] -= 6.0
    conf = dataclasses.asdict(SIFT) | {"flash": False, "depth_confidence": depth, "width_confidence": width}
    theirs = KorniaLightGlue(features=None, filter_threshold=0.02, **conf).eval()
    theirs.load_state_dict(tensors | {"confidence_thresholds": theirs.confidence_thresholds}, strict=True)
    ours = load_lightglue(write(tmp_path / "weights.pth", old_style(tensors)))
    image, other = as_image(features(80)), as_image(features(80), 3.0)
    with torch.inference_mode():
        expected = theirs({"image0": image, "image1": other})
    options = {"threshold": 0.02, "depth_confidence": depth, "width_confidence": width}
    pairs, scores = ours.match(as_side(image), as_side(other), **options)
    assert len(pairs) > (3 if exits else 20)  # an early layer of an untrained network finds few
    assert torch.equal(expected["matches"][0], pairs)
    torch.testing.assert_close(expected["scores"][0], scores, atol=1e-4, rtol=0.0)
    pruned = int((expected["prune0"] < expected["prune0"].max()).sum())
    assert (expected["stop"] < SIFT.n_layers, pruned > 0) == (exits, prunes)


def test_the_assignment_equals_kornias(tmp_path: Path) -> None:
    from kornia.feature import LightGlue as KorniaLightGlue

    tensors = seeded_tensors(SIFT)
    conf = dataclasses.asdict(SIFT) | {"flash": False, "depth_confidence": -1, "width_confidence": -1}
    theirs = KorniaLightGlue(features=None, **conf).eval()
    theirs.load_state_dict(tensors | {"confidence_thresholds": theirs.confidence_thresholds}, strict=True)
    ours = load_lightglue(write(tmp_path / "weights.pth", tensors))
    image, other = as_image(features(50)), as_image(features(60, seed=1), 3.0)
    with torch.inference_mode():
        expected = theirs({"image0": image, "image1": other})["log_assignment"]
        *_, (x0, x1) = ours.states(as_side(image), as_side(other))
        pairs, none0, none1 = log_assignment(ours.assignment(SIFT.n_layers - 1), x0, x1)
    torch.testing.assert_close(expected[:, :-1, :-1], pairs, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(expected[:, :-1, -1], none0, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(expected[:, -1, :-1], none1, atol=1e-4, rtol=1e-5)


def test_the_old_style_needs_whole_names() -> None:
    renamed = canonical_keys({f"self_attn.{n}.Wqkv.weight": torch.zeros(1) for n in (1, 11)})
    assert sorted(renamed) == ["transformers.1.self_attn.Wqkv.weight", "transformers.11.self_attn.Wqkv.weight"]


def test_missing_tensors_are_named(tmp_path: Path) -> None:
    tensors = seeded_tensors(SIFT)
    for key in ("log_assignment.2.matchability.bias", "transformers.1.cross_attn.to_v.weight"):
        del tensors[key]
    expected = "missing: log_assignment.2.matchability.bias, transformers.1.cross_attn.to_v.weight$"
    with pytest.raises(ConfigError, match=expected):
        load_lightglue(write(tmp_path / "weights.pth", tensors))


def test_unexpected_tensors_are_named(tmp_path: Path) -> None:
    tensors = seeded_tensors(SIFT) | {f"extractor.conv{n}.weight": torch.zeros(1) for n in range(7)}
    expected = f"unexpected: {', '.join(f'extractor.conv{n}.weight' for n in range(5))} and 2 more$"
    with pytest.raises(ConfigError, match=expected):
        load_lightglue(write(tmp_path / "weights.pth", tensors))


def test_a_missing_layer_is_named(tmp_path: Path) -> None:
    tensors = {key: value for key, value in seeded_tensors(SIFT).items() if not key.startswith("transformers.1.")}
    with pytest.raises(ConfigError, match=r"missing: transformers\.1\.cross_attn.*unexpected: "):
        load_lightglue(write(tmp_path / "weights.pth", tensors))


def test_wrong_shapes_are_named(tmp_path: Path) -> None:
    tensors = seeded_tensors(SIFT) | {"log_assignment.0.final_proj.bias": torch.zeros(9)}
    with pytest.raises(ConfigError, match=r"wrong shape: log_assignment.0.final_proj.bias \(9,\) instead of \(64,\)"):
        load_lightglue(write(tmp_path / "weights.pth", tensors))


def test_other_networks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    with pytest.raises(
        ConfigError, match=r"does not fit LightGlue: it has no posenc\.Wr\.weight and no transformers\.0"
    ):
        load_lightglue(write(path, {"conv1.weight": torch.zeros(3, 3)}))
    six = seeded_tensors(SIFT) | {"posenc.Wr.weight": torch.zeros(16, 6)}  # corners of affine frames
    with pytest.raises(ConfigError, match="keypoints have 6 coordinates"):
        load_lightglue(write(path, six))
    tensors = seeded_tensors(SIFT)
    twice = tensors | {"matcher.posenc.Wr.weight": tensors["posenc.Wr.weight"]}
    with pytest.raises(ConfigError, match=r"matcher\.posenc\.Wr\.weight is given twice"):
        load_lightglue(write(path, twice))


def test_loading_leaves_the_random_state_alone(tmp_path: Path) -> None:
    weights = write(tmp_path / "weights.pth", seeded_tensors(SIFT))
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    load_lightglue(weights)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("count", [5, 256, 600])
def test_bfloat16_attention_stays_close_to_float32(count: int) -> None:
    generator = torch.Generator().manual_seed(5)
    query, key, value = (torch.randn(1, 2, count, 32, generator=generator) for _ in range(3))
    exact = torch.nn.functional.scaled_dot_product_attention(query, key, value)
    rounded = attended(query.bfloat16(), key.bfloat16(), value.bfloat16())
    assert rounded.dtype == torch.bfloat16
    assert rounded.shape == exact.shape
    # Eight bits of mantissa; values are up to four, and averaged.
    assert float((rounded.float() - exact).abs().max()) < 0.03
