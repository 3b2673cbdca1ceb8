"""What the measurement of tie points by least squares brings: the same runs with `refine=none` and without, by truth.

Every block is rendered, with its noisy poses. Before: places of the detector (refine=none). Correct: within 3 px of the
exact place. Errors: medians over the correct matches of a block, pixels; rotation: median over the pairs of the error
of the relative rotation that the verified matches give, degrees. Keypoints: share of the matched ones that is measured.
Seconds: of the stage alone, on --jobs cores. Writes OUT/results.json and OUT/refine.md. What OUT has is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import product

from aeromatch_cli.config import load
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.lab.synthetic import PRESETS
from benchmarks import options, stamps
from benchmarks.processes import limit_threads
from benchmarks.scenes import NOISY_POSES, render_asked
from benchmarks.tables import Row, code, grouped, markdown, number, percent, ratio, total, write_rows
from benchmarks.whole import budget_settings, evaluated, whole_run

_FIGURES = ("correct", "kept", "median_error_px", "rotation_error_deg")


def row_of(args: argparse.Namespace, preset: str, scene: str, flight: str) -> Row:
    path = args.out / "rows" / f"{preset}-{scene}-{flight}-{args.seed}.json"
    if not path.is_file():
        block = render_asked(args, scene, flight=flight)
        given = ["--poses", str(block / NOISY_POSES), "--cameras", str(block / "block.json"), "--crs", "local"]
        row: Row = {"block": f"{scene}:{flight}, seed {args.seed}", "preset": preset}
        for label, refine in (("before", "none"), ("after", "least-squares")):
            work = args.out / "runs" / path.stem
            settings = [*budget_settings(load(preset), args.keypoints), f"refine={refine}", "run.report=false"]
            run = whole_run("run", preset, block / "images", work, extra=given, jobs=args.jobs, settings=settings)
            if not run.answer:
                raise SystemExit(f"aeromatch run {preset} on {block} failed with exit code {run.code}:\n{run.said}")
            totals = evaluated(work, block, mapping=False)["totals"]
            row |= {f"{key}_{label}": totals[key] for key in _FIGURES}
            row |= {"seconds": run.answer["stages"]["refine"]["seconds"], **run.answer["stages"]["refine"]["facts"]}
        write_json(path, row)
        print(f"{preset} {row['block']}", file=sys.stderr, flush=True)
    found: Row = read_json(path)
    return {key: value for key, value in found.items() if key != "sha256"}


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    for preset, flight, scene in product(args.presets, args.flights, args.scenes):
        yield row_of(args, preset, scene, flight)


def table_of(rows: Sequence[Row]) -> str:
    lines = [_line(row["preset"], row["block"], [row]) for row in rows]
    lines += [_line(preset, "all", own) for (preset,), own in grouped(rows, "preset")]
    titles = ["preset", "block", "correct, before", "after", "of kept, before", "after", "error px, before", "after"]
    return markdown([*titles, "rotation, before", "after", "keypoints measured", "s"], lines)


def _line(preset: str, name: str, rows: Sequence[Row]) -> list[object]:
    line: list[object] = [code(preset), name]
    line += [number(total(rows, f"correct_{label}")) for label in ("before", "after")]
    line += [
        percent(ratio(total(rows, f"correct_{label}"), total(rows, f"kept_{label}")), 1)
        for label in ("before", "after")
    ]
    for key, digits in (("median_error_px", 2), ("rotation_error_deg", 3)):
        line += [f"{_mean(rows, f'{key}_{label}'):.{digits}f}" for label in ("before", "after")]
    return [
        *line,
        percent(ratio(total(rows, "measured"), total(rows, "keypoints")), 0),
        f"{total(rows, 'seconds'):.1f}",
    ]


def _mean(rows: Sequence[Row], key: str) -> float:
    known = [row[key] for row in rows if row[key] is not None]
    return sum(known) / len(known) if known else float("nan")


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("refine", __doc__)
    add = parser.add_argument
    add("--presets", type=options.names, default="baseline,auto", help="comma-separated")
    options.add_rendered(parser, scenes=",".join(PRESETS), size="640x480", images=6, flights="nadir,mixed")
    add("--keypoints", type=options.positive, default=4096, help="SIFT descriptors per image; networks have half")
    add("--jobs", type=options.positive, default=2)
    options.add_output(parser)
    args = options.parse(parser, arguments, {"scenes": "suburb", "flights": "nadir", "size": "480x360", "images": 4})
    limit_threads(2)
    rows = list(rows_of(args))
    write_rows(args.out / "results.json", rows)
    versions: dict[str, stamps.Version] = {}
    for preset in args.presets:
        versions |= stamps.of_chain(preset)
    options.publish(
        args, table_of(rows) + "\n", args.out / "refine.md", table="bench_refine",
        command=options.command_line(parser, args), versions=versions,
    )  # fmt: skip
