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
OUT/rectification/results.json and OUT/rectification/table.md; OUT/scenes keeps the blocks.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from common import errors_as_exits, fill_in, publish, size_px
from methods.base import Options, Scene
from methods.goal_tables import markdown
from methods.ours import Preset
from methods.results import write_rows
from methods.scenes import EXACT_POSES, MIN_OVERLAP, NOISY_POSES, rendered_block
from methods.sources import code_digest
from methods.worker import limit_threads
from training_blocks import numbers

from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.evaluate import BlockTruth, open_truth
from aeromatch_cli.evaluate.overlap import sample_grid
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES
from aeromatch_cli.geometry.warps import source_from_view, view_from_source
from aeromatch_cli.stages import simulate
from aeromatch_cli.strategies.matchers.descriptors.search import Search
from aeromatch_cli.strategies.matchers.descriptors.views import alike
from aeromatch_cli.synthetic import Truth, load_truth
from aeromatch_cli.workspace import stable_hash

LARGEST_SCALE, LARGEST_TURN_DEG, GOAL = 1.25, 10.0, 0.9
FULL = {"scenes": "city,suburb,hills", "pairs": 12, "images": 25, "size": "480x360"}
QUICK = {"scenes": "hills", "pairs": 2, "images": 10, "size": "160x120"}
THREADS = 2
_SAMPLES, _STEP_PX = 2048, 0.5
_FEWEST = 12  # points that a pair's medians are taken over
# Forward and backward differences may differ by this share of the Jacobian's norm.
_SMOOTH = 0.2


@dataclass(frozen=True)
class Row:
    """One pair under one simulator. points: that the medians are of, NaN below 12 of them."""

    scene: str
    seed: int
    pair: tuple[str, str]
    view_angle_deg: float
    view_angle_class: str
    simulator: str
    scale: float
    turn_deg: float
    stretch: float
    points: int

    def listed(self) -> dict[str, Any]:
        """JSON-ready: null for unknown."""
        known = {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}
        return {key: None if value != value else value for key, value in known.items()}

    @property
    def within(self) -> bool:
        return self.scale <= LARGEST_SCALE and self.turn_deg <= LARGEST_TURN_DEG


