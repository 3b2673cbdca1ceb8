"""The picture at the top of the README: one hard pair of a rendered city, matched by SIFT and by a preset.

Both sides have the same number of descriptors per image. The pair is seen from directions 54 degrees apart, under two
suns. Every match is judged by the exact geometry of the render: correct within 3 px in both directions (green), else
wrong (red). SIFT is OpenCV's on the images as they were taken, with mutual nearest neighbours and the ratio test; the
count after verification by a fundamental matrix is printed too. The preset runs over the whole block, noisy poses.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import FloatArray
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.rendered import RenderedTruth
from aeromatch_cli.lab.synthetic import load_truth
from aeromatch_cli.stages.run import execute
from aeromatch_cli.store.matches import match_points
from aeromatch_cli.store.opened import OpenedBlock
from benchmarks import options
from benchmarks.peers.base import Options, Scene
from benchmarks.peers.matching import RATIO, mutual_nearest
from benchmarks.peers.opencv import OpenCvSift
from benchmarks.scenes import EXACT_POSES, NOISY_POSES, render_once
from benchmarks.stamps import REPOSITORY

GREEN, RED = "#2fd04f", "#ff2d2d"
WIDTH_IN, GAP, JPEG_QUALITY, DPI = 11.0, 0.03, 72, 100


@dataclass(frozen=True, eq=False)
class Side:
    """One half of the picture. points (M, 2): stored pixels of the matches kept; correct (M,): by the truth."""

    title: str
    points0_px: FloatArray
    points1_px: FloatArray
    correct: np.ndarray

    @property
    def counts(self) -> str:
        return f"{int(self.correct.sum())} correct, {int((~self.correct).sum())} wrong"


def main(arguments: Sequence[str]) -> None:
    """Render the block, match it both ways, write the JPEG, print the counts."""
    given = _options(arguments)
    size = {"width_px": 1000, "height_px": 750, "images": given.images}
    block = render_once(given.out, given.scene, seed=given.seed, flight=given.flight, **size)
    work = given.out / f"work-{block.name}"
    inputs = {
        "images": str(block / "images"), "poses": str(block / NOISY_POSES), "cameras": str(block / "block.json"),
    }  # fmt: skip
    settings = load(given.preset, [f"extract.keypoints={given.keypoints}"], inputs, workspace=str(work.absolute()))
    execute("run", settings)
    truth = RenderedTruth(load_truth(block), block / "images")
    name0, name1 = given.pair
    angle = truth.conditions(name0, name1).view_angle_deg
    sides = [_sift(block, truth, name0, name1, given.keypoints), _preset(work, truth, name0, name1, given.preset)]
    _draw(given.picture, [read_pixels(block / "images" / name, colour=True) for name in given.pair], sides)
    print(f"{name0} and {name1}, {angle:.0f} degrees apart, {given.keypoints} descriptors per image")
    for side in sides:
        print(f"{side.title}: {side.counts}")
    print(f"written to {given.picture} ({given.picture.stat().st_size / 1e3:.0f} kB)")


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = options.make_parser("picture", __doc__)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the block and its workspace")
    add("--picture", type=Path, default=REPOSITORY / ".assets" / "pair.jpg", metavar="FILE", help="the JPEG")
    add("--scene", default="city")
    add("--flight", default="mixed")
    add("--seed", type=int, default=1, help="another seed gives other blocks")
    add("--images", type=options.positive, default=16)
    add("--pair", type=options.names, default="city_0004.jpg,city_0010.jpg", metavar="NAME,NAME")
    add("--preset", default="oblique")
    add("--keypoints", type=options.positive, default=4000, help="descriptors per image, of either side")
    return options.parse(parser, arguments)


def _sift(block: Path, truth: RenderedTruth, name0: str, name1: str, keypoints: int) -> Side:
    """The peer `opencv-sift`: mutual nearest neighbours that pass the ratio test, before any geometric check."""
    scene = Scene(block.name, block / "images", block / EXACT_POSES, block / "block.json", truth.cameras, ())
    peer = OpenCvSift(scene, Options(keypoints, "image", 1, 0, None))
    first, second = peer.features(name0), peer.features(name1)
    rows, columns, scores = mutual_nearest(first.descriptors, second.descriptors, RATIO)
    points = first.places_px[rows], second.places_px[columns]
    places = [first.places_px, second.places_px]
    verified = peer.match(name0, name1, first, second)
    print(f"SIFT verified by a fundamental matrix (MAGSAC++, 15 inliers at least): {len(verified.points0_px)} matches")
    return _judged("SIFT, ratio test, source images", truth, (name0, name1), places, points, scores)


def _preset(work: Path, truth: RenderedTruth, name0: str, name1: str, preset: str) -> Side:
    """The verified matches of the pair in the workspace."""
    block = OpenedBlock(work)
    pair = next(p for p in block.pairs if (block.names[p.image_id0], block.names[p.image_id1]) == (name0, name1))
    entry = block.final(pair)
    assert entry is not None
    all_px = [block.keypoints_px(i) for i in (pair.image_id0, pair.image_id1)]
    points = match_points(entry.matches, *all_px)
    return _judged(f"preset {preset}", truth, (name0, name1), all_px, points, entry.matches.scores)


def _judged(
    title: str,
    truth: RenderedTruth,
    names: tuple[str, str],
    keypoints_px: Sequence[FloatArray],
    points_px: Sequence[FloatArray],
    scores: Any,
) -> Side:
    score = truth.judge(*names, *keypoints_px, *points_px, np.asarray(scores, dtype=np.float64))
    correct = np.isin(score.kept_idx, score.correct_idx)
    return Side(title, points_px[0][score.kept_idx], points_px[1][score.kept_idx], correct)


def _draw(path: Path, pictures: Sequence[Any], sides: Sequence[Side]) -> None:
    """Two columns, one per side; the pair one above the other, a line per match."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection

    height, width = pictures[0].shape[:2]
    gap = round(GAP * height)
    stacked = np.full((2 * height + gap, width, 3), 255, np.uint8)
    stacked[:height], stacked[height + gap :] = pictures[0], pictures[1]
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH_IN, WIDTH_IN * 0.5 * stacked.shape[0] / width + 0.1))
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.005, top=0.955, wspace=0.015)
    for axis, side in zip(axes, sides, strict=True):
        axis.imshow(stacked, interpolation="lanczos")
        ends1 = side.points1_px + np.array([0, height + gap])
        # Wrong ones first, so that they hide nothing.
        for kind, colour, strength in ((~side.correct, RED, 0.75), (side.correct, GREEN, 0.45)):
            lines = np.stack([side.points0_px[kind], ends1[kind]], axis=1)
            axis.add_collection(LineCollection(list(lines), colors=colour, linewidths=0.8, alpha=strength))
            ends = lines.reshape(-1, 2)
            axis.scatter(ends[:, 0], ends[:, 1], s=5, color=colour, linewidths=0)
        axis.set_title(f"{side.title}: {side.counts}", fontsize=13)
        axis.set_xlim(-0.5, width - 0.5)
        axis.set_ylim(stacked.shape[0] - 0.5, -0.5)
        axis.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI, pil_kwargs={"quality": JPEG_QUALITY, "optimize": True, "progressive": True})
    plt.close(figure)
