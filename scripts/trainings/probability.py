"""Weights of the probability that a match is right, from rendered blocks with exact truth.

Every block is one `aeromatch run auto` with its noisy poses. Of the verified matches, before any is dropped, that do
not contradict the adjusted block (or, of images that it lacks, the geometry of their pair),
`aeromatch_cli.sfm.probability` says how likely each is to be right: within 3 px of the exact place, which both images
see. The weights are found from the blocks of --fit and printed: WEIGHTS of that module are those of

    scripts/train probability --flights mixed,oblique --fit 931,943 --seed 917 --out DIR

Blocks of --seed, which no weight saw, say how far they hold: by stated probability, the share that is right. What OUT
has is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from benchmarks import options
from benchmarks.processes import limit_threads
from benchmarks.scenes import NOISY_POSES, render_asked
from benchmarks.tables import markdown, percent
from benchmarks.whole import whole_run

from aeromatch_cli.data import AdjustedBlock, BoolArray, Camera, FloatArray
from aeromatch_cli.evaluate.scores import CORRECT_PX
from aeromatch_cli.formats.adjusted import read_adjusted
from aeromatch_cli.formats.features import read_final_keypoints
from aeromatch_cli.formats.rows import read_verified_row
from aeromatch_cli.formats.tables import read_cameras, read_images, read_poses
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.sfm.outlier_rejection import Limits, MatchedKeypoints, Settled
from aeromatch_cli.sfm.probability import WEIGHTS, columns, fitted_weights, stated, usual_off_px
from aeromatch_cli.sfm.two_view_poses import placed_alone
from aeromatch_cli.strategies.consistencies import BlockConsistency
from aeromatch_cli.workspace import Workspace

_EDGES = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98, 1.0)

Block = tuple[str, FloatArray, BoolArray]


def block_of(args: argparse.Namespace, scene: str, flight: str, seed: int) -> Block:
    """Name, `columns` (M, F) of the matches of a block, and which of them (M,) are right."""
    name = f"{scene}:{flight}, seed {seed}"
    work = args.out / "runs" / f"{scene}-{flight}-{seed}"
    block = render_asked(args, scene, flight=flight, seed=seed)
    made = work.with_name(f"{work.name}.made")
    if not made.is_file():
        given = ["--poses", str(block / NOISY_POSES), "--cameras", str(block / "block.json"), "--crs", "local"]
        settings = [f"extract.keypoints={args.keypoints}", f"cascade.learned.keypoints={args.keypoints}"]
        run = whole_run("run", "auto", block / "images", work, extra=given, jobs=args.jobs, settings=settings)
        if not run.answer:
            raise SystemExit(f"aeromatch run on {name} failed with exit code {run.code}:\n{run.said}")
        made.touch()
    return name, *_judged(Workspace(work), block)


def _judged(workspace: Workspace, truth_folder: Path) -> tuple[FloatArray, BoolArray]:
    """`columns` of all matches of a workspace that do not contradict its adjusted block, or the geometry of a pair that
    the block lacks, and which are right."""
    truth = open_truth(truth_folder)
    images = {image.image_id: image for image in read_images(workspace.images)}
    block = read_adjusted(workspace.adjusted) if workspace.adjusted.is_file() else AdjustedBlock.empty()
    before = read_cameras(workspace.cameras)
    cameras = {i: {**before, **block.cameras}[image.camera_id] for i, image in images.items()}
    keypoints = {
        i: np.asarray(read_final_keypoints(workspace.features(i), workspace.refined(i)), float) for i in images
    }
    lenses = {i: before[image.camera_id] for i, image in images.items()}
    pairs = list(_pairs(workspace, block, lenses, keypoints))
    recipe = BlockConsistency()
    limits = Limits(recipe.epipolar_px, recipe.medians, recipe.third_image_px)
    parts, right = [np.zeros((0, len(WEIGHTS)))], [np.zeros(0, dtype=bool)]
    settled = Settled.of(block, cameras, keypoints.__getitem__, pairs, limits)
    masks, known = settled.with_lone_pairs(cameras, keypoints.__getitem__, limits)
    usual_px = usual_off_px(evidence for evidence in known if evidence is not None)
    for pair, mask, evidence in zip(pairs, masks, known, strict=True):
        if mask is None or evidence is None:
            continue
        ends = pair.image_id0, pair.image_id1
        points = [keypoints[i][pair.indices[~mask, side]] for side, i in enumerate(ends)]
        errors_px, hidden = truth.errors(images[ends[0]].name, images[ends[1]].name, *points)
        parts.append(columns(evidence, usual_px))
        right.append((np.nan_to_num(errors_px, nan=np.inf) <= CORRECT_PX) & ~hidden)
    return np.concatenate(parts), np.concatenate(right)


def _pairs(
    workspace: Workspace, block: AdjustedBlock, cameras: Mapping[str, Camera], keypoints: Mapping[str, FloatArray]
) -> Iterator[MatchedKeypoints]:
    """All verified ones, those that the block lacks with their own geometry. cameras: those of the verification."""
    poses = read_poses(workspace.poses)
    for image_id in sorted(cameras):
        path = workspace.verified(image_id)
        for entry in read_verified_row(path).values() if path.is_file() else ():
            if entry.verdict.state == "verified":
                alone = placed_alone(block, image_id, entry, cameras, keypoints.__getitem__, poses.get(image_id))
                yield MatchedKeypoints(image_id, entry.image_id1, entry.matches.indices, entry.matches.scores, alone)


def blocks_of(args: argparse.Namespace, seeds: Sequence[int]) -> Iterator[Block]:
    for seed in seeds:
        for flight in args.flights:
            for scene in args.scenes:
                yield block_of(args, scene, flight, seed)
                print(f"{scene}:{flight}, seed {seed}", file=sys.stderr, flush=True)


def together(blocks: Sequence[Block]) -> tuple[FloatArray, BoolArray]:
    """`columns` of all blocks, and which matches are right."""
    return np.concatenate([values for _, values, _ in blocks]), np.concatenate([right for _, _, right in blocks])


def table_of(values: FloatArray, right: BoolArray) -> str:
    """A line for every class of stated probability."""
    p = stated(values)
    number_of = np.digitize(p, _EDGES[1:-1])
    lines = [
        [f"{low:g} to {high:g}", int(own.sum()), percent(p[own].mean(), 1), percent(right[own].mean(), 1)]
        for k, (low, high) in enumerate(pairwise(_EDGES))
        if (own := number_of == k).any()
    ]
    return markdown(["probability", "matches", "stated", "right"], lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("probability", __doc__)
    add = parser.add_argument
    options.add_rendered(parser, scenes=",".join(PRESETS), size="640x480", images=7, flights="nadir,mixed")
    add("--fit", type=options.numbers, help="seeds of the blocks from which the weights are found, comma-separated")
    add("--keypoints", type=options.positive, default=2048, help="descriptors per image, of every step of the cascade")
    add("--jobs", type=options.positive, default=2)
    add("--out", type=Path, required=True, help="folder of results; a killed run goes on where it was")
    args = options.parse(parser, arguments, {"scenes": "suburb", "flights": "nadir", "size": "480x360"})
    if args.fit and args.seed in args.fit:
        parser.error(f"--fit holds {args.seed}, the seed of the blocks that are judged: give others")
    limit_threads(2)
    if args.fit:
        weights = fitted_weights(*together(list(blocks_of(args, args.fit))))
        print("WEIGHTS =", tuple(round(float(weight), 3) for weight in weights))
    print(table_of(*together(list(blocks_of(args, [args.seed])))))
