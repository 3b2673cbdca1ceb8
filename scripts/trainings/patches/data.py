"""Tracks on disk: made once, each source in a file of its own.

A folder may hold those of several recipes; each reads the files that it names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from trainings.blocks import LEFT_OUT, numbers, render
from trainings.lightglue.data import mapped, pictures, save_arrays
from trainings.patches import sources
from trainings.patches.tracks import Tracks, joined

# Rendered blocks for validation only: those that every training leaves out, and a city, farmland and hills.
UNSEEN = (*LEFT_OUT, 204, 207, 209)
Make = Callable[[], Mapping[str, Tracks]]
GROUPS = 40  # of homography views in a file
_UNSEEN_GROUPS = 10**6


def prepare(out: Path, rendered: Path, real: Path, names: Sequence[str], args: Any) -> tuple[list[str], list[str]]:
    """Names of the files to learn from, in OUT/known, and of those for validation, in OUT/unseen; those that are not
    there yet are made.

    rendered: where blocks of trainings.blocks are or go, args.blocks their numbers. real: folder of the real blocks
    `names`; of them args.groups groups of homography views.
    """
    paths = pictures(real / name for name in names)
    known: dict[str, Make] = {name: partial(sources.reference, real / name, name) for name in names}
    # Their pictures are in the name: the same numbers warp other blocks' in another recipe.
    warped = "+".join(sorted(names))
    for number in range(args.groups // GROUPS):
        first = args.seed * 10**7 + number * GROUPS
        known[f"homographies-{warped}-{args.seed}-{number}"] = partial(_groups, paths, first)
    known |= {f"block-{index}": partial(_rendered, rendered, index) for index in learnt_from(args.blocks)}
    unseen: dict[str, Make] = {f"block-{index}": partial(_rendered, rendered, index) for index in UNSEEN}
    unseen["homographies"] = partial(_unseen_groups, rendered)
    # Those for validation first: a run that is ended meanwhile has them. A table alone needs no others.
    parts = [(out / "unseen", unseen)] + ([] if getattr(args, "only_table", False) else [(out / "known", known)])
    jobs = [partial(_write, folder, make, name) for folder, makes in parts for name, make in makes.items()]
    for folder, _ in parts:
        folder.mkdir(parents=True, exist_ok=True)
    mapped(_call, jobs, args.jobs)
    return list(known), list(unseen)


def learnt_from(text: str) -> list[int]:
    """The blocks that `0-4,29` means, without those for validation."""
    return sorted({*numbers(text)} - {*UNSEEN})


def _call(job: Callable[[], None]) -> None:
    import cv2

    cv2.setNumThreads(1)
    job()


def _rendered(folder: Path, index: int) -> dict[str, Tracks]:
    return sources.rendered(render(folder, index))


def _groups(paths: list[Path], first: int) -> dict[str, Tracks]:
    """Upright views and turned ones apart."""
    found: dict[str, list[Tracks]] = {"ground": [], "source": []}
    for number in range(first, first + GROUPS):
        made = sources.homography(paths, number)
        if made is not None:
            found[made[0]].append(made[1])
    return {kind: joined(parts) for kind, parts in found.items() if parts}


def _unseen_groups(rendered: Path) -> dict[str, Tracks]:
    return _groups(pictures(render(rendered, index) for index in UNSEEN), _UNSEEN_GROUPS)


def _write(folder: Path, make: Callable[[], Mapping[str, Tracks]], name: str) -> None:
    """One file per kind of picture, `ground` or `source`."""
    done = folder / f"{name}.done"
    if done.is_file():
        return
    for kind, tracks in make().items():
        save_arrays(folder / f"{name}.{kind}.npz", vars(tracks))
    done.touch()


def read(folder: Path, names: Iterable[str]) -> dict[str, Tracks]:
    """The tracks of these files, by name and kind, in alphabetical order."""
    found = {}
    for name in sorted(names):
        for path in sorted(folder.glob(f"{name}.*.npz")):
            with np.load(path) as archive:
                found[path.stem] = Tracks(**dict(archive))
    return found
