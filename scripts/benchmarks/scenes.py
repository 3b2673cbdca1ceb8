"""Rendered scenes and real blocks, and which of their pairs are judged: the same for every method."""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import BlockTruth, Conditions
from aeromatch_cli.evaluate.reference import ReferenceTruth
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES, class_of
from aeromatch_cli.files import write_json
from aeromatch_cli.fingerprints import fingerprint, stable_hash
from aeromatch_cli.geometry.cameras import corner_params, from_colmap
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.images.scaling import shrink, shrink_camera
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import render_block
from benchmarks.options import size_px
from benchmarks.peers.base import Scene
from benchmarks.peers.heights import Heights
from benchmarks.sources import code_digest
from benchmarks.stamps import TRAINED_ON

MIN_OVERLAP = 0.2
# Mean grey level of one image over that of the other from which a pair of real images is hard.
HARD_BRIGHTNESS_RATIO = 1.6
HARD, EASY = "hard", "easy"
# What pairs are chosen by: equal numbers of these kinds, the first ones more where others lack.
CONDITIONS = {
    HARD: (HARD,),
    EASY: (EASY,),
    "all": (HARD, EASY),
    "angles": tuple(name for name, _ in reversed(VIEW_ANGLE_CLASSES)),
}
# Classes of real pairs, each judged by itself: the view angle, that the images have different exposures, or that a
# network that ships has seen their block in training.
REAL_ANGLES = (("0-25", 25.0), ("25-40", 40.0), ("40-60", 60.0), (">60", math.inf))
TWO_EXPOSURES = "two exposures"
TRAINING = "blocks of the training"
REAL_CLASSES = (*(name for name, _ in REAL_ANGLES), TWO_EXPOSURES, TRAINING)
EXACT_POSES, NOISY_POSES = "poses.csv", "poses_noisy.csv"


@dataclass(frozen=True)
class Selection:
    """condition: "hard", "easy", "all" (half of each) or "angles" (a quarter of each view angle class, the larger ones
    first where some are short). pairs: of each scene."""

    condition: str
    pairs: int
    seed: int


@dataclass(frozen=True)
class JudgedPair:
    """A pair and what makes it hard. condition: "hard" or "easy", or of `real_blocks` one of REAL_CLASSES."""

    images: tuple[str, str]
    condition: str
    conditions: Conditions


@dataclass(frozen=True, eq=False)
class Judged:
    """A scene, who judges it, and its pairs. key: changes with the images, the truth and the choice of pairs. heights:
    of the reference points, where truth is no more than poses."""

    scene: Scene
    truth: BlockTruth
    pairs: tuple[JudgedPair, ...]
    key: str
    heights: Heights | None = None


def render_once(folder: Path, preset: str, *, jobs: int = 2, **asked: Any) -> Path:
    """Folder of a rendered block below `folder`; made unless it is there. asked: as of `render_block`."""
    # The renderer's code counts, so that pictures of an older one are not taken for its own.
    out = folder / f"{preset}-{fingerprint(preset, asked, code_digest('lab/synthetic'))[:12]}"
    if not (out / "truth.json").is_file():
        render_block(out, preset, jobs=jobs, **asked)
    return out


def render_asked(args: argparse.Namespace, preset: str, *, flight: str, seed: int | None = None) -> Path:
    """Folder of a block as the options of `add_rendered` ask for it, below OUT/scenes."""
    width_px, height_px = size_px(args.size)
    size = {"width_px": width_px, "height_px": height_px, "images": args.images}
    size |= {"lens": args.lens.upper()} if getattr(args, "lens", None) else {}
    return render_once(args.out / "scenes", preset, seed=args.seed if seed is None else seed, flight=flight, **size)


def rendered_scenes(args: argparse.Namespace, condition: str) -> Iterator[tuple[str, Judged]]:
    """Flight and scene of the blocks that the options ask for, one after the other, each made when it is needed."""
    selection = Selection(condition, args.pairs, args.seed)
    for flight, preset in product(args.flights, args.scenes):
        out = render_asked(args, preset, flight=flight)
        yield flight, judged_block(preset, out, selection)


