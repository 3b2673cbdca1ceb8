"""Bundle adjustment with real lenses: simulated tie points, what `adjust` makes of them, beside COLMAP, by truth.

A case is a scene, a flight, a number of images, what positions are known and a seed: ground points of the scene's
surfaces seen through lenses with off-centre principal points and distortion of six terms, with 0.3 px noise, 2 % wrong
matches and tracks of SIFT's lengths. The start camera is what EXIF says: the focal length in whole millimetres.

gps5m: positions with a common drift of 5 m and 1 m noise; rtk2cm: 2 cm, heights 3 cm; both with a gimbal's angles (1
degree, the mounting 0.5). nothing: none. Errors are those of about 60 check points intersected from 0.3 px measurements
with the result, in ground pixels, after the best similarity to truth: medians of a block horizontally and in height,
and within how many 95 % of the heights are (a bent block has large ones). Absolute: without similarity, where positions
are exact. Of each line: the median over its blocks, in brackets its 90 % interval by bootstrap over them. Focal length
and principal point: errors of the median camera. Error / stated: of projection centres, over their stated standard
deviations. Verdicts: how many blocks were called good, doubtful and bad.

Peers: colmap: incremental mapping, SIMPLE_RADIAL, principal point in the middle; colmap-opencv: its model adjusted once
more as OPENCV with a free principal point. Models are put into the world by the positions.

Writes OUT/rows/CASE.json for every case, OUT/results.json and OUT/calibration.md; rows that OUT has are not made again.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.sfm.mapping import adjust_block
from aeromatch_cli.sfm.quality.finding import LEVELS
from aeromatch_cli.sfm.quality.judgement import judged as verdict
from aeromatch_cli.stages import adjust, orient
from benchmarks import options, stamps
from benchmarks.calibration.accuracy import Found, judged
from benchmarks.calibration.colmap import PEERS, mapped_by_colmap
from benchmarks.calibration.simulate import FLIGHTS, POSITIONS, mapped, simulate
from benchmarks.calibration.verdict import of_adjusted
from benchmarks.processes import fresh_process, limit_threads
from benchmarks.tables import (
    Column,
    Row,
    code,
    grouped,
    interval,
    medians,
    number,
    ranged,
    table,
    values,
    write_rows,
)

_OURS = "aeromatch"


class Case(NamedTuple):
    """One simulated block."""

    scene: str
    flight: str
    images: int
    positions: str
    seed: int
    tie_points: int


def _run(case: Case, method: str, path: Path) -> None:
    """Write the row of a case."""
    began = time.perf_counter()
    block = simulate(
        case.scene,
        case.flight,
        case.images,
        case.positions,
        case.seed,
        tie_points=case.tie_points,  # type: ignore[arg-type]
    )
    row: Row = {**case._asdict(), "method": method, "simulated_s": round(time.perf_counter() - began, 2)}
    began = time.perf_counter()
    try:
        if method == _OURS:
            contents, groups = mapped(block)
            adjusted, facts = adjust_block(contents, block.observed, groups, fixed=False)
            found: Found | None = Found.of(adjusted)
            evidence = of_adjusted(contents, block.observed, adjusted, facts, metric=case.positions != "nothing")
            row["verdict"] = verdict(evidence).verdict
        else:
            found = mapped_by_colmap(block, method)
    except AeromatchError as error:
        found, row["failed"] = None, str(error)
    row["seconds"] = round(time.perf_counter() - began, 2)
    row |= judged(block, found) if found is not None else {"oriented": 0, "checked": 0}
    write_json(path, row)


def _run_all(cases: Sequence[tuple[Case, str, Path]]) -> int:
    for case, method, path in cases:
        _run(case, method, path)
        print(f"{path.stem}", file=sys.stderr, flush=True)
    return len(cases)


def _path(out: Path, case: Case, method: str) -> Path:
    return out / "rows" / ("-".join([*map(str, case), method]) + ".json")


def rows_of(args: Any) -> Iterator[Row]:
    """All rows, the missing ones made first: cases of one scene and seed in one process, which builds it once."""
    axes = product(args.scenes, args.seeds, args.flights, args.images, args.positions)
    cases = [
        Case(scene, flight, images, positions, seed, args.points) for scene, seed, flight, images, positions in axes
    ]
    methods = [_OURS, *args.peers]
    every = [(case, method, _path(args.out, case, method)) for case in cases for method in methods]
    batches: dict[tuple[str, int], list[tuple[Case, str, Path]]] = {}
    for item in every:
        if not item[2].is_file():
            batches.setdefault((item[0].scene, item[0].seed), []).append(item)
    with fresh_process(args.jobs, limit_threads, 1) as pool:
        for _ in pool.map(_run_all, batches.values()):
            pass
    for _, _, path in every:
        yield {key: value for key, value in read_json(path).items() if key != "sha256"}


def _cell(field: str, digits: int) -> Callable[[Sequence[Row]], str]:
    def cell(rows: Sequence[Row]) -> str:
        found = values(rows, field)
        return ranged(float(np.median(found)), interval(found, medians), digits) if found else "-"

    return cell


def _worst(rows: Sequence[Row]) -> str:
    """Largest errors of a block, horizontally and in height."""
    found = [max(values(rows, field), default=math.nan) for field in ("horizontal_px", "height_px")]
    return " / ".join(number(value, 2) for value in found)


_COLUMNS: Sequence[Column[Sequence[Row]]] = (
    ("blocks", len),
    ("images oriented", lambda rows: _oriented(rows)),
    ("verdicts", lambda rows: _verdicts(rows)),
    ("horizontal, px", _cell("horizontal_px", 2)),
    ("height, px", _cell("height_px", 2)),
    ("95 % of heights, px", _cell("bend_px", 2)),
    ("worst block", _worst),
    ("absolute, horizontal", _cell("absolute_horizontal_px", 2)),
    ("absolute, height", _cell("absolute_height_px", 2)),
    ("focal length, %", _cell("focal_percent", 3)),
    ("principal point, px", _cell("centre_px", 1)),
    ("error / stated", _cell("stated_ratio", 2)),
    ("s", _cell("seconds", 1)),
)


def _oriented(rows: Sequence[Row]) -> str:
    return f"{sum(row['oriented'] for row in rows)} of {sum(row['images'] for row in rows)}"


def _verdicts(rows: Sequence[Row]) -> str:
    """How many blocks were called good, doubtful and bad."""
    called = [row["verdict"] for row in rows if row.get("verdict")]
    return "/".join(str(called.count(level)) for level in LEVELS) if called else "-"


def table_of(rows: Sequence[Row]) -> str:
    """A line for every flight, number of images, positions and method, and one for all of each method."""
    keys = ("flight", "images", "positions", "method")
    groups = [([*labels[:3], code(labels[3])], own) for labels, own in grouped(rows, *keys)]
    groups += [(["all", "", "", code(method)], own) for (method,), own in grouped(rows, "method")]
    return table(keys, groups, _COLUMNS)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("calibration", __doc__)
    add = parser.add_argument
    add("--scenes", type=options.names, default="suburb,hills", help="presets of rendered blocks")
    add("--flights", type=options.names, default="nadir,cross,mixed,five", help=f"of {', '.join(FLIGHTS)}")
    add("--images", type=options.numbers, default="24")
    add("--positions", type=options.names, default=",".join(POSITIONS))
    add("--seeds", type=options.numbers, default="1-3")
    add("--points", type=options.positive, default=500, help="about so many tie points in an image")
    add("--peers", type=options.names, default="colmap-opencv", help=f"of {', '.join(PEERS)}")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    options.add_output(parser)
    quick = {"scenes": "farmland", "flights": "cross", "images": "12", "seeds": "1", "points": 300}
    args = options.parse(parser, arguments, quick)
    for asked, known in ((args.flights, FLIGHTS), (args.positions, POSITIONS), (args.peers, PEERS)):
        if unknown := set(asked) - set(known):
            parser.error(f"{', '.join(sorted(unknown))} is none of {', '.join(known)}")
    limit_threads(1)
    (args.out / "rows").mkdir(parents=True, exist_ok=True)
    rows = list(rows_of(args))
    write_rows(args.out / "results.json", rows)
    versions: dict[str, stamps.Version] = {"stage.adjust": adjust.VERSION, "stage.orient": orient.VERSION}
    options.publish(
        args, table_of(rows) + "\n", args.out / "calibration.md", table="bench_calibration",
        command=options.command_line(parser, args), versions=versions,
    )  # fmt: skip
