"""Learned features: budget, masks, turns and light, on a picture whose copies are known exactly."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from scipy.spatial import cKDTree

from aeromatch_cli.config import load
from aeromatch_cli.data import Camera, Features, Pair, PairGeometry, View
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.nets import precision
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.precision import device_of
from aeromatch_cli.stages.pairs import _check_descriptors
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.gradients import gradient_angles
from aeromatch_cli.strategies.extractors.learned import Learned
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional

pytestmark = pytest.mark.slow

SIDE = 320


@pytest.fixture(scope="module")
def picture() -> NDArray[np.uint8]:
    """Noise with structure at several scales, and rectangles."""
    rng = np.random.default_rng(3)
    total = np.zeros((SIDE, SIDE))
    for scale in (3, 6, 12, 24):
        coarse = rng.standard_normal((SIDE // scale + 2, SIDE // scale + 2))
        total += scale**0.5 * cv2.resize(coarse, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    gray = np.clip(128 + 14 * total, 0, 255).astype(np.uint8)
    for _ in range(40):
        x, y, w, h = (int(v) for v in rng.integers((0, 0, 8, 8), (SIDE, SIDE, 40, 40)))
        gray[y : y + h, x : x + w] = gray[y : y + h, x : x + w] // 2 + int(rng.integers(0, 120))
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.8))


def extract(
    gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None, north_up: bool = False, **settings: Any
) -> Features:
    height, width = gray.shape
    camera = Camera("PINHOLE", width, height, (500.0, 500.0, (width - 1) / 2, (height - 1) / 2))
    view = View("source", width, height, np.eye(3), is_source=True, angle_deg=0.0, north_up=north_up)
    return Learned(**{"keypoints": 400, **settings})(camera, (ViewPixels(view, gray, valid),))


def share_right(first: Features, second: Features, matrix: NDArray[np.floating[Any]]) -> tuple[int, float]:
    """Matches, and the share of them that the affine matrix (2, 3) explains to 2 px."""
    camera = Camera("PINHOLE", SIDE, SIDE, (500.0, 500.0, SIDE / 2, SIDE / 2))
    geometry = PairGeometry(Pair("0", "1", np.nan, np.nan, "test"), camera, camera, None, None, None)
    found = Bidirectional()(first, second, geometry).indices
    there = first.keypoints_px[found[:, 0]] @ matrix[:, :2].T + matrix[:, 2]
    right = np.linalg.norm(there - second.keypoints_px[found[:, 1]], axis=1) < 2.0
    return len(found), float(right.mean())


@pytest.mark.parametrize("settings", [{}, {"detector": "sift"}, {"precision": "float32"}])
def test_budget_is_exact_and_runs_are_equal(picture: NDArray[np.uint8], settings: dict[str, Any]) -> None:
    first, second = (extract(picture, keypoints=150, **settings) for _ in range(2))
    assert first.descriptors.shape == (150, 128)
    assert first.descriptors.dtype == np.uint8
    for name in ("keypoints_px", "descriptors", "view_orientation_deg", "responses"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("turn_deg", [0.0, 35.0, 90.0, 200.0])
@pytest.mark.parametrize("orientation", ["network", "gradient"])
def test_matches_survive_turns_and_light(picture: NDArray[np.uint8], turn_deg: float, orientation: str) -> None:
    middle = (SIDE - 1) / 2
    matrix = cv2.getRotationMatrix2D((middle, middle), turn_deg, 0.9)
    other = cv2.warpAffine(picture, matrix, (SIDE, SIDE), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
    darker = np.clip(0.6 * other.astype(np.float32) + 5.0, 0, 255).astype(np.uint8)
    sides = [extract(pixels, orientation=orientation) for pixels in (picture, darker)]
    count, share = share_right(*sides, matrix)
    assert count >= 80
    assert share > 0.9


def test_upright_features_are_not_turned(picture: NDArray[np.uint8]) -> None:
    assert not extract(picture, orientation="upright").view_orientation_deg.any()
    assert extract(picture).view_orientation_deg.std() > 30.0


def test_angles_of_gradients_are_those_of_sift(picture: NDArray[np.uint8]) -> None:
    """A point may have several. The picture turned by 60 degrees matches itself."""
    found = extract(picture, detector="sift", orientation="gradient")
    assert len(found.descriptors) > len(found.keypoints_px) > 100
    assert found.view_orientation_deg.std() > 30.0
    matrix = cv2.getRotationMatrix2D(((SIDE - 1) / 2, (SIDE - 1) / 2), 60.0, 1.0)
    turned = cv2.warpAffine(picture, matrix, (SIDE, SIDE), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
    _, share = share_right(found, extract(turned, detector="sift", orientation="gradient"), matrix)
    assert share > 0.9


@pytest.mark.parametrize("angle_deg", [0.0, 33.0, 118.0, 270.0])
def test_gradients_point_to_where_a_patch_is_brighter(angle_deg: float) -> None:
    across, down = np.meshgrid(np.arange(32.0), np.arange(32.0))
    ramp = across * np.cos(np.deg2rad(angle_deg)) + down * np.sin(np.deg2rad(angle_deg))
    off = gradient_angles(ramp[None]) - angle_deg
    assert abs((off[0] + 180.0) % 360.0 - 180.0) < 1.0  # a tenth of a bin
    assert np.isfinite(gradient_angles(np.zeros((2, 32, 32), np.uint8))).all()


def test_where_north_is_up_nothing_is_turned_unless_asked(picture: NDArray[np.uint8]) -> None:
    assert not extract(picture, north_up=True).view_orientation_deg.any()
    assert extract(picture, north_up=True, orientation="network").view_orientation_deg.std() > 30.0


def test_a_small_budget_buys_the_surest_and_spreads_them(picture: NDArray[np.uint8]) -> None:
    every = extract(picture, keypoints=100_000)
    surest = np.sort(every.responses)[::-1]
    one_cell = extract(picture, keypoints=40, per_cell=100_000)
    # Of the 160 surest, which the budget chooses from; blobs that answer twice are one.
    np.testing.assert_allclose(np.sort(one_cell.responses)[::-1], surest[:40], atol=0.02)
    cells = {tuple(cell) for cell in (extract(picture, keypoints=160, per_cell=10).keypoints_px // 80).astype(int)}
    assert len(cells) == 16


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({}, ["detector", "geodesc", "orientation"]),
        ({"detector": "sift", "orientation": "upright"}, ["geodesc"]),
        ({"context": True}, ["context", "detector", "geodesc", "orientation"]),
    ],
)
def test_the_weights_that_are_asked_are_part_of_the_recipe(settings: dict[str, Any], names: list[str]) -> None:
    assert [Path(path).stem for path in Learned(**settings).fingerprint_files()] == names


def test_without_cuda_auto_is_the_cpu(picture: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    first, second = (extract(picture, device=device) for device in ("cpu", "auto"))
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(precision, "_may_have_cuda", lambda: True)
    assert [device_of(device) for device in ("cpu", "auto")] == ["cpu", "cuda"]


@pytest.mark.parametrize("key", ["extract=learned", "match=lightglue"])
def test_devices_have_the_same_words_for_every_network(key: str) -> None:
    place = key.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"{place}\.device: must be 'cpu', 'cuda' or 'auto' \(got 'gpu'\)"):
        load("baseline", [key, f"{place}.device=gpu"])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_finds_what_the_cpu_finds(picture: NDArray[np.uint8]) -> None:
    count, share = share_right(extract(picture, device="cpu"), extract(picture, device="auto"), np.eye(2, 3))
    assert count >= 300
    assert share > 0.95


def test_few_keypoints_of_a_large_picture_are_those_of_half_its_size(picture: NDArray[np.uint8]) -> None:
    large = np.tile(picture, (5, 5))[:1300, :1300]
    fast, whole = extract(large, keypoints=1000), extract(large, keypoints=1000, pixels_per_keypoint=0.0)
    assert len(fast.descriptors) == len(whole.descriptors) == 1000
    assert fast.sizes_px.min() == pytest.approx(15.0, rel=0.01)
    assert np.median(whole.sizes_px) == pytest.approx(7.5, rel=0.01)
    small = cv2.resize(large, (650, 650), interpolation=cv2.INTER_AREA)
    half = extract(small, keypoints=1000, pixels_per_keypoint=0.0)
    distances, nearest = cKDTree(half.keypoints_px).query((fast.keypoints_px + 0.5) / 2.0 - 0.5)
    same = distances < 1e-3
    assert same.mean() > 0.8  # cells that share the budget are not the same
    assert (fast.descriptors[same] == half.descriptors[nearest[same]]).all(axis=1).mean() > 0.95
    # Never finer ones in their place: they would match nothing in the other images.
    dull = np.full((1300, 1300), 90, np.uint8)
    dull[:SIDE, :SIDE] = picture
    few = extract(dull, keypoints=1000)
    assert 100 < len(few.descriptors) < 1000
    assert few.sizes_px.min() == pytest.approx(15.0, rel=0.01)


def test_masked_ground_has_no_keypoints(picture: NDArray[np.uint8]) -> None:
    valid = np.ones(picture.shape, bool)
    valid[:, : SIDE // 2] = False
    assert extract(picture, valid).keypoints_px[:, 0].min() > SIDE / 2


def test_flat_picture_has_no_features() -> None:
    flat = extract(np.full((SIDE, SIDE), 90, np.uint8))
    assert flat.descriptors.shape == (0, 128)


@pytest.mark.parametrize(
    ("extract", "match", "message"),
    [
        ("learned", "lightglue", "compares RootSIFT descriptors, extract learned makes GeoDesc; use match nearest or "),
        ("grid", "lightglue", "RootSIFT descriptors, extract grid makes none; use match polar, or extract sift$"),
        ("grid", "nearest", "any descriptors, extract grid makes none; use match polar, or extract sift or "),
    ],
)
def test_matcher_for_other_descriptors_is_refused(extract: str, match: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load("baseline", [f"extract={extract}", f"match={match}"])


def spoilt(name: str, folder: Path) -> None:
    """A network that ships, its tensors with the opposite sign, as a user's own."""
    content = load_file(shipped_path(name))
    save_file({key: -value for key, value in content.items()}, folder / f"{name}.safetensors")


