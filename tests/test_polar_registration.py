"""Registration by least squares on the polar grid, against known similarities; and what it says where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from make_ground import Shot, errors, ground, pair, shot, similarity

from aeromatch_cli.strategies.matchers.polar.evidence import cell_size_px, evidence
from aeromatch_cli.strategies.matchers.polar.pyramid import Pyramid
from aeromatch_cli.strategies.matchers.polar.registration import SECOND_PX, Prior, register

MIDDLE = np.array([359.5, 269.5])


def registered(first: Shot, second: Shot, prior: Prior | None = None):
    return register(Pyramid(first.reduced, second.reduced, 720), prior)


@pytest.mark.parametrize(
    ("turn_deg", "scale", "shift"),
    [
        (0.0, 1.0, (40.0, -30.0)),
        (33.0, 0.82, (120.0, 90.0)),
        (180.0, 1.0, (-150.0, 60.0)),
        (-101.0, 1.22, (90.0, 110.0)),
        (77.0, 0.9, (200.0, -140.0)),
    ],
)
def test_known_similarity_is_found_to_a_hundredth_of_a_pixel(turn_deg, scale, shift):
    first, second, truth = pair(turn_deg, scale, shift, seed=3, gain=0.8, offset=15.0)
    found = registered(first, second)
    assert found.accepted, found.reason
    place = found.fit.middle_px / found.scale
    shift_px, turn_off_deg, scale_off = errors(found.matrix, truth, place)
    assert shift_px < 0.03
    assert turn_off_deg < 0.005
    assert scale_off < 9e-5
    assert found.fit.gain == pytest.approx(1.0 / 0.8, abs=0.02)


@pytest.mark.slow
def test_covariance_says_how_exact_it_is():
    """Errors of many noises, in standard deviations: a few, for neighbours are alike and are taken for themselves."""
    source = ground(5)
    truth = similarity(12.0, 1.05, (359.5, 269.5), (410.0, 250.0))
    of_first = similarity(0.0, 1.0, (359.5, 269.5), (650.0, 500.0))
    off = []
    for seed in range(8):
        first = shot(source, of_first, noise=12.0, seed=seed)
        second = shot(source, of_first @ np.linalg.inv(truth), noise=12.0, seed=100 + seed)
        found = registered(first, second)
        shift_px, turn_deg, scale = errors(found.matrix, truth, found.fit.middle_px / found.scale)
        deviations = np.sqrt(np.diag(found.fit.covariance))
        off.append([shift_px / np.hypot(*deviations[:2]), np.deg2rad(turn_deg) / deviations[2], scale / deviations[3]])
    typical = np.sqrt(np.mean(np.square(off), axis=0))
    assert (typical > 0.25).all()
    assert (typical < 4.0).all()


@pytest.mark.slow
def test_other_ground_is_refused_with_a_reason():
    for seed in range(3):
        first, _, _ = pair(0.0, 1.0, (0.0, 0.0), seed=10 + seed)
        _, second, _ = pair(25.0, 1.1, (0.0, 0.0), seed=20 + seed)
        found = registered(first, second)
        assert not found.accepted
        assert "parts of the overlap" in found.reason or "converge" in found.reason or "correlate" in found.reason


@pytest.mark.slow
def test_pictures_without_texture_are_refused():
    black, gray, white = (Shot(np.full((540, 720), value, np.float32)) for value in (0.0, 128.0, 255.0))
    first, _, _ = pair(0.0, 1.0, (0.0, 0.0), seed=1)
    for sides in ((gray, gray), (black, white), (first, black), (first, white), (gray, first)):
        assert not registered(*sides).accepted


def test_masked_content_takes_no_part():
    first, second, truth = pair(15.0, 1.0, (60.0, 20.0), seed=6)
    pixels, valid = second.pixels.copy(), np.ones(second.pixels.shape, bool)
    # A stamp that is the same in both pictures, as a logo or a propeller is.
    stamp = ground(99, (260, 260))
    pixels[200:460, 300:560], valid[200:460, 300:560] = stamp, False
    own, known = first.pixels.copy(), np.ones(first.pixels.shape, bool)
    own[200:460, 300:560], known[200:460, 300:560] = stamp, False
    found = registered(replace(first, pixels=own, valid=known), replace(second, pixels=pixels, valid=valid))
    assert found.accepted, found.reason
    assert errors(found.matrix, truth, MIDDLE)[0] < 0.1


def test_a_moved_object_and_another_shadow_do_not_count():
    first, second, truth = pair(-20.0, 1.04, (50.0, 40.0), seed=8)
    pixels = second.pixels.copy()
    pixels[100:220, 150:400] *= 0.4
    pixels[300:360, 420:520] = 240.0
    found = registered(first, replace(second, pixels=pixels))
    assert found.accepted, found.reason
    assert errors(found.matrix, truth, MIDDLE)[0] < 0.1


def test_a_prior_tells_repeated_rows_apart():
    """Rows 24 px apart on faint ground: what lies between the rows tells them apart, even without a prior."""
    x = np.arange(1400.0)
    rows = 25.0 * np.sin(2.0 * np.pi * x / 24.0)[None] + np.zeros((1100, 1))
    source = (ground(4) - 120.0) * 0.2 + rows + 120.0
    of_first = similarity(0.0, 1.0, (359.5, 269.5), (650.0, 500.0))
    truth = similarity(4.0, 1.02, (359.5, 269.5), (395.0, 262.0))
    first = shot(source.astype(np.float32), of_first)
    second = shot(source.astype(np.float32), of_first @ np.linalg.inv(truth), seed=1)
    expected = similarity(0.0, 1.0, (0.0, 0.0), (38.0, -10.0))
    found = registered(first, second, Prior(expected, np.deg2rad(8.0), 0.06, 9.0))
    assert found.accepted, found.reason
    assert errors(found.matrix, truth, MIDDLE)[0] < 0.05
    without = registered(first, second)
    assert without.accepted, without.reason
    assert errors(without.matrix, truth, MIDDLE)[0] < 0.05


def test_rows_that_nothing_tells_apart_are_refused():
    x = np.arange(1400.0)
    source = np.tile(120.0 + 25.0 * np.sin(2.0 * np.pi * x / 24.0), (1100, 1)).astype(np.float32)
    of_first = similarity(0.0, 1.0, (359.5, 269.5), (650.0, 500.0))
    truth = similarity(4.0, 1.02, (359.5, 269.5), (395.0, 262.0))
    first, second = shot(source, of_first), shot(source, of_first @ np.linalg.inv(truth), seed=1)
    found = registered(first, second)
    assert not found.accepted
    assert "overlap" in found.reason or "correlate" in found.reason


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 45.0, 90.0, 143.0])
@pytest.mark.parametrize("period_px", [20.0, 45.0])
def test_no_evidence_of_a_place_comes_from_rows_alone(turn_deg, period_px):
    """Rows in step, everything else different: a lottery among the places along and across the rows."""
    y, x = np.mgrid[0:1000, 0:1000]
    along = np.deg2rad(turn_deg)
    rows = 120.0 + 25.0 * np.sin(2.0 * np.pi * (x * np.cos(along) + y * np.sin(along)) / period_px)
    place = similarity(0.0, 1.0, (359.5, 269.5), (500.0, 500.0))
    sides = [shot(rows.astype(np.float32), place, noise=6.0, seed=seed) for seed in (1, 2)]
    level0, level1 = Pyramid(sides[0].reduced, sides[1].reduced, 720).at(SECOND_PX, even=True)
    proof = evidence(level0, level1, np.eye(3), cell_size_px(level0, 1.0))
    assert proof.cells >= 40
    assert proof.share < 0.4


@pytest.mark.slow
def test_rows_of_places_apart_are_not_the_same_place():
    source = ground(300, (2600, 2600))
    source = (source - 120.0) * 0.12 + 25.0 * np.sin(2.0 * np.pi * np.arange(2600) / 30.0)[None] + 120.0
    for number in (4, 8):
        first = similarity(0.0, 1.0, (359.5, 269.5), (600.0, 1300.0))
        second = similarity(5.0 * number, 1.0, (359.5, 269.5), (2000.0, 1300.0 + 20.0 * number))
        sides = shot(source, first, noise=4.0, seed=number), shot(source, second, noise=4.0, seed=number + 9)
        assert not registered(*sides).accepted


@pytest.mark.parametrize(("turn_deg", "scale"), [(30.0, 1.0), (0.0, 1.2)])
def test_a_prior_rules_out_turns_and_scales_as_well_as_shifts(turn_deg, scale):
    first, second, truth = pair(turn_deg, scale, (0.0, 0.0), seed=3)
    there = truth @ np.append(MIDDLE, 1.0)
    expected = similarity(0.0, 1.0, tuple(MIDDLE), tuple(there[:2]))
    levels = Pyramid(first.reduced, second.reduced, 720)
    assert register(levels, Prior(expected, np.deg2rad(35.0), 0.25, 20.0)).accepted
    assert not register(levels, Prior(expected, np.deg2rad(3.0), 0.03, 20.0)).accepted


def test_tilt_is_followed_by_the_homography_beside_the_similarity():
    first, second, truth = pair(8.0, 1.0, (40.0, 10.0), seed=9)
    bend = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [4e-5, -3e-5, 1.0]])
    import cv2

    size = (second.width_px, second.height_px)
    tilted = cv2.warpPerspective(second.pixels, bend, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    found = registered(first, Shot(tilted.astype(np.float32)))
    assert found.accepted, found.reason
    places = np.array([[100.0, 100.0], [600.0, 100.0], [350.0, 270.0], [150.0, 450.0]])
    there = [np.column_stack([places, np.ones(4)]) @ matrix.T for matrix in (found.warp, bend @ truth)]
    assert np.abs(there[0][:, :2] / there[0][:, 2:] - there[1][:, :2] / there[1][:, 2:]).max() < 0.3
