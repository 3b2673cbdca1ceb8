"""Tracks, crops, losses and figures of scripts/train descriptor and train_orientation.py, known by construction."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.fft import dctn, idctn
from trainings.orientation.command import turn_loss
from trainings.patches import data
from trainings.patches.data import learnt_from
from trainings.patches.draws import compressed, cropped, distinct, drawn, photographed, sources_of, stored_of
from trainings.patches.loss import descriptor_loss
from trainings.patches.sources import homography
from trainings.patches.tracks import Tracks
from trainings.patches.turns import gradient_peaks, turned, wrapped_deg
from trainings.patches.validation import average_precision, fpr95

from aeromatch_cli.nets.orientation import BINS, bin_angles

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tracks(tmp_path_factory: pytest.TempPathFactory) -> Tracks:
    """Of a picture of blobs of every size, turned at will."""
    rng = np.random.default_rng(5)
    texture = sum(cv2.GaussianBlur(rng.random((700, 800)), (0, 0), s) * s for s in (1.5, 3.0, 6.0, 12.0))
    gray = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    path = tmp_path_factory.mktemp("picture") / "texture.png"
    cv2.imwrite(str(path), gray)
    made = (homography([path], seed) for seed in range(9))
    return next(found[1] for found in made if found is not None and found[0] == "source")


def alike(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(N,) correlation of patches."""
    sides = [side.reshape(len(side), -1).astype(np.float64) for side in (first, second)]
    sides = [side - side.mean(axis=1, keepdims=True) for side in sides]
    norms = [np.linalg.norm(side, axis=1) for side in sides]
    return (sides[0] * sides[1]).sum(axis=1) / (norms[0] * norms[1])


def test_patches_of_a_track_show_one_place_at_one_scale_and_turn(tracks: Tracks) -> None:
    starts = tracks.starts
    assert np.diff(starts).min() >= 2
    assert len(tracks.place_m) > 40
    first, second = tracks.patches[starts[:-1]], tracks.patches[starts[:-1] + 1]
    assert np.median(alike(first, second)) > 0.4  # other light, noise, shadow
    assert np.median(alike(first, np.rot90(second, axes=(1, 2)))) < 0.2
    assert not tracks.turn_deg.any()  # cut along the true turn


def test_pairs_come_from_one_track_and_near_places_are_no_negatives(tracks: Tracks) -> None:
    source = sources_of({"homographies-0.source": tracks})[0]
    group = drawn(source, 32, 1.0, np.random.default_rng(0))
    assert (group.rows0 != group.rows1).all()
    assert (tracks.track[group.rows0] == tracks.track[group.rows1]).all()
    assert (tracks.track[group.rows0] == group.track).all()
    apart = distinct([group, group])
    assert not apart[:32, :32].diagonal().any()
    assert apart[:32, 32:].all()  # of other sets, whatever their places


def test_a_crop_along_a_direction_shows_its_content_turned_back(tracks: Tracks) -> None:
    stored = torch.from_numpy(tracks.patches[:20])
    crops = [cropped(stored, np.full(20, a), np.ones(20), np.random.default_rng(3)) for a in (0.0, 90.0)]
    straight, along = ((crop[:, 0] * 255.0).to(torch.uint8).numpy() for crop in crops)
    off = wrapped_deg(gradient_peaks(straight) - gradient_peaks(along) - 90.0)
    assert np.median(np.abs(off)) < 15.0
    group = drawn(sources_of({"homographies-0.source": tracks})[0], 32, 0.0, np.random.default_rng(1))
    first, second, turn = turned(group, stored_of(group), np.random.default_rng(2))
    sides = [(side[:, 0] * 255.0).to(torch.uint8).numpy() for side in (first, second)]
    off = wrapped_deg(gradient_peaks(sides[1]) - gradient_peaks(sides[0]) - turn)
    assert np.median(np.abs(off)) < 20.0


def test_compression_rounds_cosine_coefficients_of_blocks() -> None:
    patches = torch.from_numpy(np.random.default_rng(0).random((3, 1, 32, 32), np.float32))
    found = compressed(patches, torch.tensor([0.0, 0.05, 0.2]), (3, 6))
    assert torch.allclose(found[0], patches[0], atol=1e-5)
    # The second block of the first row, which begins 5 rows below the upper edge and 2 columns from the left one.
    block = patches[2, 0, 5:13, 2:10].numpy()
    steps = 0.2 * (1.0 + np.add.outer(np.arange(8), np.arange(8)) / 2.0)
    expected = idctn(np.rint(dctn(block, norm="ortho") / steps) * steps, norm="ortho")
    np.testing.assert_allclose(found[2, 0, 5:13, 2:10].numpy(), expected, atol=1e-4)


