"""scripts/bench claims: estimates, verdicts, pairs of known similarity, dark pictures and tables, by hand."""

from pathlib import Path

import cv2
import make_ground
import numpy as np
import pytest
from benchmarks.claims import features, page, registration, shadow
from benchmarks.claims.grounds import errors, ground, known_pair
from benchmarks.claims.intervals import Estimate, change, column, estimate, of_sums, verdict
from benchmarks.claims.sides import unknown_geometry
from benchmarks.claims.work import Unit
from benchmarks.exposure import under_exposed

from aeromatch_cli.strategies.matchers.polar import Polar
from aeromatch_cli.strategies.matchers.polar.fit import polar_grid

SIZE = (360, 260)


def test_an_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(60):
        base = rng.uniform(50.0, 150.0, 30)
        own = base * rng.normal(2.0, 0.5, 30)
        found = estimate(of_sums(own, base), 30)
        held += found.low <= 2.0 <= found.high
    assert 45 <= held <= 60


def test_alike_pairs_have_no_interval():
    rows = [{"a": 30.0, "b": 10.0}, {"a": 6.0, "b": 2.0}, {"a": None, "b": 0.0}]
    found = estimate(of_sums(column(rows, "a"), column(rows, "b")), 3)
    assert (found.value, found.low, found.high) == pytest.approx((3.0, 3.0, 3.0))
    halved = estimate(change(of_sums(np.full(3, 5.0), np.ones(3)), of_sums(np.full(3, 10.0), np.ones(3))), 3)
    assert halved.value == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("found", "larger", "expected"),
    [
        (Estimate(4.0, 3.1, 5.0), True, "beaten"),
        (Estimate(3.2, 2.9, 5.0), True, "met"),
        (Estimate(2.9, 2.0, 5.0), True, "missed"),
        (Estimate(2.0, 1.5, 2.9), False, "beaten"),
        (Estimate(2.9, 2.0, 3.4), False, "met"),
        (Estimate(3.1, 2.0, 3.4), False, "missed"),
        (None, True, "not run"),
    ],
)
def test_verdicts(found, larger, expected):
    assert verdict(found, 3.0, larger=larger) == expected


@pytest.mark.parametrize("kind", ["grass", "furrows"])
def test_a_pair_shows_what_its_truth_says(kind):
    pair = known_pair(ground(kind, SIZE, 1), SIZE, np.random.default_rng(2))
    assert 0.8 <= np.hypot(pair.truth[0, 0], pair.truth[1, 0]) <= 1.25
    assert pair.overlap >= 0.35
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(pair.second, pair.truth[:2], SIZE, flags=flags)
    shared = cv2.warpAffine(np.full_like(pair.second, 255), pair.truth[:2], SIZE, flags=flags) == 255
    assert np.corrcoef(pair.first[shared], moved[shared])[0, 1] > 0.8


def test_ground_has_detail_at_full_size():
    values = ground("grass", SIZE, 1).astype(float)
    # Amplitudes fall with frequency: from the coarse half of the spectrum to the fine one by 2 to 4, enlarged by far.
    power = np.abs(np.fft.rfft(values, axis=1)).mean(axis=0)
    assert 1.5 < power[20:60].mean() / power[-60:].mean() < 12.0


def test_errors_are_those_that_were_made():
    truth = np.array([[0.8, -0.6, 100.0], [0.6, 0.8, -50.0], [0.0, 0.0, 1.0]])
    shifted = truth.copy()
    shifted[:2, 2] += [3.0, 4.0]
    assert errors(shifted, truth, SIZE) == pytest.approx((5.0, 0.0, 0.0))


@pytest.mark.parametrize(("turn_deg", "scale", "shift"), [(30.0, 0.9, (60.0, -30.0)), (-100.0, 1.1, (-20.0, 90.0))])
def test_a_registration_once_more_at_full_size_is_exact_to_a_hundredth(turn_deg, scale, shift):
    first, second, truth = make_ground.pair(turn_deg, scale, shift, gain=0.9, offset=10.0)
    polar = Polar()
    found = polar.registered(first, second, unknown_geometry(first.pixels, second.pixels))
    off = [errors(m, truth, (720, 540))[0] for m in (found.registration.matrix, polar.exact(found))]
    assert off[1] <= 0.01
    assert off[1] <= max(off[0], 0.005)


