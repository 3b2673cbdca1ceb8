"""Truth, pieces and figures of scripts/train lightglue, on places known by construction."""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from make_lightglue import seeded_tensors, write
from trainings.lightglue import command as train_lightglue
from trainings.lightglue import data
from trainings.lightglue.batches import batch_of, piece, unit
from trainings.lightglue.blocks import Pair
from trainings.lightglue.data import OutOfTime, mapped, read_groups, write_groups
from trainings.lightglue.homographies import SIZE_PX, make_group
from trainings.lightglue.loss import loss_of
from trainings.lightglue.sides import NONE, UNKNOWN, Partners, Seen, partners
from trainings.lightglue.validation import Found, by_ratio, fitted, judged, of_like_look, recalls, thinned

from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.nets.lightglue_file import Calibration

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(5)
    texture = sum(cv2.GaussianBlur(rng.random((700, 800)), (0, 0), s) * s for s in (1.5, 3.0, 6.0, 12.0))
    gray = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    path = tmp_path_factory.mktemp("picture") / "texture.png"
    cv2.imwrite(str(path), gray)
    return path


def side(points: np.ndarray, seed: int = 0, turned: bool = True) -> Seen:
    rng = np.random.default_rng(seed)
    count = len(points)
    descriptors = rng.integers(0, 100, (count, 128)).astype(np.uint8)
    angles = rng.uniform(-3, 3, count) if turned else np.zeros(count)
    sizes = rng.uniform(2, 9, count).astype(np.float32)
    points = points.astype(np.float32)
    return Seen(points, sizes, angles.astype(np.float32), descriptors, np.float32([640, 480]), points)


def test_partners_are_mutual_and_near_and_the_rest_is_none_or_unknown() -> None:
    places0 = np.array([[10.0, 10.0], [50.0, 10.0], [90.0, 10.0], [130.0, 10.0], [170.0, 10.0]])
    places1 = np.array([[11.0, 10.0], [54.0, 10.0], [300.0, 10.0], [131.0, 10.0], [132.5, 10.0]])
    there0, there1 = places0.copy(), places1.copy()  # the identity
    there0[4] = np.nan  # hidden in the other picture
    found = partners(side(places0), side(places1), there0, there1)
    #                              near  4 px off  no one   nearer of two  hidden
    assert found.of0.tolist() == [0, UNKNOWN, NONE, 3, NONE]
    #                              near  4 px off  no one  nearer  farther of two
    assert found.of1.tolist() == [0, UNKNOWN, NONE, 3, UNKNOWN]


def test_of_places_described_twice_those_that_look_most_alike_are_partners() -> None:
    first = side(np.array([[10.0, 10.0], [10.0, 10.0], [50.0, 10.0], [90.0, 10.0], [90.0, 10.0]]))
    second = side(np.array([[11.0, 10.0], [11.0, 10.0], [50.0, 11.0], [50.0, 11.0], [200.0, 10.0]]), 1)
    second.descriptors[[1, 0, 3]] = first.descriptors[[0, 1, 2]]
    found = partners(first, second, first.places_px, second.places_px)
    assert found.of0.tolist() == [1, 0, 3, NONE, NONE]
    assert found.of1.tolist() == [1, 0, UNKNOWN, 2, NONE]
    # Either description of the right place is right.
    pair = Pair(first, second, found, False)
    indices = np.array([[0, 1], [1, 0], [2, 4], [3, 4]])
    assert judged([(pair, indices, np.ones(4))]).right.tolist() == [True, True, False, False]
    assert judged([(pair, np.array([[0, 0]]), np.ones(1))]).right.tolist() == [True]


