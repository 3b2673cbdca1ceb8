"""scripts/training_runs: which run a folder holds, states that read back, the average that follows."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from trainings.__main__ import TABLE, main
from trainings.context.data import ContextPair, ViewSeen
from trainings.context.validation import compared
from trainings.descriptor import command as train_descriptor
from trainings.lightglue.sides import Partners, Seen
from trainings.orientation import command as train_orientation
from trainings.runs import check_recipe, descend, follow, load_state, save_state


def test_another_recipe_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    check_recipe(parser, argparse.Namespace(out=tmp_path, steps=5), ("steps",))
    check_recipe(parser, argparse.Namespace(out=tmp_path, steps=5), ("steps",))
    with pytest.raises(SystemExit):
        check_recipe(parser, argparse.Namespace(out=tmp_path, steps=6), ("steps",))
    assert "holds another run (steps 5)" in capsys.readouterr().err


def test_a_state_reads_back_and_the_average_follows_slowly(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network, average = torch.nn.BatchNorm1d(3), torch.nn.BatchNorm1d(3)
    optimiser = torch.optim.AdamW(network.parameters(), 0.1)
    descend(network(torch.rand(8, 3)).square().sum(), network, optimiser, 1.0)
    follow(average, network, 0, 0.999)  # a tenth of the old at first
    assert torch.allclose(average.weight, 0.1 + 0.9 * network.weight)
    assert torch.allclose(average.running_mean, 0.9 * network.running_mean)
    before = average.weight.clone()
    descend(network(torch.rand(8, 3)).square().sum(), network, optimiser, 1.0)
    follow(average, network, 10**6, 0.999)
    assert torch.allclose(average.weight, 0.999 * before + 0.001 * network.weight)
    path = tmp_path / "state.pt"
    fresh = torch.nn.BatchNorm1d(3)
    assert load_state(path, fresh) == (0, [])
    save_state(path, 2, [{"loss": 0.5}], network, optimiser)
    again = torch.optim.AdamW(fresh.parameters(), 0.1)
    assert load_state(path, fresh, again) == (2, [{"loss": 0.5}])
    assert torch.equal(fresh.weight, network.weight)
    assert again.state_dict()["state"][0]["step"] == 2
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]


def test_a_log_of_validation_figures_reads_back(tmp_path: Path) -> None:
    nothing = np.zeros((3, 2))
    seen = Seen(nothing, nothing, nothing, nothing, nothing, nothing)
    views = ViewSeen(seen, nothing), ViewSeen(seen, nothing)
    truth = Partners(np.array([0, 1, -1]), np.array([0, 1, -1]))
    described = {id(views[0]): np.eye(3), id(views[1]): np.eye(3)[[0, 2, 1]]}
    found = compared([ContextPair(*views, truth, 30.0)], lambda view: described[id(view)])
    assert found["20-40"]["rank1"] == 0.5
    save_state(tmp_path / "state.pt", 4, [{"context": found}])
    assert load_state(tmp_path / "state.pt") == (4, [{"context": found}])


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("context", "--blocks x", "'x' is no list of numbers"),
        ("context", "--blocks 9-3", "names no number"),
        ("context", "--weights absent", "is no folder"),
        ("orientation", "--data . --blocks 0-x", "'0-x' is no list of numbers"),
        ("orientation", "--data absent", "has no folder images"),
        ("descriptor", "--data . --real block --groups 39", "no multiple of 40"),
        ("descriptor", "--data . --real block --reference .", "tfeat-liberty.params is missing"),
        ("detector", "--data . --trained-on block --validate absent.safetensors", "absent.safetensors"),
        ("detector", "--data absent", "has no folder images"),
    ],
)
def test_wrong_arguments_are_named_and_lock_no_folder(
    name: str, arguments: str, words: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "block" / "images").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        sys.exit(main([name, *arguments.split(), "--out", "out"]))
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("recipe", [train_descriptor, train_orientation])
def test_a_training_that_minutes_ended_writes_no_weights(
    recipe: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "block" / "images").mkdir(parents=True)
    monkeypatch.setattr(recipe, "prepare", lambda *_: ([], []))
    monkeypatch.setattr(recipe, "train", lambda *_: False)
    for pairs in ("pairs_of", "unseen_pairs"):
        monkeypatch.setattr(recipe, pairs, lambda *_: [], raising=False)
    out = tmp_path / "out"
    recipe.main(["--data", str(tmp_path), "--real", "block", "--out", str(out)])
    assert "after step 0 of" in capsys.readouterr().out
    assert [path.name for path in out.iterdir()] == ["recipe.json"]


def test_the_table_names_modules_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    for name, (module, about) in TABLE.items():
        assert callable(import_module(module).main)
        assert f"  {name}" in listed
        assert about in listed
    assert main(["nothing"]) == 2
    assert "scripts/train knows no 'nothing'" in capsys.readouterr().err