def test_what_says_less_than_the_registration_is_not_taken(monkeypatch):
    first, second, _ = make_ground.pair(30.0, 0.9, (60.0, -30.0))
    polar = Polar()
    found = polar.registered(first, second, unknown_geometry(first.pixels, second.pixels))
    monkeypatch.setattr("aeromatch_cli.strategies.matchers.polar._LEAST_PATCHES", 1000)
    np.testing.assert_array_equal(polar.exact(found), found.registration.matrix)


def test_layouts_have_as_many_samples():
    dynamic = polar_grid(100.0, 2.0)
    plain, square = registration.plain_polar(100, 2.0), registration.cartesian(100, 2.0)
    count = len(dynamic.offsets_px)
    assert abs(len(plain) / count - 1.0) < 0.02
    assert abs(len(square) / count - 1.0) < 0.02
    # In the inner half of the radius lie half of the plain samples, and a quarter of the others.
    for offsets, share in ((plain, 0.5), (square, 0.25), (dynamic.offsets_px, 0.25)):
        assert abs((np.hypot(*offsets.T) < 50.0).mean() - share) < 0.02


def test_layouts_use_as_many_samples(monkeypatch):
    monkeypatch.setattr(registration, "GRID_SIZE", (920, 690))
    monkeypatch.setattr(registration, "GRID_PAIRS", 1)
    used = {(row["start"], row["layout"]): row["samples"] for row in registration.grid_rows("grass", 1)}
    for layout in registration.LAYOUTS:
        assert abs(used["near", layout] / used["near", "dynamic polar"] - 1.0) < 0.02


def test_a_start_is_as_far_off_as_asked():
    truth = np.array([[0.0, -1.1, 300.0], [1.1, 0.0, 20.0], [0.0, 0.0, 1.0]])
    start = registration._off(truth, (0.01, 0.6, 1.01), 0.3, (401, 301))
    off = truth[:2] @ [200.0, 150.0, 1.0] - start[:2] @ [200.0, 150.0, 1.0]
    assert np.linalg.norm(off) == pytest.approx(1.1 * 0.01 * 401)
    assert errors(start, truth, (401, 301))[1:] == pytest.approx((0.6, 0.01))


def test_under_exposed_shadow_is_noise():
    lit, shade, other = (
        under_exposed(np.full((80, 80, 3), level, np.uint8), 0.06, np.random.default_rng(level))
        for level in (128, 40, 43)
    )
    # sRGB 128 is 0.2159 of full light, 40 is 0.0212: 0.06 of it is stored as 30 and 4 levels.
    assert lit.mean() == pytest.approx(30.1, abs=0.7)
    assert shade.mean() == pytest.approx(4.2, abs=0.7)
    # What differed by a fifth of the light is less than the noise.
    assert abs(other.mean() - shade.mean()) < shade.std()


def test_rows_depend_on_arguments_but_not_on_folders():
    def path(*given):
        return Unit("a", shadow.rows_of, given, ("benchmarks/claims/shadow.py",)).path(Path("rows")).name

    assert path("city", 1, Path("x")) == path("city", 1, Path("y"))
    assert path("city", 1, Path("x")) != path("city", 2, Path("x"))
    assert path("city", 1, Path("x")).startswith("shadow-")


