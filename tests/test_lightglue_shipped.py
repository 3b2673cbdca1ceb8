"""The LightGlue that ships, on a small set that the renderer makes: weights that get worse fail here."""

from __future__ import annotations

import pytest
from lightglue_training.blocks import block_pairs
from lightglue_training.validation import Found, compared

from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration
from aeromatch_cli.nets.weights import SHIPPED_LIGHTGLUE
from aeromatch_cli.synthetic import render_block

# Far from the seeds of scripts/training_blocks.
SEED = 90210


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> tuple[Found, Found]:
    """What the mutual ratio test and the network find among 600 keypoints, upright and along gradients."""
    folder = tmp_path_factory.mktemp("suburb")
    render_block(folder, "suburb", seed=SEED, width_px=480, height_px=360, images=4, flight="mixed")
    return compared(load_lightglue(SHIPPED_LIGHTGLUE), block_pairs(folder, keypoints=600))


def test_the_network_recalls_more_at_the_ratio_tests_precision(answers: tuple[Found, Found]) -> None:
    ratio, network = answers
    assert ratio.recall == pytest.approx(0.335, abs=0.03)  # a set as hard as it was
    # 0.634 when these weights were made; those before them reach 0.606.
    assert network.recall_at(ratio.precision) >= 0.61
    assert network.wrong_at(ratio.recall) <= 0.4 * (~ratio.right).sum()


def test_scores_mean_what_they_say(answers: tuple[Found, Found]) -> None:
    _, network = answers
    rows = network.reliability(read_calibration(SHIPPED_LIGHTGLUE))
    total = sum(matches for _, _, matches, _, _ in rows)
    # So few keypoints are fewer than the scores were calibrated with: partners are missing, and fewer matches right.
    assert sum(matches * abs(mean - right) for _, _, matches, mean, right in rows) / total < 0.1
    assert rows[-1][4] > 0.85
