"""The LightGlue that ships, on a small set that the renderer makes: weights that get worse fail here."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from trainings.lightglue.blocks import Pair, block_pairs
from trainings.lightglue.validation import Found, compared

from aeromatch_cli.lab.synthetic import render_block
from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration

pytestmark = pytest.mark.slow

# Far from the seeds of scripts/training_blocks.
SEED = 90210


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    """Among 600 keypoints, upright and along gradients."""
    folder: Path = tmp_path_factory.mktemp("suburb")
    render_block(folder, "suburb", seed=SEED, width_px=480, height_px=360, images=4, flight="mixed")
    return block_pairs(folder, keypoints=600)


@pytest.fixture(scope="module")
def answers(pairs: list[Pair]) -> tuple[Found, Found]:
    """What the mutual ratio test and the network find."""
    return compared(load_lightglue(SHIPPED_LIGHTGLUE), pairs)


def test_the_network_recalls_more_at_the_ratio_tests_precision(answers: tuple[Found, Found]) -> None:
    ratio, network = answers
    assert ratio.recall == pytest.approx(0.335, abs=0.03)  # a set as hard as it was
    # 0.634 when these weights were made; those before them reach 0.606.
    assert network.recall_at(ratio.precision) >= 0.61
    assert 0 <= network.wrong_at(ratio.recall) <= 0.4 * (~ratio.right).sum()


def test_bfloat16_costs_next_to_nothing(pairs: list[Pair]) -> None:
    """On some of the pairs: it is slow where the processor lacks it."""
    exact, coarse = load_lightglue(SHIPPED_LIGHTGLUE), load_lightglue(SHIPPED_LIGHTGLUE).with_layers_in(torch.bfloat16)
    (ratio, network), (_, found) = (compared(one, pairs[:4]) for one in (exact, coarse))
    assert found.recall_at(ratio.precision) == pytest.approx(network.recall_at(ratio.precision), abs=0.01)


def test_scores_mean_what_they_say(answers: tuple[Found, Found]) -> None:
    _, network = answers
    rows = network.reliability(read_calibration(SHIPPED_LIGHTGLUE))
    total = sum(matches for _, _, matches, _, _ in rows)
    # So few keypoints are fewer than the scores were calibrated with: partners are missing, and fewer matches right.
    assert sum(matches * abs(mean - right) for _, _, matches, mean, right in rows) / total < 0.1
    assert rows[-1][4] > 0.85
