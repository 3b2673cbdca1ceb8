"""Train the keypoint detector that ships with the package, in the paper's two stages.

Stage 1 (`shapes`) learns exact corners of simple shapes in any light (trainings.detector.shapes); its targets are
Gaussian heat maps. Stage 2 goes on with real and rendered images (trainings.detector.groups): several views of one
place, of pictures of --trained-on by homographies with a light of their own each, and of rendered blocks as north-up
ground views from noisy poses, with parallax, occlusion and two suns, the warps exact. First (`adaptation`) the heat of
all views of a place is averaged in one of them, and the maxima of the average are its labels: homographic adaptation
(DeTone et al. 2018, SuperPoint) and, over rendered views, view adaptation. Then (`pairs`) two views are compared
directly: what counts is how many keypoints of the one, within a budget, the other one has at their exact place
(trainings.detector.loss), with the labels beside it.

Validation: rendered blocks that are left out, by view angle, exactly --keypoints keypoints in the
overlap, one-to-one at 3 and 1 px, beside the project's SIFT on the same views.

With layers in bfloat16, on the CPU and on a CUDA device where there is one. OUT/views and OUT/state.pt are kept: a
killed run, or one ended by --minutes, goes on where it was; OUT/recipe.json makes sure that it is the same run. Writes
OUT/detector.safetensors (float16), OUT/log.json and OUT/curves.png.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aeromatch_cli.nets.detector import REACH_PX, Detector, load_detector
from trainings.blocks import LEFT_OUT, add_blocks, block_list, numbers, render
from trainings.detector.groups import SIDE_PX, Gray, Group, block_group, homography_group, pictures
from trainings.detector.loss import at, drawn, label_loss, peaks, repeat_loss
from trainings.detector.scenes import Sight, read_sights, sights, write_sights
from trainings.detector.shapes import shape
from trainings.detector.validation import by_heat, by_sift, pairs_of, scores, table, thinned
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

DECAY, CLIP = 0.995, 1.0
LABEL_PX2 = 160.0  # a view has one label per so many pixels
OF_RUN = ("trained_on", "blocks", "unseen", "seed", "scale", "batch", "rate")
STEEP_DEG, STEEP_PAIRS = 45.0, 4
MOST_PAIRS = 24  # of validation between two view angles
REPORT_EVERY, SAVE_EVERY = 250, 50  # steps


@dataclass(frozen=True)
class Phase:
    """steps of so many views at once. rendered: share of groups of rendered blocks. labels, pairs: weights of both
    losses in stage 2."""

    name: str
    steps: int
    views: int = 1
    rendered: float = 0.0
    labels: float = 1.0
    pairs: float = 0.0


def phases(scale: float) -> tuple[Phase, ...]:
    return (
        Phase("shapes", round(250 * scale)),
        Phase("adaptation", round(150 * scale), views=3, rendered=0.5),
        Phase("pairs", round(2000 * scale), views=3, rendered=0.75, labels=0.1, pairs=1.0),
    )


@dataclass
class Run:
    """Everything that a resumed run needs."""

    network: Detector
    average: Detector
    optimiser: torch.optim.Optimizer
    step: int
    log: Log

    def save(self, path: Path) -> None:
        save_state(path, self.step, self.log, self.network, self.average, self.optimiser)

    @classmethod
    def begin(cls, path: Path, rate: float, seed: int, device: str) -> Run:
        """Where the state file left it, else from nothing."""
        torch.manual_seed(seed)
        network = Detector().to(device)
        run = cls(network, copy.deepcopy(network), torch.optim.AdamW(network.parameters(), rate), 0, [])
        with torch.no_grad():
            network.last.bias.fill_(-3.0)
        run.step, run.log = load_state(path, run.network, run.average, run.optimiser, device=device)
        return run


@dataclass(frozen=True, eq=False)
class Sources:
    """What stage 2 learns from."""

    pictures: list[Gray]
    blocks: list[list[Sight]]


def train(args: argparse.Namespace, sources: Sources, unseen: list[list[Sight]]) -> Run | None:
    """The finished run, or None where --minutes ended it before."""
    plan = phases(args.scale)
    total = sum(phase.steps for phase in plan)
    state, started = args.out / "state.pt", time.monotonic()
    run = Run.begin(state, args.rate, args.seed, training_device())
    pairs = thinned(pairs_of(unseen), MOST_PAIRS)
    if not run.log:
        run.log.append({"step": 0, "phase": "sift", "unseen": table(scores(pairs, by_sift, args.keypoints))})
        print(json.dumps(run.log[-1]), flush=True)
    print(f"{len(sources.pictures)} pictures, {len(sources.blocks)} blocks, {run.step} of {total} steps", flush=True)
    figures: list[Counter[str]] = []
    while run.step < total:
        phase, first = _phase(plan, run.step)
        for group in run.optimiser.param_groups:
            group["lr"] = args.rate * _rate(run.step - first, phase.steps, last=phase is plan[-1])
        rng = np.random.default_rng([run.step, 11, args.seed])
        figures.append(step(run, phase, args.batch, sources, rng))
        run.step += 1
        last_of_phase = run.step - first == phase.steps
        if run.step % REPORT_EVERY == 0 or last_of_phase:
            row = {"step": run.step, "phase": phase.name, "minutes": round((time.monotonic() - started) / 60, 1)}
            sums = sum(figures, Counter())
            row |= {name: round(value / len(figures), 4) for name, value in sums.items()}
            figures = []
            row["unseen"] = table(scores(pairs, by_heat(copy.deepcopy(run.average).eval()), args.keypoints))
            run.log.append(row)
            print(json.dumps(row), flush=True)
            run.save(state)
            write(run, args.out)
        elif run.step % SAVE_EVERY == 0:
            run.save(state)
        if args.minutes and time.monotonic() - started > 60.0 * args.minutes:
            run.save(state)
            return None
    return run


def _phase(plan: tuple[Phase, ...], step: int) -> tuple[Phase, int]:
    """The phase of a step, and its first step."""
    first = 0
    for phase in plan:
        if step < first + phase.steps:
            return phase, first
        first += phase.steps
    return plan[-1], first - plan[-1].steps


def _rate(step: int, steps: int, *, last: bool) -> float:
    """Of the learning rate: a short rise in every phase; the last one falls along a cosine to next to nothing."""
    rise = min(1.0, (step + 1) / 40)
    return rise * ((0.5 + 0.5 * math.cos(math.pi * step / steps)) + 0.01 if last else 1.0)


def step(run: Run, phase: Phase, batch: int, sources: Sources, rng: np.random.Generator) -> Counter[str]:
    """One step of the optimiser; what the log sums up."""
    run.network.train()
    if phase.name == "shapes":
        loss, figures = shapes_loss(run.network, batch * 3, rng)
    else:
        loss, figures = views_loss(run.network, phase, groups(phase, batch, sources, rng))
    descend(loss, run.network, run.optimiser, CLIP)
    follow(run.average, run.network, run.step, DECAY)
    return figures


def shapes_loss(network: Detector, count: int, rng: np.random.Generator) -> tuple[Tensor, Counter[str]]:
    made = [shape(SIDE_PX, rng) for _ in range(count)]
    logits = forward(network, torch.from_numpy(np.stack([gray for gray, _ in made])))
    target = drawn([corners for _, corners in made], SIDE_PX).to(logits.device)
    loss = label_loss(logits, target, _inner(torch.ones_like(logits)))
    return loss, Counter({"shapes": float(loss.detach())})


def groups(phase: Phase, batch: int, sources: Sources, rng: np.random.Generator) -> list[Group]:
    found: list[Group] = []
    while len(found) < batch:
        if rng.random() < phase.rendered:
            group = block_group(sources.blocks, phase.views, rng)
        else:
            group = homography_group(sources.pictures, phase.views, rng)
        if group is not None:
            found.append(group)
    return found


def views_loss(network: Detector, phase: Phase, made: list[Group]) -> tuple[Tensor, Counter[str]]:
    """Of groups of equally many views: (B, V) grays, (B, V - 1) places."""
    views, figures = phase.views, Counter[str]()
    grays = torch.from_numpy(np.stack([group.grays for group in made]))
    logits = forward(network, grays.flatten(0, 1)).unflatten(0, (len(made), views))
    places = torch.from_numpy(np.stack([group.places for group in made])).to(logits.device)
    seen = torch.isfinite(places[..., 0])[:, :, None].float()
    places = places.nan_to_num(nan=-1e4)
    loss = logits.new_zeros(())
    if phase.pairs:
        for other in range(1, views):
            shown = _inner(seen[:, other - 1])
            rank, place, repeated = repeat_loss(logits[:, 0], logits[:, other], places[:, other - 1], shown)
            loss = loss + phase.pairs * (0.5 * rank + place) / (views - 1)
            figures += Counter(
                {"rank": float(rank.detach()) / (views - 1), "soft repeat": float(repeated) / (views - 1)}
            )
    with torch.no_grad():
        target, weight = adapted(logits.sigmoid(), places, seen)
    labels = label_loss(logits[:, 0], target, weight)
    figures["labels"] = float(labels.detach())
    return loss + phase.labels * labels, figures


def adapted(heat: Tensor, places: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Labels (B, 1, S, S) in the first of V views (B, V, 1, S, S), and where they count.

    places: (B, V - 1, S, S, 2). seen: (B, V - 1, 1, S, S). The heat of all views is averaged where it is seen; the
    largest maxima of the average get a Gaussian each, equally many in every group whatever the network's confidence.
    """
    total, count = heat[:, 0].clone(), torch.ones_like(heat[:, 0])
    for other in range(places.shape[1]):
        total += at(heat[:, other + 1], places[:, other]) * seen[:, other]
        count += seen[:, other]
    shown = (count > 1.5).float()
    areas = _inner(shown).sum(dim=(1, 2, 3))
    averages = _inner(total / count * shown)
    points = [
        peaks(average[None], max(1, round(float(area) / LABEL_PX2)))[0]
        for average, area in zip(averages, areas, strict=True)
    ]
    return drawn(points, SIDE_PX).to(heat.device), _inner(shown)


