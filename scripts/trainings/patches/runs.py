"""What both recipes share: arguments, the state of a run, learning rate, curves."""

from __future__ import annotations

import argparse
import copy
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from trainings.blocks import add_blocks
from trainings.patches.data import GROUPS
from trainings.runs import (
    Log,
    check_images,
    check_recipe,
    descend,
    follow,
    load_state,
    save_state,
    shipped,
    training_device,
)

DECAY, CLIP = 0.998, 5.0
# Patches at once through a network: their answers stay in a processor's cache, and batch norm's statistics are of so
# many. A CUDA device is idle with so few.
CHUNK = {"cpu": 256, "cuda": 4096}
T = TypeVar("T")
OF_RUN = ("patches", "blocks", "groups", "real", "seed", "steps", "batch", "rate")


def add_arguments(parser: argparse.ArgumentParser, *, others: str, steps: int, batch: int) -> None:
    """Those of every recipe. others: whose weights --reference holds."""
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of real blocks, each with folders images and reference")
    add("--real", default="sheffield,caliterra,seneca,brighton", help="real blocks to learn from")
    add("--reference", type=Path, help=f"folder of other {others}' weights, to compare with")
    add_blocks(parser)
    add("--rendered", type=Path, help="where rendered blocks are, or go (default OUT/blocks)")
    add("--groups", type=int, default=960, help=f"groups of homography views, a multiple of {GROUPS}")
    add("--patches", type=Path, help="where patches are, or go (default OUT/data)")
    add("--seed", type=int, default=0)
    add("--steps", type=int, default=steps)
    add("--batch", type=int, default=batch, help="pairs of a step")
    add("--rate", type=float, default=3e-3, help="largest learning rate")
    add("--jobs", type=int, default=2, help="processes that make the data, threads that train")
    add("--minutes", type=float, default=0.0, help="stop after so long (0: never) and go on when called again")
    add("--out", type=Path, required=True)


def parsed(
    parser: argparse.ArgumentParser, arguments: Sequence[str] | None, peers: Iterable[str]
) -> argparse.Namespace:
    """The arguments of a run, its folders filled in; refuses what is not there, and to go on with another run.

    peers: files that --reference must hold.
    """
    args = parser.parse_args(arguments)
    check_images(parser, args.data, args.real.split(","), "--data and --real")
    for file in peers if args.reference is not None else ():
        if not (args.reference / file).is_file():
            parser.error(f"{args.reference / file} is missing; --reference may be left out")
    if args.groups % GROUPS:
        parser.error(f"--groups {args.groups} is no multiple of {GROUPS}")
    args.patches, args.rendered = args.patches or args.out / "data", args.rendered or args.out / "blocks"
    torch.set_num_threads(args.jobs)
    check_recipe(parser, args, OF_RUN)
    return args


@dataclass
class Run:
    """Everything that a resumed run needs. average: moving average of the weights, batch norm's statistics included."""

    network: nn.Module
    average: nn.Module
    optimiser: torch.optim.Optimizer
    step: int
    log: Log

    @classmethod
    def begin(cls, path: Path, make: Callable[[], nn.Module], rate: float, seed: int) -> Run:
        """Where the state file `path` left it, else from nothing."""
        torch.manual_seed(seed)
        device = training_device()
        network = make().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-3)
        run = cls(network, copy.deepcopy(network), optimiser, 0, [])
        run.step, run.log = load_state(path, run.network, run.average, run.optimiser, device=device)
        return run

    @property
    def device(self) -> torch.device:
        return next(self.network.parameters()).device

    def tell_unfinished(self, steps: int) -> None:
        """What a call that --minutes ended says."""
        print(f"ended by --minutes after step {self.step} of {steps}: the same command goes on, and writes weights")

    def save(self, path: Path) -> None:
        save_state(path, self.step, self.log, self.network, self.average, self.optimiser)

    def learn(self, loss: Tensor, rate: float) -> None:
        """One step of the optimiser, and of the average."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        descend(loss, self.network, self.optimiser, CLIP)
        follow(self.average, self.network, self.step, DECAY)
        self.step += 1


def answered(network: Callable[[Tensor], Tensor], patches: Tensor, device: torch.device) -> Tensor:
    """What a network in training says on its device of patches (N, 1, 32, 32), CHUNK at a time, in bfloat16."""
    with torch.autocast(device.type, dtype=torch.bfloat16):
        return torch.cat([network(part) for part in patches.to(device).split(CHUNK[device.type])])


def ahead(make: Callable[[int], T], first: int, last: int, jobs: int) -> Iterator[T]:
    """make(first), ... make(last - 1), in order, made by `jobs` threads while the caller is busy with earlier ones."""
    with ThreadPoolExecutor(jobs) as pool:
        waiting = deque(pool.submit(make, number) for number in range(first, min(last, first + 2 * jobs)))
        number = first + len(waiting)
        while waiting:
            done = waiting.popleft().result()
            if number < last:
                waiting.append(pool.submit(make, number))
                number += 1
            yield done


def rate_at(step: int, total: int, largest: float) -> float:
    """A short rise, then a cosine to next to nothing."""
    return largest * (min(1.0, (step + 1) / (0.04 * total)) * (0.5 + 0.5 * math.cos(math.pi * step / total)) + 0.002)


def ship(folded: nn.Module, path: Path) -> None:
    """Weights as float16."""
    save_file(shipped(folded), path)


def draw_curves(log: Log, values: dict[str, list[float]], lines: dict[str, float], label: str, path: Path) -> None:
    """Values by step, lines of others to compare with (dashed), and the loss."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.3), dpi=110, layout="constrained")
    axes, losses = figure.subplots(1, 2)
    steps = [row["step"] for row in log]
    for name, series in values.items():
        axes.plot(steps, series, label=name)
    for number, (name, value) in enumerate(lines.items()):
        axes.axhline(value, color=f"C{number + len(values)}", linestyle="--", linewidth=0.9, label=name)
    axes.set(xlabel="steps", ylabel=label)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    losses.plot(steps, [row["loss"] for row in log])
    losses.set(xlabel="steps", ylabel="loss")
    figure.savefig(path)
