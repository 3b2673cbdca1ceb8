"""Several pairs at once give what each gives alone."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from make_lightglue import SIFT, features, seeded_tensors
from torch import Tensor

from aeromatch_cli.nets.lightglue import LightGlue, Side, normalised
from aeromatch_cli.nets.lightglue_batch import batches, match_batch

pytestmark = pytest.mark.slow

SIZES = [(200, 150), (120, 200), (1, 30), (0, 40), (90, 0), (3, 2), (200, 200)]


def network_of(confident: bool) -> LightGlue:
    """confident: some keypoints are certain early, and some are pruned."""
    tensors = seeded_tensors(SIFT)
    for layer in range(SIFT.n_layers - 1) if confident else ():
        tensors[f"token_confidence.{layer}.token.0.bias"] += 2.2
        tensors[f"log_assignment.{layer}.matchability.bias"] -= 6.0
    network = LightGlue(SIFT)
    network.load_state_dict({key: value for key, value in tensors.items() if key != "confidence_thresholds"})
    return network.eval()


def side_of(count: int, seed: int) -> Side:
    found = features(count, seed)
    points = normalised(torch.from_numpy(found.view_keypoints_px), torch.tensor([640.0, 480.0]))
    more = torch.from_numpy(found.view_size_px)[:, None], torch.deg2rad(torch.from_numpy(found.view_orientation_deg))
    descriptors = torch.nn.functional.normalize(torch.from_numpy(found.descriptors).float(), dim=1)
    return Side(torch.cat([points, more[0], more[1][:, None]], dim=1)[None], descriptors[None])


def pairs_of(sizes: list[tuple[int, int]]) -> tuple[list[Side], list[Side]]:
    """Half of either side's keypoints are the other's, as far as they go."""
    sides0, sides1 = [], []
    for seed, (count0, count1) in enumerate(sizes):
        one, own = side_of(count0, 2 * seed), side_of(count1, 2 * seed + 1)
        shared = min(count0, count1) // 2
        sides0.append(one)
        sides1.append(Side(*(torch.cat([a[:, :shared], b[:, shared:]], dim=1) for a, b in _parts(one, own))))
    return sides0, sides1


def _parts(one: Side, other: Side) -> list[tuple[Tensor, Tensor]]:
    return [(one.places, other.places), (one.descriptors, other.descriptors)]


@pytest.mark.parametrize(("depth", "width"), [(-1.0, -1.0), (0.57, -1.0), (-1.0, 0.9), (0.57, 0.9)])
def test_every_pair_is_answered_as_alone(depth: float, width: float) -> None:
    network = network_of(confident=depth > 0.0 or width > 0.0)
    sides0, sides1 = pairs_of(SIZES)
    options = {"threshold": 0.0, "depth_confidence": depth, "width_confidence": width}
    together = match_batch(network, sides0, sides1, **options)
    alone = [network.match(*sides, **options) for sides in zip(sides0, sides1, strict=True)]
    assert sum(len(scores) for _, scores in alone) > 80
    for (pairs, scores), (own_pairs, own_scores) in zip(together, alone, strict=True):
        assert pairs.tolist() == own_pairs.tolist()
        torch.testing.assert_close(scores, own_scores, atol=1e-4, rtol=0.0)


def test_pairs_stop_after_different_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    network, layers = network_of(confident=True), []
    plain = LightGlue.assignment

    def spy(self: LightGlue, index: int) -> object:
        layers.append(index)
        return plain(self, index)

    monkeypatch.setattr(LightGlue, "assignment", spy)
    sides = pairs_of([(200, 150), (3, 2), (200, 200)])
    match_batch(network, *sides, threshold=0.02, depth_confidence=0.57, width_confidence=-1.0)
    assert layers == [0, 1, 1]


def test_no_pair_is_no_batch() -> None:
    assert batches([], 100) == []


@given(st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 3000)), max_size=40), st.integers(1, 20000))
def test_batches_hold_every_pair_once_and_no_more_than_fits(sizes: list[tuple[int, int]], most: int) -> None:
    found = batches(sizes, most)
    assert sorted(position for batch in found for position in batch) == list(range(len(sizes)))
    for batch in found:
        filled = max(sizes[i][0] for i in batch) + max(sizes[i][1] for i in batch)
        assert len(batch) == 1 or len(batch) * filled <= most
    totals = [sum(sizes[i]) for batch in found for i in batch]
    assert totals == sorted(totals, reverse=True)  # similar sizes together
