"""scripts/bench rectification: Jacobians of mappings that are known, and the table, by hand."""

import argparse
import math

import numpy as np
import pytest
from benchmarks import rectification as bench
from benchmarks.views import ImageView

from aeromatch_cli.data import Camera, View
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.lab.synthetic import render_block

pytestmark = pytest.mark.slow

CAMERA = Camera("SIMPLE_PINHOLE", 200, 150, (180.0, 100.0, 75.0))


class Plane:
    """A truth in which image 1 shows what image 0 shows by a homography; right of x = hides, nothing is seen."""

    def __init__(self, matrix, hides=math.inf, step=math.inf):
        self.matrix, self.hides, self.step = matrix, hides, step

    def transfer(self, name0, points_px, name1):
        places = apply_homography(self.matrix, points_px)
        places[points_px[:, 0] > self.step] += [5.0, 0.0]
        return places, points_px[:, 0] > self.hides


def view(matrix, *, source=False, direction=(0.0, 0.0, -1.0), size=(200, 150)):
    return View("v", *size, np.asarray(matrix, float), source, angle_deg=0.0, world_direction=np.array(direction))


def side(matrix, **options):
    return ImageView("image", CAMERA, view(matrix, **options))


def similarity(scale, turn_deg):
    c, s = scale * math.cos(math.radians(turn_deg)), scale * math.sin(math.radians(turn_deg))
    about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    middle = np.array([[1.0, 0.0, 100.0], [0.0, 1.0, 75.0], [0.0, 0.0, 1.0]])
    return middle @ about @ np.linalg.inv(middle)


GRID = np.stack(np.meshgrid(np.arange(10.0, 191.0, 6.0), np.arange(10.0, 141.0, 6.0)), axis=2).reshape(-1, 2)


@pytest.mark.parametrize(("scale", "turn_deg"), [(1.0, 0.0), (1.4, 25.0), (0.6, -80.0), (0.9, 170.0)])
def test_scale_and_rotation_of_pictures_as_taken(scale, turn_deg):
    truth, as_taken = Plane(similarity(scale, turn_deg)), side(np.eye(3), source=True)
    found = bench.jacobians(truth, as_taken, as_taken, GRID)
    assert len(found) > 200
    expected = (max(scale, 1.0 / scale), abs(turn_deg), 1.0)
    assert bench.figures(found) == pytest.approx(expected, abs=1e-6)


def test_views_that_undo_the_mapping_leave_nothing():
    """View 1 is drawn through the mapping itself: what it shows lies where view 0 has it."""
    matrix = similarity(0.7, 40.0) @ np.array([[1.0, 0.2, 3.0], [0.0, 0.8, 5.0], [2e-4, 1e-4, 1.0]])
    sides = side(np.eye(3)), side(matrix)
    found = bench.jacobians(Plane(matrix), *sides, GRID)
    assert bench.figures(found) == pytest.approx((1.0, 0.0, 1.0), abs=1e-4)
    stretched = side(matrix @ np.diag([1.5, 1.0, 1.0]))
    scale, turn_deg, stretch = bench.figures(bench.jacobians(Plane(matrix), sides[0], stretched, GRID))
    assert (scale, turn_deg, stretch) == pytest.approx((math.sqrt(1.5), 0.0, 1.5), abs=1e-4)


def test_what_is_hidden_outside_or_at_an_edge_is_left_out():
    as_taken = side(np.eye(3), source=True)
    everything = len(bench.jacobians(Plane(np.eye(3)), as_taken, as_taken, GRID))
    assert everything == len(GRID)
    column = len(np.unique(GRID[:, 1]))
    hidden = bench.jacobians(Plane(np.eye(3), hides=100.0), as_taken, as_taken, GRID)
    assert len(hidden) == (GRID[:, 0] <= 99.5).sum()
    edge = bench.jacobians(Plane(np.eye(3), step=100.2), as_taken, as_taken, GRID)
    assert len(edge) == everything - column  # the points at x = 100 see the step half a pixel on
    small = side(np.eye(3), size=(100, 150))
    assert len(bench.jacobians(Plane(np.eye(3)), small, as_taken, GRID)) == (GRID[:, 0] <= 99.5).sum()
    mirrored = np.diag([-1.0, 1.0, 1.0])
    mirrored[0, 2] = 199.0
    assert len(bench.jacobians(Plane(mirrored), as_taken, as_taken, GRID)) == 0


def test_few_points_have_no_median():
    assert all(math.isnan(value) for value in bench.figures(np.repeat(np.eye(2)[None], 11, axis=0)))


def test_the_views_with_most_points_are_taken():
    truth = Plane(similarity(1.2, 10.0))
    small = [side(np.eye(3), size=(40, 40))]
    whole = [side(np.eye(3)), side(np.eye(3), direction=(0.6, 0.0, -0.8))]
    scale, turn_deg, _, points = bench.measured(truth, [*small, *whole], whole[:1])
    assert (scale, turn_deg) == pytest.approx((1.2, 10.0), abs=1e-6)
    assert points > 1000
    # Views of unlike directions, and views with pictures as taken, are not compared.
    assert bench.measured(truth, whole[1:], whole[:1])[3] == 0
    assert bench.measured(truth, [side(np.eye(3), source=True)], whole[:1])[3] == 0


def row(scene, angle_class, simulator, scale, turn_deg):
    return {
        "scene": scene, "seed": 1, "pair": ("a", "b"), "view_angle_deg": 30.0, "view_angle_class": angle_class,
        "simulator": simulator, "scale": scale, "turn_deg": turn_deg, "stretch": None if scale is None else 1.1,
        "points": 100,
    }  # fmt: skip


def test_the_table_counts_pairs_within_the_goal():
    rows = [row("city", "20-40", "ground", *values) for values in ((1.0, 2.0), (1.2, 12.0), (1.3, 1.0))]
    rows.append(row("hills", "40-60", "ground", None, None))
    lines = bench.table_of(rows).splitlines()
    assert "| 20-40 deg | `ground` | 3 | 1.20 | 1.28 | 67 % | 2.0 | 10.0 | 67 % | 33 % | 1.10 | 0 |" in lines
    assert "| 40-60 deg | `ground` | 1 | - | - | - | - | - | - | - | - | 1 |" in lines
    assert "| all | `ground` | 4 | 1.20 | 1.28 | 50 % | 2.0 | 10.0 | 50 % | 25 % | 1.10 | 1 |" in lines
    assert [bench.within(one) for one in rows] == [True, False, False, False]


def test_rectified_views_of_a_rendered_block_agree_in_scale_and_turn(tmp_path):
    """With exact poses every pair keeps the limits that nine of ten have to; as taken, few do."""
    render_block(tmp_path, "farmland", seed=2, width_px=160, height_px=120, images=10, flight="oblique")
    args = argparse.Namespace(simulators=["none", "neighbours"], pairs=99, exact=True)
    rows = list(bench.rows_of(tmp_path, "farmland", 0, args))
    within = {name: [bench.within(row) for row in rows if row["simulator"] == name] for name in ("none", "neighbours")}
    assert len(within["neighbours"]) >= 6
    assert all(within["neighbours"])
    assert sum(within["none"]) <= 0.5 * len(within["none"])
