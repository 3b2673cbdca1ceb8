"""Cascades: which pairs go on to a further step, and how the matches of several steps become one result."""

from __future__ import annotations

import csv
import json
import sqlite3
from typing import Any

import numpy as np
import pytest
from conftest import IMAGES, UNORIENTED, Site

from aeromatch_cli.config import load
from aeromatch_cli.data import Camera, Matches, Pair, PairGeometry, Pose, Verdict
from aeromatch_cli.errors import ItemError
from aeromatch_cli.files import read_json
from aeromatch_cli.formats.features import read_joined, read_keypoints
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry, read_verified_row
from aeromatch_cli.geometry.coverage import CELLS, covered_share, shared_cells
from aeromatch_cli.stages import extract, filter  # noqa: A004
from aeromatch_cli.stages.cascade import _not_tied_by_a_third, _with_few_partners, keypoints_of, strategies_of
from aeromatch_cli.stages.joined_steps import joined_keypoints, joined_matches
from aeromatch_cli.stages.pair_statistics import PairStatistics
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.strategies.extractors.described import Described
from aeromatch_cli.strategies.steps import GuidedSearch, LearnedFeatures

SETTINGS = UNORIENTED

CAMERA = Camera("SIMPLE_PINHOLE", 800, 600, (800.0, 399.5, 299.5))
DOWN = np.diag([1.0, -1.0, -1.0])
NOTHING = np.zeros(0)
MANY = 8000


def geometry(east_m: float) -> PairGeometry:
    """Two pictures of flat ground from 100 m, straight down, 100 m by 75 m each."""
    poses = [Pose(np.array([x, 0.0, 100.0]), DOWN, 0.1, 0.1) for x in (0.0, east_m)]
    return PairGeometry(Pair("a", "b", np.nan, np.nan, "x"), CAMERA, CAMERA, *poses, 0.0)


@pytest.mark.parametrize(("east_m", "columns"), [(0.0, 8), (50.0, 4), (75.0, 2), (120.0, 0)])
def test_the_shared_cells_are_those_that_the_other_image_shows(east_m: float, columns: int) -> None:
    shared = shared_cells(geometry(east_m))
    assert shared is not None
    expected = np.zeros((CELLS, CELLS), dtype=bool)
    expected[:, CELLS - columns :] = columns > 0
    np.testing.assert_array_equal(shared.cells0, expected)
    np.testing.assert_array_equal(shared.cells1, expected[:, ::-1])
    assert shared.share == columns / CELLS


def test_coverage_counts_shared_cells_with_a_point() -> None:
    shared = shared_cells(geometry(50.0))
    assert shared is not None
    points = np.array([[450.0, 10.0], [451.0, 11.0], [799.4, 599.4], [10.0, 10.0]])
    assert covered_share(shared.cells0, CAMERA, points) == 2 / 32
    assert np.isnan(covered_share(np.zeros((CELLS, CELLS), bool), CAMERA, points))


def test_without_attitudes_no_overlap_is_known() -> None:
    known = geometry(50.0)
    assert known.pose1 is not None
    unposed = PairGeometry(known.pair, CAMERA, CAMERA, known.pose0, None, 0.0)
    assert shared_cells(unposed) is None


def test_an_image_that_nothing_ties_is_tried_with_three_partners() -> None:
    """x has no verified match: of its four pairs those with most candidates go on; a-b is tied, whatever its count."""
    found = {("a", "b"): PairStatistics(5, 0.5, 0.1, MANY, 9)}
    found |= {
        (name, "x"): PairStatistics(0, np.nan, np.nan, MANY, count)
        for name, count in zip("abcd", (8, 2, 9, 5), strict=True)
    }
    found[("c", "d")] = PairStatistics(700, 0.5, 0.9, MANY, 900)
    left = {key: "few" for key in found if key != ("c", "d")}
    assert set(_with_few_partners(left, found)) == {("a", "b"), ("a", "x"), ("c", "x"), ("d", "x")}


def test_rare_pairs_go_without_features_where_a_third_image_ties_them() -> None:
    left = {("a", "c"): "few", ("c", "d"): "few"}
    assert _not_tied_by_a_third(left, [("a", "b"), ("b", "c"), ("d", "e")]) == {("c", "d"): "few"}


