"""One method on one scene, in a process of its own: its memory is its own, and start-up is not timed. What it answered
stays on disk: matching takes an hour and judging seconds, so a new judge needs no new matches."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.lab.strategies import add_arms
from benchmarks.peers.base import Found, Method, Options, Scene
from benchmarks.peers.table import PEERS, method, reads_poses
from benchmarks.processes import fresh_process, watched
from benchmarks.scenes import Judged
from benchmarks.sources import GROUND_CODE, OUR_CODE, PEER_CODE, code_digest, library_versions

_ARRAYS = ("points0_px", "points1_px", "scores", "keypoints0_px", "keypoints1_px")


@dataclass(frozen=True, eq=False)
class Measured:
    """One pair: seconds of both images' features, matching and verification, and of each image's features in them; peak
    resident memory over these."""

    found: Found
    seconds: float
    peak_mb: float
    features_seconds: tuple[float, float]


def measure(spec: str, judged: Judged, options: Options, store: Path) -> Iterator[tuple[str, Measured]]:
    """Key and answer of one method for every pair of a scene, in order; what the store has is not made again."""
    # What an answer depends on, the judge left out. Most peers read nothing of stages, strategies and presets.
    if spec in PEERS:
        code, settings = (GROUND_CODE if reads_poses(spec) else PEER_CODE), None
    else:
        code, settings = OUR_CODE, load(*parse_method(spec)).model_dump(mode="json")
    basis = [spec, settings, judged.key, vars(options) | {"weights": None}, code_digest(*code), library_versions()]
    paths = [store / f"{fingerprint(basis, pair.images)[:16]}.npz" for pair in judged.pairs]
    if all(path.is_file() for path in paths):
        yield from ((path.stem, read_measured(path)) for path in paths)
        return
    with fresh_process(1, start, spec, judged.scene, options) as process:
        for pair, path in zip(judged.pairs, paths, strict=True):
            if not path.is_file():
                try:
                    write_measured(path, process.submit(run_pair, pair.images).result())
                except BrokenProcessPool as error:
                    raise SystemExit(f"{spec} on {judged.scene.name}: its process died ({error})") from error
            yield path.stem, read_measured(path)


def write_measured(path: Path, measured: Measured) -> None:
    """One pair of one method, whole or not at all."""
    found = measured.found
    buffer = io.BytesIO()
    numbers = np.array([found.descriptors, measured.seconds, measured.peak_mb, *measured.features_seconds])
    np.savez_compressed(buffer, numbers=numbers, **{name: getattr(found, name) for name in _ARRAYS})
    write_atomically(path, lambda stream: stream.write(buffer.getvalue()))


def read_measured(path: Path) -> Measured:
    with np.load(path, allow_pickle=False) as arrays:
        descriptors, seconds, peak_mb, *features_seconds = arrays["numbers"].tolist()
        found = Found(**{name: arrays[name] for name in _ARRAYS}, descriptors=descriptors)
    return Measured(found, seconds, peak_mb, (features_seconds[0], features_seconds[1]))


class Worker:
    """Runs pairs in order; features of an image are made once, and their cost is part of each of its pairs."""

    def __init__(self, name: str, scene: Scene, options: Options) -> None:
        import cv2

        logging.getLogger("aeromatch").setLevel(logging.ERROR)  # images in no judged pair are no surprise here
        self.method: Method = method(name)(scene, options)
        cv2.setNumThreads(options.threads)  # after the method was made: stages set one thread
        self.known: dict[str, tuple[Any, float, float]] = {}
        # Imports, lazily built objects and first kernels: what the first pair would pay for all.
        self.run(scene.pairs[0])
        self.known.clear()

    def run(self, pair: tuple[str, str]) -> Measured:
        sides = [self._features(image) for image in pair]
        found, seconds, peak_mb = watched(lambda: self.method.match(*pair, sides[0][0], sides[1][0]))
        total = seconds + sum(side[1] for side in sides)
        return Measured(found, total, max(peak_mb, *(side[2] for side in sides)), (sides[0][1], sides[1][1]))

    def _features(self, image: str) -> tuple[Any, float, float]:
        if image not in self.known:
            self.known[image] = watched(lambda: self.method.features(image))
        return self.known[image]


_worker: Worker | None = None


def start(name: str, scene: Scene, options: Options) -> None:
    """Initialise this process, whose settings can name the laboratory's strategies as well."""
    global _worker
    add_arms()
    _worker = Worker(name, scene, options)


def run_pair(pair: tuple[str, str]) -> Measured:
    """The task of one pair; `start` has run in this process."""
    assert _worker is not None
    return _worker.run(pair)
