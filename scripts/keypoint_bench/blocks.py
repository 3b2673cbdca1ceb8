"""Rendered blocks and their pairs, as bench_methods chooses them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from methods.scenes import Judged, Selection, rendered
from methods.sources import code_digest

from aeromatch_cli.evaluate import RenderedTruth


@dataclass(frozen=True)
class LoadedNetwork:
    """Which blocks: presets, flight, width and height, images of each, pairs of each, seed."""

    scenes: tuple[str, ...]
    flight: str
    size_px: tuple[int, int]
    images: int
    pairs: int
    seed: int
    jobs: int = 2


def blocks(folder: Path, asked: LoadedNetwork) -> Iterator[tuple[Judged, RenderedTruth]]:
    """One after the other, pairs by class of view angle; rendered below folder/scenes unless they are there."""
    scenes = folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    selection, code = Selection("angles", asked.pairs, asked.seed), code_digest("synthetic")
    for preset in asked.scenes:
        judged = rendered(
            scenes, preset, selection, size_px=asked.size_px, images=asked.images, jobs=asked.jobs, code=code,
            flight=asked.flight,
        )  # fmt: skip
        assert isinstance(judged.truth, RenderedTruth)
        yield judged, judged.truth
