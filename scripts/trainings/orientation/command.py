"""Train the orientation network that ships with the package, by nothing but turns.

Two patches of one ground point, each turned at will, are to have orientations that differ by the turn between them: the
drawn one plus the true one between their pictures (trainings.patches.sources; the patches are those of
scripts/train descriptor). Place and scale are off as a detector leaves them and every patch has a light of its own.
Nobody says what the orientation of a patch is: the network settles on what it finds again. The loss is the logarithm of
the chance that two draws from both histograms differ by the turn.

Validation knows neither the scenes nor the flights. Beside it stand SIFT's gradient histogram and, with --reference,
OriNet, on the same patches.

On the CPU, and on a CUDA device where there is one. OUT/state.pt is kept: a killed run, or one ended by --minutes, goes
on where it was; OUT/recipe.json makes sure that it is the same run. Writes OUT/orientation.safetensors (float16, batch
norm folded in), OUT/log.json, OUT/table.json, OUT/curves.png and OUT/errors.png.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aeromatch_cli.nets.orientation import BINS, OrientationNet, directions
from aeromatch_cli.nets.patches import fold, in_channels_last
from trainings.patches.data import prepare, read
from trainings.patches.draws import Group, Source, developed, drawn, photographed, sources_of, stored_of
from trainings.patches.runs import Run, add_arguments, ahead, answered, draw_curves, parsed, rate_at, ship
from trainings.patches.turns import (
    Orient,
    TurnedPairs,
    draw_distribution,
    errors_deg,
    gradient_peaks,
    orinet,
    table,
    turned,
    unseen_pairs,
)

# A chance below the floor counts as hopeless: two suns, or nothing to orient by.
TOLERANCE_DEG, FLOOR = 7.0, 0.02
# Small view angles first.
HARDNESS = (-1.0, 0.5)
REPORTS, SAVES = 25, 100  # of a run
GROUPS = 4
EACH = 1500  # validation pairs of a set
PEER = "OriNet.pth"


def turn_loss(first: Tensor, second: Tensor, turn_deg: Tensor) -> Tensor:
    """Of logarithms of histograms (N, 36) and the turn (N,) by which the second's orientation is to exceed the first's.

    The chance that an orientation drawn from the one and one drawn from the other differ by the turn, give or take
    TOLERANCE_DEG; its logarithm over a floor.
    """
    spectra = (torch.fft.rfft(side.exp(), dim=1) for side in (first, second))
    along, other = spectra
    differences = torch.fft.irfft(along.conj() * other, n=BINS, dim=1)  # (N, 36) chances of 0, 10, ... 350 degrees
    steps = torch.arange(BINS, device=turn_deg.device) * (360.0 / BINS)
    off = torch.deg2rad(steps - turn_deg[:, None])
    near = torch.exp((torch.cos(off) - 1.0) / np.deg2rad(TOLERANCE_DEG) ** 2)
    return -torch.log((differences * near).sum(dim=1).clamp(min=0.0) + FLOOR).mean()


def train(run: Run, known: list[Source], quick: TurnedPairs, args: argparse.Namespace) -> bool:
    """Whether it came to the end; False where --minutes ended it before."""
    weights = np.array([source.weight for source in known])
    started, losses = time.monotonic(), []

    def draw(step: int) -> tuple[list[Group], list[tuple[Tensor, Tensor]], np.random.Generator]:
        """A step's groups, what is stored of them, and draws for the rest."""
        rng = np.random.default_rng([step, 11, args.seed])
        hardness = HARDNESS[0] + (HARDNESS[1] - HARDNESS[0]) * step / args.steps
        chosen = rng.choice(len(known), GROUPS, p=weights / weights.sum())
        groups = [drawn(known[i], args.batch // GROUPS, hardness, rng) for i in chosen]
        return groups, [stored_of(group) for group in groups], rng

    for groups, stored, rng in ahead(draw, run.step, args.steps, args.jobs):
        there = [(first.to(run.device), second.to(run.device)) for first, second in stored]
        sides = [turned(group, both, rng) for group, both in zip(groups, there, strict=True)]
        first, second = (torch.cat([photographed(developed(side[i], rng), rng) for side in sides]) for i in (0, 1))
        turn = torch.from_numpy(np.concatenate([side[2] for side in sides])).float()
        run.network.train()
        both = answered(run.network.scores, torch.stack([first, second], dim=1).flatten(0, 1), run.device)
        both = both.view(len(first), 2, BINS)
        loss = turn_loss(both[:, 0], both[:, 1], turn.to(run.device))
        run.learn(loss, rate_at(run.step, args.steps, args.rate))
        losses.append(loss.detach())
        if run.step % max(1, args.steps // REPORTS) == 0 or run.step == args.steps:
            minutes = round((time.monotonic() - started) / 60.0, 1)
            row = {"step": run.step, "minutes": minutes, "loss": round(float(torch.stack(losses).mean()), 4)}
            run.log.append(row | {"unseen": table(oriented_by(run), quick)["all"]})
            print(json.dumps(run.log[-1]), flush=True)
            losses = []
        over = args.minutes and time.monotonic() - started > 60.0 * args.minutes
        if over or run.step % max(1, args.steps // SAVES) == 0 or run.step == args.steps:
            run.save(args.out / "state.pt")
        if over:
            return run.step >= args.steps
    return True


def oriented_by(run: Run) -> Orient:
    """The averaged network as it is used, in bfloat16."""
    network = in_channels_last(fold(run.average.eval(), OrientationNet(folded=True)).to(run.device, torch.bfloat16))

    def orient(patches: Any) -> Any:
        found = directions(patches, network)
        return np.rad2deg(np.arctan2(found[:, 1], found[:, 0]))

    return orient


def peers(reference: Path | None) -> dict[str, Orient]:
    """What stands beside it."""
    ways: dict[str, Orient] = {"gradient histogram": gradient_peaks}
    if reference is not None:
        content = torch.load(reference / PEER, map_location="cpu", weights_only=True)
        ways["OriNet"] = orinet(content.get("state_dict", content))
    return ways


def compare(run: Run, unseen: TurnedPairs, out: Path, reference: Path | None) -> None:
    """OUT/table.json and OUT/errors.png: every estimator on the same patches."""
    ways = {"ours": oriented_by(run), **peers(reference)}
    found = {name: table(way, unseen) for name, way in ways.items()}
    (out / "table.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    draw_distribution({name: errors_deg(way, unseen) for name, way in ways.items()}, out / "errors.png")
    for row in found["ours"]:
        print(row, {name: list(rows[row].values()) for name, rows in found.items()}, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, others="networks", steps=5000, batch=128)
    args = parsed(parser, arguments, (PEER,))
    known, unseen = prepare(args.patches, args.rendered, args.data, args.real.split(","), args)
    patches = read(args.patches / "unseen", unseen)
    run = Run.begin(args.out / "state.pt", OrientationNet, args.rate, args.seed)
    quick = unseen_pairs(patches, EACH // 5)
    if not train(run, sources_of(read(args.patches / "known", known)), quick, args):
        run.tell_unfinished(args.steps)
        return
    ship(fold(run.average.eval(), OrientationNet(folded=True)), args.out / "orientation.safetensors")
    (args.out / "log.json").write_text(json.dumps(run.log, indent=1) + "\n", encoding="utf-8")
    compare(run, unseen_pairs(patches, EACH), args.out, args.reference)
    others = {way: table(peer, quick)["all"] for way, peer in peers(args.reference).items()}
    names = [name for name in run.log[-1]["unseen"] if name.startswith("within")]
    values = {name: [row["unseen"][name] for row in run.log] for name in names}
    lines = {f"{way}, {name}": rows[name] for way, rows in others.items() for name in names}
    draw_curves(run.log, values, lines, "share of unseen pairs within 10 and 20 degrees", args.out / "curves.png")
