"""What the matcher does around the network: which keypoints go in, what becomes of the answer, which options count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from make_lightglue import SIFT, Answers, features, seeded_tensors, stand_in, write
from torch import Tensor

from aeromatch_cli.data import Camera, Pair, PairGeometry
from aeromatch_cli.nets.lightglue import LightGlue as Network
from aeromatch_cli.nets.lightglue import Side, log_assignment, mutual_best
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, joined
from aeromatch_cli.strategies.matchers.descriptors.search import finished
from aeromatch_cli.strategies.matchers.lightglue import matcher as lightglue
from aeromatch_cli.strategies.matchers.lightglue.inference import FRAME_PX
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (600.0, 319.5, 239.5))
GEOMETRY = PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, None, None, None)


def asked_of(count: int = 40) -> Comparison:
    sides = features(count), features(count, seed=1)
    return Comparison(*sides, GEOMETRY, np.ones((1, 1), bool))


def found_before(*costs: float) -> Found:
    """Matches of keypoints that the network does not answer with."""
    rows = np.arange(30, 30 + len(costs))
    return Found(rows, rows, np.array(costs))


def test_what_is_left_of_a_view_gets_a_frame_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    network, comparison = Answers((0.9, 0.8)), asked_of()
    stand_in(monkeypatch, network)
    shown = comparison.features0.keypoints_px[:, 0] > 400, np.ones(40, bool)
    found = finished(LightGlue().by_network(comparison, shown), LightGlue().run_network)
    side0, side1, _ = network.given[0]
    rows = np.flatnonzero(shown[0])
    assert 5 < len(rows) < 35
    assert found.rows.tolist() == rows[:2].tolist()  # of the image's descriptors, not of those that went in
    # By hand: 4 px around the outermost of those shown; the middle is 0, half the longer side 1.
    points = comparison.features0.view_keypoints_px[rows] + 0.5
    low, high = points.min(axis=0) - FRAME_PX, points.max(axis=0) + FRAME_PX
    expected = (points - (low + high) / 2) / ((high - low).max() / 2)
    np.testing.assert_allclose(side0.places[0, :, :2].numpy(), expected, atol=1e-5)
    # Nothing is culled there: the frame stays that of the view.
    whole = (comparison.features1.view_keypoints_px + 0.5 - (320, 240)) / 320
    np.testing.assert_allclose(side1.places[0, :, :2].numpy(), whole, atol=1e-5)


@pytest.mark.parametrize("overlap", [True, False])
def test_only_the_overlap_goes_in_where_wanted(monkeypatch: pytest.MonkeyPatch, overlap: bool) -> None:
    network, comparison = Answers(), asked_of()
    stand_in(monkeypatch, network)
    half = np.arange(40) < 20
    monkeypatch.setattr(lightglue, "in_overlap", lambda *_: (half, half))
    matcher = LightGlue(only_overlap=overlap)
    finished(matcher.refined(comparison, joined([]), None), matcher.run_network)
    side0, side1, _ = network.given[0]
    assert side0.places.shape[1] == side1.places.shape[1] == (20 if overlap else 40)


def test_sets_of_surer_matches_compete_and_the_winner_leads_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, Answers((0.95, 0.6, 0.35, 0.15)))
    competing: list[list[Found]] = []
    before = found_before(0.2, 0.9)

    def most_evident(_: Comparison, sets: list[Found]) -> Found:
        competing.append(sets)
        return sets[2]

    calls: list[tuple[Found, bool]] = []

    def again(found: Found, *, keep: bool) -> Found:
        calls.append((found, keep))
        return found.take(np.arange(1))

    monkeypatch.setattr(lightglue, "most_evident", most_evident)
    matcher = LightGlue(threshold=0.1, only_overlap=False)
    second: Any = again
    found = finished(matcher.refined(asked_of(), before, second), matcher.run_network)
    # At 0.1, 0.3, 0.5 and 0.8, each with the two from before, whose cost says that the network did not find them.
    probabilities = [1.0 - part.costs for part in competing[0]]
    doubtful = [0.3, 0.1]
    expected = [[0.95, 0.6, 0.35, 0.15], [0.95, 0.6, 0.35], [0.95, 0.6], [0.95], []]
    for part, least in zip(probabilities, expected, strict=True):
        np.testing.assert_allclose(part, [*least, *doubtful], atol=1e-6)
    assert [keep for _, keep in calls] == [True]
    np.testing.assert_array_equal(calls[0][0].costs, competing[0][2].costs)
    assert len(found.rows) == 1
    # Without a second search the winner is the answer.
    plain = finished(matcher.refined(asked_of(), before, None), matcher.run_network)
    np.testing.assert_array_equal(plain.costs, competing[1][2].costs)


def test_the_settings_reach_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "sift.pth", seeded_tensors(SIFT))
    options: list[dict[str, float]] = []
    plain = Network.match

    def spy(self: Network, side0: Side, side1: Side, **given: float) -> tuple[Tensor, Tensor]:
        options.append(given)
        return plain(self, side0, side1, **given)  # type: ignore[arg-type]

    monkeypatch.setattr(Network, "match", spy)
    settings = {"threshold": 0.25, "depth_confidence": 0.7, "width_confidence": 0.6}
    matcher = LightGlue(weights=str(path), **settings)
    finished(matcher.by_network(asked_of()), matcher.run_network)
    assert options == [settings]


@pytest.mark.parametrize("counts", [(700, 600), (513, 40), (30, 1100)])
def test_the_assignment_in_blocks_is_the_whole_ones_mutual_best(counts: tuple[int, int]) -> None:
    network = Network(SIFT)
    network.load_state_dict({k: v for k, v in seeded_tensors(SIFT).items() if k != "confidence_thresholds"})
    generator = torch.Generator().manual_seed(2)
    x0, x1 = (torch.randn(1, count, 64, generator=generator) for count in counts)
    with torch.inference_mode():
        rows, columns, scores = mutual_best(network.assignment(0), x0, x1)
        whole = log_assignment(network.assignment(0), x0, x1)[0][0]
    mutual = whole.argmax(0)[whole.argmax(1)] == torch.arange(counts[0])
    assert rows.tolist() == torch.nonzero(mutual).squeeze(1).tolist()
    assert len(rows) > 10
    assert columns.tolist() == whole.argmax(1)[rows].tolist()
    torch.testing.assert_close(scores, whole[rows, columns].exp())


def test_in_bfloat16_the_position_code_is_computed_in_full() -> None:
    network = Network(SIFT)
    places = torch.tensor([[[0.3, -0.7, 40.0, 3.0], [0.9, 0.2, 3.0, -2.0]]])
    exact = network.posenc(places)
    coarse = network.with_layers_in(torch.bfloat16)
    assert coarse.posenc.Wr.weight.dtype == torch.float32
    assert coarse.transformers[0].self_attn.Wqkv.weight.dtype == torch.bfloat16  # type: ignore[union-attr]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        code = coarse.posenc(places)
    for one, other in zip(exact, code, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0.0)
    states, turned = coarse.begin(Side(places, torch.randn(1, 2, 128)))
    assert {states.dtype, *(part.dtype for part in turned.picture)} == {torch.bfloat16}
