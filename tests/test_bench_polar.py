"""What scripts/bench polar is made of: pairs cut out of a ground, errors against their truth, tables of the rows."""

import cv2
import numpy as np
import pytest
from benchmarks.polar.grounds import errors, known_pair
from benchmarks.polar.sides import SiftPair
from benchmarks.polar.tables import tables
from make_ground import ground

from aeromatch_cli.geometry.frames import apply_homography

pytestmark = pytest.mark.slow

SIZE = (360, 260)
GROUND = np.clip(ground(7, (900, 800)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_a_pair_shows_what_its_truth_says(seed):
    pair = known_pair(GROUND, SIZE, np.random.default_rng(seed))
    scale = np.hypot(pair.truth[0, 0], pair.truth[1, 0])
    assert 0.8 <= scale <= 1.25
    assert pair.overlap >= 0.3
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(pair.second, pair.truth[:2], SIZE, flags=flags)
    shared = cv2.warpAffine(np.full_like(pair.second, 255), pair.truth[:2], SIZE, flags=flags) == 255
    shared &= (moved > 0) & (moved < 255) & (pair.first > 0) & (pair.first < 255)
    assert np.corrcoef(pair.first[shared], moved[shared])[0, 1] > 0.95


def test_errors_are_those_that_were_made():
    truth = np.array([[0.8, -0.6, 100.0], [0.6, 0.8, -50.0], [0.0, 0.0, 1.0]])
    assert errors(truth, truth, SIZE) == (0.0, 0.0, 0.0)
    shifted = truth.copy()
    shifted[:2, 2] += [3.0, 4.0]
    assert errors(shifted, truth, SIZE)[0] == pytest.approx(5.0)
    turn = np.deg2rad(0.1)
    cosine, sine = 1.001 * np.cos(turn), 1.001 * np.sin(turn)
    turned = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ truth
    assert errors(turned, truth, SIZE)[1:] == (pytest.approx(0.1), pytest.approx(0.001))


def test_sift_finds_the_similarity_of_a_textured_pair():
    pair = known_pair(GROUND, SIZE, np.random.default_rng(1))
    found = SiftPair(pair.first, pair.second).matched(0.8)
    assert found.accepted
    assert errors(found.matrix, pair.truth, SIZE)[0] < 1.0
    off = np.linalg.norm(apply_homography(pair.truth, found.points0) - found.points1, axis=1)
    assert np.median(off[found.verified]) < 1.0
    assert SiftPair(pair.first, pair.second).matched(0.6).inliers <= found.inliers


def row(**more):
    return {
        "section": "known", "kind": "grass", "size": "10x10", "pair": 0, "method": "polar", "accepted": True,
        "translation_error_px": 0.01, "rotation_error_deg": 0.001, "scale_error": 1e-6, "seconds": 1.0,
        "seconds_tie_points": 2.0, "tie_points": 100, "tie_points_right": 99, "tie_point_error_px": 0.1,
        "coverage": 0.9, "right": True,
    } | more  # fmt: skip


def test_tables_count_what_was_accepted_wrongly_and_compare_times():
    rows = [row(), row(pair=1, translation_error_px=7.0), row(pair=2, accepted=False)]
    rows += [row(method="sift", pair=number, seconds=8.0) for number in range(3)]
    rows += [row(section="honesty", kind="saturated", accepted=flag) for flag in (False, True, False)]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables(rows).splitlines() if "|" in line]
    mine = next(line for line in lines if line[:2] == ["grass", "polar"])
    assert mine[2:5] == ["3", "2", "1"]
    times = next(line for line in lines if line[:3] == ["known", "polar", "10x10"])
    assert times[3:9] == ["3", "8.00", "1.00", "2.00", "12.5%", "25.0%"]
    assert next(line for line in lines if line[0] == "saturated")[1:3] == ["3", "1"]


def test_agreement_is_with_sift_where_both_register():
    against = {"translation_px": 200.0, "rotation_deg": 30.0}
    rows = [
        row(section="unknown", **against, translation_error_px=1.9, rotation_error_deg=0.2),
        row(section="unknown", pair=1, **against, translation_error_px=2.1, rotation_error_deg=0.4),
        row(section="unknown", pair=2, accepted=False, **against),
    ]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables(rows).splitlines() if "|" in line]
    assert lines[-1][:6] == ["grass", "polar", "3", "2", "1", "1"]
