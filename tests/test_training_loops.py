"""Trainings that were stopped after every step end with the weights of one that was not."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn
from trainings.descriptor import command as train_descriptor
from trainings.detector import command as train_detector
from trainings.detector.scenes import sights
from trainings.lightglue import command as train_lightglue
from trainings.lightglue.blocks import Pair
from trainings.lightglue.data import write_block
from trainings.lightglue.sides import Partners, Seen
from trainings.orientation import command as train_orientation
from trainings.patches.draws import sources_of
from trainings.patches.runs import Run, ship
from trainings.patches.sources import homography

from aeromatch_cli.nets.geodesc import GeoDesc
from aeromatch_cli.nets.lightglue import Dimensions
from aeromatch_cli.nets.orientation import OrientationNet

pytestmark = pytest.mark.slow

STEPS = 3


@pytest.fixture(autouse=True)
def on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def options(out: Path, **further: object) -> argparse.Namespace:
    return argparse.Namespace(out=out, seed=0, steps=STEPS, batch=4, rate=1e-3, minutes=0.0, jobs=1, **further)


def same(first: nn.Module, second: nn.Module) -> bool:
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


@pytest.mark.parametrize(
    ("recipe", "make", "taught"),
    [
        (train_descriptor, partial(GeoDesc, "large"), False),
        (train_descriptor, partial(GeoDesc, "small"), True),
        (train_orientation, OrientationNet, False),
    ],
    ids=["large descriptor", "small descriptor", "orientation"],
)
def test_patch_trainings_go_on_where_they_were(
    recipe: object, make: Callable[[], nn.Module], taught: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    teacher = tmp_path / "teacher.safetensors" if taught else None
    if teacher:
        ship(GeoDesc("large", folded=True), teacher)
    texture = np.random.default_rng(5).random((500, 600))
    gray = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 3.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "texture.png"), gray)
    made = (homography([tmp_path / "texture.png"], seed) for seed in range(9))
    known = sources_of({"homographies-0.source": next(found[1] for found in made if found is not None)})
    monkeypatch.setattr(recipe, "table", lambda *_: {"all": {"fpr95": 1.0}})
    weights = []
    for minutes in (0.0, 1e-9):
        args = options(tmp_path / str(minutes), teacher=teacher)
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


def shifted_pair(count: int = 80) -> Pair:
    """Keypoints and the same 5 px further right."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (300, 200), (count, 2)).astype(np.float32)
    rest = (
        rng.uniform(2, 9, count).astype(np.float32),
        rng.uniform(-3, 3, count).astype(np.float32),
        rng.integers(0, 100, (count, 128)).astype(np.uint8),
        np.float32([320, 240]),
    )
    first, second = (Seen(places, *rest, places) for places in (points, points + np.float32((5.0, 0.0))))
    return Pair(first, second, Partners(np.arange(count), np.arange(count)), False)


def test_lightglues_training_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_lightglue, "DIMENSIONS", Dimensions(128, 32, 2, 2, add_scale_ori=True))
    monkeypatch.setattr(train_lightglue, "report", lambda *_: {})
    monkeypatch.setattr(train_lightglue, "draw_curves", lambda *_: None)
    plan = (
        train_lightglue.Phase("blocks", 16, 32, 1.0),
        train_lightglue.Phase("many", 8, 64, 1.0, confidence=True),
    )
    monkeypatch.setattr(train_lightglue, "phases", lambda *_, **__: plan)
    weights = []
    for minutes, calls in ((0.0, 1), (1e-9, 4)):
        args = options(tmp_path / str(minutes), scale=1.0, start=None, features="sift")
        args.minutes, args.batch = minutes, 1  # one of 256 keypoints: eight and four of these
        (args.out / "data" / "stage2").mkdir(parents=True)
        write_block(args.out / "data" / "stage2" / "block.npz", lambda: [shifted_pair()])
        for call in range(calls):
            run = train_lightglue.train(args, "cpu")
            assert (run is None) == (call < calls - 1)
        assert run is not None
        assert run.seen == 24
        weights.append(run.average)
    assert "8 of 24 pairs seen; the same command goes on from here" in capsys.readouterr().out
    assert same(*weights)