@pytest.mark.parametrize(("words", "pixels"), [((), 1500.0), (("extract.pixels_per_keypoint=0",), 0.0)])
def test_learned_keypoints_halve_views_unless_the_user_never_does(words: tuple[str, ...], pixels: float) -> None:
    extract = strategies_of(LearnedFeatures(), load("auto", words))["extract"]
    assert isinstance(extract, Described)
    assert extract.pixels_per_keypoint == pixels


def test_a_step_finds_as_many_keypoints_as_the_first() -> None:
    for words, most in (((), 8000), (("extract.keypoints=900",), 900)):
        settings = load("auto", words)
        assert keypoints_of(GuidedSearch(), settings) == most
        assert keypoints_of(LearnedFeatures(), settings) == most
        assert keypoints_of(LearnedFeatures(keypoints=70), settings) == 70


def test_a_keypoint_of_a_later_step_that_lies_on_an_earlier_one_is_that_one() -> None:
    first = np.array([[10.0, 10.0], [50.0, 50.0], [90.0, 10.0]], np.float32)
    later = np.array([[50.3, 50.2], [70.0, 70.0], [10.1, 10.0], [9.8, 10.0]], np.float32)
    sizes = np.ones(4, np.float32)
    joined = joined_keypoints([("first", first, sizes[:3]), ("learned", later, sizes)])
    # Of two that lie on one keypoint the nearer has it.
    np.testing.assert_array_equal(joined.numbers["learned"], [1, 3, 0, 4])
    np.testing.assert_array_equal(joined.numbers["first"], [0, 1, 2])
    np.testing.assert_allclose(joined.keypoints_px, np.concatenate([first, later[[1, 3]]]))
    np.testing.assert_array_equal(joined.kind_idx, [0, 0, 0, 1, 1])
    assert joined.kinds == ("first", "learned")


def entry(indices: list[tuple[int, int]], scores: list[float]) -> MatchEntry:
    pairs = np.array(indices, np.int32).reshape(-1, 2)
    return MatchEntry("b", "", "nearest", Matches(pairs, np.array(scores, np.float32), np.zeros_like(pairs, np.int16)))


def verified(made: MatchEntry, keep: list[int]) -> VerifiedEntry:
    kept = Matches(made.matches.indices[keep], made.matches.scores[keep], made.matches.view_pairs[keep])
    return VerifiedEntry("b", "", len(made.matches.indices), kept, Verdict(np.ones(len(keep), bool), "verified"))


def test_of_matches_that_contradict_or_lie_together_the_verified_one_stays() -> None:
    places = np.array([[100.0 * n, 0.0] for n in range(4)], np.float32)
    near = places[[0, 1, 3]] + np.array([[0.8, 0.0]], np.float32)  # keypoints of their own, less than 1 px away
    sizes = np.ones(4, np.float32)
    sides = [joined_keypoints([("first", places, sizes), ("learned", near, sizes[:3])]) for _ in range(2)]
    first = entry([(0, 0), (1, 2), (2, 2)], [0.2, 0.9, 0.3])
    learned = entry([(0, 0), (1, 1), (2, 2)], [0.6, 0.5, 0.4])
    found = joined_matches(
        [("first", first, verified(first, [0, 2])), ("learned", learned, verified(learned, [1, 2]))], *sides
    )
    # 0-0 of the first step is verified and that of the second lies on it; 1-2 takes 2 from the verified 2-2.
    np.testing.assert_array_equal(found.indices, [(0, 0), (2, 2), (5, 5), (6, 6)])
    np.testing.assert_allclose(found.scores, [0.2, 0.3, 0.5, 0.4])


