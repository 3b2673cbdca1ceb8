"""Train the context network that ships with the package: descriptors that know what is around them.

Views of rendered blocks (trainings.blocks) with the shipped detector, orientation network and GeoDesc; partners by
exact truth, so that parallax, occlusion, oblique views and other suns are in it. Of a pair, every keypoint with a
partner must be more alike to it than to any other keypoint of the other view, either way (cross entropy over cosines,
learned temperature). Keypoints are dropped, and coarse pictures' brightness changed, at random. The learning rate falls
along a cosine; what is kept is a moving average. Validation: the blocks that trainings.blocks leaves out, with and
without context.

In bfloat16 where the processor has it, else in float32; on a CUDA device where there is one. OUT/data and OUT/state.pt
are kept: a killed run, or one ended by --minutes, goes on where it was; OUT/recipe.json makes sure that it is the same
run. Writes OUT/context.safetensors (float16), OUT/log.json and OUT/curves.png.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from aeromatch_cli.nets.context import Context, load_context
from aeromatch_cli.nets.descriptor_bytes import from_bytes
from aeromatch_cli.nets.precision import has_bfloat16
from aeromatch_cli.strategies.extractors.context import context_inputs_of_coarse
from aeromatch_cli.strategies.extractors.detection import Raw
from aeromatch_cli.strategies.extractors.learned import Learned
from trainings.blocks import LEFT_OUT, add_blocks, numbers, render
from trainings.context.data import ContextPair, ViewSeen, block_pairs
from trainings.context.validation import compared
from trainings.runs import (
    Log,
    at_least_one,
    check_recipe,
    descend,
    follow,
    load_state,
    save_state,
    shipped,
    training_device,
)

DECAY, CLIP, RATE, BATCH = 0.999, 1.0, 1e-3, 4
OF_RUN = ("blocks", "pairs", "weights", "start", "seed")
REPORT_EVERY = 2_000
_KEEP = (0.5, 1.0)  # share of the keypoints of a view, drawn for every step


class Run(torch.nn.Module):
    """The network, the temperature of its loss, and the average that is kept."""

    def __init__(self, start: Path | None = None) -> None:
        """start: weights to go on from."""
        super().__init__()
        torch.manual_seed(0)
        network = Context() if start is None else load_context(start).requires_grad_(True)
        # Channels last: 1.6 times as fast in bfloat16.
        self.network = network.to(training_device(), memory_format=torch.channels_last)
        self.sharpness = torch.nn.Parameter(torch.tensor(math.log(15.0), device=training_device()))
        self.average = copy.deepcopy(self.network).requires_grad_(False)


def inputs(view: ViewSeen, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], np.ndarray[Any, Any]]:
    """What the network is asked of a view, and which of its keypoints: all, or as drawn."""
    seen, coarse = view.seen, view.coarse
    rows = np.arange(len(seen.points_px))
    if rng is not None:
        share = rng.uniform(*_KEEP)
        rows = np.sort(rng.permutation(len(rows))[: max(16, int(share * len(rows)))])
        level = (coarse / 255.0) ** np.exp(rng.normal(0.0, 0.3)) * np.exp(rng.normal(0.0, 0.2))
        coarse = np.clip(255.0 * level + rng.normal(0.0, 2.0, coarse.shape), 0, 255).astype(np.uint8)
    places = seen.points_px[rows] - 0.5
    raw = Raw(places, seen.sizes_px[rows], places, seen.sizes_px[rows], np.rad2deg(seen.angles_rad[rows]),
              np.zeros(len(rows)), np.zeros(len(rows)), np.zeros(len(rows)))  # fmt: skip
    descriptors = from_bytes(seen.descriptors[rows])
    descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    size = int(seen.size_px[0]), int(seen.size_px[1])
    return context_inputs_of_coarse(descriptors, raw, coarse, size), rows


def on(given: tuple[Tensor, ...], device: torch.device) -> tuple[Tensor, ...]:
    return tuple(part.to(device) for part in given)


def loss_of(run: Run, pair: ContextPair, rng: np.random.Generator) -> Tensor:
    (in0, rows0), (in1, rows1) = (inputs(view, rng) for view in (pair.view0, pair.view1))
    device = run.sharpness.device
    with torch.autocast(device.type, torch.bfloat16, enabled=has_bfloat16(device.type)):
        found0, found1 = (run.network(*on(given, device)).float() for given in (in0, in1))
    truth = pair.truth.take(rows0, rows1)
    parts = []
    for own, others, mates in ((found0, found1, truth.of0), (found1, found0, truth.of1)):
        known = np.flatnonzero(mates >= 0)
        if len(known):
            similar = run.sharpness.exp() * own[known] @ others.T
            parts.append(torch.nn.functional.cross_entropy(similar, torch.from_numpy(mates[known]).long().to(device)))
    return torch.stack(parts).mean() if parts else found0.sum() * 0.0


def train(pairs: list[ContextPair], unseen: list[ContextPair], args: argparse.Namespace) -> Run | None:
    """The finished run, or None where --minutes ended it before."""
    run, started = Run(args.start), time.monotonic()
    optimiser = torch.optim.AdamW([*run.network.parameters(), run.sharpness], RATE, weight_decay=1e-3)
    state = args.out / "state.pt"
    device = run.sharpness.device
    seen, log = load_state(state, run, optimiser, device=device.type)
    plain = compared(unseen, lambda view: inputs(view, None)[0][0].numpy())
    losses: list[float] = []
    while seen < args.pairs:
        rng = np.random.default_rng([args.seed, seen])
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (seen + 1) / 1000) * (0.5 + 0.5 * math.cos(math.pi * seen / args.pairs))
        chosen = [pairs[int(rng.integers(len(pairs)))] for _ in range(BATCH)]
        loss = torch.stack([loss_of(run, pair, rng) for pair in chosen]).mean()
        descend(loss, run.network, optimiser, CLIP)
        follow(run.average, run.network, seen // BATCH, DECAY)
        losses.append(float(loss.detach()))
        before, seen = seen, seen + BATCH
        ended = bool(args.minutes) and time.monotonic() - started > 60.0 * args.minutes
        if seen // REPORT_EVERY > before // REPORT_EVERY or seen >= args.pairs or ended:
            with torch.inference_mode():
                found = compared(unseen, lambda view: run.average(*on(inputs(view, None)[0], device)).cpu().numpy())
            minutes = round((time.monotonic() - started) / 60.0, 1)
            row = {"seen": seen, "minutes": minutes, "loss": round(float(np.mean(losses)), 4)}
            log.append(row | {"context": found, "plain": plain})
            print(json.dumps(log[-1]), flush=True)
            losses = []
            save_state(state, seen, log, run, optimiser)
            draw_curves(log, args.out / "curves.png")
        if ended:
            return None
    (args.out / "log.json").write_text(json.dumps(log, indent=1) + "\n", encoding="utf-8")
    return run


def draw_curves(log: Log, path: Path) -> None:
    """Rank-1 rate by class of view angle, with context and without (dashed)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.5), dpi=110, layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(log[-1]["context"]):
        axes.plot(
            [row["seen"] for row in log], [row["context"][name]["rank1"] for row in log], f"C{number}", label=name
        )
        axes.axhline(log[-1]["plain"][name]["rank1"], color=f"C{number}", linestyle="--", linewidth=0.8)
    axes.set(xlabel="pairs seen", ylabel="nearest neighbour is the partner (dashed: without context)")
    figure.legend(title="view angle", loc="outside right upper", frameon=False)
    figure.savefig(path)