def forward(network: Detector, grays: Tensor) -> Tensor:
    """Logits (N, 1, S, S) of grays (N, S, S) uint8."""
    grays = grays.to(next(network.parameters()).device)
    with torch.autocast(grays.device.type, dtype=torch.bfloat16):
        return network(grays[:, None].float() / 255.0).float()


def _inner(weight: Tensor) -> Tensor:
    """Nothing where the layers see the piece's edge."""
    inner = torch.zeros_like(weight)
    rim = REACH_PX // 2
    inner[..., rim:-rim, rim:-rim] = weight[..., rim:-rim, rim:-rim]
    return inner


def write(run: Run, out: Path) -> None:
    """Weights, log and curves as they are now."""
    from safetensors.torch import save_file

    save_file(shipped(run.average), out / "detector.safetensors")
    (out / "log.json").write_text(json.dumps(run.log, indent=1) + "\n", encoding="utf-8")
    draw_curves(run.log, out / "curves.png")


def draw_curves(log: Log, path: Path) -> None:
    """Repeatability by steps and view angle at 3 px and 1 px, and SIFT's (dashed)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), dpi=110, layout="constrained")
    rows = [row for row in log if row["phase"] != "sift"]
    for axes, limit in zip(figure.subplots(1, 2, sharey=True), ("3px", "1px"), strict=True):
        for number, angle in enumerate(log[0]["unseen"]):
            axes.plot([r["step"] for r in rows], [r["unseen"][angle][limit] for r in rows], color=f"C{number}",
                      label=f"{angle} degrees")  # fmt: skip
            axes.axhline(log[0]["unseen"][angle][limit], color=f"C{number}", linestyle="--", linewidth=0.8)
        axes.set(xlabel="steps", ylabel=f"repeatability at {limit} (dashed: SIFT)", ylim=(0.0, None))
    if log[0]["unseen"]:
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(path)


def prepared_views(args: argparse.Namespace, blocks: list[int]) -> list[list[Sight]]:
    """Views of rendered blocks by number, made once."""
    folder = args.out / "views"
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for number in blocks:
        path = folder / f"{number}.npz"
        if not path.is_file():
            write_sights(path, sights(render(args.rendered, number)))
        block = read_sights(path)
        if len(block) > 1:
            found.append(block)
    return found


def check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuses what cannot be trained on, and to go on with another run's state."""
    check_images(parser, args.data, args.trained_on.split(","), "--data and --trained-on")
    shared = {*LEFT_OUT, *numbers(args.unseen)} & set(numbers(args.blocks))
    if shared:
        parser.error(f"--blocks {args.blocks}: {', '.join(map(str, sorted(shared)))} are for validation")
    if args.validate is None:
        check_recipe(parser, args, OF_RUN)
        return
    load_detector(args.validate, "bfloat16")


