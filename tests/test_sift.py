"""SIFT against rendered truth: places, budget, spread, tiles, masks, views."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from aeromatch_cli.data import Camera, View
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors import detection
from aeromatch_cli.strategies.extractors.detection import root_sift
from aeromatch_cli.strategies.extractors.reduction import factor_for
from aeromatch_cli.strategies.extractors.selection import merge_keypoints
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.extractors.tiles import tiles


def camera_of(gray):
    height, width = gray.shape
    return Camera("PINHOLE", width, height, (1000.0, 1000.0, (width - 1) / 2, (height - 1) / 2))


def source(gray, valid=None):
    height, width = gray.shape
    return ViewPixels(View("source", width, height, np.eye(3), is_source=True, angle_deg=0.0), gray, valid)


def extract(gray, valid=None, **settings):
    return Sift(**settings)(camera_of(gray), (source(gray, valid),))


def texture(width, height, seed=0):
    """Noise with structure at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for scale in (2, 4, 8, 16):
        coarse = rng.standard_normal((height // scale + 2, width // scale + 2))
        total += scale**0.5 * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 25 * total, 0, 255).astype(np.uint8)


def blobs(centers, sigma, size=160):
    y, x = np.mgrid[:size, :size]
    gray = np.full((size, size), 60.0)
    for cx, cy in centers:
        gray += 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.rint(gray).astype(np.uint8)


@pytest.mark.parametrize("sigma", [2.0, 3.0, 6.0])
def test_a_blob_is_found_at_its_centre(sigma):
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(12):
        centre = 80 + rng.uniform(-0.5, 0.5, 2)
        keypoints = extract(blobs([centre], sigma)).keypoints_px
        distance = np.linalg.norm(keypoints - centre, axis=1)
        errors.append(keypoints[distance.argmin()] - centre)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.03
    assert np.abs(errors).max() < 0.1


def test_the_size_is_the_blobs_diameter():
    features = extract(blobs([(80.3, 79.8)], 5.0))
    nearest = np.linalg.norm(features.keypoints_px - [80.3, 79.8], axis=1).argmin()
    # The scale space extremum of a Gaussian blob lies near its own sigma; the size is twice the scale.
    assert features.sizes_px[nearest] == pytest.approx(10.0, rel=0.15)


@pytest.mark.parametrize("budget", [1, 100, 777])
def test_the_budget_is_exact(budget):
    features = extract(texture(400, 300), keypoints=budget)
    assert features.descriptors.shape == (budget, 128)
    keypoints = len(features.keypoints_px)
    assert 0.6 * budget <= keypoints <= budget
    assert np.array_equal(np.unique(features.descriptor_keypoint_idx), np.arange(keypoints))


def test_the_budget_is_for_the_image_or_for_each_view():
    gray = texture(400, 300)
    views = (source(gray), shrunk_view(gray))
    whole = Sift(keypoints=60)(camera_of(gray), views)
    each = Sift(keypoints=60, budget="view")(camera_of(gray), views)
    assert len(whole.descriptors) == 60
    assert np.bincount(each.view_idx).tolist() == [60, 60]
    alone = [Sift(keypoints=60, budget=b)(camera_of(gray), views[:1]).descriptors for b in ("image", "view")]
    assert np.array_equal(*alone)


@pytest.mark.slow
def test_few_keypoints_of_a_large_view_are_those_of_a_reduced_one():
    gray, valid, keypoints = texture(1800, 1400), np.ones((1400, 1800), bool), 800
    valid[:, 1500:] = False
    assert factor_for(camera_of(gray), [source(gray, valid)], keypoints, 1200.0) == 2
    whole = extract(gray, valid, keypoints=keypoints, pixels_per_keypoint=0.0)
    fast = extract(gray, valid, keypoints=keypoints)
    assert len(fast.descriptors) == len(whole.descriptors) == keypoints
    distances, nearest = cKDTree(whole.keypoints_px).query(fast.keypoints_px)
    same = distances < 2.0
    assert same.mean() > 0.8
    assert np.median(distances[same]) < 0.15
    offset = fast.keypoints_px[same] - whole.keypoints_px[nearest[same]]
    assert np.abs(np.median(offset, axis=0)).max() < 0.03


@pytest.mark.slow
def test_a_view_is_not_reduced_where_it_would_have_too_few_keypoints():
    dull = np.full((1300, 1300), 90, np.uint8)
    dull[:300, :300] = texture(300, 300)
    settings = {"keypoints": 1000, "pixels_per_keypoint": 300.0}
    assert factor_for(camera_of(dull), [source(dull)], 1000, 300.0) == 2
    assert len(extract(dull, **settings).descriptors) == len(extract(dull, keypoints=1000).descriptors)


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"sigma": 2.4}, {"selection": "scale"}])
def test_a_view_is_not_reduced_where_its_strongest_blobs_are_the_smallest(more):
    noise = np.random.default_rng(3).normal(0.0, 40.0, (1300, 1300)).astype(np.float32)
    for blur_px, reduced in ((1.1, False), (5.0, True)):
        blurred = cv2.GaussianBlur(noise, (0, 0), blur_px)
        gray = np.clip(np.rint(110.0 + blurred * 25.0 / blurred.std()), 0, 255).astype(np.uint8)
        fast, whole = (extract(gray, keypoints=1200, pixels_per_keypoint=pixels, **more) for pixels in (900.0, 0.0))
        assert np.array_equal(fast.keypoints_px, whole.keypoints_px) is not reduced