def cells(text, head):
    line = next(line for line in text.splitlines() if line.startswith(f"| {head}"))
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_claims_are_judged_against_the_papers_own_baseline():
    def row(arm, chain, correct, wrong, error_px):
        kept = correct + wrong
        return {
            "paper": "A", "arm": arm, "chain": chain, "scene": "city", "pair": "a b", "suns": 1, "kept": kept,
            "under_exposed": False, "correct": correct, "wrong": wrong, "correct_in_shadow": correct, "errors": kept,
            "error_sum_px": error_px * kept,
        }  # fmt: skip

    single = [
        row(shadow.PAPER, "homography 3 px", 100, 25, 2.0),
        row(shadow.WHOLE, shadow.OWN, 400, 0, 0.5),
        row(shadow.STEP, shadow.CLUSTERED, 220, 20, 1.0),
    ]
    # Direct RANSAC keeps 50 correct matches more per pixel: 5 px are needed for as many as clustered RANSAC.
    single += [row(shadow.STEP, f"homography {px} px", 50 * px, 10 * px, float(px)) for px in shadow.SWEPT_PX]
    rows = [one | {"pair": pair} for one in single for pair in ("a b", "c d")]
    text = page.tables(rows)
    assert cells(text, "A1")[2:] == [
        "200 correct", "300 correct: 1.50 x (1.50 x to 1.50 x)", "800 correct: 4.00 x (4.00 x to 4.00 x)",
        "step missed, whole beaten",
    ]  # fmt: skip
    assert cells(text, "A2")[2:4] == ["3.00 px (homography 3 px)", "1.00 px: -66.7 % (-66.7 % to -66.7 %)"]
    fair = cells(text, "A3 the same: share of right matches, as many")
    assert fair[2:4] == ["83.3 % (homography 5 px)", "91.7 %: +8.3 points (+8.3 points to +8.3 points)"]
    assert fair[5] == "missed"


def test_times_and_features_are_compared_and_what_is_missing_is_not_run():
    def known(kind, sift_s, exact_s, points_s):
        return {
            "paper": "B", "section": "known", "kind": kind, "accepted": True, "sift_accepted": True, "seconds": 0.2,
            "sift_seconds": sift_s, "exact_seconds": exact_s, "tie_point_seconds": points_s,
            "against_share": 0.02, "exact_against_share": 0.001, "against_deg": 0.0, "exact_against_deg": 0.0,
            "px": 0.03, "deg": 1e-4, "scale": 1e-6, "exact_px": 0.004, "exact_deg": 1e-5, "exact_scale": 1e-7,
            "sift_px": 0.002, "sift_deg": 1e-5, "sift_scale": 1e-7,
        }  # fmt: skip

    def method(name, correct):
        head = {"paper": "C", "section": "features", "method": name, "scene": "city", "pair": "a b"}
        return head | {"kept": 100, "correct": correct, "possible": 200, "coverage": 0.5, "median_error_px": 0.3}

    rows = [known("grass", 100.0, 1.0, 50.0), known("sand", 50.0, 0.5, 25.0)]
    rows += [method(name, 20) for name in features.RIVALS if name != features.SUPERPOINT]
    rows += [method(features.STEP, 10), method(features.WHOLE, 60)]
    rows += [row | {"pair": "c d"} for row in rows if row["paper"] == "C"]
    text = page.tables(rows)
    assert cells(text, "B1")[3:] == [
        "0.75 s: -99.0 % (-99.0 % to -99.0 %)", "37.50 s: -50.0 % (-50.0 % to -50.0 %)", "step beaten, whole missed",
    ]  # fmt: skip
    assert cells(text, "B2")[2] == "of 2 pairs SIFT registers 2, polar 2 of these"
    assert cells(text, "B2")[5] == "step missed, whole beaten"
    said = "step missed, whole beaten, of those run, two of them stand-ins"
    assert cells(text, "C1")[4:] == ["120: 3.00 x (3.00 x to 3.00 x)", said]
    few = page.tables([*rows, known("sand", 50.0, 0.5, 25.0) | {"sift_accepted": False}])
    assert cells(few, "B2")[2] == "of 3 pairs SIFT registers 2, polar 2 of these"
    assert cells(few, "B2")[5] == "step missed, whole beaten, on 2 of 3 pairs"
    whole = [*rows, *(method(features.SUPERPOINT, 20) | {"pair": pair} for pair in ("a b", "c d"))]
    assert cells(page.tables(whole), "C1")[5] == "step missed, whole beaten, two of them stand-ins"
    assert cells(text, features.SUPERPOINT) == [features.SUPERPOINT, *["not run"] * 6]


def test_the_legend_says_in_words_what_arms_are():
    lines = page.legend().splitlines()
    assert len(lines) == len({**shadow.ARMS, **features.RIVALS, **features.OURS})
    assert not any("=" in line or "`" in line for line in lines)
