"""Rendered blocks by condition, with exact truth."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.exposure import write_under_exposed
from benchmarks.scenes import Judged, Selection, judged_block, render_asked

# A flight of its own name: straight above, every second picture under-exposed.
EXPOSED = "exposed"
# Share of the light of a well exposed picture.
_LIGHT = 1.0 / 8.0
_EVERY_PAIR = 1_000_000
# Condition -> SCENE:FLIGHT of its blocks; a block may be of several.
CONDITIONS: Mapping[str, tuple[str, ...]] = {
    "one sun": ("suburb:nadir", "city:nadir"),
    "two suns": ("city:mixed", "suburb:two-flights"),
    "two exposures": (f"city:{EXPOSED}",),
    "five cameras": ("city:oblique",),
    "texture-poor": ("grass:nadir", "farmland:nadir"),
    "rows and facades": ("farmland:nadir", "city:nadir", "city:oblique"),
}
ALL = "all"
PLACES = tuple(dict.fromkeys(place for places in CONDITIONS.values() for place in places))


@dataclass(frozen=True)
class Block:
    """place: SCENE:FLIGHT."""

    place: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.place}, seed {self.seed}"

    @property
    def slug(self) -> str:
        return f"{self.place.replace(':', '-')}-{self.seed}"

    @property
    def conditions(self) -> list[str]:
        """Those that it belongs to, and ALL."""
        return [*(name for name, places in CONDITIONS.items() if self.place in places), ALL]

    @property
    def nadir(self) -> bool:
        """Whether all of its pictures look straight down."""
        return self.place.endswith((":nadir", f":{EXPOSED}"))


def asked_blocks(args: argparse.Namespace) -> Iterator[tuple[Block, Judged]]:
    """The blocks of --places and --seeds, each rendered when it is needed, and all of its pairs that overlap."""
    for seed in args.seeds:
        for place in args.places:
            scene, _, flight = place.partition(":")
            # A rig of five cameras takes so many pictures of a place that few of them overlap.
            images = args.images * (2 if flight == "oblique" else 1)
            given = argparse.Namespace(**{**vars(args), "images": images})
            folder = render_asked(given, scene, flight="nadir" if flight == EXPOSED else flight, seed=seed)
            if flight == EXPOSED:
                folder = darker_block(folder)
            yield Block(place, seed), judged_block(scene, folder, Selection("all", _EVERY_PAIR, seed))


def darker_block(folder: Path) -> Path:
    """A copy of a rendered block, of which every second picture by name got an eighth of the light. The truth is the
    same."""
    out = folder.with_name(f"{folder.name}-{_LIGHT:g}-of-light")
    if out.is_dir():
        return out
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(folder, part)
    for number, path in enumerate(sorted((part / "images").iterdir())):
        if number % 2:
            write_under_exposed(path, path, _LIGHT, np.random.default_rng(number))
    part.rename(out)
    return out