def test_photographed_patches_still_show_the_same(tracks: Tracks) -> None:
    patches = torch.from_numpy(tracks.patches[:40, None, 8:40, 8:40]).float() / 255.0
    first, again, other = (photographed(patches, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert alike(first.numpy(), patches.numpy()).min() > 0.6
    # Some are sharper than the other camera has them, some softer.
    finer = (first - other).diff(dim=3).abs().mean(dim=(1, 2, 3)) > 0.0
    assert finer.all()
    detail = [side.diff(dim=3).square().mean(dim=(1, 2, 3)) for side in (first, other)]
    assert 0 < int((detail[0] > detail[1]).sum()) < 40


def test_the_turn_loss_is_least_at_the_turn() -> None:
    angles = bin_angles().tolist()
    assert sorted(angle % 360.0 for angle in angles) == [10.0 * k for k in range(BINS)]
    peaked = torch.full((1, BINS), -20.0)
    first, second = peaked.clone(), peaked.clone()
    first[0, angles.index(30.0)], second[0, angles.index(80.0)] = 0.0, 0.0
    losses = [float(turn_loss(first, second, torch.tensor([turn]))) for turn in (50.0, 58.0, -50.0, 410.0)]
    assert losses[0] == pytest.approx(losses[3], abs=1e-3)
    assert losses[0] < losses[1] < losses[2]


def test_the_descriptor_loss_asks_for_the_hardest_that_is_surely_another_place() -> None:
    first = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 0.1]]), dim=1)
    everywhere = ~torch.eye(3, dtype=torch.bool)
    near = everywhere.clone()
    near[0, 2] = near[2, 0] = False
    assert descriptor_loss(first, first, near) < descriptor_loss(first, first, everywhere)


def test_figures_of_small_sets() -> None:
    apart = np.array([[0.1, 0.9, 0.9], [0.9, 0.8, 0.2], [0.9, 0.9, 0.3]])
    wrong = ~np.eye(3, dtype=bool)
    # By distance: 0 right, 1 wrong, 2 right: (1 + 2/3) / 3.
    assert average_precision(apart, wrong) == pytest.approx(5.0 / 9.0)
    wrong[1, 2] = False  # perhaps the same place: left out, and row 1 is right, but last
    assert average_precision(apart, wrong) == pytest.approx(1.0)
    assert fpr95(np.linspace(0.0, 1.0, 101), np.array([0.5, 0.94, 0.96, 2.0])) == 0.5


def test_blocks_for_validation_are_never_learnt_from() -> None:
    assert learnt_from("0-2,15-18,204") == [0, 1, 2, 15, 17]


def test_a_folder_of_patches_serves_several_recipes(
    tracks: Tracks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each reads what it names, whatever the folder holds besides."""
    made: list[object] = []
    for name in ("seneca", "brighton"):
        (tmp_path / name / "images").mkdir(parents=True)

    def one(*asked: object) -> dict[str, Tracks]:
        made.append(asked[-1])
        return {"source": tracks}

    monkeypatch.setattr(data, "_rendered", one)
    monkeypatch.setattr(data, "_groups", one)
    monkeypatch.setattr(data, "_unseen_groups", one)
    monkeypatch.setattr(data.sources, "reference", one)
    monkeypatch.setattr(data, "mapped", lambda call, jobs, count: [call(job) for job in jobs])

    def prepared(real: str, blocks: str, groups: int, seed: int) -> list[str]:
        args = argparse.Namespace(blocks=blocks, groups=groups, seed=seed, jobs=1)
        known, unseen = data.prepare(tmp_path / "data", tmp_path, tmp_path, real.split(","), args)
        assert len(unseen) == len(data.UNSEEN) + 1
        return sorted(data.read(tmp_path / "data" / "known", known))

    first = prepared("seneca", "0-1", 80, 0)
    names = ["block-0", "block-1", "homographies-seneca-0-0", "homographies-seneca-0-1", "seneca"]
    assert first == [f"{name}.source" for name in names]
    names = ["block-1", "brighton", "homographies-brighton-5-0"]
    assert prepared("brighton", "1", 40, 5) == [f"{name}.source" for name in names]
    made.clear()
    assert prepared("seneca", "0-1", 80, 0) == first
    assert made == []
