"""Trainings that were stopped after every step end with the weights of one that was not."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import train_descriptor
import train_detector
import train_orientation
from detector_training.scenes import sights
from patch_training.draws import sources_of
from patch_training.runs import Run
from patch_training.sources import homography
from torch import nn

from aeromatch_cli.nets.geodesc import GeoDesc
from aeromatch_cli.nets.orientation import OrientationNet

STEPS = 3


@pytest.fixture(autouse=True)
def on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def options(out: Path, **further: object) -> argparse.Namespace:
    return argparse.Namespace(out=out, seed=0, steps=STEPS, batch=16, rate=1e-3, minutes=0.0, **further)


def same(first: nn.Module, second: nn.Module) -> bool:
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


@pytest.mark.parametrize(("recipe", "make"), [(train_descriptor, GeoDesc), (train_orientation, OrientationNet)])
def test_patch_trainings_go_on_where_they_were(
    recipe: object, make: Callable[[], nn.Module], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texture = np.random.default_rng(5).random((500, 600))
    gray = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 3.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "texture.png"), gray)
    made = (homography([tmp_path / "texture.png"], seed) for seed in range(9))
    known = sources_of({"homographies-0.source": next(found[1] for found in made if found is not None)})
    monkeypatch.setattr(recipe, "table", lambda *_: {"all": {"fpr95": 1.0}})
    weights = []
    for minutes in (0.0, 1e-9):
        args = options(tmp_path / str(minutes))
        args.out.mkdir()
        args.minutes = minutes
        for _ in range(STEPS if minutes else 1):
            run = Run.begin(args.out / "state.pt", make, args.rate, args.seed)
            before = run.step
            recipe.train(run, known, [], args)  # type: ignore[attr-defined]
            assert run.step - before == (1 if minutes else STEPS)
        weights.append(run.average)
    assert same(*weights)
    torch.manual_seed(0)
    assert not same(weights[0], make())


def test_the_detectors_training_goes_on_where_it_was(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    phases = (
        train_detector.Phase("shapes", 1),
        train_detector.Phase("adaptation", 1, views=2, rendered=0.5),
        train_detector.Phase("pairs", 1, views=2, rendered=0.5, labels=0.1, pairs=1.0),
    )
    monkeypatch.setattr(train_detector, "phases", lambda _: phases)
    picture = np.random.default_rng(1).integers(0, 255, (400, 500)).astype(np.uint8)
    sources = train_detector.Sources([picture], [sights(rendered)])
    weights = []
    for minutes in (0.0, 1e-9):
        args = options(tmp_path / str(minutes), scale=1.0, keypoints=50)
        args.out.mkdir()
        args.minutes, args.batch = minutes, 1
        for _ in range(STEPS if minutes else 1):
            run = train_detector.train(args, sources, [])
        # Ended by --minutes, it is not finished; called once more, it is.
        run = run or train_detector.train(args, sources, [])
        assert run is not None
        assert [row["phase"] for row in run.log] == ["sift", "shapes", "adaptation", "pairs"]
        weights.append(run.average)
    assert same(*weights)
