"""Rendered blocks by condition, with exact truth."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.scenes import Judged, Selection, judged_block, render_asked

# A flight of its own name: straight above, every second picture under-exposed.
EXPOSED = "exposed"
# Of the light of an under-exposed picture, and the noise of its sensor, in levels of 8 bits.
_DARKER, _NOISE = 1.0 / 8.0, 1.5
_GAMMA = 2.2
_EVERY_PAIR = 1_000_000
# Condition -> SCENE:FLIGHT of its blocks; a block may be of several.
CONDITIONS: Mapping[str, tuple[str, ...]] = {
    "one sun": ("suburb:nadir", "city:nadir"),
    "two suns": ("city:mixed", "suburb:two-flights"),
    "two exposures": (f"suburb:{EXPOSED}", f"city:{EXPOSED}"),
    "five cameras": ("city:oblique",),
    "texture-poor": ("grass:nadir", "desert:nadir", "farmland:nadir"),
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
                folder = under_exposed(folder)
            yield Block(place, seed), judged_block(scene, folder, Selection("all", _EVERY_PAIR, seed))


def under_exposed(folder: Path) -> Path:
    """A copy of a rendered block, of which every second picture by name got an eighth of the light, with a sensor's
    noise, in 8 bits: dark parts have lost their contrast. The truth is the same."""
    import cv2

    out = folder.with_name(f"{folder.name}-{EXPOSED}")
    if out.is_dir():
        return out
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(folder, part)
    for number, path in enumerate(sorted((part / "images").iterdir())):
        if number % 2 == 0:
            continue
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert pixels is not None
        light = _DARKER * (pixels / 255.0) ** _GAMMA
        noise = _NOISE * np.random.default_rng(number).standard_normal(pixels.shape)
        darker = np.clip(np.rint(255.0 * light ** (1.0 / _GAMMA) + noise), 0, 255).astype(np.uint8)
        cv2.imwrite(str(path), darker, [cv2.IMWRITE_JPEG_QUALITY, 95])
    part.rename(out)
    return out