def test_how_often_a_view_is_halved():
    large, small = source(np.zeros((4000, 6000), np.uint8)), source(np.zeros((600, 1000), np.uint8))
    camera = camera_of(large.gray)
    assert [factor_for(camera, [large], number, 1200.0) for number in (30_000, 20_000, 8_000, 4_000)] == [1, 1, 2, 4]
    assert factor_for(camera, [large, large, small], 20_000, 1200.0) == 1  # nor does their number
    assert factor_for(camera, [large], 10, 0.0) == 1
    assert factor_for(camera_of(small.gray), [small], 10, 1200.0) == 1  # it takes no time as it is
    # Neither a mask nor how much ground a view shows makes images of one camera differ.
    quarter = source(np.zeros((2000, 3000), np.uint8))
    assert factor_for(camera, [quarter], 8_000, 1200.0) == 2
    half = np.arange(4000 * 6000).reshape(4000, 6000) % 2 == 0
    assert factor_for(camera, [source(large.gray, half)], 8_000, 1200.0) == 2
    assert factor_for(camera_of(small.gray), [large], 100, 1200.0) == 1
    sliver = source(np.zeros((3, 4000), np.uint8))
    assert factor_for(camera, [large, sliver], 1_000, 1200.0) == 2


def test_fewer_only_where_fewer_exist():
    gray = texture(200, 150)
    everything = extract(gray, keypoints=10**6)
    assert len(extract(gray, keypoints=len(everything.descriptors) + 1).descriptors) == len(everything.descriptors)
    assert len(np.unique(everything.keypoints_px, axis=0)) > 0.9 * len(everything.keypoints_px)


def test_the_arrays_have_the_documented_types():
    features = extract(texture(300, 200), keypoints=50)
    count = len(features.descriptors)
    assert features.keypoints_px.dtype == np.float32
    assert features.descriptors.dtype == np.uint8
    assert features.descriptors.shape == (count, 128)
    assert features.descriptor_keypoint_idx.dtype == np.int32
    assert (np.diff(features.descriptor_keypoint_idx) >= 0).all()
    assert np.array_equal(features.view_sizes_px, [[300, 200]])
    rows = features.descriptor_keypoint_idx
    assert np.array_equal(features.view_keypoints_px, features.keypoints_px[rows])
    assert (features.view_orientation_deg >= 0).all()
    assert (features.view_orientation_deg <= 360).all()


def test_an_empty_picture_gives_empty_features_of_the_right_shapes():
    features = extract(np.full((64, 80), 127, np.uint8))
    assert features.keypoints_px.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert features.descriptors.dtype == np.uint8
    assert features.descriptor_keypoint_idx.dtype == np.int32
    assert features.view_keypoints_px.shape == (0, 2)
    assert features.view_sizes_px.shape == (1, 2)


def test_two_runs_are_equal_to_the_bit():
    gray = texture(300, 250)
    first, second = extract(gray, keypoints=300), extract(gray, keypoints=300)
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    assert all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def test_tiles_share_out_every_pixel_once_and_are_bounded():
    for width, height in [(5472, 3648), (2304, 1728), (4000, 2250), (11000, 700), (100, 90)]:
        layout = tiles(width, height, 4_000_000, 128)
        y, x = np.mgrid[0:height:7, 0:width:7]
        points = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
        owners = sum(tile.owns(points).astype(int) for tile in layout)
        assert (owners == 1).all()
        for tile in layout:
            assert (tile.x1 - tile.x0) * (tile.y1 - tile.y0) <= 4_000_000
            mine = points[tile.owns(points)]
            for low, high, values, end in (
                (tile.x0, tile.x1, mine[:, 0], width),
                (tile.y0, tile.y1, mine[:, 1], height),
            ):
                assert low == 0 or values.min() - low >= 120
                assert high == end or high - values.max() >= 120


