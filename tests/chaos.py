"""Faults injected into runs: after each, the command must say what happened with the right exit code, and the next run
must end with the same files as one that nothing disturbed. `scripts/chaos` injects as many as are asked for.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sqlite3
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from chaos_faults import OF_FILES, OF_RUNS, PASSING, RUNS, Fault, Site, ended
from conftest import contents

from aeromatch_cli.lab.synthetic import render_block

_IMAGES, _WIDTH, _HEIGHT = 4, 240, 180
KINDS = {**OF_RUNS, **OF_FILES}


class Calm:
    """A block and, of every run that is asked for, what it makes undisturbed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.block = folder, folder / "block"
        render_block(self.block, "suburb", seed=5, width_px=_WIDTH, height_px=_HEIGHT, images=_IMAGES)
        self._made: dict[str, tuple[float, dict[str, Any]]] = {}

    def work(self, preset: str) -> Path:
        return self.folder / "calm" / preset

    def expected(self, preset: str) -> tuple[float, dict[str, Any]]:
        """Seconds, and contents."""
        if preset not in self._made:
            started = time.monotonic()
            ended(Site(self.block, self.work(preset), preset).start())
            self._made[preset] = time.monotonic() - started, _compared(self.work(preset))
        return self._made[preset]


def _compared(work: Path) -> dict[str, Any]:
    return {name: content for name, content in contents(work).items() if not PASSING & set(Path(name).parts)}


def mended(site: Site) -> None:
    """The next run, in a process of its own: a fault may make it hang."""
    ended(site.start())


def injected(kind: str | Fault, seed: int, calm: Calm, preset: str = "", mend: Callable[[Site], None] = mended) -> str:
    """One fault, by its name or of a finished workspace; "" where all is as it should be, else what is not."""
    rng = random.Random(seed)
    preset = preset or rng.choice(list(RUNS))
    seconds, expected = calm.expected(preset)
    # Of the same name as the undisturbed one: the report's title has it.
    site = Site(calm.block, calm.folder / "disturbed" / preset, preset, seconds)
    shutil.rmtree(site.work, ignore_errors=True)
    try:
        if not isinstance(kind, str) or kind in OF_FILES:
            shutil.copytree(calm.work(preset), site.work)
        (KINDS[kind] if isinstance(kind, str) else kind)(site, rng)
        mend(site)
        found = _compared(site.work)
        different = sorted(n for n in {*found, *expected} if not _same(found.get(n), expected.get(n)))
        assert not different, f"other files than of an undisturbed run: {', '.join(different[:5])}"
    except (AssertionError, zipfile.BadZipFile, sqlite3.DatabaseError, ValueError) as error:
        # The last three: a damaged file is still there, and cannot be compared.
        return f"{preset} {site.touched}: {error or type(error).__name__}"
    return ""


def _same(one: object, other: object) -> bool:
    return bool(np.all(one == other)) if type(one) is type(other) else False


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/chaos", description=__doc__)
    parser.add_argument("--faults", type=int, default=200, help="default 200")
    parser.add_argument("--first", type=int, default=0, help="number of the first one, to go on from; default 0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default="", help=f"comma-separated of {', '.join(KINDS)}; all by default")
    args = parser.parse_args()
    kinds = [kind.strip() for kind in args.kinds.split(",") if kind.strip()] or list(KINDS)
    if unknown := set(kinds) - KINDS.keys():
        parser.error(f"--kinds: {', '.join(sorted(unknown))} are none of {', '.join(KINDS)}")
    count, bad = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        calm = Calm(Path(scratch))
        for number in range(args.first, args.faults):
            kind = kinds[number % len(kinds)]
            what = injected(kind, args.seed * 100_000 + number, calm)
            count[kind] += 1
            if what:
                bad[kind] += 1
                print(f"{kind}, number {number}: {what}", file=sys.stderr, flush=True)
            if number % 20 == 19:
                print(f"{number + 1} of {args.faults}: {bad.total()} not withstood", file=sys.stderr, flush=True)
    for kind in kinds:
        print(f"{kind}: {count[kind]} injected, {bad[kind]} not withstood")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
