"""The LightGlue that ships, on a small set that the renderer makes: weights that get worse fail here."""

from __future__ import annotations

import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from trainings.lightglue.blocks import Pair, block_pairs
from trainings.lightglue.photographs import pictures_of, truth_of
from trainings.lightglue.validation import Found, by_network, compared, judged

from aeromatch_cli.geometry.cameras import distort
from aeromatch_cli.lab.synthetic import load_truth, render_block
from aeromatch_cli.nets.files import shipped_path
from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

pytestmark = pytest.mark.slow

LIGHTGLUE = shipped_path("lightglue")
# Far from the seeds of scripts/training_blocks.
SEED = 90210


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("suburb")
    render_block(out, "suburb", seed=SEED, width_px=480, height_px=360, images=4, flight="mixed")
    return out


@pytest.fixture(scope="module")
def pairs(folder: Path) -> list[Pair]:
    """Among 600 keypoints, upright and along gradients."""
    return block_pairs(folder, keypoints=600)


@pytest.fixture(scope="module")
def answers(pairs: list[Pair]) -> tuple[Found, Found]:
    """What the mutual ratio test and the network find."""
    return compared(load_lightglue(LIGHTGLUE), pairs)


def test_the_network_recalls_more_at_the_ratio_tests_precision(answers: tuple[Found, Found]) -> None:
    ratio, network = answers
    assert ratio.recall == pytest.approx(0.335, abs=0.03)  # a set as hard as it was
    # 0.634 when these weights were made; those before them reach 0.606.
    assert network.recall_at(ratio.precision) >= 0.61
    assert 0 <= network.wrong_at(ratio.recall) <= 0.4 * (~ratio.right).sum()


def test_bfloat16_costs_next_to_nothing(pairs: list[Pair]) -> None:
    """On some of the pairs: it is slow where the processor lacks it."""
    exact, coarse = load_lightglue(LIGHTGLUE), load_lightglue(LIGHTGLUE).with_layers_in(torch.bfloat16)
    (ratio, network), (_, found) = (compared(one, pairs[:4]) for one in (exact, coarse))
    assert found.recall_at(ratio.precision) == pytest.approx(network.recall_at(ratio.precision), abs=0.01)


def test_scores_mean_what_they_say(answers: tuple[Found, Found]) -> None:
    _, network = answers
    rows = network.reliability(read_calibration(LIGHTGLUE))
    total = sum(matches for _, _, matches, _, _ in rows)
    # So few keypoints are fewer than the scores were calibrated with: partners are missing, and fewer matches right.
    assert sum(matches * abs(mean - right) for _, _, matches, mean, right in rows) / total < 0.1
    assert rows[-1][4] > 0.85


@pytest.fixture(scope="module")
def learned(folder: Path) -> list[Pair]:
    """Learned features of the ground views and of the pictures as taken."""
    return block_pairs(folder, keypoints=600, features="learned")


def test_the_network_of_learned_features_recalls_more_where_it_knows_the_ground(learned: list[Pair]) -> None:
    network = load_lightglue(shipped_path("lightglue-learned"))
    upright = [pair for pair in learned if not pair.side0.angles_rad.any()]
    ratio, plain = compared(network, upright)
    known = judged((pair, *by_network(network, pair, 0.03)) for pair in upright)
    assert ratio.recall == pytest.approx(0.436, abs=0.03)  # a set as hard as it was
    # 0.502 and 0.564 when these weights were made.
    assert plain.recall_at(ratio.precision) >= 0.48
    assert known.recall_at(ratio.precision) >= plain.recall_at(ratio.precision) + 0.04


def test_photographs_tell_partners_by_the_reference(folder: Path, tmp_path: Path) -> None:
    """A rendered block stands for a real one: the truth by 3,000 points of its surface beside the exact one."""
    truth = load_truth(folder)
    rng = np.random.default_rng(2)
    points_m = np.concatenate([
        truth.surface_points(name, rng.uniform(0, [479, 359], (800, 2))) for name in sorted(truth.cameras)
    ])  # fmt: skip
    (tmp_path / "reference").mkdir()
    (tmp_path / "images").symlink_to(folder / "images")
    for name in ("poses.csv", "block.json"):
        shutil.copy(folder / name, tmp_path / "reference" / name)
    np.savez(tmp_path / "reference" / "points.npz", xyz=points_m[np.isfinite(points_m).all(axis=1)])
    errors_px = []
    for picture0, picture1 in combinations(pictures_of(tmp_path, ("extract=learned",)), 2):
        mates = truth_of(picture0, picture1)
        rows = np.flatnonzero(mates.of0 >= 0)
        places = [distort(p.camera, p.side.places_px.astype(float)) for p in (picture0, picture1)]
        there, hidden = truth.transfer(picture0.name, places[0][rows], picture1.name)
        apart = np.linalg.norm(there - places[1][mates.of0[rows]], axis=1)
        errors_px.append(np.where(hidden, np.inf, apart))
    right = np.concatenate(errors_px) <= 4.0
    assert len(right) > 300
    # Trees and eaves are where the others are; 0.893 when it was written.
    assert right.mean() > 0.87
