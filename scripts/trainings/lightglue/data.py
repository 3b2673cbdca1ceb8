"""Training and validation pairs on disk: made once, in parallel, each part in a file of its own."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from trainings.blocks import LEFT_OUT, render
from trainings.lightglue.blocks import RECIPES, Pair, block_pairs
from trainings.lightglue.homographies import make_group
from trainings.lightglue.photographs import photograph_pairs
from trainings.lightglue.sides import Partners, Seen

SHARD = 50  # groups of homography views in a file


class OutOfTime(Exception):  # noqa: N818 - no error: what is left is done when called again
    """Not all was done by the time that was set."""


def prepare(
    out: Path, data: Path, trained_on: Sequence[str], unseen: Sequence[str], args: Any, until: float = math.inf
) -> None:
    """Every file that is not there yet.

    trained_on, unseen: real blocks below `data` whose pictures are warped for training and for validation; every
    fourth shard is of rendered pictures. until: of time.time(), when no further file is begun. Raises OutOfTime then.
    """
    for folder in ("stage1", "stage2", "unseen1", "unseen2", "unseen3"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    blocks = range(args.blocks)
    folders = mapped(partial(render, args.rendered), list(blocks), args.jobs, until)
    known = [folder for index, folder in enumerate(folders) if index not in LEFT_OUT]
    left = [folders[index] for index in LEFT_OUT]
    real, other = (pictures(data / name for name in names) for names in (trained_on, unseen))
    made, left_out = (pictures(group) for group in (known, left))
    jobs: list[Callable[[], None]] = []
    for shard in range(args.groups // SHARD):
        paths = made if shard % 4 == 3 else real
        first = args.seed * 10**7 + shard * SHARD
        jobs.append(partial(write_groups, out / "stage1" / f"{shard:04d}.npz", paths, first, SHARD, args.features))
    for index, paths in enumerate((other, left_out)):
        first = 10**6 + index * SHARD
        jobs.append(partial(write_groups, out / "unseen1" / f"{index}.npz", paths, first, SHARD, args.features))
    for name, group in (("stage2", known), ("unseen2", left)):
        paths = ((out / name / f"{folder.name}.npz", folder) for folder in group)
        jobs += [
            partial(write_block, path, partial(block_pairs, folder, features=args.features)) for path, folder in paths
        ]
    if args.features == "learned":
        recipe = RECIPES["learned"][0]
        for kind, names in (("stage2", trained_on), ("unseen3", unseen)):
            jobs += [
                partial(write_block, out / kind / f"{name}.npz", partial(photograph_pairs, data / name, recipe))
                for name in names
            ]
        jobs.reverse()  # whole blocks of photographs take longest
    mapped(_call, jobs, args.jobs, until)


def _call(job: Callable[[], None]) -> None:
    cv2.setNumThreads(1)
    job()


def mapped(function: Callable[[Any], Any], items: list[Any], jobs: int, until: float = math.inf) -> list[Any]:
    """Results in order. Raises OutOfTime where some were not begun by `until`, of time.time(); the others are done."""
    work = partial(_in_time, function, until)
    if jobs == 1:
        found = [work(item) for item in items]
    else:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(work, items))
    if not all(done for done, _ in found):
        raise OutOfTime
    return [result for _, result in found]


def _in_time(function: Callable[[Any], Any], until: float, item: Any) -> tuple[bool, Any]:
    return (True, function(item)) if time.time() < until else (False, None)


def pictures(folders: Iterable[Path]) -> list[Path]:
    """The pictures of blocks, in order."""
    found = [p for folder in folders for p in sorted((folder / "images").iterdir())]
    return [path for path in found if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff")]


def write_groups(path: Path, chosen: list[Path], first: int, count: int, features: str = "sift") -> None:
    """Groups of views of chosen pictures in a file, numbered from `first`, unless it is there."""
    if path.is_file():
        return
    arrays: dict[str, Any] = {}
    for number in range(count):
        group = make_group(chosen, first + number, features)
        for view, side in enumerate(group.views):
            arrays |= {f"{number}.{view}.{name}": value for name, value in side.arrays().items()}
        for a, b in combinations(range(len(group.views)), 2):
            truth = group.truth(a, b)
            arrays |= {f"{number}.{a}{b}.of0": truth.of0, f"{number}.{a}{b}.of1": truth.of1}
    save_arrays(path, arrays)


def write_block(path: Path, pairs: Callable[[], list[Pair]]) -> None:
    """The pairs of a rendered block in a file, unless it is there."""
    if path.is_file():
        return
    sides: dict[int, tuple[int, Seen]] = {}
    arrays: dict[str, Any] = {}
    for number, pair in enumerate(pairs()):
        for side in (pair.side0, pair.side1):
            sides.setdefault(id(side), (len(sides), side))
        ids = [sides[id(side)][0] for side in (pair.side0, pair.side1)]
        arrays[f"pair.{number}"] = np.array([*ids, pair.two_suns])
        arrays |= {f"pair.{number}.of0": pair.truth.of0, f"pair.{number}.of1": pair.truth.of1}
    for index, side in sides.values():
        arrays |= {f"side.{index}.{name}": value for name, value in side.arrays().items()}
    save_arrays(path, arrays)


def save_arrays(path: Path, arrays: dict[str, Any]) -> None:
    partly = path.with_suffix(".partly")  # no .npz: a killed run's is never read
    with partly.open("wb") as stream:
        np.savez(stream, **arrays)
    partly.replace(path)


def read_groups(path: Path) -> list[Pair]:
    """All pairs of a file of homography groups."""
    found = []
    with np.load(path) as archive:
        arrays = dict(archive)
    numbers = {int(name.split(".")[0]) for name in arrays}
    for number in sorted(numbers):
        views = sorted(
            {int(name.split(".")[1]) for name in arrays if name.startswith(f"{number}.") and "of" not in name}
        )
        sides = [_side(arrays, f"{number}.{view}.") for view in views]
        for a, b in combinations(views, 2):
            found.append(Pair(sides[a], sides[b], _truth(arrays, f"{number}.{a}{b}."), False))
    return found


def read_block(path: Path) -> list[Pair]:
    """All pairs of a rendered block."""
    with np.load(path) as archive:
        arrays = dict(archive)
    heads = sorted(int(name.split(".")[1]) for name in arrays if name.startswith("pair.") and name.count(".") == 1)
    known: dict[int, Seen] = {}
    found = []
    for number in heads:
        first, second, two_suns = (int(v) for v in arrays[f"pair.{number}"])
        for index in (first, second):
            known.setdefault(index, _side(arrays, f"side.{index}."))
        truth = _truth(arrays, f"pair.{number}.")
        found.append(Pair(known[first], known[second], truth, bool(two_suns)))
    return found


def _side(arrays: dict[str, Any], prefix: str) -> Seen:
    return Seen(**{name: arrays[prefix + name] for name in Seen.__dataclass_fields__})


def _truth(arrays: dict[str, Any], prefix: str) -> Partners:
    return Partners(arrays[prefix + "of0"], arrays[prefix + "of1"])