def test_partners_of_other_size_or_turn_are_told_apart() -> None:
    places = np.array([[10.0 + 40.0 * n, 10.0] for n in range(6)])
    first, second = side(places), side(places, 1)
    first.sizes_px[:], second.sizes_px[:] = 4.0, 8.0  # twice the size is usual here
    first.angles_rad[:], second.angles_rad[:] = 3.0, -3.0  # and 16 degrees, across the wrap
    second.sizes_px[1] *= 1.5
    second.angles_rad[2] += 0.7
    pair = Pair(first, second, partners(first, second, places, places), False)
    assert of_like_look(pair).tolist() == [True, False, False, True, True, True]
    # Of the like ones 0 and 3 are found surely, 4 doubtfully, 5 wrongly; of the others 1.
    answer = (pair, np.array([[0, 0], [1, 1], [3, 3], [4, 4], [5, 2]]), np.array([0.9, 0.9, 0.9, 0.2, 0.9]))
    assert recalls([answer], 0.5) == pytest.approx((4 / 6, 2 / 4, 1 / 2))
    assert recalls([answer], -np.inf) == pytest.approx((4 / 6, 3 / 4, 1 / 2))
    usual = Pair(first, first, partners(first, first, places, places), False)
    everything = (usual, np.array([[0, 0]]), np.ones(1))
    assert recalls([everything], 0.0) == pytest.approx((1.0, 1 / 6, np.nan), nan_ok=True)  # no others
    nothing = Pair(first, first, partners(first, first, places + 900.0, places + 900.0), False)
    assert recalls([answer, (nothing, np.zeros((0, 2), int), np.zeros(0))], 0.5) == recalls([answer], 0.5)


def test_the_least_score_is_where_the_precision_ends() -> None:
    found = Found(np.array([0.9, 0.5, 0.8, 0.3]), np.array([True, True, False, False]), 4)
    assert found.least_score_at(0.6) == 0.5
    assert found.least_score_at(1.0) == 0.9
    assert Found(np.array([0.9]), np.array([False]), 4).least_score_at(0.5) == np.inf


@pytest.mark.parametrize("jobs", [1, 2])
def test_nothing_is_begun_when_the_time_is_over(jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:  # begun once for both calls
        monkeypatch.setattr(data, "ProcessPoolExecutor", lambda *_, **__: nullcontext(pool))
        nothing_is_begun_late(jobs)


def nothing_is_begun_late(jobs: int) -> None:
    assert mapped(abs, [-1, 2], jobs, time.time() + 1000.0) == [1, 2]
    with pytest.raises(OutOfTime):
        mapped(abs, [-1, 2], jobs, time.time() - 1.0)


def test_homography_truth_joins_places_of_the_same_point(picture: Path) -> None:
    group = make_group([picture], 3)
    truth = group.truth(0, 1)
    matched = np.flatnonzero(truth.of0 >= 0)
    assert len(matched) > 50
    to_base = [np.linalg.inv(matrix) for matrix in group.matrices]
    base = [cv2.perspectiveTransform(view.places_px[None].astype(np.float64), m)[0] for view, m in
            zip(group.views, to_base, strict=True)]  # fmt: skip
    scale = np.sqrt(abs(np.linalg.det(to_base[0][:2, :2])))
    apart = np.linalg.norm(base[0][matched] - base[1][truth.of0[matched]], axis=1)
    assert np.median(apart) < 2.0 * scale
    assert all(tuple(view.size_px) == SIZE_PX for view in group.views)


def test_a_file_of_groups_reads_back(picture: Path, tmp_path: Path) -> None:
    write_groups(tmp_path / "x.npz", [picture], 7, 1)
    pairs, group = read_groups(tmp_path / "x.npz"), make_group([picture], 7)
    assert len(pairs) == 6
    assert np.array_equal(pairs[0].side0.descriptors, group.views[0].descriptors)
    assert np.array_equal(pairs[5].truth.of1, group.truth(2, 3).of1)


@pytest.mark.parametrize("seed", range(6))
def test_a_piece_keeps_partners_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, [640, 480], (300, 2))
    order = rng.permutation(300)
    truth = Partners(np.argsort(order).astype(np.int32), order.astype(np.int32))
    first = side(points)
    given = first, first.take(order), truth
    side0, side1, cut = piece(*given, 120, rng, free=True)
    assert len(side0.points_px) == len(side1.points_px) == 120
    joined = np.flatnonzero(cut.of0 >= 0)
    assert len(joined) > 10
    assert np.array_equal(side0.descriptors[joined], side1.descriptors[cut.of0[joined]])
    assert np.array_equal(cut.of1[cut.of0[joined]], joined)
    gone = np.flatnonzero(cut.of0 == NONE)
    assert not {d.tobytes() for d in side0.descriptors[gone]} & {d.tobytes() for d in side1.descriptors}
    # One turn and one scale for the whole picture: distances and orientations change together.
    turn = np.mod(side0.angles_rad - first.take(_rows_of(first, side0)).angles_rad, 2 * np.pi)
    assert np.ptp(np.unwrap(np.sort(turn))) == pytest.approx(0.0, abs=1e-4)
    assert (side0.points_px >= -1e-3).all()
    assert (side0.points_px <= side0.size_px + 1e-3).all()


