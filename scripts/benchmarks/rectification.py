"""What scale and rotation remain between the views of two oblique pictures, by exact truth.

Rendered blocks of a five-camera rig (flight `oblique`), pairs that overlap by a fifth at least, as many of each class
of view angle as asked. The blocks of one seed share the noise of their poses, picture by picture: several seeds are as
many draws of it. Views are made by the simulators of --simulators from poses with the block's noise; with `none`
the pictures are compared as they were taken. A pair is compared in those of its like views that show most of the
overlap.

The true mapping from view 0 to view 1 is differentiated at a grid of points: pixel -> surface -> pixel, central
differences over half a view pixel. Points that either image does not see are left out, and those at edges, where
forward and backward differences disagree. Of the Jacobian, sqrt |det| is the scale, as s or 1/s, whichever is larger;
the rotation is that of its polar decomposition; the stretch is the ratio of its singular values. A pair's figures are
medians over its points. Goal: 90 % of the pairs within a scale of 1.25 and 10 degrees.

Nothing is matched, so that small pictures do: angles and ratios of scales do not depend on their size. Writes
OUT/rectification.json and OUT/rectification.md; OUT/scenes keeps the blocks.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import BoolArray, FloatArray, View
from aeromatch_cli.evaluate import BlockTruth
from aeromatch_cli.evaluate.overlap import sample_grid
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES
from aeromatch_cli.fingerprints import stable_hash
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import Truth, load_truth
from aeromatch_cli.stages import simulate
from aeromatch_cli.strategies.matchers.descriptors.search import Search, comparable
from benchmarks import options, stamps
from benchmarks.peers.base import Options, Scene
from benchmarks.peers.ours import Preset
from benchmarks.processes import limit_threads
from benchmarks.scenes import EXACT_POSES, NOISY_POSES, overlapping, render_asked
from benchmarks.tables import Column, Row, code, grouped, number, percent, plain, table, values, write_rows
from benchmarks.views import ImageView, inside

LARGEST_SCALE, LARGEST_TURN_DEG, GOAL = 1.25, 10.0, 0.9
QUICK = {"scenes": "hills", "pairs": 2, "images": 10, "size": "160x120"}
THREADS = 2
_SAMPLES, _STEP_PX = 2048, 0.5
_FEWEST = 12  # points that a pair's medians are taken over
# Forward and backward differences may differ by this share of the Jacobian's norm.
_SMOOTH = 0.2


def jacobians(truth: Truth, side0: ImageView, side1: ImageView, stored_px: FloatArray) -> FloatArray:
    """(N, 2, 2) of the true mapping from view 0 to view 1, where it is smooth and seen; stored pixels of image 0."""
    middle = side0.from_stored(stored_px)
    middle = middle[inside(middle, side0.view)]
    steps = _STEP_PX * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    asked = (middle + steps[:, None]).reshape(-1, 2)
    there, hidden = truth.transfer(side0.image, side0.stored_px(asked), side1.image)
    places = side1.from_stored(there)
    usable = (~hidden & inside(places, side1.view)).reshape(len(steps), -1).all(axis=0)
    at, right, below, left, above = places.reshape(len(steps), -1, 2)[:, usable]
    forward = np.stack([right - at, below - at], axis=2) / _STEP_PX
    backward = np.stack([at - left, at - above], axis=2) / _STEP_PX
    both = (forward + backward) / 2.0
    apart, size = (np.linalg.norm(m, axis=(1, 2)) for m in (forward - backward, both))
    # A surface that both see is not mirrored.
    return np.asarray(both[(apart <= _SMOOTH * size) & (np.linalg.det(both) > 0.0)])


def figures(found: FloatArray) -> tuple[float, float, float]:
    """Median scale (>= 1), rotation in degrees and stretch of Jacobians (N, 2, 2); NaN for fewer than 12."""
    if len(found) < _FEWEST:
        return float("nan"), float("nan"), float("nan")
    scales = np.sqrt(np.linalg.det(found))
    turns = np.arctan2(found[:, 1, 0] - found[:, 0, 1], found[:, 0, 0] + found[:, 1, 1])
    values = np.linalg.svd(found, compute_uv=False)
    medians = [np.median(v) for v in (np.maximum(scales, 1.0 / scales), np.abs(turns), values[:, 0] / values[:, 1])]
    return float(medians[0]), float(np.rad2deg(medians[1])), float(medians[2])


def like(views0: Sequence[View], views1: Sequence[View]) -> BoolArray:
    """(V0, V1) which views the matchers would compare."""
    unknown = np.full(3, np.nan)
    directions0, directions1 = (
        np.array([unknown if view.world_direction is None else view.world_direction for view in views])
        for views in (views0, views1)
    )
    source0, source1 = (np.array([view.is_source for view in views]) for views in (views0, views1))
    return comparable(directions0, directions1, source0, source1, Search.model_fields["max_direction_deg"].default)


def measured(truth: Truth, sides0: Sequence[ImageView], sides1: Sequence[ImageView]) -> tuple[float, float, float, int]:
    """Figures and number of points of the like views with most points."""
    grid_px = sample_grid(sides0[0].camera, _SAMPLES)
    found: list[FloatArray] = [np.zeros((0, 2, 2))]
    compared = like([side.view for side in sides0], [side.view for side in sides1])
    found += [jacobians(truth, sides0[i], sides1[j], grid_px) for i, j in np.argwhere(compared)]
    most = max(found, key=len)
    return *figures(most), len(most)


def chosen(judge: BlockTruth, scene: str, seed: int, pairs: int) -> list[tuple[tuple[str, str], float, str]]:
    """Pairs, their view angles and classes: at most `pairs` of each class, seeded."""
    classes: dict[str, list[tuple[tuple[str, str], float, str]]] = {name: [] for name, _ in VIEW_ANGLE_CLASSES}
    for pair, found in overlapping(judge).items():
        classes[found.view_angle_class].append((pair, found.view_angle_deg, found.view_angle_class))
    rng = np.random.default_rng([seed, stable_hash(scene) % (1 << 32)])
    return sorted(members[i] for members in classes.values() for i in rng.permutation(len(members))[:pairs])


def rows_of(folder: Path, scene: str, seed: int, args: argparse.Namespace) -> Iterator[Row]:
    """A row for each pair of a block and simulator. points: that the medians are of, unknown below 12 of them."""
    judge, truth = open_truth(folder), load_truth(folder)
    pairs = chosen(judge, scene, seed, args.pairs)
    poses = folder / (EXACT_POSES if args.exact else NOISY_POSES)
    listed = tuple(pair for pair, _, _ in pairs)
    described = Scene(scene, folder / "images", poses, folder / "block.json", judge.cameras, listed)
    for simulator in args.simulators:
        limits = Options(512, "image", THREADS, seed, None)
        preset = Preset(described, limits, preset="baseline", settings=(f"simulate={simulator}",))
        context, sides = preset.context, {}
        for name in sorted({name for pair in listed for name in pair}):
            task = simulate.make_task(context, context.image_by_id[preset.id_of[name]])
            sides[name] = [ImageView(name, judge.cameras[name], view) for view in simulate.views_of(task)]
        for (name0, name1), angle_deg, angle_class in pairs:
            head = {"scene": scene, "seed": seed, "pair": (name0, name1), "view_angle_deg": plain(angle_deg)}
            scale, turn_deg, stretch, points = measured(truth, sides[name0], sides[name1])
            row = {"scale": plain(scale), "turn_deg": plain(turn_deg), "stretch": plain(stretch), "points": points}
            yield head | {"view_angle_class": angle_class, "simulator": simulator} | row


def within(row: Row) -> bool:
    """Whether a pair keeps both limits; one whose views share nothing does not."""
    known = row["scale"] is not None
    return known and row["scale"] <= LARGEST_SCALE and row["turn_deg"] <= LARGEST_TURN_DEG


def _share(rows: Sequence[Row], field: str, limit: float) -> str:
    return percent(sum(value <= limit for value in values(rows, field)) / len(rows)) if values(rows, field) else "-"


def _quantile(rows: Sequence[Row], field: str, share: float, digits: int) -> str:
    found = values(rows, field)
    return number(float(np.quantile(found, share)) if found else math.nan, digits)


# Pairs whose views share nothing count as not within.
_COLUMNS: tuple[Column[Sequence[Row]], ...] = (
    ("number", len),
    ("scale, median", lambda rows: _quantile(rows, "scale", 0.5, 2)),
    ("90 %", lambda rows: _quantile(rows, "scale", GOAL, 2)),
    ("within 1.25", lambda rows: _share(rows, "scale", LARGEST_SCALE)),
    ("rotation, median", lambda rows: _quantile(rows, "turn_deg", 0.5, 1)),
    ("90 %", lambda rows: _quantile(rows, "turn_deg", GOAL, 1)),
    ("within 10 deg", lambda rows: _share(rows, "turn_deg", LARGEST_TURN_DEG)),
    ("both", lambda rows: percent(sum(map(within, rows)) / len(rows)) if values(rows, "scale") else "-"),
    ("stretch, median", lambda rows: _quantile(rows, "stretch", 0.5, 2)),
    ("cannot be compared", lambda rows: len(rows) - len(values(rows, "scale"))),
)


def table_of(rows: Sequence[Row]) -> str:
    """By class over all scenes, then by scene over all classes, each simulator a line."""
    groups = [(f"{name} deg", [r for r in rows if r["view_angle_class"] == name]) for name, _ in VIEW_ANGLE_CLASSES]
    groups += [*((scene, own) for (scene,), own in grouped(rows, "scene")), ("all", list(rows))]
    lines = [
        ((label, code(simulator)), own)
        for label, members in groups
        for (simulator,), own in grouped(members, "simulator")
    ]
    return table(("pairs", "views"), lines, _COLUMNS)


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("rectification", __doc__)
    add = parser.add_argument
    about = "comma-separated, with settings as for `simulate`"
    add("--simulators", type=options.names, default="none,ground,neighbours", help=about)
    add("--scenes", type=options.names, default="city,suburb,hills", help="rendered blocks, comma-separated")
    add("--pairs", type=options.positive, default=12, help="of each block and class of view angle, at most")
    add("--seeds", type=options.numbers, default="0", help="as 1,2 or 1-4: each gives other scenes, poses, pairs")
    add("--size", metavar="WxH", default="480x360", help="of rendered images")
    add("--images", type=options.positive, default=25, help="of each rendered block, five at every place")
    add("--exact", action="store_true", help="poses without noise")
    options.add_output(parser)
    return parser


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments, QUICK)
    limit_threads(THREADS)
    rows: list[Row] = []
    for scene, seed in product(args.scenes, args.seeds):
        print(f"{scene}, seed {seed}", file=sys.stderr, flush=True)
        rows += rows_of(render_asked(args, scene, flight="oblique", seed=seed), scene, seed, args)
        write_rows(args.out / "rectification.json", rows)
    used = (load("baseline", [f"simulate={simulator}"]) for simulator in args.simulators)
    options.publish(
        args, table_of(rows) + "\n", args.out / "rectification.md", table="bench_rectification",
        command=options.command_line(parser, args),
        versions=stamps.of_settings(*used, families=("pairs", "simulate", "match")),
    )  # fmt: skip
