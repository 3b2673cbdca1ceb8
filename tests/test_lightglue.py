"""LightGlue: strict loading of every key style, and the matcher around it. Networks are seeded and untrained."""

from __future__ import annotations

import dataclasses
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from aeromatch_cli.data import Camera, Features, FloatArray, Matches, Pair, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.lightglue import Dimensions, Side, log_assignment, normalised
from aeromatch_cli.nets.lightglue import LightGlue as Network
from aeromatch_cli.nets.lightglue_file import canonical_keys, load_lightglue
from aeromatch_cli.strategies.matchers import lightglue
from aeromatch_cli.strategies.matchers.lightglue import LightGlue, wrapped_rad

SIFT = Dimensions(input_dim=128, descriptor_dim=64, n_layers=3, num_heads=2, add_scale_ori=True)
PLAIN = Dimensions(input_dim=32, descriptor_dim=32, n_layers=2, num_heads=1, add_scale_ori=False)
CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (600.0, 319.5, 239.5))
GEOMETRY = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, None, None, None)


def seeded_tensors(dimensions: Dimensions) -> dict[str, Tensor]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        state = Network(dimensions).state_dict()
        random = {key: torch.randn_like(value) * 0.1 for key, value in state.items()}
    # Close to the identity, so that similar descriptors match; attention that heeds positions.
    for key, value in random.items():
        if "final_proj.weight" in key or key == "input_proj.weight":
            value += 5.0 * torch.eye(*value.shape)
        if "matchability.bias" in key:
            value += 4.0
        if key == "posenc.Wr.weight" or "Wqkv.weight" in key:
            value *= 5.0
    return random | {"confidence_thresholds": torch.full((dimensions.n_layers,), 0.9)}


def recipe(weights: str, **settings: Any) -> LightGlue:
    """In full precision, so that tests can compare to the last digits."""
    return LightGlue(weights=weights, **{"precision": "float32", **settings})


def old_style(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {re.sub(r"^transformers\.(\d+)\.(self|cross)_attn", r"\2_attn.\1", k): v for k, v in tensors.items()}


STYLES = {
    "kornia and new": lambda tensors: tensors,
    "old": old_style,
    "prefixed": lambda tensors: {f"matcher.{key}": value for key, value in tensors.items()},
    "prefixed old": lambda tensors: {f"matcher.{key}": value for key, value in old_style(tensors).items()},
    "without thresholds": lambda tensors: {k: v for k, v in tensors.items() if k != "confidence_thresholds"},
}


def write(path: Path, tensors: dict[str, Tensor]) -> Path:
    torch.save(tensors, path)
    return path


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Small networks lose time to a second thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write(tmp_path_factory.mktemp("weights") / "sift.pth", seeded_tensors(SIFT)))


