"""Whether the verdict on a block can be believed: blocks spoilt in known ways, of which none may be called good, and
good blocks, of which none may be called bad.

Tie points are simulated as in `scripts/bench calibration`; what is spoilt is what the adjustment is given (positions,
cameras, angles, control points, matches) and nothing tells it. Starts are near the truth, as a first pass leaves them,
so that the faults reach the adjustment; what a first pass itself finds wrong is not tested here.

Verdict: `good`, `doubtful` or `bad`. Findings: the criteria that spoke, the gravest first, with their numbers. Height:
median absolute error of about 60 check points, in ground pixels; absolute, where positions are RTK, else after the best
similarity. The truth has the heights of the positions: a block that follows control points 40 m higher lies 1,200 px
above it, and is right. In brackets of the summary: the 90 % interval of the share of wrong verdicts, over blocks; where
there is none, up to the share that would have shown one in 95 of 100 such tables. Writes
OUT/rows/NAME.json with the facts of every block, OUT/results.json and OUT/robustness.md; facts that OUT has are not
made again, and judged by the criteria as they are now.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.results.stages import AdjustResult
from aeromatch_cli.sfm.mapping import adjust_block
from aeromatch_cli.sfm.quality.finding import LEVELS, QualityInput
from aeromatch_cli.sfm.quality.judgement import judged
from aeromatch_cli.stages import adjust
from benchmarks import options
from benchmarks.calibration.accuracy import Found
from benchmarks.calibration.accuracy import judged as by_truth
from benchmarks.calibration.verdict import of_adjusted
from benchmarks.processes import fresh_process, limit_threads
from benchmarks.robustness.blocks import FAULTS, GOOD, Task
from benchmarks.tables import Column, Row, interval, means, number, percent, table, write_rows

_MOST_FINDINGS = 3
# Blocks that one process makes, which builds their scene once.
_TOGETHER = 9


def evidence_of(task: Task) -> tuple[QualityInput, Row]:
    """What the adjustment makes of a task, and errors of that by truth."""
    try:
        adjusted, groups = adjust_block(task.contents, task.observed, task.groups, fixed=task.fixed)
    except AeromatchError as error:
        nothing = AdjustResult(images=0, remarks=[str(error)])
        return QualityInput(images=len(task.contents.block.images), adjust=nothing, refined=True), {}
    one = next(iter(adjusted.cameras.values()))  # of all, where several were taken as one
    whole = {camera_id: adjusted.cameras.get(camera_id, one) for camera_id in task.block.cameras}
    errors = by_truth(task.block, Found.of(replace(adjusted, cameras=whole)))
    metric = task.block.positions != "nothing"
    return of_adjusted(task.contents, task.observed, adjusted, groups, metric=metric), errors


def _run(name: str, expected: str, path: Path, tie_points: int) -> None:
    plan, spoil = (FAULTS if expected == "spoilt" else GOOD)[name]
    evidence, errors = evidence_of(spoil(plan.task(tie_points)))
    height = errors.get("absolute_height_px", errors.get("height_px"))
    write_json(path, {"block": name, "expected": expected, "height_px": height, "evidence": evidence.as_json()})


def _judged(row: Row) -> Row:
    """A row of what was found with the present verdict on it."""
    quality = judged(QualityInput(**row["evidence"]))
    faults = [[one.what, one.value, one.level, one.sentence] for one in quality.faults]
    shown = {key: row[key] for key in ("block", "expected", "height_px")}
    return {**shown, "verdict": quality.verdict, "findings": faults, "unchecked": list(quality.unchecked)}


def _run_all(cases: Sequence[tuple[str, str, Path]], tie_points: int) -> int:
    for name, expected, path in cases:
        _run(name, expected, path, tie_points)
        print(f"{expected}: {name}", file=sys.stderr, flush=True)
    return len(cases)


def rows_of(out: Path, names: Sequence[tuple[str, str]], tie_points: int, jobs: int) -> Iterator[Row]:
    """All rows, the missing ones made first: blocks of one scene and flight by one process, which simulates it once."""
    paths = {
        (name, kind): out / "rows" / f"{kind}-{re.sub('[^a-z0-9]+', '-', name.lower())}.json" for name, kind in names
    }
    batches: dict[Any, list[tuple[str, str, Path]]] = {}
    for (name, kind), path in paths.items():
        if not path.is_file():
            plan, _ = (FAULTS if kind == "spoilt" else GOOD)[name]
            key = plan.scene, plan.seed
            batches.setdefault(key, []).append((name, kind, path))
    parts = [batch[at : at + _TOGETHER] for batch in batches.values() for at in range(0, len(batch), _TOGETHER)]
    with fresh_process(jobs, limit_threads, 1) as pool:
        for _ in pool.map(_run_all, parts, [tie_points] * len(parts)):
            pass
    for path in paths.values():
        yield _judged(read_json(path))


def _findings(row: Row) -> str:
    shown = [what if value is None else f"{what} {number(value, 2)}" for what, value, *_ in row["findings"]]
    return "; ".join(shown[:_MOST_FINDINGS]) + ("; ..." if len(shown) > _MOST_FINDINGS else "")


def table_of(rows: Sequence[Row]) -> str:
    columns: list[Column[Row]] = [
        ("verdict", lambda row: str(row["verdict"])),
        ("findings", _findings),
        ("height, px", lambda row: "-" if row["height_px"] is None else number(row["height_px"], 1)),
    ]
    return table(("", "block"), (([row["expected"], row["block"]], row) for row in rows), columns)


def summary_of(rows: Sequence[Row]) -> str:
    """How many blocks of each kind got which verdict; the share of right verdicts with its interval over blocks, or
    where none is wrong the largest share of wrong ones that 95 of 100 such counts would have shown."""
    words = []
    for kind, wrong in (("spoilt", "good"), ("good", "bad")):
        own = [row["verdict"] for row in rows if row["expected"] == kind]
        if not own:
            continue
        counts = ", ".join(f"{own.count(level)} {level}" for level in LEVELS)
        missed = [level == wrong for level in own]
        low, high = interval(missed, means) if any(missed) else (0.0, 1.0 - 0.05 ** (1.0 / len(own)))
        share = f"{sum(missed)} of {len(own)} called {wrong} ({percent(low)} to {percent(high)})"
        words.append(f"{len(own)} {kind} blocks: {counts}; {share}")
    return ". ".join(words) + "."


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("robustness", __doc__)
    add = parser.add_argument
    add("--only", default="", metavar="WORDS", help="blocks whose names hold these words")
    add("--points", type=options.positive, default=1000, help="about so many tie points in an image")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"only": "factory", "points": 500})
    names = [(name, kind) for kind, some in (("spoilt", FAULTS), ("good", GOOD)) for name in some if args.only in name]
    if not names:
        parser.error(f"no block has {args.only!r} in its name")
    limit_threads(1)
    (args.out / "rows").mkdir(parents=True, exist_ok=True)
    rows = list(rows_of(args.out, names, args.points, args.jobs))
    write_rows(args.out / "results.json", rows)
    options.publish(
        args, f"{summary_of(rows)}\n\n{table_of(rows)}\n", args.out / "robustness.md", table="bench_robustness",
        command=options.command_line(parser, args), versions={"stage.adjust": adjust.VERSION},
    )  # fmt: skip
