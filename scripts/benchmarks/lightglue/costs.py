"""What matching with LightGlue costs: the forward pass in every way, processes beside threads, and a block's pairs."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from trainings.lightglue.batches import as_side
from trainings.lightglue.blocks import Pair, prepared

from aeromatch_cli.data import Features, PairGeometry
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.nets.lightglue_batch import match_batch
from aeromatch_cli.nets.lightglue_file import load_lightglue
from aeromatch_cli.nets.precision import has_bfloat16, layer_type
from aeromatch_cli.stages import extract
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue as Matcher
from benchmarks.processes import fresh_process, median_seconds, peak_mb
from benchmarks.tables import markdown

OFFICIAL = Dimensions(input_dim=128, descriptor_dim=256, n_layers=9, num_heads=4, add_scale_ori=True)
REPEATS = 20
BATCH = 16
_ROUNDS = 3
MATCHERS = Matcher(), Nearest()  # with their defaults
BLOCK_PAIRS = 16
EVERYTHING = {"depth_confidence": -1.0, "width_confidence": -1.0}


def forward_table(network: LightGlue, pair: Pair, device: str) -> str:
    """Every way on the same pair, all of whose keypoints enter."""
    ways = {
        "kornia, official size, float32": _kornia(OFFICIAL, device, None),
        "kornia, these weights, float32": _kornia(network.dimensions, device, network),
        "own forward, float32": _own(network, device),
    }
    kind = "float32"
    if has_bfloat16(device):
        kind = "bfloat16"
        ways["own forward, bfloat16"] = _own(as_used(network, device), device)
    ways[f"{kind}, early exit"] = _own(as_used(network, device), device, depth_confidence=0.95)
    both = {"depth_confidence": 0.95, "width_confidence": 0.99}
    ways[f"{kind}, early exit and pruning"] = _own(as_used(network, device), device, **both)
    if device == "cuda":
        ways[f"{kind}, {BATCH} pairs at once"] = _own_batch(as_used(network, device), device)
    lines: list[tuple[str, ...]] = []
    base = 0.0
    for name, way in ways.items():
        seconds = median_seconds(partial(way, pair), REPEATS, device)[0] / (BATCH if "at once" in name else 1)
        base = base or seconds
        lines.append((name, f"{seconds:.3f}", f"{1.0 / seconds:.1f}", f"{seconds / base:.2f}"))
        print(*lines[-1], file=sys.stderr, flush=True)
    return markdown(("forward", "seconds a pair", "pairs a second", "x official (goal 0.25)"), lines)


def as_used(network: LightGlue, device: str) -> LightGlue:
    """A copy in the precision that the matcher takes there."""
    copied = LightGlue(network.dimensions).to(device).eval()
    copied.load_state_dict(network.state_dict())
    return copied.with_layers_in(layer_type("auto", device))


def _kornia(dimensions: Dimensions, device: str, weights: LightGlue | None) -> Callable[[Pair], Any]:
    from kornia.feature import LightGlue as Kornia

    torch.manual_seed(0)
    conf = dict(vars(dimensions)) | {"flash": False} | EVERYTHING
    theirs = Kornia(features=None, **conf).eval().to(device)
    if weights is not None:
        theirs.load_state_dict(weights.state_dict(), strict=False)

    def image(side: Any) -> dict[str, torch.Tensor]:
        arrays = {"keypoints": side.points_px, "scales": side.sizes_px / 2, "oris": side.angles_rad}
        arrays |= {"image_size": side.size_px, "descriptors": side.descriptors / 512.0}
        return {k: torch.from_numpy(np.asarray(v, np.float32))[None].to(device) for k, v in arrays.items()}

    def match(pair: Pair) -> Any:
        with torch.inference_mode():
            return theirs({"image0": image(pair.side0), "image1": image(pair.side1)})

    return match


def _own(network: LightGlue, device: str, **options: float) -> Callable[[Pair], Any]:
    def match(pair: Pair) -> Any:
        sides = [as_side([side]).to(device) for side in (pair.side0, pair.side1)]
        return network.match(*sides, threshold=0.1, **(EVERYTHING | options))

    return match


def _own_batch(network: LightGlue, device: str) -> Callable[[Pair], Any]:
    def match(pair: Pair) -> Any:
        sides = [[as_side([side]).to(device)] * BATCH for side in (pair.side0, pair.side1)]
        return match_batch(network, *sides, threshold=0.1, **EVERYTHING)

    return match


def first_keypoints(pair: Pair, count: int) -> Pair:
    """The first so many of either side, for timing: truth stays behind."""
    rows = np.arange(count)
    return Pair(pair.side0.take(rows), pair.side1.take(rows), pair.truth, pair.two_suns)


def jobs_table(weights: Path, pair: Pair) -> str:
    """Pairs a second, all keypoints entering, of one process with two threads and of two with one each; memory."""
    lines = []
    for jobs, threads in ((1, 2), (2, 1)):
        with fresh_process(jobs) as pool:
            results = list(pool.map(partial(_work, weights, pair), [threads] * jobs))
        rate = sum(1.0 / seconds for seconds, _ in results)
        lines.append((f"{jobs} x {threads}", f"{rate:.2f}", f"{max(mb for _, mb in results):.0f}"))
        print(*lines[-1], file=sys.stderr, flush=True)
    return markdown(("processes x threads", "pairs a second", "additional memory of each, MB"), lines)


def _work(weights: Path, pair: Pair, threads: int) -> tuple[float, float]:
    """Seconds a pair and megabytes beyond the loaded network, in a fresh process."""
    torch.set_num_threads(threads)
    network = as_used(load_lightglue(weights), "cpu")
    before_mb = peak_mb()
    seconds, _ = median_seconds(partial(_own(network, "cpu"), pair), REPEATS)
    return seconds, peak_mb() - before_mb


def block_table(folder: Path, weights: Path, keypoints: int) -> str:
    """The matcher over some pairs of a rendered block, with what saves time switched on step by step; medians of the
    rounds' means.
    """
    always = {"guide_below_matches": keypoints + 1, "network_below_matches": keypoints + 1}
    steps: Mapping[str, dict[str, Any]] = {
        "every keypoint": {"only_overlap": False, **always, **EVERYTHING},
        "+ only the predicted overlap": {**always, **EVERYTHING},
        "+ early exit": {**always, "width_confidence": -1.0},
        "+ pruning": always,
        "+ only where the ratio test leaves few (default)": {},
    }
    matchers = {name: Matcher(weights=str(weights), **settings) for name, settings in steps.items()}
    pairs = _block_features(folder, keypoints)
    block = pairs[:: max(1, len(pairs) // BLOCK_PAIRS)][:BLOCK_PAIRS]
    asked = {**matchers, "nearest": Nearest()}
    seconds: dict[str, list[float]] = {name: [] for name in asked}
    found = dict.fromkeys(asked, 0)
    for matcher in asked.values():
        matcher(*block[0])
    # In turns: what else the machine does meets all alike.
    for name, matcher in [*asked.items()] * _ROUNDS:
        started = time.perf_counter()
        found[name] = sum(len(matcher(*pair).indices) for pair in block)
        seconds[name].append((time.perf_counter() - started) / len(block))
    lines = [(name, f"{np.median(seconds[name]):.3f}", found[name]) for name in asked]
    return markdown(("matcher", "seconds a pair", "matches"), lines)


def _block_features(folder: Path, keypoints: int) -> list[tuple[Features, Features, PairGeometry]]:
    """Features of preset `baseline` and geometry of the block's pairs, poses noisy."""
    with tempfile.TemporaryDirectory() as scratch:
        context = prepared(folder, scratch, (f"extract.keypoints={keypoints}",))
        extract.run(context)
        features = {i.image_id: read_features(context.workspace.features(i.image_id)) for i in context.images()}
        chosen = [pair for row in context.rows().values() for pair in row]
        return [(features[p.image_id0], features[p.image_id1], context.geometry(p)) for p in chosen]