def features(count: int, seed: int = 0) -> Features:
    """SIFT-like features of one view, one descriptor per keypoint. Same seed, same features."""
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(0, [639, 479], (count, 2)).astype(np.float32)
    descriptors = np.minimum(rng.gamma(0.4, 60.0, (count, 128)), 255).astype(np.uint8)
    sizes = rng.uniform(2, 12, count).astype(np.float32)
    return Features(
        keypoints_px=keypoints,
        sizes_px=sizes,
        responses=rng.uniform(0, 1, count).astype(np.float32),
        descriptors=descriptors,
        descriptor_keypoint_idx=np.arange(count, dtype=np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=keypoints,
        view_size_px=sizes,
        view_orientation_deg=rng.uniform(0, 360, count).astype(np.float32),
        view_sizes_px=np.array([[640, 480]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )


OF_VIEWS = {"view_sizes_px", "view_angles_deg", "view_directions", "view_gsd_m", "view_enhanced"}


def permuted(original: Features, order: np.ndarray) -> Features:
    """The same keypoints listed in another order: new row n is old row order[n]."""
    rows = {field.name: getattr(original, field.name) for field in dataclasses.fields(original)}
    for name in rows.keys() - {*OF_VIEWS, "descriptor_keypoint_idx", "colours"}:
        rows[name] = rows[name][order]
    return Features(**rows)


def noisy(original: Features, shift_px: float) -> Features:
    moved = np.clip(original.view_keypoints_px + np.float32(shift_px), 0, [639, 479]).astype(np.float32)
    return dataclasses.replace(original, keypoints_px=moved, view_keypoints_px=moved)


def two_views(view0: Features, view1: Features) -> Features:
    """One image whose keypoint n is row n of both views."""
    rows = {field.name: getattr(view0, field.name) for field in dataclasses.fields(view0)}
    for name in rows.keys() - {"keypoints_px", "sizes_px", "responses", "colours"}:
        rows[name] = np.concatenate([rows[name], getattr(view1, name)])
    return Features(**rows | {"view_idx": np.repeat(np.arange(2, dtype=np.int32), len(view0.keypoints_px))})


def as_dict(matches: Matches) -> dict[tuple[int, int], float]:
    return {(int(i), int(j)): float(s) for (i, j), s in zip(matches.indices, matches.scores, strict=True)}


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
    tensors = seeded_tensors(SIFT) | {f"extractor.conv{n}.weight": torch.zeros(1) for n in range(5)}
    expected = "unexpected: extractor.conv0.weight, extractor.conv1.weight, extractor.conv2.weight and 2 more$"
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
    with pytest.raises(ConfigError, match=r"not a LightGlue: it has no posenc\.Wr\.weight and no transformers\.0"):
        load_lightglue(write(path, {"conv1.weight": torch.zeros(3, 3)}))
    six = seeded_tensors(SIFT) | {"posenc.Wr.weight": torch.zeros(16, 6)}  # corners of affine frames
    with pytest.raises(ConfigError, match="keypoints have 6 coordinates"):
        load_lightglue(write(path, six))
    tensors = seeded_tensors(SIFT)
    twice = tensors | {"matcher.posenc.Wr.weight": tensors["posenc.Wr.weight"]}
    with pytest.raises(ConfigError, match=r"matcher\.posenc\.Wr\.weight is given twice"):
        load_lightglue(write(path, twice))


def test_loading_leaves_the_random_state_alone(weights: str) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    load_lightglue(Path(weights))
    assert torch.equal(torch.rand(3), expected)


def test_nothing_is_downloaded(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    assert len(recipe(weights, threshold=0.05)(features(40), features(40), GEOMETRY).indices) > 0


def test_equal_pictures_match_point_by_point(weights: str) -> None:
    first, second = features(200), noisy(features(200), 2.0)
    matches = recipe(weights)(first, second, GEOMETRY)
    assert (matches.indices.dtype, matches.scores.dtype, matches.view_pairs.dtype) == (np.int32, np.float32, np.int16)
    assert len(matches.indices) > 150
    assert (matches.indices[:, 0] == matches.indices[:, 1]).mean() > 0.95
    assert (np.diff(matches.indices[:, 0]) > 0).all()
    assert len(np.unique(matches.indices[:, 1])) == len(matches.indices)
    assert matches.scores.min() > 0.1
    assert matches.scores.max() <= 1.0
    assert (matches.view_pairs == 0).all()
    assert matches.points0_px is None


def test_the_order_of_keypoints_only_renames_matches(weights: str) -> None:
    first, second = features(150), noisy(features(150), 2.0)
    order = np.random.default_rng(2).permutation(150)
    plain = as_dict(recipe(weights)(first, second, GEOMETRY))
    shuffled = as_dict(recipe(weights)(first, permuted(second, order), GEOMETRY))
    renamed = {(i, int(order[j])): score for (i, j), score in shuffled.items()}
    assert renamed.keys() == plain.keys()
    np.testing.assert_allclose([renamed[key] for key in plain], list(plain.values()), atol=1e-4)


def test_swapping_the_images_swaps_the_matches(weights: str) -> None:
    first, second = features(150), noisy(features(170), 2.0)
    forth = as_dict(recipe(weights)(first, second, GEOMETRY))
    back = as_dict(recipe(weights)(second, first, GEOMETRY))
    assert {(j, i) for i, j in back} == forth.keys()


def test_the_same_call_gives_the_same_bits(weights: str) -> None:
    first, second = features(150), noisy(features(150), 2.0)
    runs = [recipe(weights)(first, second, GEOMETRY) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].indices, runs[1].indices)
    np.testing.assert_array_equal(runs[0].scores, runs[1].scores)


@pytest.mark.parametrize(("count0", "count1"), [(0, 0), (0, 30), (30, 0), (1, 1), (1, 30), (2, 1)])
def test_few_keypoints_are_no_error(weights: str, count0: int, count1: int) -> None:
    matches = recipe(weights, threshold=0.0)(features(count0), features(count1, seed=1), GEOMETRY)
    assert matches.indices.shape == (len(matches.scores), 2)
    assert matches.view_pairs.shape == matches.indices.shape
    assert len(matches.indices) <= min(count0, count1)


def test_images_without_views_match_nothing(weights: str) -> None:
    nothing = dataclasses.replace(
        features(0),
        view_sizes_px=np.zeros((0, 2), np.int32),
        view_angles_deg=np.zeros(0, np.float32),
        view_directions=np.zeros((0, 3), np.float32),
        view_gsd_m=np.zeros(0, np.float32),
        view_enhanced=np.zeros(0, bool),
    )
    assert recipe(weights)(nothing, features(20), GEOMETRY).indices.shape == (0, 2)


def test_points_over_the_border_are_clipped(weights: str) -> None:
    original = features(60)
    moved = original.view_keypoints_px.copy()
    moved[:3] = [[-0.8, 5.0], [639.9, 479.9], [10.0, -3.0]]
    outside = dataclasses.replace(original, view_keypoints_px=moved)
    assert len(recipe(weights)(outside, outside, GEOMETRY).indices) > 40


def test_several_views_are_merged_one_to_one(weights: str) -> None:
    pictures0 = [features(60), features(60, seed=9)]
    pictures1 = [features(60, seed=8), features(60, seed=7)]
    matcher = recipe(weights, threshold=0.01)
    # By hand: the matches of all four view pairs, best first, each keypoint once.
    found = [
        (score, key, (v0, v1))
        for v0 in range(2)
        for v1 in range(2)
        for key, score in as_dict(matcher(pictures0[v0], pictures1[v1], GEOMETRY)).items()
    ]
    expected: dict[tuple[int, int], tuple[float, tuple[int, int]]] = {}
    for score, key, views in sorted(found, reverse=True):
        if all(key[0] != i and key[1] != j for i, j in expected):
            expected[key] = (score, views)
    matches = matcher(two_views(*pictures0), two_views(*pictures1), GEOMETRY)
    assert as_dict(matches) == {key: score for key, (score, _) in expected.items()}
    assert [tuple(v) for v in matches.view_pairs.tolist()] == [expected[key][1] for key in sorted(expected)]
    assert len({views for _, views in expected.values()}) > 1


def test_the_budget_keeps_the_strongest(weights: str) -> None:
    first = features(100)
    matches = recipe(weights, max_keypoints=30)(first, first, GEOMETRY)
    strongest = np.argsort(-first.responses)[:30]
    assert len(matches.indices) > 15
    assert set(matches.indices.ravel().tolist()) <= set(strongest.tolist())


def test_scale_and_orientation_reach_the_network(weights: str) -> None:
    first, second = features(100), noisy(features(100), 2.0)
    plain = as_dict(recipe(weights, threshold=0.0)(first, second, GEOMETRY))
    turned_by_360 = dataclasses.replace(second, view_orientation_deg=second.view_orientation_deg - np.float32(360.0))
    np.testing.assert_allclose(
        list(as_dict(recipe(weights, threshold=0.0)(first, turned_by_360, GEOMETRY)).values()),
        list(plain.values()),
        atol=1e-3,
    )
    for change in (
        {"view_orientation_deg": second.view_orientation_deg + 90},
        {"view_size_px": second.view_size_px * 4},
    ):
        changed = recipe(weights, threshold=0.0)(first, dataclasses.replace(second, **change), GEOMETRY)
        shared = plain.keys() & as_dict(changed).keys()
        assert max(abs(as_dict(changed)[key] - plain[key]) for key in shared) > 1e-3


@pytest.mark.parametrize(
    ("degrees", "radians"),
    [
        (0, 0.0),
        (90, np.pi / 2),
        (180, np.pi),
        (-180, np.pi),
        (181, -179 * np.pi / 180),
        (359, -np.pi / 180),
        (540, np.pi),
    ],
)
def test_orientations_are_wrapped_half_open(degrees: float, radians: float) -> None:
    wrapped: FloatArray = wrapped_rad(np.array([degrees], np.float32))
    np.testing.assert_allclose(wrapped, [radians], atol=1e-6)


def by_hand() -> Features:
    """Three keypoints; two lie in view 0 (640 x 480), the third in view 1 (200 x 100)."""
    descriptors = np.zeros((3, 128), np.uint8)
    descriptors[0, :2], descriptors[1, 5], descriptors[2, 7] = (30, 40), 200, 9
    places = np.array([[10.0, 20.25], [-0.7, 480.0], [150.0, 60.0]], np.float32)
    return Features(
        keypoints_px=np.array([[400.0, 300.0], [1.0, 2.0], [3.0, 4.0]], np.float32),  # in the source: not what is sent
        sizes_px=np.array([90.0, 91.0, 92.0], np.float32),
        responses=np.ones(3, np.float32),
        descriptors=descriptors,
        descriptor_keypoint_idx=np.array([0, 1, 2], np.int32),
        view_idx=np.array([0, 0, 1], np.int32),
        view_keypoints_px=places,
        view_size_px=np.array([3.0, 8.0, 5.0], np.float32),
        view_orientation_deg=np.array([270.0, 180.0, 45.0], np.float32),
        view_sizes_px=np.array([[640, 480], [200, 100]], np.int32),
        view_angles_deg=np.zeros(2, np.float32),
        view_directions=np.full((2, 3), np.nan, np.float32),
        view_gsd_m=np.full(2, np.nan, np.float32),
        view_enhanced=np.zeros(2, bool),
    )


class Recorder:
    """Stands for the network: keeps what it is given, matches nothing."""

    def __init__(self, dimensions: Dimensions) -> None:
        self.dimensions = dimensions
        self.given: list[tuple[Side, Side]] = []

    def match(self, side0: Side, side1: Side, **options: float) -> tuple[Tensor, Tensor]:
        self.given.append((side0, side1))
        return torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0)


def given_to(recorder: Recorder, weights: str, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Side, Side]]:
    monkeypatch.setattr(lightglue, "_matcher", lambda *_: lightglue._Matcher(recorder, "cpu", {}))
    recipe(weights)(by_hand(), by_hand(), GEOMETRY)
    return recorder.given


def test_what_the_network_is_given(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = given_to(Recorder(SIFT), weights, monkeypatch)
    assert len(given) == 4  # every view with every view
    first, last = given[0][0], given[3][1]
    # From the corner of the picture, clipped to it, middle 0, half the longer side 1.
    points = [[(10.5 - 320) / 320, (20.75 - 240) / 320], [-1.0, 0.75]]
    np.testing.assert_allclose(first.places[0, :, :2].numpy(), points, atol=1e-6)
    np.testing.assert_allclose(last.places[0, :, :2].numpy(), [[0.505, 0.105]], atol=1e-6)
    assert first.places[0, :, 2].tolist() == [1.5, 4.0]
    np.testing.assert_allclose(first.places[0, :, 3].numpy(), [-np.pi / 2, np.pi], atol=1e-6)
    np.testing.assert_allclose(last.places[0, :, 3].numpy(), [np.pi / 4], atol=1e-6)
    np.testing.assert_allclose(first.descriptors[0, 0, :3].numpy(), [0.6, 0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(torch.linalg.norm(first.descriptors, dim=2).numpy(), [[1.0, 1.0]], atol=1e-6)
    assert (first.places.dtype, first.descriptors.dtype) == (torch.float32, torch.float32)


def test_networks_without_scale_and_orientation_get_none(weights: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = given_to(Recorder(dataclasses.replace(SIFT, add_scale_ori=False)), weights, monkeypatch)
    assert given[0][0].places.shape == (1, 2, 2)


def test_other_descriptors_are_refused(weights: str) -> None:
    short = features(20)
    short = dataclasses.replace(short, descriptors=short.descriptors[:, :64])
    with pytest.raises(ConfigError, match="length 128, the extractor makes 64"):
        recipe(weights)(short, short, GEOMETRY)


def test_missing_weights_say_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("aeromatch_cli.nets.weights.SHIPPED_LIGHTGLUE", tmp_path / "absent.safetensors")
    with pytest.raises(ConfigError, match=r"needs a weights file.*aeromatch weights add"):
        LightGlue().fingerprint_files()
    with pytest.raises(ConfigError, match=r"no such file.*aeromatch weights add"):
        LightGlue(weights=str(tmp_path / "absent.pth"))(features(3), features(3), GEOMETRY)


def test_fingerprint_files_and_schema(weights: str) -> None:
    matcher = recipe(weights)
    assert matcher.fingerprint_files() == (weights,)
    assert hash(matcher) == hash(recipe(weights))
    with pytest.raises(ValidationError):
        LightGlue(weight="x")  # type: ignore[call-arg]


def test_a_replaced_file_is_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    matcher = LightGlue(weights=str(write(path, seeded_tensors(SIFT))))
    assert len(matcher(features(50), features(50), GEOMETRY).indices) > 20
    write(path, {"conv1.weight": torch.zeros(3, 3)})
    with pytest.raises(ConfigError, match="not a LightGlue"):
        matcher(features(50), features(50), GEOMETRY)