def judged_block(name: str, folder: Path, selection: Selection) -> Judged:
    """A rendered block that lies there already."""
    return _judged(name, folder, open_truth(folder), selection, set())


def real(folder: Path, data: Path, block: str, selection: Selection, *, max_size_px: int) -> Judged:
    """A shared block with reference poses, its images reduced once to at most max_size_px."""
    out = _reduced(folder, data, block, max_size_px)
    return _judged(block, out, open_truth(out), selection, _differently_bright(out / "images"))


def real_blocks(
    folder: Path, data: Path, blocks: Sequence[str], per_class: int, seed: int, *, max_size_px: int
) -> list[Judged]:
    """Shared blocks with `per_class` pairs of each of REAL_CLASSES, the blocks in turn; fewer where there are no more.

    A pair of a block of the training, or under two exposures, counts there alone, whatever its view angle.
    """
    places = {block: _reduced(folder, data, block, max_size_px) for block in blocks}
    truths = {block: open_truth(out) for block, out in places.items()}
    known = {block for blocks in TRAINED_ON.values() for block in blocks}
    members: dict[str, list[tuple[float, str, JudgedPair]]] = {kind: [] for kind in REAL_CLASSES}
    for block, truth in truths.items():
        bright = _differently_bright(places[block] / "images")
        rng = np.random.default_rng([seed, stable_hash(block) % (1 << 32)])
        seen = list(overlapping(truth).items())
        ranks = dict.fromkeys(REAL_CLASSES, 0)
        for i in rng.permutation(len(seen)):
            images, found = seen[i]
            kind = TWO_EXPOSURES if images in bright else class_of(found.view_angle_deg, REAL_ANGLES)
            kind = TRAINING if block in known else kind
            members[kind].append((ranks[kind], block, JudgedPair(images, kind, found)))
            ranks[kind] += 1
    taken = [one for those in members.values() for one in sorted(those, key=lambda one: one[0])[:per_class]]
    chosen_of = {block: tuple(pair for _, of, pair in taken if of == block) for block in blocks}
    return [_of_pairs(block, places[block], truths[block], chosen_of[block]) for block in blocks if chosen_of[block]]


def _reduced(folder: Path, data: Path, block: str, max_size_px: int) -> Path:
    """Folder of a shared block's reduced copy, made unless it is there."""
    source = data / block
    if not (source / "reference" / "poses.csv").is_file():
        raise ConfigError(f"{source} is no block with reference poses: give --data and --blocks of such a folder")
    out = folder / f"{block}-{max_size_px}"
    points = Path("reference", "points.npz")
    if not (out / "block.json").is_file() or (source / points).is_file() > (out / points.name).is_file():
        _reduce(source, out, max_size_px)
    return out


def _judged(name: str, out: Path, truth: BlockTruth, selection: Selection, hard: set[tuple[str, str]]) -> Judged:
    seen = overlapping(truth)
    kinds = {images: HARD if found.hard or images in hard else EASY for images, found in seen.items()}
    candidates = [JudgedPair(images, kinds[images], found) for images, found in seen.items()]
    # Streams of their own, so that one scene's pairs do not depend on which others are judged.
    rng = np.random.default_rng([selection.seed, stable_hash(name) % (1 << 32)])
    return _of_pairs(name, out, truth, chosen(candidates, selection, rng))


def _of_pairs(name: str, out: Path, truth: BlockTruth, pairs: tuple[JudgedPair, ...]) -> Judged:
    listed = tuple(pair.images for pair in pairs)
    scene = Scene(name, out / "images", out / EXACT_POSES, out / "block.json", truth.cameras, listed)
    heights = None
    if isinstance(truth, ReferenceTruth) and (out / "points.npz").is_file():
        heights = Heights.of(out, truth)
    return Judged(scene, truth, pairs, _key(scene), heights)


def overlapping(truth: BlockTruth, least: float = MIN_OVERLAP) -> dict[tuple[str, str], Conditions]:
    """The pairs that overlap by so much at least, names in order, and what is known of them."""
    near = (pair for pair in combinations(sorted(truth.cameras), 2) if truth.overlap_at_most(*pair) >= least)
    found = {pair: truth.conditions(*pair) for pair in near}
    return {pair: conditions for pair, conditions in found.items() if conditions.overlap >= least}


