"""What trainings share: which run a folder holds, its state on file, steps of the optimiser and of the average."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

Log = list[dict[str, Any]]
# Of a run: networks and optimisers.
Part = nn.Module | torch.optim.Optimizer


def training_device() -> str:
    """CUDA where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def at_least_one(text: str) -> int:
    """For argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


def check_images(parser: argparse.ArgumentParser, data: Path, names: Iterable[str], options: str) -> None:
    """Refuses real blocks without a folder of images. options: those that name folder and blocks."""
    for name in names:
        if not (data / name / "images").is_dir():
            parser.error(f"{data / name} has no folder images; see {options}")


def check_recipe(parser: argparse.ArgumentParser, args: argparse.Namespace, names: Sequence[str]) -> None:
    """Refuses to go on with a run of other arguments; OUT/recipe.json remembers them.

    What it does not hold yet is added: a run that makes data alone names less.
    """
    asked = {name: str(getattr(args, name)) for name in names}
    path = args.out / "recipe.json"
    if args.out.exists() and not args.out.is_dir():
        parser.error(f"--out {args.out} is no folder")
    try:
        known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except json.JSONDecodeError:
        parser.error(f"{path} is damaged: delete it if {args.out} holds this very run, or give another --out")
    other = [f"{name} {known[name]}" for name in names if known.get(name, asked[name]) != asked[name]]
    if other:
        parser.error(f"{args.out} holds another run ({', '.join(other)}); give another --out")
    args.out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(known | asked, indent=1) + "\n", encoding="utf-8")


def save_state(path: Path, done: int, log: Log, *parts: Part) -> None:
    """Whole or not at all: a run may be killed at any moment. done: steps, or pairs seen."""
    partly = path.with_suffix(".partly")
    torch.save((done, log, *(part.state_dict() for part in parts)), partly)
    partly.replace(path)


def load_state(path: Path, *parts: Part, device: str = "cpu") -> tuple[int, Log]:
    """Put the parts where the file left them; how much is done, and the log. Nothing, where there is no file."""
    if not path.is_file():
        return 0, []
    done, log, *states = torch.load(path, map_location=device, weights_only=True)
    for part, state in zip(parts, states, strict=True):
        part.load_state_dict(state)
    return done, log


def descend(loss: Tensor, network: nn.Module, optimiser: torch.optim.Optimizer, clip: float) -> None:
    """One step of the optimiser. clip: largest norm of the network's gradient."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    optimiser.step()


def follow(average: nn.Module, network: nn.Module, step: int, decay: float) -> None:
    """One step of the moving average of the weights, batch norm's statistics included; the first ones are longer."""
    keep = min(decay, (step + 1) / (step + 10))
    with torch.no_grad():
        for old, new in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
            if old.is_floating_point():
                old.lerp_(new, 1.0 - keep)


def shipped(network: nn.Module) -> dict[str, Tensor]:
    """Weights as they are shipped, in float16."""
    return {name: value.half().cpu().contiguous() for name, value in network.state_dict().items()}