@pytest.mark.slow
def test_a_cascade_ends_in_one_result(site: Site) -> None:
    """All pairs take the second step; keypoints and matches of both are one result, made once. With orientation."""
    site = Site(site.root)
    settings = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=100000")
    settings += ("--set", "cascade.learned.keypoints=300")
    outcome = site("run", *settings, "--json")
    assert outcome.code == 0, outcome.stderr
    pairs = IMAGES * (IMAGES - 1) // 2
    lacking = f"{pairs} have fewer matches, or less of the overlap covered, than the last step asks for"
    enough = f"0 of {pairs} pairs have enough matches after step first, 0 more after learned"
    assert f"{enough}; {lacking}" in outcome.stdout
    with (site.work / "steps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == pairs
    assert {row["steps"] for row in rows} == {"first+learned"}
    assert all("verified matches of" in row["reasons"] and row["lacks"] for row in rows)
    assert all(int(row["expected"]) > 0 for row in rows)
    ids = [name.replace(".", "_") for name in site.names()]
    features, own_keypoints = outcome.facts["stages"]["extract"]["result"], 0
    for image_id in ids:
        joined = read_joined(site.work / "features" / f"{image_id}.npz")
        for step, numbers in joined.numbers.items():
            own = read_keypoints(site.work / "features" / step / f"{image_id}.npz")[0]
            own_keypoints += len(own)
            apart_px = np.linalg.norm(joined.keypoints_px[numbers] - own, axis=1)
            assert apart_px.max() < (1e-6 if step == "first" else 0.51)
    assert features["images_by_step"] == {"first": IMAGES, "learned": IMAGES}
    assert (features["images"], features["keypoints"]) == (2 * IMAGES, own_keypoints)
    steps = [read_json(site.work / "reports" / step / "extract.json")["result"] for step in ("first", "learned")]
    for sums in ("views", "view_megapixels"):
        assert features[sums] == pytest.approx(sum(one[sums] for one in steps))
    assert features["views"] >= 2 * IMAGES
    assert "views per image: " in outcome.stdout
    both = {step: _matches(site, step) for step in ("first", "learned")}
    whole = sum(len(e.matches.indices) for e in _rows(site.work / "verified"))
    assert whole > 1.05 * max(both.values())
    with sqlite3.connect(site.work / "export" / "colmap" / "database.db") as database:
        (exported,) = database.execute("SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0").fetchone()
    assert exported == sum(e.verdict.state == "verified" for e in _rows(site.work / "verified"))
    before = {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()}
    assert site("run", *settings).code == 0
    assert {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_pairs_of_images_that_have_the_features_take_the_step_too(site: Site) -> None:
    """Learned features cost much and their matches little: a pair needs no reason of its own."""
    settings = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=1000")
    settings += ("--set", "cascade.learned.keypoints=200", "--set", "cascade.learned.below_coverage=0")
    assert site("run", *settings).code == 0
    with (site.work / "steps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    asked = {i for r in rows if "overlap" in r["reasons"] for i in (r["image_id0"], r["image_id1"])}
    shared = [row for row in rows if "both images have its features" in row["reasons"]]
    assert shared, rows
    assert all({row["image_id0"], row["image_id1"]} <= asked for row in shared)
    left = [row for row in rows if row["steps"] == "first"]
    assert all(not {row["image_id0"], row["image_id1"]} <= asked for row in left)


def _matches(site: Site, step: str) -> int:
    return sum(len(e.matches.indices) for e in _rows(site.work / "verified" / step))


def _rows(folder) -> list[VerifiedEntry]:
    return [e for path in sorted(folder.glob("*.npz")) for e in read_verified_row(path).values()]


@pytest.mark.slow
def test_guided_search_takes_the_first_steps_keypoints_and_replaces_its_matches(site: Site) -> None:
    settings = ("--set", "cascade=guided", "--set", "cascade.guided.below_matches=100000")
    outcome = site("run", *settings)
    assert outcome.code == 0, outcome.stderr
    with (site.work / "steps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["steps"] for row in rows} == {"first+guided"}
    assert not (site.work / "features" / "guided").exists()
    extracted = _report(site, "guided", "extract")
    assert extracted["skipped"] == extracted["items"] == IMAGES
    first, guided = (_rows(site.work / "verified" / step) for step in ("first", "guided"))
    whole = _rows(site.work / "verified")
    assert len(whole) == len(guided) == len(first)
    assert sum(len(e.matches.indices) for e in guided) > sum(len(e.matches.indices) for e in first)
    assert [int(row["verified"]) for row in rows] == [len(e.matches.indices) for e in guided]
    expected, found = (np.array([float(row[key]) for row in rows]) for key in ("expected", "verified"))
    assert np.abs(np.log(expected / found)).max() < 0.7, rows
    for joined, own in zip(whole, guided, strict=True):
        np.testing.assert_array_equal(joined.matches.indices, own.matches.indices)
    before = {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()}
    assert site("run", *settings).code == 0
    assert {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()} == before
    changed = next(path for path in before if path.parent == site.work / "matches" / "first")
    changed.write_bytes(before[changed][:-40])
    assert site("run", *settings).code == 0
    arrays = {path: content for path, content in before.items() if path.suffix == ".npz"}
    assert {path: path.read_bytes() for path in arrays} == arrays
    # All is made again, each image's features once.
    assert site("run", *settings, "--overwrite").code == 0
    assert {path: path.read_bytes() for path in arrays} == arrays
    assert [_report(site, step, "extract")["done"] for step in ("first", "guided")] == [IMAGES, 0]
    # The step goes on from what the first one finds: other settings of that count.
    assert site("match", *settings, "--set", "match.guided=true").code == 0
    assert _report(site, "guided", "match")["done"] == len(rows)


def _report(site: Site, step: str, stage: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((site.work / "reports" / step / f"{stage}.json").read_text())
    return found


@pytest.mark.slow
def test_a_pair_that_a_step_cannot_verify_is_a_failure_that_the_next_run_mends(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ("--set", "cascade=guided", "--set", "cascade.guided.below_matches=100000")
    judge = filter._judge

    def broken(task: Any, pair: Any, entry: Any) -> Any:
        if task.workspace.step and task.image_id0 == "suburb_0001_jpg":
            raise ItemError("on purpose")
        return judge(task, pair, entry)

    monkeypatch.setattr(filter, "_judge", broken)
    outcome = site("run", *settings)
    assert outcome.code == 1, outcome.stderr
    assert {item.partition(" ")[0] for stage, item in site.failures() if stage == "match"} == {"suburb_0001.jpg"}
    assert "on purpose" in outcome.stderr
    monkeypatch.undo()
    mended = site("run", *settings)
    assert mended.code == 0, mended.stderr
    assert site.failures() == []
    verified = {path.name: path.read_bytes() for path in (site.work / "verified").glob("*.npz")}
    other = site.another_workspace("whole")
    assert site("run", *settings, "--workspace", other).code == 0
    assert {path.name: path.read_bytes() for path in (other / "verified").glob("*.npz")} == verified


@pytest.mark.slow
def test_a_failure_in_one_step_counts_no_image_as_less_than_none(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=100000")
    settings += ("--set", "cascade.learned.keypoints=200")
    made = extract.run_task

    def broken(task: Any) -> Any:
        if task.path.parent.name == "learned" and task.image_id == "suburb_0002_jpg":
            raise ItemError("on purpose")
        return made(task)

    monkeypatch.setattr(extract, "run_task", broken)
    outcome = site("run", *settings)
    assert outcome.code == 1, outcome.stderr
    # Its keypoints are those of the first step.
    assert outcome.counts("extract") == (IMAGES, 0, 1)


@pytest.mark.slow
def test_a_shard_of_a_cascade_makes_its_own_images_first_and_no_others_than_its_pairs(site: Site) -> None:
    settings = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=100000", "--set", "orient=none")
    settings += ("--set", "cascade.learned.keypoints=200", "--set", "pairs=sequential", "--set", "pairs.window=1")
    for part in ("1/3", "2/3"):
        assert site("run", *settings, "--shard", part).code == 0
    shard = Shard.parse("2/3")
    with (site.work / "pairs.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if shard.owns(row["image_id0"])]
    wanted = {row[key] for row in rows for key in ("image_id0", "image_id1")}
    report = json.loads((site.work / "reports" / "learned" / "extract.2-of-3.json").read_text())
    assert report["items"] == len(wanted) < IMAGES


@pytest.mark.slow
def test_shards_of_a_cascade_agree_with_the_whole(site: Site) -> None:
    settings = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=2000")
    settings += ("--set", "cascade.learned.keypoints=200")
    assert site("run", *settings).code == 0
    whole = {path.name: path.read_bytes() for path in (site.work / "verified").glob("*.npz")}
    steps = (site.work / "steps.csv").read_text()
    other = site.another_workspace("parts")
    for part in ("1/2", "2/2"):
        assert site("run", *settings, "--workspace", other, "--shard", part).code == 0
    assert not list((other / "verified").glob("*.npz"))
    assert site("run", *settings, "--workspace", other).code == 0
    assert (other / "steps.csv").read_text() == steps
    assert {path.name: path.read_bytes() for path in (other / "verified").glob("*.npz")} == whole
