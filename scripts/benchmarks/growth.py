"""How seconds and memory of every stage grow with the number of images.

Blocks of small images are cut from one made texture, as a level camera above a plane sees it, in strips with 70 % and
60 % overlap; poses and camera are exact. `run`: the whole command; `again`: the same command on the finished workspace.
Memory: the largest sum of what the command's processes hold (PSS), looked at every 0.2 s. Exponent: of the power of the
number of images by which the seconds grow from one block to the next. Processor: seconds of all processes together,
which other work on the machine hardly changes.

Writes OUT/growth.json, OUT/growth.md and OUT/growth.svg. Whole rows that OUT has are not made again.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import options, stamps
from benchmarks.memory import peak_mb, texture
from benchmarks.pages import FOLDER
from benchmarks.processes import children_seconds
from benchmarks.tables import Row, markdown, number, write_rows

_WIDTH, _HEIGHT, _FOCAL, _GSD_M = 160, 120, 200.0, 0.5
_STEP_X, _STEP_Y = 48, 48
_SIZE_IN = (7.5, 5.0)
STAGES = ("orient", "pairs", "extract", "match", "filter", "refine", "adjust", "consistency", "export", "report")


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
    """Two rows per block, those that are known first."""
    for images in args.images:
        if len(before := [row for row in known if row["images"] == images]) == 2:
            yield from before
            continue
        folder, work = args.out / f"block-{images}", args.out / f"work-{images}"
        write_block(folder, images, args.seed)
        shutil.rmtree(work, ignore_errors=True)
        command = [sys.executable, "-m", "aeromatch_cli.cli", "run", args.preset, "--quiet", "--json"]
        command += ["--images", str(folder / "images"), "--poses", str(folder / "poses.csv")]
        command += ["--cameras", str(folder / "cameras.json"), "--ground", "0", "--crs", "local"]
        command += ["--workspace", str(work), "--jobs", str(args.jobs), "--set", f"extract.keypoints={args.keypoints}"]
        for run in ("run", "again"):
            log, used_s = args.out / f"{run}-{images}.log", children_seconds()
            exit_code, seconds, peak = peak_mb(command, log)
            answer = _answer(log)
            if exit_code not in (0, 1) or not answer:
                raise SystemExit(f"{run} of {images} images ended with exit code {exit_code}: see {log}")
            yield {
                "images": images, "run": run, "seconds": seconds, "peak_mb": peak, "exit_code": exit_code,
                "processor_seconds": children_seconds() - used_s,
                "pairs": answer["stages"]["pairs"]["items"],
                "stages": {stage: answer["stages"][stage]["seconds"] for stage in STAGES},
                "report_mb": (work / "report" / "index.html").stat().st_size / 1e6,
                "workspace_mb": sum(path.stat().st_size for path in work.rglob("*") if path.is_file()) / 1e6,
            }  # fmt: skip
        if not args.keep:
            shutil.rmtree(work, ignore_errors=True)


def _answer(log: Path) -> dict[str, Any]:
    lines = [line for line in log.read_text(encoding="utf-8").splitlines() if line.startswith("{")]
    return dict(json.loads(lines[-1])) if lines else {}


def table_of(rows: Sequence[Row]) -> str:
    """Seconds of every stage of the first runs, with exponents, then whole runs, again, memory and sizes."""
    first = [row for row in rows if row["run"] == "run"]
    again = {row["images"]: row for row in rows if row["run"] == "again"}
    heads = ("", *(f"{number(row['images'])} images" for row in first))
    lines: list[tuple[str, ...]] = [("pairs", *(number(row["pairs"]) for row in first))]
    lines += [(f"{stage}, s", *_grown(first, lambda row, s=stage: row["stages"][s])) for stage in STAGES]
    lines.append(("whole run, s", *_grown(first, lambda row: row["seconds"])))
    lines.append(("processor, s", *_grown(first, lambda row: row["processor_seconds"])))
    lines.append(("again, s", *_grown(first, lambda row: again[row["images"]]["seconds"])))
    lines.append(("peak memory, MB", *_grown(first, lambda row: row["peak_mb"])))
    lines.append(("of again, MB", *_grown(first, lambda row: again[row["images"]]["peak_mb"])))
    lines.append(("report's page, MB", *(f"{row['report_mb']:.1f}" for row in first)))
    lines.append(("workspace, MB", *_grown(first, lambda row: row["workspace_mb"])))
    return markdown(heads, lines)


def _grown(rows: Sequence[Mapping[str, Any]], value: Any) -> Iterator[str]:
    """Values, and in brackets by which power of the number of images they have grown."""
    before: tuple[float, float] | None = None
    for row in rows:
        now = float(value(row))
        text = f"{now:.1f}" if now < 100 else number(now)
        if before is not None and before[1] > 0.0 and now > 0.0:
            text += f" ({math.log(now / before[1]) / math.log(row['images'] / before[0]):.2f})"
        before = row["images"], now
        yield text


def draw_growth(path: Path, rows: Sequence[Row]) -> None:
    """Write an SVG: seconds of every stage, of the whole run and of the same command again, and n log n beside them."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "growth"
    import matplotlib.pyplot as plt

    first, again = ([row for row in rows if row["run"] == run] for run in ("run", "again"))
    counts = [row["images"] for row in first]
    lines = {stage: [row["stages"][stage] for row in first] for stage in STAGES}
    lines["whole run"] = [row["seconds"] for row in first]
    lines["again"] = [row["seconds"] for row in again]
    figure, axis = plt.subplots(figsize=_SIZE_IN)
    for order, (name, seconds) in enumerate(lines.items()):
        whole = name not in STAGES
        style: dict[str, Any] = {"color": "black", "linestyle": "--" if name == "again" else "-"} if whole else {}
        axis.plot(counts, seconds, marker="os^vD"[order % 5], markersize=4, linewidth=1.2, label=name, **style)
    top = lines["whole run"][-1] / (counts[-1] * math.log(counts[-1]))
    axis.plot(counts, [top * n * math.log(n) for n in counts], color="#999999", linestyle=":", label="n log n")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("images")
    axis.set_ylabel("seconds")
    axis.grid(color="#eeeeee")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("growth", __doc__)
    add = parser.add_argument
    add("--images", type=options.numbers, default="100,1000,10000", help="of each block, comma-separated, ascending")
    add("--preset", default="baseline")
    add("--keypoints", type=options.positive, default=200)
    add("--keep", action="store_true", help="leave the workspaces in OUT")
    add("--seed", type=int, default=0)
    add("--jobs", type=options.positive, default=2)
    options.add_output(parser)
    args = options.parse(parser, arguments, {"images": "20,40"})
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "growth.json"
    rows: list[Row] = []
    for row in rows_of(args, json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else []):
        rows.append(row)
        write_rows(kept, rows)
        print({key: value for key, value in row.items() if key != "stages"}, row["stages"], file=sys.stderr)
    draw_growth(args.out / "growth.svg", rows)
    if args.docs is not None:
        draw_growth(FOLDER / "large.svg", rows)
    options.publish(
        args, table_of(rows) + "\n", args.out / "growth.md", table="bench_growth_blocks",
        command=options.command_line(parser, args),
        versions=stamps.of_chain(args.preset, [f"extract.keypoints={args.keypoints}"]),
    )  # fmt: skip
