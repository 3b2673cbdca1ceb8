"""Train the LightGlue networks that ship with the package: keypoints of aerial images, SIFT's or (--features learned)
learned ones; 6 layers of 128 channels.

Stage 1 learns from homography pairs: pictures of --trained-on (real blocks below --data) and of rendered blocks, warped
and developed anew (trainings.lightglue.homographies). Stage 2 mixes them with pairs of the rendered blocks themselves
(trainings.lightglue.blocks): parallax, occlusion, oblique views, two suns. The last part of stage 2 sees more keypoints
and trains the confidence heads. Every pair is cut to equally many keypoints, turned and scaled at random, so that no
two steps see the same. The learning rate falls along a cosine; what is kept is a moving average of the weights.

With learned features stage 2 has pairs of photographs, too, by the reference reconstruction of the real blocks
(trainings.lightglue.photographs), and in three fifths of the pairs the network is told where inexact poses expect each
keypoint on the ground.

Validation knows neither the pictures nor the scenes: homography pairs of --unseen and of two rendered blocks that are
left out, the pairs of these two, and with learned features the photographs of --unseen. Beside it stands the mutual
ratio test (0.8) on the same keypoints.

On the CPU and on a CUDA device in bfloat16; a CUDA device takes larger batches, so that as many pairs are fewer steps:
what ships for SIFT was trained on a CPU, for learned features on a GPU. OUT/data and OUT/state.pt are kept: a killed
run, or one ended by --minutes, goes on where it was; OUT/recipe.json makes sure that it is the same run. Writes
OUT/lightglue.safetensors (float16, with the calibration of its scores on the validation pairs), OUT/log.json,
OUT/curves.png and OUT/reliability.png.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.nets.lightglue_file import CALIBRATION_KEY, DESCRIPTORS_KEY, Calibration, load_lightglue
from trainings.blocks import LEFT_OUT
from trainings.lightglue.batches import Batch, batch_of, piece, unit
from trainings.lightglue.blocks import LEAST_PARTNERS, Pair
from trainings.lightglue.data import SHARD, OutOfTime, pictures, prepare, read_block, read_groups
from trainings.lightglue.loss import loss_of
from trainings.lightglue.validation import Found, compared, fitted, report, thinned, together
from trainings.runs import (
    Log,
    at_least_one,
    check_images,
    check_recipe,
    descend,
    follow,
    load_state,
    save_state,
    shipped,
    training_device,
)

DIMENSIONS = Dimensions(input_dim=128, descriptor_dim=128, n_layers=6, num_heads=2, add_scale_ori=True)
DECAY, CLIP = 0.999, 1.0
ALL_KEYPOINTS = 4096
# Of the features by --features: what their descriptors are called.
DESCRIPTORS = {"sift": "RootSIFT", "learned": "GeoDesc"}
# Arguments of which another value makes other data, and another run.
OF_DATA, OF_RUN = ("features", "trained_on", "unseen", "groups", "blocks", "seed"), ("start", "scale", "batch", "rate")
REPORT_EVERY, SAVE_EVERY = 16_000, 2_000  # pairs


@dataclass(frozen=True)
class Phase:
    """pairs: to be seen. count: keypoints of either side. rendered: share of pairs of rendered blocks."""

    name: str
    pairs: int
    count: int
    rendered: float
    confidence: bool = False


def phases(scale: float, *, anew: bool) -> tuple[Phase, ...]:
    """anew: not from weights, which have learnt from homographies before."""
    first = (Phase("homographies", round(240_000 * scale), 256, 0.0),) if anew else ()
    return (
        *first,
        Phase("blocks", round(160_000 * scale), 384, 0.6),
        Phase("many", round(32_000 * scale), 768, 0.6, confidence=True),
    )


def drawn(stage1: list[Pair], stage2: list[Pair], phase: Phase, size: int, seen: int, seed: int) -> Batch:
    """The batch after so many pairs."""
    rng = np.random.default_rng([seen, 17, seed])
    pieces = []
    for _ in range(size):
        source = stage2 if rng.random() < phase.rendered else stage1
        pair = source[int(rng.integers(len(source)))]
        upright = not pair.side0.angles_rad.any()
        # Upright descriptors do not turn with the picture.
        sides = (pair.side0, pair.side1, pair.truth)
        pieces.append(piece(*sides, phase.count, rng, free=not upright))
    return batch_of(pieces, phase.count, rng)


class Batches(Dataset[Batch]):
    """Every batch from the pair `begin` on, in order."""

    def __init__(
        self, stage1: list[Pair], stage2: list[Pair], plan: Sequence[Phase], batch: int, begin: int, seed: int
    ) -> None:
        self.stages, self.seed = (stage1, stage2), seed
        self._plan, self._batch = plan, batch
        self.begins: list[int] = []
        while begin < sum(phase.pairs for phase in plan):
            self.begins.append(begin)
            begin += self.plan_at(begin)[1]

    def plan_at(self, seen: int) -> tuple[Phase, int]:
        """The phase after so many pairs, and how many pairs its batches have."""
        phase = _phase(self._plan, seen)
        return phase, max(1, self._batch * 256 // phase.count)

    def __len__(self) -> int:
        return len(self.begins)

    def __getitem__(self, number: int) -> Batch:
        if number >= len(self.begins):
            raise IndexError(number)
        seen = self.begins[number]
        return drawn(*self.stages, *self.plan_at(seen), seen, self.seed)


def on(batch: Batch, device: str) -> Batch:
    sides = (unit(side.to(device)) for side in (batch.side0, batch.side1))
    return Batch(*sides, batch.partners0.to(device), batch.partners1.to(device))


@dataclass
class Run:
    """Everything that a resumed run needs."""

    network: LightGlue
    average: LightGlue
    optimiser: torch.optim.Optimizer
    seen: int
    log: Log

    def save(self, path: Path) -> None:
        save_state(path, self.seen, self.log, self.network, self.average, self.optimiser)

    @classmethod
    def begin(
        cls,
        path: Path,
        device: str,
        rate: float,
        seed: int,
        start: Path | None = None,
        dimensions: Dimensions | None = None,
    ) -> Run:
        """Where the state file `path` left it, else from the weights `start`, else from nothing."""
        torch.manual_seed(seed)
        network = load_lightglue(start) if start else LightGlue(dimensions or DIMENSIONS)
        network = network.to(device).requires_grad_(True)
        run = cls(network, copy.deepcopy(network), torch.optim.AdamW(network.parameters(), rate), 0, [])
        run.seen, run.log = load_state(path, run.network, run.average, run.optimiser, device=device)
        return run


def train(args: argparse.Namespace, device: str, spent_s: float = 0.0) -> Run | None:
    """The finished run, or None where --minutes, of which so much is spent, ended it before."""
    plan = phases(args.scale, anew=args.start is None)
    total = sum(phase.pairs for phase in plan)
    stage1 = read_all(args.out / "data" / "stage1", read_groups)
    stage2 = read_all(args.out / "data" / "stage2", read_block)
    sets = validation_sets(args.out / "data")
    state, started = args.out / "state.pt", time.monotonic()
    dimensions = replace(DIMENSIONS, knows_ground=args.features == "learned")
    run = Run.begin(state, device, args.rate, args.seed, args.start, dimensions)
    print(f"{len(stage1)} homography pairs, {len(stage2)} rendered pairs, {run.seen} of {total} pairs seen", flush=True)
    losses: list[tuple[float, float, float]] = []
    batches = Batches(stage1, stage2, plan, args.batch, run.seen, args.seed)
    # Where a device computes, drawing is done beside it.
    for batch in DataLoader(batches, batch_size=None, num_workers=args.jobs if device == "cuda" else 0):
        phase, size = batches.plan_at(run.seen)
        for group in run.optimiser.param_groups:
            group["lr"] = args.rate * _rate(run.seen, total)
        losses.append(step(run, on(batch, device), phase, device))
        before, run.seen = run.seen, run.seen + size
        if run.seen // REPORT_EVERY > before // REPORT_EVERY or run.seen >= total:
            row = {"seen": run.seen, "phase": phase.name, "minutes": round((time.monotonic() - started) / 60, 1)}
            row |= dict(zip(("loss", "partner", "none"), np.mean(losses, axis=0).round(4).tolist(), strict=True))
            run.log.append(row | {"unseen": report(run.average.eval(), sets)})
            print(json.dumps(run.log[-1]), flush=True)
            losses = []
            run.save(state)
            draw_curves(run.log, args.out / "curves.png")
        elif run.seen // SAVE_EVERY > before // SAVE_EVERY:
            run.save(state)
        if args.minutes and run.seen < total and time.monotonic() - started > 60.0 * args.minutes - spent_s:
            run.save(state)
            print(f"{run.seen} of {total} pairs seen; the same command goes on from here", flush=True)
            return None
    return run


def read_all(folder: Path, read: Callable[[Path], list[Pair]]) -> list[Pair]:
    """Pairs of all files of a folder that there is something to learn from."""
    return [pair for path in sorted(folder.glob("*.npz")) for pair in read(path) if usable(pair)]


def usable(pair: Pair) -> bool:
    """Whether there is something to learn from it."""
    return pair.truth.count >= LEAST_PARTNERS


def _phase(plan: tuple[Phase, ...], seen: int) -> Phase:
    for phase in plan:
        if seen < phase.pairs:
            return phase
        seen -= phase.pairs
    return plan[-1]


def _rate(seen: int, total: int) -> float:
    """Of the learning rate: a short rise, then a cosine to next to nothing."""
    return min(1.0, (seen + 1) / min(8_000, 0.1 * total)) * (0.5 + 0.5 * math.cos(math.pi * seen / total)) + 0.005


def step(run: Run, batch: Batch, phase: Phase, device: str) -> tuple[float, float, float]:
    run.network.train()
    with torch.autocast(device, dtype=torch.bfloat16):
        loss = loss_of(run.network, batch, confidence=phase.confidence)
    descend(loss.total, run.network, run.optimiser, CLIP)
    follow(run.average, run.network, run.seen // len(batch.partners0), DECAY)
    return float(loss.total.detach()), loss.partner, loss.none


def validation_sets(data: Path, keypoints: tuple[int, int] = (512, 1024)) -> dict[str, list[Pair]]:
    """Unseen pairs by name, keypoints of homographies and of rendered pairs cut so that validation takes seconds."""
    first = read_all(data / "unseen1", read_groups)
    second = read_all(data / "unseen2", read_block)
    turned = [pair for pair in first if pair.side0.angles_rad.any()]
    upright = [pair for pair in first if not pair.side0.angles_rad.any()]
    third = read_all(data / "unseen3", read_block)
    sets = {} if not third else {"photographs": thinned(third, keypoints[1], 60)}
    return sets | {
        "homography, turned": thinned(turned, keypoints[0], 40),
        "homography, upright": thinned(upright, keypoints[0], 40),
        "rendered, one sun": thinned([pair for pair in second if not pair.two_suns], keypoints[1], 40),
        "rendered, two suns": thinned([pair for pair in second if pair.two_suns], keypoints[1], 40),
    }


def draw_curves(log: Log, path: Path) -> None:
    """Recall at the ratio test's precision, and what that test recalls (dashed), by pairs seen."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), dpi=110, layout="constrained")
    axes, losses = figure.subplots(1, 2)
    seen = [row["seen"] for row in log]
    for number, name in enumerate(log[-1]["unseen"]):
        axes.plot(seen, [row["unseen"][name]["recall"] for row in log], color=f"C{number}", label=name)
        axes.axhline(log[-1]["unseen"][name]["ratio_recall"], color=f"C{number}", linestyle="--", linewidth=0.8)
    axes.set(xlabel="pairs seen", ylabel="recall at the ratio test's precision (dashed: its recall)", ylim=(0.0, 1.0))
    axes.legend(frameon=False, fontsize=8)
    for name in ("loss", "partner", "none"):
        losses.plot(seen, [row[name] for row in log], label=name)
    losses.set(xlabel="pairs seen", ylabel="loss")
    losses.legend(frameon=False, fontsize=8)
    for part in (axes, losses):
        part.locator_params(axis="x", nbins=4)
    figure.savefig(path)


