"""Tracks on disk: made once, each source in a file of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lightglue_training.data import mapped, pictures, save_arrays
from training_blocks import LEFT_OUT, numbers, render

from patch_training import sources
from patch_training.tracks import Tracks, joined

# Rendered blocks for validation only: those that every training leaves out, and a city, farmland and hills.
UNSEEN = (*LEFT_OUT, 204, 207, 209)
GROUPS = 40  # of homography views in a file
_UNSEEN_GROUPS = 10**6


def prepare(out: Path, rendered: Path, real: Path, names: Sequence[str], args: Any) -> None:
    """Every file that is not there yet, in OUT/known and OUT/unseen.

    rendered: where blocks of training_blocks are or go, args.blocks their numbers. real: folder of the real blocks
    `names`.
    """
    for folder in ("known", "unseen"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    paths = pictures(real / name for name in names)
    jobs: list[Callable[[], None]] = []
    jobs += [partial(_write, out / "unseen", partial(_rendered, rendered, index), f"block-{index}") for index in UNSEEN]
    jobs += [partial(_write, out / "known", partial(sources.reference, real / name, name), name) for name in names]
    for number in range(args.groups // GROUPS):
        first = args.seed * 10**7 + number * GROUPS
        jobs.append(partial(_write, out / "known", partial(_groups, paths, first), f"homographies-{number}"))
    jobs.append(partial(_write, out / "unseen", partial(_unseen_groups, rendered), "homographies"))
    for index in learnt_from(args.blocks):
        jobs.append(partial(_write, out / "known", partial(_rendered, rendered, index), f"block-{index}"))
    mapped(_call, jobs, args.jobs)


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


def read(folder: Path) -> dict[str, Tracks]:
    """Every finished file's tracks, by its name and kind."""
    found = {}
    for done in sorted(folder.glob("*.done")):
        for path in sorted(folder.glob(f"{done.stem}.*.npz")):
            with np.load(path) as archive:
                found[path.stem] = Tracks(**dict(archive))
    return found