def _rows_of(whole: Seen, part: Seen) -> np.ndarray:
    rows = {d.tobytes(): n for n, d in enumerate(whole.descriptors)}
    return np.array([rows[d.tobytes()] for d in part.descriptors])


def test_batches_go_on_where_a_run_was_left() -> None:
    rng = np.random.default_rng(4)
    first = side(rng.uniform(0, [640, 480], (60, 2)))
    truth = Partners(np.arange(60, dtype=np.int32), np.arange(60, dtype=np.int32))
    pairs = [Pair(first, first, truth, False)]
    plan = (train_lightglue.Phase("homographies", 10, 16, 0.0), train_lightglue.Phase("blocks", 5, 32, 0.6))
    every = train_lightglue.Batches(pairs, pairs, plan, 1, 0, seed=2)
    # 1 x 256 keypoints a batch: 16 pairs of 16 pass the first phase's end, and 8 of 32 would pass the second's.
    assert every.begins == [0]
    assert every.plan_at(10) == (plan[1], 8)
    later = train_lightglue.Batches(pairs, pairs, plan, 1, 10, seed=2)
    assert later.begins == [10]
    assert [len(batch.partners0) for batch in later] == [8]
    again = train_lightglue.drawn(pairs, pairs, plan[1], 8, 10, 2)
    assert torch.equal(later[0].side0.places, again.side0.places)
    assert torch.equal(later[0].partners1, again.partners1)


def test_a_small_network_learns_a_batch_by_heart() -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    first = side(rng.uniform(0, [640, 480], (40, 2)))
    truth = Partners(np.arange(40, dtype=np.int32), np.arange(40, dtype=np.int32))
    batch = batch_of([(first, first, truth), (first.take(np.arange(30)), side(np.zeros((20, 2)), 9),
                      Partners(np.full(30, NONE, np.int32), np.full(20, NONE, np.int32)))], 40, rng)  # fmt: skip
    batch = replace(batch, side0=unit(batch.side0), side1=unit(batch.side1))
    network = LightGlue(Dimensions(128, 32, 2, 1, True))
    optimiser = torch.optim.AdamW(network.parameters(), 3e-3)
    losses = []
    for _ in range(60):
        loss = loss_of(network, batch, confidence=True)
        optimiser.zero_grad()
        loss.total.backward()
        optimiser.step()
        losses.append(loss.partner + loss.none)
    assert losses[-1] < 0.2 * losses[0]
    pairs, scores = network.eval().match(
        *(type(s)(s.places[:1], s.descriptors[:1]) for s in (batch.side0, batch.side1)),
        threshold=0.1, depth_confidence=-1.0, width_confidence=-1.0,
    )  # fmt: skip
    assert len(pairs) > 35
    assert (pairs[:, 0] == pairs[:, 1]).all()
    assert float(scores.mean()) > 0.5