@pytest.mark.slow
def test_tiles_find_the_same_keypoints(monkeypatch):
    gray = texture(800, 600, seed=3)
    whole = extract(gray, keypoints=10**6)
    monkeypatch.setattr(detection, "TILE_AREA_PX", 150_000)
    assert len(tiles(800, 600, 150_000, 128)) > 3
    tiled = extract(gray, keypoints=10**6)
    a = {(round(float(x), 2), round(float(y), 2)) for x, y in whole.keypoints_px}
    b = {(round(float(x), 2), round(float(y), 2)) for x, y in tiled.keypoints_px}
    assert len(a) > 2000
    assert len(a ^ b) < 0.01 * len(a)
    assert len(tiled.keypoints_px) == pytest.approx(len(whole.keypoints_px), rel=0.005)


def test_nothing_is_found_under_or_at_the_edge_of_a_mask():
    gray = texture(400, 300)
    valid = np.ones(gray.shape, dtype=bool)
    valid[:, 200:] = False
    gray[:, 200:] = 0
    features = extract(gray, valid, keypoints=10**6)
    assert len(features.keypoints_px) > 300
    assert (features.keypoints_px[:, 0] + features.sizes_px < 200).all()
    assert len(extract(gray, np.zeros_like(valid)).keypoints_px) == 0


def test_root_sift_has_length_512():
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 60, (50, 128)).astype(np.uint8)
    described = root_sift(raw)
    assert np.linalg.norm(described.astype(float), axis=1) == pytest.approx(np.full(50, 512.0), rel=0.005)
    expected = np.sqrt(raw / raw.sum(axis=1, keepdims=True, dtype=float)) * 512
    assert np.abs(described - expected).max() <= 0.5001
    assert root_sift(np.eye(128, dtype=np.uint8)[:1]).max() == 255
    assert root_sift(np.zeros((1, 128), np.uint8)).max() == 0


def shrunk_view(gray, factor=2):
    """The picture at half size as a view, in the pixel-centre convention."""
    height, width = gray.shape
    small = cv2.resize(gray, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    shift = (factor - 1) / 2
    warp = np.array([[factor, 0.0, shift], [0.0, factor, shift], [0.0, 0.0, 1.0]])
    view = View("half", width // factor, height // factor, warp, is_source=False, angle_deg=10.0)
    return ViewPixels(view, small, None)


def test_views_are_merged_in_source_pixels():
    rng = np.random.default_rng(5)
    centres = [
        (40.0 + 80 * i + rng.uniform(-1, 1), 40.0 + 80 * j + rng.uniform(-1, 1)) for i in range(4) for j in range(4)
    ]
    gray = blobs(centres, 6.0, size=320)
    features = Sift()(camera_of(gray), (source(gray), shrunk_view(gray)))
    assert set(features.view_idx.tolist()) == {0, 1}
    for centre in centres:
        near = np.flatnonzero((np.linalg.norm(features.keypoints_px - centre, axis=1) < 0.5) & (features.sizes_px > 8))
        assert len(near) == 1
        of_point = features.descriptor_keypoint_idx == near[0]
        assert set(features.view_idx[of_point].tolist()) == {0, 1}
        half = of_point & (features.view_idx == 1)
        assert features.view_keypoints_px[half][0] == pytest.approx((np.array(centre) - 0.5) / 2, abs=0.2)
        assert features.view_size_px[half][0] * 2 == pytest.approx(features.sizes_px[near[0]], rel=0.3)
    assert np.array_equal(features.view_sizes_px, [[320, 320], [160, 160]])
    assert features.view_angles_deg.tolist() == [0.0, 10.0]


def test_merging_by_hand():
    points = np.array([[5.0, 5.0], [5.0, 5.0], [9.0, 9.0], [5.4, 5.0], [20.0, 3.0], [9.3, 9.0]])
    sizes = np.array([4.0, 4.0, 4.0, 4.5, 2.0, 40.0])
    numbers, standing = merge_keypoints(points, sizes, np.array([0, 0, 0, 1, 1, 1]))
    # The fourth joins the first; the last one is near the third, but ten times as large.
    assert numbers.tolist() == [0, 0, 1, 0, 2, 3]
    assert standing.tolist() == [0, 2, 4, 5]