def one_block(out: Path, rendered: Path, weights: Path | None, index: int) -> None:
    """Render block `index` and write its pairs, unless they are there."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    folder = render(rendered, index)
    block_pairs(folder, out / "data" / f"{index:04d}.npz", weights)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add_blocks(parser)
    add("--weights", type=Path, help="folder of your own networks, as `extract.weights` takes it; default: what ships")
    add("--start", type=Path, help="weights to go on from, as those of other descriptors")
    add("--rendered", type=Path, help="where rendered blocks are, or go (default OUT/blocks)")
    add("--pairs", type=at_least_one, default=6_000, help="to be seen")
    add("--seed", type=int, default=0, help="of what is drawn")
    add("--jobs", type=at_least_one, default=2, help="processes that make the data, threads that train")
    add("--minutes", type=float, default=0.0, help="stop after so long (0: never) and go on when called again")
    add("--out", type=Path, required=True)
    args = parser.parse_args(arguments)
    if args.weights is not None:
        Learned(weights=str(args.weights)).check_files(Learned.descriptor_length)
    check_recipe(parser, args, OF_RUN)
    wanted = sorted({*numbers(args.blocks), *LEFT_OUT})
    (args.out / "data").mkdir(parents=True, exist_ok=True)
    rendered = args.rendered or args.out / "blocks"
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        list(pool.map(partial(one_block, args.out, rendered, args.weights), wanted))
    torch.set_num_threads(args.jobs)
    groups: dict[bool, list[ContextPair]] = {False: [], True: []}
    for index in wanted:
        folder = render(rendered, index)
        groups[index in LEFT_OUT] += block_pairs(folder, args.out / "data" / f"{index:04d}.npz", args.weights)
    print(f"{len(groups[False])} pairs, {len(groups[True])} unseen ones", flush=True)
    run = train(groups[False], groups[True], args)
    if run is not None:
        from safetensors.torch import save_file

        save_file(shipped(run.average), args.out / "context.safetensors")