def test_recall_at_a_precision_and_wrong_at_a_recall() -> None:
    found = Found(np.array([0.9, 0.8, 0.7, 0.6, 0.5]), np.array([True, True, False, True, False]), 10)
    assert (found.recall, found.precision) == (0.3, 0.6)
    assert (found.recall_at(1.0), found.recall_at(0.75), found.recall_at(0.7)) == (0.2, 0.3, 0.3)
    assert (found.wrong_at(0.2), found.wrong_at(0.3), found.wrong_at(0.4)) == (0, 1, -1)


def test_the_ratio_test_is_judged_by_truth() -> None:
    points = np.random.default_rng(1).uniform(0, [640, 480], (60, 2))
    first = side(points)
    truth = Partners(np.arange(60, dtype=np.int32), np.arange(60, dtype=np.int32))
    truth.of0[:10], truth.of1[:10] = UNKNOWN, UNKNOWN
    truth.of0[10:20], truth.of1[10:20] = NONE, NONE
    pair = Pair(first, first, truth, False)
    found = judged([(pair, *by_ratio(pair))])
    assert found.possible == 40
    assert (found.right.sum(), (~found.right).sum()) == (40, 10)  # unknown ones are not counted
    assert len(thinned([pair] * 5, 30, 2)) == 2


def test_a_calibration_is_found_again():
    rng = np.random.default_rng(3)
    scores = rng.uniform(0.01, 0.99, 40_000)
    truth = Calibration(1.4, 0.6)
    found = Found(scores, rng.random(len(scores)) < truth.calibrated(scores), len(scores))
    calibration = fitted(found)
    assert calibration.slope == pytest.approx(1.4, abs=0.05)
    assert calibration.offset == pytest.approx(0.6, abs=0.05)
    for low, high, matches, mean, right in found.reliability(calibration):
        assert low < mean <= high
        assert right == pytest.approx(mean, abs=4.0 * np.sqrt(0.25 / matches))
    assert max(abs(right - mean) for *_, mean, right in found.reliability(Calibration())) > 0.1


def test_a_run_is_not_mixed_with_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b", "empty"):
        (tmp_path / "data" / name / "images").mkdir(parents=True)
    for name in ("a", "b"):
        (tmp_path / "data" / name / "images" / "1.jpg").touch()
    other = write(tmp_path / "other.pth", seeded_tensors(Dimensions(32, 32, 2, 1, add_scale_ori=True)))
    parser = argparse.ArgumentParser()
    plain = {"trained_on": "a", "unseen": "b", "groups": 200, "blocks": 19, "start": None, "scale": 1.0, "batch": 16}
    args = argparse.Namespace(
        data=tmp_path / "data", out=tmp_path / "out", only_data=True, rate=1e-3, seed=0, features="sift", **plain
    )
    train_lightglue.check(parser, args)
    args.only_data = False
    train_lightglue.check(parser, args)
    train_lightglue.check(parser, args)
    for name, value, said in (
        ("scale", 0.5, "holds another run (scale 1.0)"),
        ("seed", 1, "holds another run (seed 0)"),
        ("groups", 250, "holds another run (groups 200)"),
        ("groups", 130, "multiple of 50"),
        ("blocks", 4, "give at least 19"),
        ("unseen", "c", "c has no folder images"),
        ("unseen", "empty", "holds no picture"),
        ("unseen", "a", "a: in --trained-on and --unseen"),
        ("scale", -1.0, "--scale -1.0: give a positive number"),
        ("rate", np.nan, "--rate nan: give a positive number"),
        ("start", tmp_path / "none.safetensors", "none.safetensors"),
        ("start", other, "descriptors of 32"),
        ("out", tmp_path / "other.pth", "is no folder"),
    ):
        with pytest.raises(SystemExit) as refused:
            train_lightglue.check(parser, argparse.Namespace(**(vars(args) | {name: value})))
        assert refused.value.code == 2
        assert said in capsys.readouterr().err
    (tmp_path / "out" / "recipe.json").write_text("{", encoding="utf-8")
    with pytest.raises(SystemExit):
        train_lightglue.check(parser, args)
    assert "recipe.json is damaged" in capsys.readouterr().err
