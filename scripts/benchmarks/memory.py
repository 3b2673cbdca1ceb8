"""Peak memory of whole runs against `--memory`: of all processes together, on large images of several kinds.

The images are cut from one made texture with 70 % overlap, in 8-bit JPEG or 16-bit TIFF of four bands, and have
positions 100 m apart and no attitudes. Memory: the largest sum of what the command's processes hold (PSS of Linux:
pages that several share count once), looked at every 0.2 s. A run that ends with another exit code than 0 is listed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.stages.memory import budget_mb
from benchmarks import options, stamps
from benchmarks.tables import Row, code, markdown, write_rows

KINDS = ("jpeg", "tiff16x4")
_STEP = 0.3  # of an image's height, between images
_EVERY_S = 0.2


def texture(width_px: int, height_px: int, seed: int) -> NDArray[np.uint8]:
    """Ground that has structure at every scale: sums of enlarged noise."""
    import cv2

    rng = np.random.default_rng(seed)
    found = np.full((height_px, width_px), 128.0, np.float32)
    for cell_px, contrast in ((3, 20.0), (9, 25.0), (40, 25.0), (400, 20.0)):
        small = rng.standard_normal((height_px // cell_px + 2, width_px // cell_px + 2)).astype(np.float32)
        found += contrast * cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    return np.clip(found, 0, 255).astype(np.uint8)


def write_block(folder: Path, megapixels: float, kind: str, images: int, seed: int) -> None:
    """folder/images and folder/poses.csv; a block that is there already stays."""
    if (folder / "poses.csv").is_file():
        return
    import cv2
    import rasterio

    height = round((megapixels * 1e6 * 0.75) ** 0.5)
    width = round(height / 0.75)
    step = round(_STEP * height)
    ground = texture(width, height + (images - 1) * step, seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = ["image,x,y,z"]
    for number in range(images):
        part = ground[number * step : number * step + height]
        name = f"{number:04d}.{'jpg' if kind == 'jpeg' else 'tif'}"
        path = folder / "images" / name
        if kind == "jpeg":
            cv2.imwrite(str(path), cv2.applyColorMap(part, cv2.COLORMAP_CIVIDIS), [cv2.IMWRITE_JPEG_QUALITY, 92])
        else:
            shape = {"width": width, "height": height, "count": 4, "dtype": "uint16", "compress": "deflate"}
            with rasterio.open(path, "w", driver="GTiff", tiled=True, blockxsize=512, blockysize=512, **shape) as out:
                for band in range(4):
                    out.write(part.astype(np.uint16) * (60 + 20 * band), band + 1)
        lines.append(f"{name},0,{-100.0 * number},100")
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def peak_mb(command: Sequence[str], log: Path) -> tuple[int, float, float]:
    """Exit code, seconds and the largest sum of PSS of a command and all that it starts."""
    started, peak = time.monotonic(), 0.0
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        while process.poll() is None:
            peak = max(peak, sum(_pss_mb(pid) for pid in _tree(process.pid)))
            time.sleep(_EVERY_S)
    return process.returncode, time.monotonic() - started, peak


def _tree(pid: int) -> Iterator[int]:
    yield pid
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:  # it has ended meanwhile
        return
    for child in children:
        yield from _tree(int(child))


def _pss_mb(pid: int) -> float:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024.0 for line in text.splitlines() if line.startswith("Pss:")), 0.0)


def rows_of(args: Any) -> Iterator[Row]:
    for megapixels in args.megapixels:
        for kind in args.kinds:
            folder = args.out / f"{kind}-{megapixels}"
            write_block(folder, megapixels, kind, args.images, args.seed)
            for preset in args.presets:
                for budget in args.memory:
                    work = args.out / "work"
                    shutil.rmtree(work, ignore_errors=True)
                    command = [sys.executable, "-m", "aeromatch_cli.cli", "run", preset, "--quiet"]
                    command += ["--images", str(folder / "images"), "--poses", str(folder / "poses.csv")]
                    command += ["--workspace", str(work), "--jobs", str(args.jobs), "--memory", budget]
                    command += [word for text in args.set for word in ("--set", text)]
                    exit_code, seconds, peak = peak_mb(command, args.out / "said.log")
                    yield {
                        "megapixels": megapixels, "kind": kind, "preset": preset, "budget": budget,
                        "exit_code": exit_code, "seconds": seconds, "peak_mb": peak,
                        "share": peak / (budget_mb(budget) or np.nan),
                    }  # fmt: skip
                    shutil.rmtree(work, ignore_errors=True)


def table_of(rows: Sequence[Row]) -> str:
    heads = ("megapixels", "images", "preset", "`--memory`", "peak, MB", "of the budget", "exit code", "s")
    lines = [
        (
            row["megapixels"], {"jpeg": "JPEG, 8 bit", "tiff16x4": "TIFF, 16 bit, 4 bands"}[row["kind"]],
            code(row["preset"]), row["budget"], f"{row['peak_mb']:.0f}", f"{row['share']:.2f}", row["exit_code"],
            f"{row['seconds']:.0f}",
        )
        for row in rows
    ]  # fmt: skip
    return markdown(heads, lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("memory", __doc__)
    add = parser.add_argument
    add("--megapixels", type=options.numbers, default="12,50,150", help="comma-separated")
    add("--kinds", type=options.names, default=",".join(KINDS), help=f"of {', '.join(KINDS)}")
    add("--presets", type=options.names, default="baseline", help="comma-separated")
    add("--memory", type=options.names, default="8GB", help="budgets, comma-separated")
    add("--images", type=options.positive, default=4)
    add("--set", type=options.names, default="", metavar="KEY=VALUE", help="settings, comma-separated")
    add("--seed", type=int, default=0)
    add("--jobs", type=options.positive, default=2)
    options.add_output(parser)
    args = options.parse(parser, arguments, {"megapixels": "3", "images": "2"})
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in rows_of(args):
        rows.append(row)
        write_rows(args.out / "memory.json", rows)
        print(row, file=sys.stderr)
    versions: dict[str, stamps.Version] = {}
    for preset in args.presets:
        versions |= stamps.of_chain(preset)
    options.publish(
        args, table_of(rows) + "\n", args.out / "memory.md", table="bench_memory",
        command=options.command_line(parser, args), versions=versions,
    )  # fmt: skip