@pytest.mark.parametrize("name", ["detector", "orientation", "geodesc", "context"])
def test_own_weights_take_the_place_of_those_that_ship(picture: NDArray[np.uint8], tmp_path: Path, name: str) -> None:
    settings = {"context": name == "context", "orientation": "network"}
    spoilt(name, tmp_path)
    plain, own = extract(picture, **settings), extract(picture, weights=str(tmp_path), **settings)
    same = [
        np.array_equal(getattr(plain, part), getattr(own, part))
        for part in ("keypoints_px", "view_orientation_deg", "descriptors")
    ]
    # Places come first, angles of patches there second, what both look like last.
    changed = {"detector": 0, "orientation": 1, "geodesc": 2, "context": 2}[name]
    assert same == [part < changed for part in range(3)]
    recipe = Learned(**settings)
    assert fingerprint(recipe) != fingerprint(Learned(weights=str(tmp_path), **settings))
    Learned(weights=str(tmp_path), **settings).check_files(128)


def test_own_weights_count_by_what_they_hold(picture: NDArray[np.uint8], tmp_path: Path) -> None:
    path = tmp_path / "geodesc.safetensors"
    path.write_bytes(shipped_path("geodesc").read_bytes())
    assert fingerprint(Learned()) == fingerprint(Learned(weights=str(tmp_path)))
    before = extract(picture, weights=str(tmp_path))
    spoilt("geodesc", tmp_path)  # the same process must not go on with the old ones
    assert not np.array_equal(before.descriptors, extract(picture, weights=str(tmp_path)).descriptors)


