"""How seconds and memory of every stage grow with the number of images.

Blocks of small images are cut from one made texture, as a level camera above a plane sees it, in strips with 70 % and
60 % overlap; poses and camera are exact. Whole run: the command from an empty folder; again: the same command on the
finished workspace. Memory: the largest sum of what the command's processes hold (PSS), looked at every 0.2 s. Medians
of --repeats runs, in brackets their 90 % interval. Exponent: of the power of the number of images by which a figure
grows from one block to the next. Processor: seconds of all processes together, which other work on the machine hardly
changes.

Writes OUT/growth.json and OUT/growth.md. Whole rows that OUT has are not made again.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import options, stamps
from benchmarks.processes import children_seconds, run_watched
from benchmarks.tables import Row, extremes, interval, markdown, medians, number, ranged, values, write_rows

_WIDTH, _HEIGHT, _FOCAL, _GSD_M = 160, 120, 200.0, 0.5
_STEP_X, _STEP_Y = 48, 48
STAGES = ("orient", "pairs", "extract", "match", "filter", "refine", "adjust", "consistency", "export", "report")


def texture(width_px: int, height_px: int, seed: int) -> NDArray[np.uint8]:
    """Ground that has structure at every scale: sums of enlarged noise."""
    import cv2

    rng = np.random.default_rng(seed)
    found = np.full((height_px, width_px), 128.0, np.float32)
    for cell_px, contrast in ((3, 20.0), (9, 25.0), (40, 25.0), (400, 20.0)):
        small = rng.standard_normal((height_px // cell_px + 2, width_px // cell_px + 2)).astype(np.float32)
        found += contrast * cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    return np.clip(found, 0, 255).astype(np.uint8)


def write_block(folder: Path, images: int, seed: int) -> None:
    """folder/images, poses.csv and cameras.json; a block that is there already stays."""
    if (folder / "cameras.json").is_file():
        return
    import cv2

    columns = math.ceil(math.sqrt(images))
    rows = math.ceil(images / columns)
    ground = texture(_WIDTH + columns * _STEP_X, _HEIGHT + rows * _STEP_Y, seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = ["image,x,y,z,omega_deg,phi_deg,kappa_deg"]
    for index in range(images):
        row, column = divmod(index, columns)
        left, top = column * _STEP_X, row * _STEP_Y
        name = f"{index:05d}.png"
        cv2.imwrite(str(folder / "images" / name), ground[top : top + _HEIGHT, left : left + _WIDTH])
        x, y = (left + _WIDTH / 2) * _GSD_M, -(top + _HEIGHT / 2) * _GSD_M
        lines.append(f"{name},{x},{y},{_FOCAL * _GSD_M},0,0,0")
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    params = [_FOCAL, _FOCAL, _WIDTH / 2, _HEIGHT / 2]
    camera = {"model": "PINHOLE", "width": _WIDTH, "height": _HEIGHT, "params": params}
    (folder / "cameras.json").write_text(json.dumps({"1": camera}), encoding="utf-8")


def rows_of(args: Any, known: Sequence[Row]) -> Iterator[Row]:
    """Two rows for every block and repeat, those that are known first."""
    for images, repeats in zip(args.images, args.repeats, strict=True):
        folder = args.out / f"block-{images}"
        write_block(folder, images, args.seed)
        for repeat in range(repeats):
            before = [row for row in known if (row["images"], row["repeat"]) == (images, repeat)]
            yield from before if len(before) == 2 else _run_twice(args, folder, images, repeat)


def _run_twice(args: Any, folder: Path, images: int, repeat: int) -> Iterator[Row]:
    """The row of a whole run, and of the same command on its workspace."""
    work = args.out / f"work-{images}"
    shutil.rmtree(work, ignore_errors=True)
    command = [sys.executable, "-m", "aeromatch_cli.cli", "run", args.preset, "--quiet", "--json"]
    command += ["--images", str(folder / "images"), "--poses", str(folder / "poses.csv")]
    command += ["--cameras", str(folder / "cameras.json"), "--ground", "0", "--crs", "local"]
    command += ["--workspace", str(work), "--jobs", str(args.jobs), "--set", f"extract.keypoints={args.keypoints}"]
    for run in ("run", "again"):
        log, used_s = args.out / f"{run}-{images}.log", children_seconds()
        exit_code, seconds, peak_mb = run_watched(command, log)
        answer = _answer(log)
        if exit_code not in (0, 1) or not answer:
            raise SystemExit(f"{run} of {images} images ended with exit code {exit_code}: see {log}")
        yield {
            "images": images, "repeat": repeat, "run": run, "seconds": seconds, "peak_mb": peak_mb,
            "processor_seconds": children_seconds() - used_s,
            "pairs": answer["stages"]["pairs"]["items"],
            "stages": {stage: answer["stages"][stage]["seconds"] for stage in STAGES},
            "report_mb": (work / "report" / "index.html").stat().st_size / 1e6,
            "workspace_mb": sum(path.stat().st_size for path in work.rglob("*") if path.is_file()) / 1e6,
        }  # fmt: skip
    shutil.rmtree(work, ignore_errors=True)


def _answer(log: Path) -> dict[str, Any]:
    lines = [line for line in log.read_text(encoding="utf-8").splitlines() if line.startswith("{")]
    return dict(json.loads(lines[-1])) if lines else {}


# What the lines below those of the stages show: title, field, and whose (the whole run's or that of the same again).
_LINES = (
    ("whole run, s", "seconds", "run"), ("processor, s", "processor_seconds", "run"), ("again, s", "seconds", "again"),
    ("peak memory, MB", "peak_mb", "run"), ("of again, MB", "peak_mb", "again"),
    ("report's page, MB", "report_mb", "run"), ("workspace, MB", "workspace_mb", "run"),
)  # fmt: skip


def table_of(rows: Sequence[Row]) -> str:
    """Medians over the repeats with their intervals, and exponents from one size to the next."""
    sizes = list(dict.fromkeys(row["images"] for row in rows))
    heads = ["", *(f"{number(images)} images" for images in sizes)]
    heads += [f"exponent to {number(images)}" for images in sizes[1:]]
    runs = [row for row in rows if row["run"] == "run"]
    repeats = [sum(row["images"] == images for row in runs) for images in sizes]
    pairs = [next(number(row["pairs"]) for row in runs if row["images"] == images) for images in sizes]
    blank = [""] * (len(sizes) - 1)
    lines = [["runs", *map(str, repeats), *blank], ["pairs", *pairs, *blank]]
    for stage in STAGES:
        figures = [{"images": row["images"], "value": row["stages"][stage]} for row in runs]
        lines.append([f"{stage}, s", *_cells(figures, sizes)])
    for title, field, run in _LINES:
        figures = [{"images": row["images"], "value": row[field]} for row in rows if row["run"] == run]
        lines.append([title, *_cells(figures, sizes)])
    return markdown(heads, lines)


def _cells(figures: Sequence[Row], sizes: Sequence[int]) -> list[str]:
    """Of each size the median, with its interval; then by which power of the number of images it has grown, with what
    the least and the most of both sizes would give."""
    own = {images: values([row for row in figures if row["images"] == images], "value") for images in sizes}
    middle = {images: float(np.median(found)) for images, found in own.items()}
    cells = [ranged(middle[n], interval(own[n], medians), 1 if middle[n] < 100 else 0) for n in sizes]
    for before, after in pairwise(sizes):
        powers = [_power(a, b, after / before) for a, b in product(own[before], own[after])]
        cells.append(ranged(_power(middle[before], middle[after], after / before), extremes(powers), 2))
    return cells


def _power(before: float, after: float, times: float) -> float:
    """By which power of a number a figure has grown, while the number has grown `times`."""
    return math.log(after / before) / math.log(times) if min(before, after) > 0.0 else math.nan


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("growth", __doc__)
    add = parser.add_argument
    add("--images", type=options.numbers, default="100,300,1000", help="of each block, comma-separated, ascending")
    add("--repeats", type=options.numbers, default="3,2,2", help="runs of each block, comma-separated")
    add("--preset", default="baseline")
    add("--keypoints", type=options.positive, default=200)
    add("--seed", type=int, default=0, help="another seed gives other blocks")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"images": "20,40", "repeats": "2,1"})
    if len(args.images) != len(args.repeats):
        parser.error("--repeats must say for every block of --images how often it is run")
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "growth.json"
    rows: list[Row] = []
    for row in rows_of(args, json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else []):
        rows.append(row)
        write_rows(kept, rows)
        print({key: value for key, value in row.items() if key != "stages"}, row["stages"], file=sys.stderr)
    options.publish(
        args, table_of(rows) + "\n", args.out / "growth.md", table="bench_growth",
        command=options.command_line(parser, args), versions=stamps.of_pipeline(),
    )  # fmt: skip