@dataclass(frozen=True, eq=False)
class Side:
    """One picture of a pair and one view of it."""

    name: str
    camera: Camera
    view: View

    def places(self, stored_px: FloatArray) -> FloatArray:
        """View pixels (N, 2) of stored ones; a source view has these."""
        return stored_px if self.view.is_source else view_from_source(self.camera, self.matrix, stored_px)

    def stored(self, places_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of view pixels."""
        return places_px if self.view.is_source else source_from_view(self.camera, self.matrix, places_px)

    @property
    def matrix(self) -> FloatArray:
        return self.view.undistorted_from_view

    def holds(self, places_px: FloatArray) -> BoolArray:
        """Whether view pixels (N, 2) lie in the view."""
        last = np.array([self.view.width_px, self.view.height_px]) - 0.5
        with np.errstate(invalid="ignore"):
            return np.asarray(((places_px >= -0.5) & (places_px <= last)).all(axis=1))


def jacobians(truth: Truth, side0: Side, side1: Side, stored_px: FloatArray) -> FloatArray:
    """(N, 2, 2) of the true mapping from view 0 to view 1, where it is smooth and seen; stored pixels of image 0."""
    middle = side0.places(stored_px)
    middle = middle[side0.holds(middle)]
    steps = _STEP_PX * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    asked = (middle + steps[:, None]).reshape(-1, 2)
    there, hidden = truth.transfer(side0.name, side0.stored(asked), side1.name)
    places = side1.places(there)
    usable = (~hidden & side1.holds(places)).reshape(len(steps), -1).all(axis=0)
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
    return alike(directions0, directions1, source0, source1, Search.model_fields["max_direction_deg"].default)


def measured(truth: Truth, sides0: Sequence[Side], sides1: Sequence[Side]) -> tuple[float, float, float, int]:
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
    for pair in combinations(sorted(judge.cameras), 2):
        if judge.overlap_at_most(*pair) >= MIN_OVERLAP:
            found = judge.conditions(*pair)
            if found.overlap >= MIN_OVERLAP:
                classes[found.view_angle_class].append((pair, found.view_angle_deg, found.view_angle_class))
    rng = np.random.default_rng([seed, stable_hash(scene) % (1 << 32)])
    return sorted(members[i] for members in classes.values() for i in rng.permutation(len(members))[:pairs])


def rows_of(folder: Path, scene: str, seed: int, args: argparse.Namespace) -> Iterator[Row]:
    """Of all pairs of a block under all simulators."""
    judge, truth = open_truth(folder), load_truth(folder)
    pairs = chosen(judge, scene, seed, args.pairs)
    poses = folder / (EXACT_POSES if args.exact else NOISY_POSES)
    listed = tuple(pair for pair, _, _ in pairs)
    described = Scene(scene, folder / "images", poses, folder / "block.json", judge.cameras, listed)
    for simulator in args.simulators.split(","):
        options = Options(512, "image", THREADS, seed, None)
        preset = Preset(described, options, preset="baseline", settings=(f"simulate={simulator}",))
        context, sides = preset.context, {}
        for name in sorted({name for pair in listed for name in pair}):
            task = simulate.make_task(context, context.image_by_id[preset.id_of[name]])
            sides[name] = [Side(name, judge.cameras[name], view) for view in simulate.views_of(task)]
        for (name0, name1), angle_deg, angle_class in pairs:
            scale, turn_deg, stretch, points = measured(truth, sides[name0], sides[name1])
            yield Row(scene, seed, (name0, name1), angle_deg, angle_class, simulator, scale, turn_deg, stretch, points)


def table(rows: Sequence[Row]) -> str:
    """Markdown: by class over all scenes, then by scene over all classes, each simulator a line."""
    columns = (
        "pairs", "views", "number", "scale, median", "90 %", "within 1.25", "rotation, median", "90 %", "within 10 deg",
        "both", "stretch, median", "cannot be compared",
    )  # fmt: skip
    scenes = list(dict.fromkeys(row.scene for row in rows))
    groups = [(f"{name} deg", [r for r in rows if r.view_angle_class == name]) for name, _ in VIEW_ANGLE_CLASSES]
    groups += [(scene, [r for r in rows if r.scene == scene]) for scene in scenes] + [("all", list(rows))]
    lines = [
        [label, f"`{simulator}`", *_cells([r for r in members if r.simulator == simulator])]
        for label, members in groups
        for simulator in dict.fromkeys(row.simulator for row in members)
    ]
    return markdown(columns, lines)


def _cells(rows: Sequence[Row]) -> list[str]:
    """Pairs whose views share nothing count as not within."""
    known = [row for row in rows if np.isfinite(row.scale)]
    if not known:
        return [str(len(rows)), *["-"] * 8, str(len(rows))]
    scales, turns, stretches = (np.array([getattr(r, key) for r in known]) for key in ("scale", "turn_deg", "stretch"))
    counts = [sum(flags) for flags in (scales <= LARGEST_SCALE, turns <= LARGEST_TURN_DEG, [r.within for r in known])]
    shares = [f"{100 * count / len(rows):.0f} %" for count in counts]
    return [
        str(len(rows)),
        f"{np.median(scales):.2f}",
        f"{np.quantile(scales, GOAL):.2f}",
        shares[0],
        f"{np.median(turns):.1f}",
        f"{np.quantile(turns, GOAL):.1f}",
        shares[1],
        shares[2],
        f"{np.median(stretches):.2f}",
        str(len(rows) - len(known)),
    ]


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--simulators", default="none,ground,neighbours", help="comma-separated, with settings as for `simulate`")
    add("--scenes", help="comma-separated presets of rendered blocks")
    add("--pairs", type=int, help="of each block and class of view angle, at most")
    add("--seeds", type=numbers, default=[0], help="as 1,2 or 1-4: each gives other scenes, poses, pairs")
    add("--size", metavar="WxH", help="of rendered images")
    add("--images", type=int, help="of each rendered block, five at every place")
    add("--exact", action="store_true", help="poses without noise")
    add("--quick", action="store_true", help=f"small: {QUICK}")
    add("--readme", action="store_true", help="write the table into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    fill_in(args, QUICK if args.quick else FULL)
    return args


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    seeds = ",".join(str(seed) for seed in args.seeds)
    asked = f"--simulators {args.simulators} --scenes {args.scenes} --pairs {args.pairs} --seeds {seeds}"
    exact = " --exact" if args.exact else ""
    return f"scripts/bench_rectification {asked} --size {args.size} --images {args.images}{exact} --out DIR"


def main() -> None:
    args = parse()
    limit_threads(THREADS)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    (args.out / "scenes").mkdir(parents=True, exist_ok=True)
    (args.out / "rectification").mkdir(exist_ok=True)
    rows: list[Row] = []
    with errors_as_exits():
        for scene, seed in product(filter(None, args.scenes.split(",")), args.seeds):
            print(f"{scene}, seed {seed}", file=sys.stderr, flush=True)
            folder = rendered_block(
                args.out / "scenes",
                scene,
                seed,
                "oblique",
                size_px=size_px(args.size),
                images=args.images,
                jobs=THREADS,
                code=code_digest("synthetic"),
            )
            rows += rows_of(folder, scene, seed, args)
            write_rows(args.out / "rectification" / "results.json", [row.listed() for row in rows])
    text = table(rows) + "\n"
    markers = "bench_rectification" if args.readme else None
    publish(text, args.out / "rectification" / "table.md", markers, command(args))


if __name__ == "__main__":
    main()
