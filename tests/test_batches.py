"""Pairs that run the network together: the same matches as one by one, and nothing lost where something fails."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from make_lightglue import SIFT, features, seeded_tensors, write

from aeromatch_cli.config import load
from aeromatch_cli.data import Camera, Features, Pair, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import write_features
from aeromatch_cli.formats.rows import read_match_row
from aeromatch_cli.nets import lightglue_batch
from aeromatch_cli.nets.precision import device_of
from aeromatch_cli.stages import batches, match
from aeromatch_cli.stages.batches import matched_in_batches
from aeromatch_cli.stages.driver import PairTask
from aeromatch_cli.stages.pairs import chosen_strategies
from aeromatch_cli.strategies import Matcher
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.matchers.lightglue import inference
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue
from aeromatch_cli.workspace import Workspace

pytestmark = pytest.mark.slow

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (600.0, 319.5, 239.5))


class Together(LightGlue):
    """As where there is a GPU."""

    @property
    def batches_pairs(self) -> bool:
        return True


def task(image_id1: str) -> PairTask:
    return PairTask(
        PairGeometry(Pair("a", image_id1, np.nan, np.nan, "x"), CAMERA, CAMERA, None, None, None), "", ("", "")
    )


PAIRS = [task(name) for name in ("same", "moved", "many", "few")]


def alike(matcher: Matcher) -> dict[str, Matcher]:
    """The same for every pair."""
    return {pair.image_id1: matcher for pair in PAIRS}


def sides(pair: PairTask) -> tuple[Features, Features]:
    """`many` has enough matches by the ratio test; the others use the network."""
    if pair.image_id1 == "many":
        return features(400), features(400)
    if pair.image_id1 == "few":
        return features(30), features(20)
    return features(120), features(120, seed=pair.image_id1 != "same")


@pytest.fixture(scope="module")
def matcher(tmp_path_factory: pytest.TempPathFactory) -> Together:
    path = write(tmp_path_factory.mktemp("weights") / "sift.pth", seeded_tensors(SIFT))
    return Together(weights=str(path), precision="float32", threshold=0.0, device="cpu")


@pytest.mark.parametrize("most", [1, 3, 32])
def test_together_they_find_what_each_finds_alone(
    matcher: Together, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(batches, "_BATCH_PAIRS", most)
    asked: list[int] = []
    plain = LightGlue.run_network

    def spy(self: LightGlue, questions: Sequence[Any]) -> Any:
        asked.append(len(questions))
        return plain(self, questions)

    monkeypatch.setattr(Together, "run_network", spy)
    found = matched_in_batches(alike(matcher), PAIRS, sides)
    assert asked == {1: [1, 1, 1], 3: [2, 1], 32: [3]}[most]
    assert found.keys() == {pair.image_id1 for pair in PAIRS}
    for pair in PAIRS:
        alone = matcher(*sides(pair), pair.geometry)
        assert len(alone.indices) > 5 or pair.image_id1 in ("moved", "few")
        np.testing.assert_array_equal(found[pair.image_id1].indices, alone.indices)
        np.testing.assert_array_equal(found[pair.image_id1].scores, alone.scores)


def test_one_by_one_where_nothing_is_gained(matcher: Together) -> None:
    assert matched_in_batches(alike(matcher), PAIRS[:1], sides) == {}
    assert matched_in_batches(alike(LightGlue(weights=matcher.weights)), PAIRS, sides) == {}
    assert matched_in_batches(alike(Nearest()), PAIRS, sides) == {}


def test_a_pair_that_fails_is_left_for_its_own_turn(matcher: Together) -> None:
    def broken(pair: PairTask) -> tuple[Features, Features]:
        if pair.image_id1 == "moved":
            raise ConfigError("no features")
        return sides(pair)

    assert matched_in_batches(alike(matcher), PAIRS, broken).keys() == {"same", "many", "few"}


def test_where_the_network_fails_only_settled_pairs_are_there(
    matcher: Together, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("CUDA out of memory")

    monkeypatch.setattr(Together, "run_network", full)
    with caplog.at_level(logging.WARNING):
        assert matched_in_batches(alike(matcher), PAIRS, sides).keys() == {"many"}
    assert "pair by pair" in caplog.text
    assert "CUDA out of memory" in caplog.text


def test_batches_on_a_gpu_answer_in_the_order_of_the_questions(
    matcher: Together, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inference, "_BATCH_KEYPOINTS", 400)
    given = [features(count, seed) for seed, count in enumerate((40, 120, 0, 80, 119))]
    kept = np.ones(200, bool)
    shown = [inference.network_input(one, 0, kept[: len(one.keypoints_px)], 2048) for one in given]
    (path,) = matcher.fingerprint_files()
    here = inference.loaded_network(inference.NetworkOptions(path, "float32", "cpu", 0.0, 0.95, 0.99))
    calls: list[int] = []
    plain = lightglue_batch.match_batch

    def spy(network: Any, sides0: Sequence[Any], sides1: Sequence[Any], **options: float) -> Any:
        calls.append(len(sides0))
        return plain(network, sides0, sides1, **options)

    monkeypatch.setattr(lightglue_batch, "match_batch", spy)
    alone = here.run_network([(one, one) for one in shown])
    assert calls == []
    # As on a GPU, but for where the tensors lie.
    there = dataclasses.replace(here, device="cuda")
    tensors = here._tensors
    monkeypatch.setattr(inference.LoadedNetwork, "_tensors", lambda _, one: tensors(one))
    together = there.run_network([(one, one) for one in shown])
    assert calls == [1, 1, 2, 1]
    for (pairs, scores), (own_pairs, own_scores) in zip(together, alone, strict=True):
        assert pairs.tolist() == own_pairs.tolist()
        np.testing.assert_allclose(scores, own_scores, atol=1e-4)
    assert [len(scores) > 20 for _, scores in alone] == [True, True, False, True, True]


def test_the_stage_writes_what_was_asked_together(matcher: Together, tmp_path: Path) -> None:
    """A row of the match stage, its pairs run together and one by one, is the same file."""
    names = ("a", *(pair.image_id1 for pair in PAIRS))
    rows = []
    for kind in (matcher, LightGlue(**{**matcher.model_dump(), "name": "lightglue"})):
        workspace = Workspace(tmp_path / type(kind).__name__)
        for name in names:
            own = sides(task(name))[1] if name != "a" else features(120)
            write_atomically(workspace.features(name), partial(write_features, features=own, fingerprint=""))
        result = match.run_task(match.MatchTask("a", tuple(PAIRS), alike(kind), workspace, overwrite=True))
        assert (result.done, result.failures) == (len(PAIRS), ())
        rows.append(read_match_row(workspace.matches("a")))
    assert rows[0].keys() == rows[1].keys() == set(names[1:])
    for name, entry in rows[0].items():
        np.testing.assert_array_equal(entry.matches.indices, rows[1][name].matches.indices)
        np.testing.assert_array_equal(entry.matches.scores, rows[1][name].matches.scores)
    assert len(rows[0]["same"].matches.indices) > 100
    assert len(rows[0]["moved"].matches.indices) < 100


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    ("preset", "setting"),
    [
        ("fusion", "match.device"),
        ("oblique", "extract.device"),
        ("oblique", "match.device"),
        ("auto", "cascade.learned.device"),
    ],
)
def test_a_device_that_is_not_there_is_named(preset: str, setting: str) -> None:
    strategies = list(chosen_strategies(load(preset, [f"{setting}=cuda"])))
    with pytest.raises(ConfigError, match="torch sees none on this machine; set `auto`"):
        [strategy.check_files(128) for strategy in strategies]
    assert device_of("auto") == "cpu"


def test_the_device_is_no_part_of_the_recipe() -> None:
    one, other = LightGlue(), LightGlue(device="cpu")
    assert one.device == "auto"
    assert fingerprint(one) == fingerprint(other)
    assert fingerprint(one) != fingerprint(LightGlue(precision="float32"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_finds_what_the_cpu_finds(matcher: Together) -> None:
    there = LightGlue(weights=matcher.weights, precision="float32", threshold=0.0, device="cuda")
    together = matched_in_batches(alike(there), PAIRS, sides)
    for pair in PAIRS:
        alone, own = matcher(*sides(pair), pair.geometry), together[pair.image_id1]
        here = dict(zip(map(tuple, alone.indices.tolist()), alone.scores, strict=True))
        found = dict(zip(map(tuple, own.indices.tolist()), own.scores, strict=True))
        both = here.keys() & found.keys()
        assert len(both) >= 0.999 * max(len(here), len(found))
        np.testing.assert_allclose([found[key] for key in both], [here[key] for key in both], atol=1e-3)