def finish(run: Run, out: Path, descriptors: str) -> None:
    """Weights with their calibration and the descriptors that they know, log and reliability plot."""
    from safetensors.torch import save_file

    network = run.average.eval()
    # With every keypoint, as in use: where partners were cut away fewer matches are right. Of rendered blocks alone:
    # the same score means more in homography pairs, where nothing is hidden.
    sets = validation_sets(out / "data", (ALL_KEYPOINTS, ALL_KEYPOINTS))
    found = together([compared(network, pairs)[1] for name, pairs in sets.items() if name.startswith("rendered")])
    calibration = fitted(found)
    metadata = {
        CALIBRATION_KEY: f"{calibration.slope:.4f} {calibration.offset:.4f}",
        DESCRIPTORS_KEY: descriptors,
    }
    save_file(shipped(network), out / "lightglue.safetensors", metadata)
    (out / "log.json").write_text(json.dumps(run.log, indent=1) + "\n", encoding="utf-8")
    draw_reliability({"raw": Calibration(), "calibrated": calibration}, found, out / "reliability.png")


def draw_reliability(ways: dict[str, Calibration], found: Found, path: Path) -> None:
    """Share of right matches by score."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5, 4.5), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=0.8)
    for name, calibration in ways.items():
        rows = found.reliability(calibration)
        axes.plot([row[3] for row in rows], [row[4] for row in rows], marker="o", label=name)
    axes.set(xlabel="score", ylabel="share of right matches", xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.legend(frameon=False)
    figure.savefig(path)


def check_start(parser: argparse.ArgumentParser, start: Path) -> None:
    """Before hours of data are made: the weights are there, and of this input."""
    try:
        found = load_lightglue(start).dimensions
    except (ConfigError, OSError) as error:
        parser.error(f"--start {start}: {error}")
    if (found.input_dim, found.add_scale_ori) != (DIMENSIONS.input_dim, DIMENSIONS.add_scale_ori):
        parser.error(f"--start {start}: descriptors of {found.input_dim}, SIFT with scale and orientation is trained")


def check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuses what cannot be trained on, and to go on with another run's data or state."""
    if args.blocks <= max(LEFT_OUT):
        parser.error(
            f"--blocks {args.blocks}: block {max(LEFT_OUT)} is for validation; give at least {max(LEFT_OUT) + 1}"
        )
    if args.groups < 4 * SHARD or args.groups % SHARD:
        parser.error(f"--groups {args.groups}: give a multiple of {SHARD}, at least {4 * SHARD}")
    for name in ("scale", "rate"):
        if not 0.0 < getattr(args, name) < math.inf:
            parser.error(f"--{name} {getattr(args, name)}: give a positive number")
    known, unseen = args.trained_on.split(","), args.unseen.split(",")
    if both := set(known) & set(unseen):
        parser.error(f"{', '.join(sorted(both))}: in --trained-on and --unseen; validation must not know it")
    check_images(parser, args.data, (*known, *unseen), "--data, --trained-on and --unseen")
    for name in (*known, *unseen):
        if not pictures([args.data / name]):
            parser.error(f"{args.data / name / 'images'} holds no picture")
    if args.start is not None:
        check_start(parser, args.start)
    check_recipe(parser, args, OF_DATA if args.only_data else (*OF_DATA, *OF_RUN))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of real blocks, each with a folder images")
    add("--trained-on", default="sheffield,caliterra,brighton", help="real blocks whose pictures are warped")
    add("--unseen", default="ochota,lewis,seneca", help="real blocks for validation only")
    add("--features", choices=("sift", "learned"), default="sift", help="whose keypoints and descriptors are matched")
    add("--groups", type=at_least_one, default=2400, help="groups of four homography views")
    add("--blocks", type=int, default=60, help="rendered blocks, at least 19")
    add("--rendered", type=Path, help="where rendered blocks are, or go (default OUT/blocks)")
    add("--start", type=Path, help="weights to go on from; the first phase, of homographies alone, is left out then")
    add(
        "--seed",
        type=int,
        default=0,
        help="of the first weights, the homography groups and what is drawn; rendered blocks stay",
    )
    add("--scale", type=float, default=1.0, help="of the number of pairs of every phase")
    add("--batch", type=at_least_one, help="pairs of 256 keypoints at once (default 16, 96 on CUDA)")
    add("--rate", type=float, default=6e-4, help="largest learning rate")
    add(
        "--jobs",
        type=at_least_one,
        default=2,
        help="processes that make the data, and beside a CUDA device draw batches; threads that train",
    )
    add("--minutes", type=float, default=0.0, help="stop after so long (0: never) and go on when called again")
    add("--only-data", action="store_true", help="make the data and stop")
    add("--out", type=Path, required=True)
    args = parser.parse_args(arguments)
    device = training_device()
    args.batch = args.batch or (96 if device == "cuda" else 16)
    args.rendered = args.rendered or args.out / "blocks"
    torch.set_num_threads(args.jobs)
    check(parser, args)
    began = time.time()
    try:
        until = began + 60.0 * args.minutes if args.minutes else math.inf
        prepare(args.out / "data", args.data, args.trained_on.split(","), args.unseen.split(","), args, until)
    except OutOfTime:
        print("the data is not all made; the same command goes on from here", flush=True)
        return
    run = None if args.only_data else train(args, device, time.time() - began)
    if run is not None:
        finish(run, args.out, DESCRIPTORS[args.features])
