"""How many verified matches a pair can be expected to have after a step of `auto`, and how many it has.

Every block is one `aeromatch run auto` whose pairs all take every step; rendered blocks with their noisy poses, real
ones (--data, every k-th image) with their reference poses. Before each step, `stages.pair_statistics` says of every
pair with known overlap what it is expected to have after it. The number behind a block's name: SIFT descriptors per
image. Found: verified matches of all steps together, those that two steps have found counted once. Error: root mean
square of the difference of logarithms, as a factor. Gain: matches after over before.

--fit SEEDS renders other blocks of the same scenes and flights, with other numbers of descriptors for each scene, finds
the weights from these alone, and prints them: `expectation_weights` of the steps are those of the command that
docs/results/auto.md shows. Writes OUT/results.json, OUT/evidence.md and OUT/evidence.svg. What OUT has is not made
again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from aeromatch_cli.config import load
from aeromatch_cli.data import FloatArray
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.stages import cascade, pairs
from aeromatch_cli.stages.pair_statistics import columns, expected_number, fitted_weights, log_error
from aeromatch_cli.strategies.steps import STEPS
from benchmarks import options, stamps
from benchmarks.blocks.cases import chosen_images
from benchmarks.pages import FOLDER
from benchmarks.processes import limit_threads
from benchmarks.scenes import NOISY_POSES, render_asked
from benchmarks.tables import Row, grouped, markdown, number, total, write_rows
from benchmarks.whole import budget_settings, whole_run

_EVERY_PAIR = 1_000_000
_GAINS = (0.0, 1.1, 1.25, 1.5, 2.0, 3.0, np.inf)
_SIZE_IN = (5.6, 4.8)
_COLOURS = {"guided": "#4477aa", "learned": "#1f6f3f"}


@dataclass(frozen=True)
class Block:
    """name: of its lines. given: options of `aeromatch run` beside the images. keypoints: SIFT's, per image."""

    name: str
    images: Path
    given: tuple[str, ...]
    keypoints: int


def rendered_blocks(args: argparse.Namespace, seeds: Sequence[int], first: int = 0) -> Iterator[Block]:
    """first: which of the numbers of descriptors the first block has."""
    for k, (seed, flight, scene) in enumerate(product(seeds, args.flights, args.scenes), start=first):
        folder = render_asked(args, scene, flight=flight, seed=seed)
        given = "--poses", str(folder / NOISY_POSES), "--cameras", str(folder / "block.json"), "--crs", "local"
        keypoints = args.keypoints[k % len(args.keypoints)]
        yield Block(f"{scene}:{flight}, seed {seed}, {keypoints}", folder / "images", given, keypoints)


def real_blocks(args: argparse.Namespace) -> Iterator[Block]:
    for k, (name, every) in enumerate(product(args.blocks if args.data else (), args.thin)):
        source = args.data / name
        images = chosen_images(source / "images", every, 0, args.out / "images" / f"{name}-{every}")
        reference = source / "reference"
        given = "--poses", str(reference / "poses.csv"), "--cameras", str(reference / "block.json")
        keypoints = args.keypoints[k % len(args.keypoints)]
        yield Block(f"{name}, 1 image of {every}, {keypoints}", images, given, keypoints)


def rows_of(args: argparse.Namespace, block: Block) -> list[Row]:
    """One row for each step after the first and each pair that took it."""
    path = args.out / "rows" / f"{block.name.replace(', ', '-').replace(' ', '-').replace(':', '-')}.json"
    if not path.is_file():
        work = args.out / "runs" / path.stem
        settings = budget_settings(load("auto"), block.keypoints)
        settings += [f"cascade.{step.name}.below_matches={_EVERY_PAIR}" for step in load("auto").cascade]
        run = whole_run(
            "run", "auto", block.images, work, extra=block.given, jobs=1, settings=[*settings, "run.report=false"]
        )
        if not run.answer:
            raise SystemExit(f"aeromatch run on {block.name} failed with exit code {run.code}:\n{run.said}")
        write_json(path, {"rows": [{"block": block.name, **row} for row in _judged(work)]})
        print(block.name, file=sys.stderr, flush=True)
    rows: list[Row] = read_json(path)["rows"]
    return rows


def _judged(work: Path) -> Iterator[Row]:
    context, *_ = pairs.prepare(load(str(work / "config.yaml")), Executor("serial", 1), dry=True)
    steps = cascade.steps_on_file(context)
    known = [cascade.evidence_of(steps[: k + 1]) for k in range(len(steps))]
    for step, recipe, before, after in zip(steps[1:], context.settings.cascade, known, known[1:], strict=False):
        for key, evidence in before.items():
            values = columns(evidence, cascade.keypoints_of(recipe, context.settings))
            if values is not None and key in after and key in step.reasons:
                found = {"before": evidence.verified, "found": after[key].verified}
                yield {"step": step.name, "pair": list(key), "columns": values.tolist(), **found}


def all_rows(args: argparse.Namespace, blocks: Sequence[Block]) -> list[Row]:
    with ThreadPoolExecutor(args.jobs) as pool:
        return [row for rows in pool.map(lambda block: rows_of(args, block), blocks) for row in rows]


