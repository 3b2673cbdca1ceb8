"""Rendered scenes and real blocks, and which of their pairs are judged: the same for every method."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import BlockTruth, Conditions, open_truth
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES
from aeromatch_cli.geometry.cameras import colmap_params, from_colmap
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.images.scaling import shrink, shrink_camera
from aeromatch_cli.synthetic import render_block
from aeromatch_cli.workspace import fingerprint, stable_hash, write_json
from methods.base import Scene

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
MIXED = "mixed"  # the flight of all benchmarks that name no other
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
    """A pair and what makes it hard. condition: "hard" or "easy"."""

    images: tuple[str, str]
    condition: str
    conditions: Conditions


@dataclass(frozen=True, eq=False)
class Judged:
    """A scene, who judges it, and its pairs. key: changes with the images, the truth and the choice of pairs."""

    scene: Scene
    truth: BlockTruth
    pairs: tuple[JudgedPair, ...]
    key: str


def rendered(
    folder: Path,
    preset: str,
    selection: Selection,
    *,
    size_px: tuple[int, int],
    images: int,
    jobs: int,
    code: str,
    flight: str = MIXED,
) -> Judged:
    """A block of this preset and flight, rendered below `folder` unless it is there already; code as in its folder."""
    out = rendered_block(folder, preset, selection.seed, flight, size_px=size_px, images=images, jobs=jobs, code=code)
    return _judged(preset, out, open_truth(out), selection, set())


def rendered_block(
    folder: Path, preset: str, seed: int, flight: str, *, size_px: tuple[int, int], images: int, jobs: int, code: str
) -> Path:
    """Folder of the block below `folder`, rendered unless it is there already.

    code: digest of the renderer, so that pictures of an older one are not taken for its own.
    """
    asked = {"seed": seed, "width_px": size_px[0], "height_px": size_px[1], "images": images}
    flown = () if flight == MIXED else (flight,)
    out = folder / f"{preset}-{fingerprint(preset, asked, code, *flown)[:12]}"
    if not (out / "truth.json").is_file():
        render_block(out, preset, flight=flight, jobs=jobs, **asked)  # type: ignore[arg-type]
    return out


def real(folder: Path, data: Path, block: str, selection: Selection, *, max_size_px: int) -> Judged:
    """A shared block with reference poses, its images reduced once to at most max_size_px."""
    source = data / block
    if not (source / "reference" / "poses.csv").is_file():
        raise ConfigError(f"{source} is no block with reference poses: give --data and --blocks of such a folder")
    out = folder / f"{block}-{max_size_px}"
    if not (out / "block.json").is_file():
        _reduce(source, out, max_size_px)
    truth = open_truth(out)
    return _judged(block, out, truth, selection, _differently_bright(out / "images", sorted(truth.cameras)))


def _judged(name: str, out: Path, truth: BlockTruth, selection: Selection, hard: set[tuple[str, str]]) -> Judged:
    candidates = []
    for images in combinations(sorted(truth.cameras), 2):
        if truth.overlap_at_most(*images) < MIN_OVERLAP:
            continue
        found = truth.conditions(*images)
        if found.overlap >= MIN_OVERLAP:
            candidates.append(JudgedPair(images, HARD if found.hard or images in hard else EASY, found))
    # Streams of their own, so that one scene's pairs do not depend on which others are judged.
    rng = np.random.default_rng([selection.seed, stable_hash(name) % (1 << 32)])
    pairs = chosen(candidates, selection, rng)
    listed = tuple(pair.images for pair in pairs)
    scene = Scene(name, out / "images", out / EXACT_POSES, out / "block.json", truth.cameras, listed)
    return Judged(scene, truth, pairs, _key(scene))


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


def _differently_bright(images: Path, names: list[str]) -> set[tuple[str, str]]:
    grey = {name: float(read_pixels(images / name, colour=False).mean()) for name in names}
    ratio = {(a, b): max(grey[a], grey[b]) / max(min(grey[a], grey[b]), 1.0) for a, b in combinations(names, 2)}
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
        lens.update(width=small.width_px, height=small.height_px, params=list(colmap_params(small)))
    shutil.copy(source / "reference" / "poses.csv", out / "poses.csv")
    write_json(out / "block.json", facts)  # last: it says that the rest is there
