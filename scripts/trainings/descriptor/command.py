"""Train the descriptors that ship with the package: GeoDesc's recipe on the L2-Net architecture, then on a small one.

Pairs of patches show one ground point in two pictures (trainings.patches.sources): rendered blocks by exact truth, with
parallax, occlusion, oblique views and two suns; homographies of real pictures, developed anew; sparse points of
reference reconstructions of real blocks. They are cut around SIFT keypoints (or sparse points) of 3 to 40 px at the
true scale, upright in ground views, along the true turn in pictures as taken, and cropped off place, scale and turn as
detectors and orientation networks leave them.

A batch is made of groups from one block each, of places of like size: its hardest negatives are look-alikes of the same
scene; two places that overlap are no negatives. Pairs are drawn by view angle, small ones first, large ones later. The
loss is HardNet's plus a softmax over the batch. The learning rate falls along a cosine; what is kept is a moving
average.

With --teacher, weights of the large network, it is the small one that learns, to answer as the teacher does, too: it
takes a quarter of the seconds, and its descriptors can stand in for the teacher's.

Validation knows neither the scenes nor the flights: pairs of pictures of rendered blocks of other seeds. Beside it
stand RootSIFT and, with --reference, TFeat and HardTFeat on the same patches.

On the CPU, and on a CUDA device where there is one. OUT/state.pt is kept: a killed run, or one ended by --minutes, goes
on where it was; OUT/recipe.json makes sure that it is the same run. Writes OUT/geodesc.safetensors (float16, batch norm
folded in), OUT/log.json, OUT/table.json and OUT/curves.png.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from aeromatch_cli.nets.geodesc import GeoDesc, Size, describe, load_geodesc
from aeromatch_cli.nets.patches import fold, in_channels_last
from trainings.patches.data import prepare, read
from trainings.patches.draws import Group, Source, distinct, drawn, looked_at, sources_of, stored_of
from trainings.patches.loss import descriptor_loss
from trainings.patches.runs import Run, add_arguments, ahead, answered, draw_curves, parsed, rate_at, ship
from trainings.patches.validation import Describe, Pair, pairs_of, sift, table, tfeat
from trainings.runs import check_recipe

GROUPS = 4  # of a batch, each from one block
# How much pairs of larger view angle are favoured, at the first step and at the last.
HARDNESS = (-1.0, 1.0)
# Weight of 1 - cosine to the teacher's answer.
LIKENESS = 4.0
REPORTS, SAVES = 32, 128  # of a run
QUICK = 120  # tracks of a pair of pictures, and every so many pairs, while it trains
PEERS = {"TFeat": "tfeat-liberty.params", "HardTFeat": "HardTFeat.pth"}


def train(run: Run, known: list[Source], quick: list[Pair], args: argparse.Namespace) -> bool:
    """Whether it came to the end; False where --minutes ended it before."""
    teacher = None if args.teacher is None else load_geodesc(args.teacher, "bfloat16", str(run.device))
    weights = np.array([source.weight for source in known])
    started, losses = time.monotonic(), []

    def draw(step: int) -> tuple[list[Group], list[tuple[Tensor, Tensor]], Tensor, np.random.Generator]:
        """A step's groups, what is stored of them, which tracks are negatives, and draws for the rest."""
        rng = np.random.default_rng([step, 7, args.seed])
        hardness = HARDNESS[0] + (HARDNESS[1] - HARDNESS[0]) * step / args.steps
        chosen = rng.choice(len(known), GROUPS, p=weights / weights.sum())
        groups = [drawn(known[i], args.batch // GROUPS, hardness, rng) for i in chosen]
        return groups, [stored_of(group) for group in groups], distinct(groups), rng

    for groups, stored, negatives, rng in ahead(draw, run.step, args.steps, args.jobs):
        there = [(first.to(run.device), second.to(run.device)) for first, second in stored]
        sides = [looked_at(group, both, rng) for group, both in zip(groups, there, strict=True)]
        first, second = (torch.cat([side[i] for side in sides]) for i in (0, 1))
        run.network.train()
        # Both sides of a pair go through together.
        both = answered(run.network, torch.stack([first, second], dim=1).flatten(0, 1), run.device)
        both = both.view(len(first), 2, -1)
        loss = descriptor_loss(both[:, 0], both[:, 1], negatives.to(run.device))
        if teacher is not None:
            loss = loss + LIKENESS * unlikeness(both[:, 0], first, teacher, run.device)
        run.learn(loss, rate_at(run.step, args.steps, args.rate))
        losses.append(loss.detach())
        if run.step % max(1, args.steps // REPORTS) == 0 or run.step == args.steps:
            minutes = round((time.monotonic() - started) / 60.0, 1)
            row = {"step": run.step, "minutes": minutes, "loss": round(float(torch.stack(losses).mean()), 4)}
            run.log.append(row | {"unseen": table(described_by(run, args), quick)["all"]})
            print(json.dumps(run.log[-1]), flush=True)
            losses = []
        if run.step % max(1, args.steps // SAVES) == 0 or run.step == args.steps:
            run.save(args.out / "state.pt")
        if args.minutes and time.monotonic() - started > 60.0 * args.minutes:
            run.save(args.out / "state.pt")
            return run.step >= args.steps
    return True


def unlikeness(own: Tensor, patches: Tensor, teacher: nn.Module, device: torch.device) -> Tensor:
    """Mean of 1 - cosine between own descriptors (N, 128) of patches (N, 1, 32, 32) and the teacher's."""
    with torch.no_grad():
        taught = answered(teacher, patches, device)
    return (1.0 - (own * taught).sum(dim=1)).mean()


def folded(run: Run, args: argparse.Namespace) -> GeoDesc:
    """The averaged network as it is shipped."""
    return fold(run.average.eval(), GeoDesc(size_of(args), folded=True))


def size_of(args: argparse.Namespace) -> Size:
    return "large" if args.teacher is None else "small"


def described_by(run: Run, args: argparse.Namespace) -> Describe:
    """The averaged network as it is used, in bfloat16."""
    network = in_channels_last(folded(run, args).to(run.device, torch.bfloat16))
    return lambda patches: describe(patches, network)


def peers(reference: Path | None) -> dict[str, Describe]:
    """What stands beside it."""
    found: dict[str, Describe] = {"RootSIFT": sift}
    if reference is not None:
        found |= {name: tfeat(peer_weights(reference / file)) for name, file in PEERS.items()}
    return found


def peer_weights(path: Path) -> Any:
    """Published tensors by name; files that keep them under `state_dict` are unwrapped."""
    content = torch.load(path, map_location="cpu", weights_only=True)
    return content.get("state_dict", content)


def compare(run: Run, unseen: list[Pair], args: argparse.Namespace) -> None:
    """OUT/table.json: every descriptor on the same patches."""
    ways = {"GeoDesc": described_by(run, args)}
    if args.teacher is not None:
        ways["teacher"] = partial(describe, network=load_geodesc(args.teacher, "bfloat16"))
    found = {name: table(way, unseen) for name, way in {**ways, **peers(args.reference)}.items()}
    (args.out / "table.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    for row in found["GeoDesc"]:
        cells = (f"{way} {rows[row]['fpr95']:.3f} {rows[row]['map']:.3f}" for way, rows in found.items())
        print(f"{row} ({found['GeoDesc'][row]['pairs']}): {' | '.join(cells)}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, others="descriptors", steps=3200, batch=512)
    parser.add_argument("--teacher", type=Path, help="weights of the large network, for the small one to learn from")
    parser.add_argument("--only-data", action="store_true", help="make the data and stop")
    parser.add_argument("--only-table", action="store_true", help="compare the state as it is and write its weights")
    args = parsed(parser, arguments, PEERS.values())
    check_recipe(parser, args, ("teacher",))
    known, unseen = prepare(args.patches, args.rendered, args.data, args.real.split(","), args)
    if args.only_data:
        return
    patches = read(args.patches / "unseen", unseen)
    run = Run.begin(args.out / "state.pt", partial(GeoDesc, size_of(args)), args.rate, args.seed)
    quick = pairs_of(patches, QUICK)[::5]
    if args.only_table and not run.log:
        parser.error(f"--only-table: {args.out} has no state of a training yet")
    sources = [] if args.only_table else sources_of(read(args.patches / "known", known))
    if not args.only_table and not train(run, sources, quick, args):
        run.tell_unfinished(args.steps)
        return
    ship(folded(run, args), args.out / "geodesc.safetensors")
    (args.out / "log.json").write_text(json.dumps(run.log, indent=1) + "\n", encoding="utf-8")
    compare(run, pairs_of(patches), args)
    others = {way: table(peer, quick)["all"] for way, peer in peers(args.reference).items()}
    values = {name: [row["unseen"][name] for row in run.log] for name in ("fpr95", "map")}
    lines = {f"{way} {name}": rows[name] for way, rows in others.items() for name in values}
    draw_curves(run.log, values, lines, "FPR95, mAP on unseen pairs", args.out / "curves.png")