def test_the_precision_reaches_every_network(picture: NDArray[np.uint8]) -> None:
    exact, coarse = (extract(picture, context=True, precision=kind) for kind in ("float32", "bfloat16"))
    assert not np.array_equal(exact.keypoints_px, coarse.keypoints_px)
    assert share_right(exact, coarse, np.eye(2, 3))[1] > 0.95


def test_own_weights_that_are_not_there_or_no_network_are_named(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("")
    for place, wrong in (
        ("absent", "is no folder"),
        ("other", "is a file; give its folder"),
        (".", r"holds none of .*: detector\.safetensors, geodesc\.safetensors, orient"),
    ):
        with pytest.raises(ConfigError, match=wrong):
            Learned(weights=str(tmp_path / place)).check_files(128)
    (tmp_path / "detector.safetensors").write_bytes(b"no network")
    with pytest.raises(ConfigError, match=r"detector\.safetensors is damaged"):
        Learned(weights=str(tmp_path)).check_files(128)
    # A network that this recipe does not ask is not read.
    with pytest.raises(ConfigError, match="holds none of"):
        Learned(weights=str(tmp_path), detector="sift").check_files(128)


def test_own_descriptors_are_refused_with_the_lightglue_of_others(tmp_path: Path) -> None:
    """A copy of the file that ships is none of the user's own."""
    settings = load("baseline", ["extract=learned", f"extract.weights={tmp_path}", "match=lightglue-learned"])
    shutil.copy(shipped_path("geodesc"), tmp_path / "geodesc.safetensors")
    _check_descriptors(settings)
    spoilt("geodesc", tmp_path)
    with pytest.raises(ConfigError, match=r"was trained on the descriptors that ship, not on those of .*geodesc\.saf"):
        _check_descriptors(settings)


def test_own_descriptors_ask_for_their_own_context(tmp_path: Path) -> None:
    """The context network corrects the descriptors that it was trained on."""
    shutil.copy(shipped_path("geodesc"), tmp_path / "geodesc.safetensors")
    Learned(weights=str(tmp_path), context=True).check_files(128)  # the same as those that ship
    spoilt("geodesc", tmp_path)
    Learned(weights=str(tmp_path)).check_files(128)
    with pytest.raises(ConfigError, match=r"no context\.safetensors that was trained on them: .* --weights"):
        Learned(weights=str(tmp_path), context=True).check_files(128)
    shutil.copy(shipped_path("context"), tmp_path / "context.safetensors")
    Learned(weights=str(tmp_path), context=True).check_files(128)