def validate(args: argparse.Namespace, unseen: list[list[Sight]]) -> None:
    """Print the figures of --validate's weights, and SIFT's."""
    pairs = thinned(pairs_of(unseen), MOST_PAIRS)
    for name, find in (("sift", by_sift), ("heat", by_heat(load_detector(args.validate, "bfloat16")))):
        print(json.dumps({name: table(scores(pairs, find, args.keypoints))}), flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of real blocks, each with a folder images")
    add("--trained-on", default="sheffield,caliterra,seneca,brighton", help="real blocks whose pictures are warped")
    add_blocks(parser, "0-15,17")
    add("--unseen", type=block_list, default="16,18,40,42,209", help="rendered blocks for validation only")
    add("--rendered", type=Path, help="where rendered blocks are, or go (default OUT/blocks)")
    add("--keypoints", type=int, default=400, help="of validation, in the overlap")
    add("--seed", type=int, default=0)
    add("--scale", type=float, default=1.0, help="of the number of steps of every phase")
    add("--batch", type=at_least_one, default=8, help="groups of views at once")
    add("--rate", type=float, default=2e-3, help="largest learning rate")
    add("--jobs", type=at_least_one, default=1, help="threads")
    add("--minutes", type=float, default=0.0, help="stop after so long (0: never) and go on when called again")
    add("--validate", type=Path, help="weights to validate, beside SIFT; nothing is trained")
    add("--out", type=Path, required=True)
    args = parser.parse_args(arguments)
    args.rendered = args.rendered or args.out / "blocks"
    torch.set_num_threads(args.jobs)
    check(parser, args)
    unseen = prepared_views(args, numbers(args.unseen))
    if args.validate is not None:
        validate(args, unseen)
        return
    blocks = prepared_views(args, numbers(args.blocks))
    # Blocks seen at steep angles are drawn three times as often.
    steep = [block for block in blocks if len(pairs_of([block], STEEP_DEG)) >= STEEP_PAIRS]
    real = pictures([args.data / name for name in args.trained_on.split(",")])
    run = train(args, Sources(real, blocks + 2 * steep), unseen)
    if run is not None:
        write(run, args.out)
