"""Weights that say how many verified matches a pair can be expected to have after a step of `auto`.

Every block is one `aeromatch run auto` on a rendered block with noisy poses whose pairs all take every step. Before
each step, `stages.pair_statistics` says of every pair with known overlap what it is expected to have after it. Blocks
differ in scene, flight, seed and number of descriptors. The weights are found from the blocks of --fit and printed:
`expectation_weights` of the steps are those of

    scripts/train evidence --fit 5101 --seed 5102 --out DIR

Blocks of --seed, which no weight saw, say how far they hold: sums of matches before, expected and found, and the error
of a pair, the root mean square of the difference of logarithms as a factor. What OUT has is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from benchmarks import options
from benchmarks.processes import limit_threads
from benchmarks.scenes import NOISY_POSES, render_asked
from benchmarks.tables import Row, grouped, markdown, number, total, write_rows
from benchmarks.whole import budget_settings, whole_run

from aeromatch_cli.config import load
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.stages import cascade, pairs
from aeromatch_cli.stages.pair_statistics import columns, expected_number, fitted_weights, log_error
from aeromatch_cli.strategies.steps import STEPS

_EVERY_PAIR = 1_000_000


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


def rows_of(args: argparse.Namespace, block: Block) -> list[Row]:
    """One row for each step after the first and each pair that took it."""
    path = args.out / "rows" / f"{block.name.replace(', ', '-').replace(' ', '-').replace(':', '-')}.json"
    if not path.is_file():
        work = args.out / "runs" / path.stem
        settings = budget_settings(load("auto"), block.keypoints)
        # Half as many: of numbers that are always equal no weights could be told apart.
        settings += [f"cascade.learned.keypoints={block.keypoints // 2}"]
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
        if (own := weights.get(row["step"])) is not None
    ]


def _factor(rows: Sequence[Row]) -> float:
    expected, found = (np.array([row[key] for row in rows], float) for key in ("expected", "found"))
    return float(np.exp(np.sqrt(np.mean(log_error(expected, found) ** 2))))


def table_of(rows: Sequence[Row]) -> str:
    """A line for every step: how far the weights hold."""
    lines = [
        [step, len(own), *(number(total(own, key)) for key in ("before", "expected", "found")),
         f"{total(own, 'expected') / max(1.0, total(own, 'found')):.2f}", f"{_factor(own):.2f}"]
        for (step,), own in grouped(rows, "step")
    ]  # fmt: skip
    titles = ["step", "pairs", "before", "expected", "found", "expected / found", "error of a pair"]
    return markdown(titles, lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("evidence", __doc__)
    add = parser.add_argument
    flights = "nadir,mixed,oblique,two-flights"
    options.add_rendered(parser, scenes=",".join(PRESETS), size="640x480", images=6, flights=flights)
    add("--fit", type=options.numbers, help="seeds of the blocks from which the weights are found, comma-separated")
    about = "SIFT descriptors per image, networks have half; of several, comma-separated, every block takes the next"
    add("--keypoints", type=options.numbers, default="2000,4000,8000", help=about)
    add("--jobs", type=options.positive, default=2, help="blocks at a time")
    add("--out", type=Path, required=True, help="folder of results; a killed run goes on where it was")
    args = options.parse(parser, arguments, {"scenes": "suburb", "flights": "nadir", "size": "480x360", "images": 4})
    if args.fit and args.seed in args.fit:
        parser.error(f"--fit holds {args.seed}, the seed of the blocks that are judged: give others")
    limit_threads(1)
    if args.fit:
        for (step,), own in grouped(all_rows(args, list(rendered_blocks(args, args.fit, first=1))), "step"):
            weights = fitted_weights([np.array(row["columns"]) for row in own], [row["found"] for row in own])
            print(f"{step}: expectation_weights =", tuple(round(float(weight), 3) for weight in weights))
    rows = with_expected(all_rows(args, list(rendered_blocks(args, [args.seed]))))
    write_rows(args.out / "results.json", rows)
    print(table_of(rows))