def _key(scene: Scene) -> str:
    return fingerprint(scene.images.parent.name, scene.poses.name, scene.pairs)


def with_noisy_poses(judged: Judged) -> Judged | None:
    """The same scene and pairs with poses that have the block's noise; None where it has none (real blocks)."""
    poses = judged.scene.poses.with_name(NOISY_POSES)
    if not poses.is_file():
        return None
    scene = replace(judged.scene, poses=poses)
    return replace(judged, scene=scene, key=_key(scene))


def chosen(candidates: list[JudgedPair], selection: Selection, rng: np.random.Generator) -> tuple[JudgedPair, ...]:
    """As many pairs as asked, seeded, spread over the classes of view angle and of shadow, in the order of names.

    For "all" half of them are hard, for "angles" a quarter is of each class; where a scene has too few of one kind the
    others fill up.
    """
    kinds = CONDITIONS[selection.condition]
    of_kind = [[c for c in candidates if kind in (c.condition, c.conditions.view_angle_class)] for kind in kinds]
    orders = [_spread(members, rng) for members in of_kind]
    wanted = [selection.pairs // len(kinds)] * len(kinds)
    for k in range(selection.pairs - sum(wanted)):
        wanted[k] += 1
    taken = [order[:count] for order, count in zip(orders, wanted, strict=True)]
    rest = [pair for order, count in zip(orders, wanted, strict=True) for pair in order[count:]]
    pairs = [pair for part in taken for pair in part]
    pairs += rest[: selection.pairs - len(pairs)]
    return tuple(sorted(pairs, key=lambda pair: pair.images))


def _spread(candidates: list[JudgedPair], rng: np.random.Generator) -> list[JudgedPair]:
    """All of them, the classes in turn, at random within a class; the order of the classes is random too."""
    classes: dict[tuple[str, str], list[JudgedPair]] = {}
    for i in rng.permutation(len(candidates)):
        pair = candidates[i]
        classes.setdefault((pair.conditions.view_angle_class, pair.conditions.shadow_class), []).append(pair)
    turns = [(turn, rank, pair) for rank, pairs in enumerate(classes.values()) for turn, pair in enumerate(pairs)]
    return [pair for _, _, pair in sorted(turns, key=lambda item: item[:2])]


def brightness_of(images: Path) -> dict[str, float]:
    """Mean grey level of every image of a folder, by name in order."""
    return {path.name: float(read_pixels(path, colour=False).mean()) for path in sorted(images.iterdir())}


def _differently_bright(images: Path) -> set[tuple[str, str]]:
    grey = brightness_of(images)
    ratio = {(a, b): max(grey[a], grey[b]) / max(min(grey[a], grey[b]), 1.0) for a, b in combinations(grey, 2)}
    return {images for images, value in ratio.items() if value >= HARD_BRIGHTNESS_RATIO}


def _reduce(source: Path, out: Path, max_size_px: int) -> None:
    """Copies of a block's images of at most max_size_px and of its reference, with half-pixel correct cameras."""
    import cv2

    (out / "images").mkdir(parents=True, exist_ok=True)
    facts: dict[str, Any] = json.loads((source / "reference" / "block.json").read_text(encoding="utf-8"))
    longest = max(max(lens["width"], lens["height"]) for lens in facts["cameras"].values())
    scale = min(1.0, max_size_px / longest)
    for path in sorted((source / "images").iterdir()):
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is not None:
            cv2.imwrite(str(out / "images" / path.name), shrink(pixels, scale), [cv2.IMWRITE_JPEG_QUALITY, 98])
    for lens in facts["cameras"].values():
        camera = from_colmap(lens["model"], lens["width"], lens["height"], tuple(lens["params"]))
        small = shrink_camera(camera, scale)
        lens.update(width=small.width_px, height=small.height_px, params=list(corner_params(small)))
    for path in (source / "reference" / "poses.csv", source / "reference" / "points.npz"):
        if path.is_file():
            shutil.copy(path, out / path.name)
    write_json(out / "block.json", facts)  # last: it says that the rest is there