def with_expected(rows: Sequence[Row]) -> list[Row]:
    """The rows with what the steps' weights expect."""
    weights = {name: step.expectation_weights for name, step in STEPS.items()}
    return [
        {**row, "expected": expected_number(np.array(row["columns"]), own)}
        for row in rows
        if (own := weights[row["step"]]) is not None
    ]


def _factor(rows: Sequence[Row]) -> float:
    expected, found = (np.array([row[key] for row in rows], float) for key in ("expected", "found"))
    return float(np.exp(np.sqrt(np.mean(log_error(expected, found) ** 2))))


def _gain(row: Row, key: str) -> float:
    return float(row[key] / max(row["before"], 1))


def table_of(rows: Sequence[Row]) -> str:
    """Blocks, and classes of expected gain."""
    by_block = [
        [block, step, len(own), *(number(total(own, key)) for key in ("before", "expected", "found")),
         f"{total(own, 'expected') / max(1.0, total(own, 'found')):.2f}", f"{_factor(own):.2f}"]
        for (step, block), own in grouped(rows, "step", "block")
    ]  # fmt: skip
    classes = []
    for (step,), own in grouped(rows, "step"):
        for low, high in pairwise(_GAINS):
            held = [row for row in own if low <= _gain(row, "expected") < high]
            if held:
                means = [total(held, key) / max(1.0, total(held, "before")) for key in ("expected", "found")]
                name = f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} and more"
                classes.append([step, name, len(held), *(f"{mean:.2f}" for mean in means), f"{_factor(held):.2f}"])
    titles = ["block", "step", "pairs", "before", "expected", "found", "expected / found", "error of a pair"]
    return "\n\n".join(
        [
            "#### By block\n\n" + markdown(titles, by_block),
            "#### By expected gain\n\n"
            + markdown(["step", "expected gain", "pairs", "mean", "found", "error of a pair"], classes),
        ]
    )


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Write an SVG: found against expected matches, every pair and the medians of classes."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "evidence"
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=_SIZE_IN)
    every: list[FloatArray] = []
    for (step,), own in grouped(rows, "step"):
        expected, found = (np.array([row[key] for row in own], float) + 1.0 for key in ("expected", "found"))
        every += [expected, found]
        axis.scatter(expected, found, s=4, alpha=0.25, color=_COLOURS.get(step), linewidths=0)
        edges = np.quantile(expected, np.linspace(0, 1, 9))
        number_of = np.clip(np.searchsorted(edges, expected, side="right") - 1, 0, 7)
        middles = [(np.median(expected[number_of == k]), np.median(found[number_of == k])) for k in set(number_of)]
        axis.plot(*zip(*middles, strict=True), marker="o", markersize=4, color=_COLOURS.get(step), label=step)
    low, high = (float(pick(np.concatenate(every))) for pick in (np.min, np.max))
    axis.plot([low, high], [low, high], color="#999999", linewidth=0.8)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("verified matches expected after the step")
    axis.set_ylabel("verified matches found")
    axis.legend(frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("evidence", __doc__)
    add = parser.add_argument
    options.add_rendered(
        parser, scenes=",".join(PRESETS), size="640x480", images=6, flights="nadir,mixed,oblique,two-flights"
    )
    add("--fit", type=options.numbers, help="seeds of the blocks from which the weights are found, comma-separated")
    about = "SIFT descriptors per image, networks have half; of several, comma-separated, every block takes the next"
    add("--keypoints", type=options.numbers, default="2000,4000,8000", help=about)
    add("--data", type=Path, metavar="DIR", help="folder of real blocks")
    add("--blocks", type=options.names, default="lewis,ochota", help="of --data, comma-separated")
    add("--thin", type=options.numbers, default="3", help="keep every k-th real image; several k comma-separated")
    add("--jobs", type=options.positive, default=2, help="blocks at a time")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"scenes": "suburb", "flights": "nadir", "size": "480x360", "images": 4})
    if args.fit and args.seed in args.fit:
        parser.error(f"--fit holds {args.seed}, the seed of the blocks that are judged: give others")
    limit_threads(1)
    if args.fit:
        for (step,), own in grouped(all_rows(args, list(rendered_blocks(args, args.fit, first=1))), "step"):
            weights = fitted_weights([np.array(row["columns"]) for row in own], [row["found"] for row in own])
            print(f"{step}: expectation_weights =", tuple(round(float(weight), 3) for weight in weights))
    blocks = [*rendered_blocks(args, [args.seed]), *real_blocks(args)]
    rows = with_expected(all_rows(args, blocks))
    write_rows(args.out / "results.json", rows)
    draw(args.out / "evidence.svg", rows)
    if args.docs is not None:
        draw(FOLDER / "evidence.svg", rows)
    options.publish(
        args, table_of(rows) + "\n", args.out / "evidence.md", table="bench_evidence",
        command=options.command_line(parser, args), versions=stamps.of_chain("auto"),
    )  # fmt: skip
