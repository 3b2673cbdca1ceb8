"""Masks of the strategy `shadow` beside rendered truth, on shadow-free pictures and beside hand labels; its cost.

Each of --scenes is rendered with the `mixed` flight (two sorties, two suns); a picture counts as one with shadow where
truth says so of 5 % of its pixels or more, sky left out, and as shadow-free below 0.5 %. Each of --open is rendered
from above under a sun at 89 degrees, for more shadow-free pictures. IoU: intersection over union of mask and truth
(direct sun below half). False: share of a shadow-free picture's pixels that the mask calls shadow.

With --data, points labelled by hand in tests/ochota_shadow_labels.csv (image, x_px, y_px, lit or shadow) are asked of
the masks of DATA/ochota/images. Seconds and memory are those of a process of its own with one thread, on the rendered
picture with most shadow, enlarged to 20 megapixels, in memory. Writes OUT/shadow.json and OUT/shadow.md; OUT/scenes
keeps what was rendered, so that a killed run goes on where it was.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.files import write_json
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.lab.synthetic.write import depth_path, read_raster, sun_path
from aeromatch_cli.strategies.enhancers import ENHANCERS
from benchmarks import options, stamps
from benchmarks.processes import fresh_process, limit_threads, peak_mb
from benchmarks.scenes import render_once
from benchmarks.tables import Column, Row, code, grouped, mean, median, number, table, total, values

WITH_SHADOW, WITHOUT_SHADOW = 0.05, 0.005
LABELS = stamps.REPOSITORY / "tests" / "ochota_shadow_labels.csv"
LARGE_PX = (5164, 3873)
TIMED = ("shadow", "clahe", "wallis")
_ENHANCERS = {**ENHANCERS, **ARMS["enhance"]}


def mask_of(pixels: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) bool, what the strategy with its defaults calls shadow."""
    return np.asarray(ENHANCERS["shadow"]()(pixels, None).mask) > 0


def scene_rows(folder: Path, scene: str) -> Iterator[Row]:
    """One row per picture of a rendered block."""
    for path in sorted((folder / "images").iterdir()):
        name = path.name
        ground = np.isfinite(read_raster(depth_path(folder, name)))
        shadow = (read_raster(sun_path(folder, name)) < 128) & ground
        found = mask_of(read_pixels(path, colour=True)) & ground
        either = np.count_nonzero(found | shadow)
        yield {
            "scene": scene,
            "folder": folder.name,
            "image": name,
            "shadow_share": np.count_nonzero(shadow) / max(1, np.count_nonzero(ground)),
            "iou": np.count_nonzero(found & shadow) / either if either else None,
            "false_share": np.count_nonzero(found & ~shadow) / max(1, np.count_nonzero(ground)),
            "missed_share": np.count_nonzero(shadow & ~found) / max(1, np.count_nonzero(ground)),
        }


def rendered_rows(args: argparse.Namespace) -> list[Row]:
    """Rows of all pictures of all scenes; blocks are rendered unless they are there."""
    width_px, height_px = options.size_px(args.size)
    wanted = [(preset, preset, {"flight": "mixed", "images": args.images}) for preset in args.scenes]
    high = {"flight": "nadir", "sun_deg": (180.0, 89.0), "images": max(4, args.images // 3)}
    wanted += [(preset, f"{preset}, sun at 89°", high) for preset in args.open]
    rows: list[Row] = []
    for preset, title, asked in wanted:
        size = {"width_px": width_px, "height_px": height_px}
        rows += scene_rows(render_once(args.out / "scenes", preset, seed=args.seed, **size, **asked), title)
    return rows


def label_rows(images: Path) -> list[Row]:
    """Per labelled picture: points, and how many of them the mask agrees with."""
    points: dict[str, list[tuple[int, int, bool]]] = defaultdict(list)
    with LABELS.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(line for line in stream if not line.startswith("#")):
            points[row["image"]].append((int(row["x_px"]), int(row["y_px"]), row["label"] == "shadow"))
    rows = []
    for name, labelled in sorted(points.items()):
        x, y, shadow = (np.array(column) for column in zip(*labelled, strict=True))
        found = mask_of(read_pixels(images / name, colour=True))[y, x]
        rows.append(
            {
                "image": name,
                "points": len(labelled),
                "shadow_points": int(shadow.sum()),
                "agree": int((found == shadow).sum()),
                "false": int((found & ~shadow).sum()),
                "missed": int((~found & shadow).sum()),
            }
        )
    return rows


def cost(name: str, picture: Path) -> Row:
    """Seconds and additional memory of one strategy on a picture enlarged; to be called in a fresh process."""
    import cv2

    cv2.setNumThreads(1)
    small = read_pixels(picture, colour=True)
    pixels = cv2.resize(small, LARGE_PX, interpolation=cv2.INTER_CUBIC)
    strategy = _ENHANCERS[name]()
    strategy(small[:100, :100], None)  # modules and weights are loaded once per process
    before_mb = peak_mb()
    wall, cpu = time.perf_counter(), time.process_time()
    enhanced = strategy(pixels, None)
    return {
        "strategy": name,
        "megapixels": LARGE_PX[0] * LARGE_PX[1] / 1e6,
        "shadow_share": None if enhanced.mask is None else float(np.mean(enhanced.mask > 0)),
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "additional_mb": peak_mb() - before_mb,
    }


def cost_rows(picture: Path) -> list[Row]:
    """Each strategy in a process of its own, one thread."""
    limit_threads(1)
    rows = []
    for name in TIMED:
        with fresh_process() as process:
            rows.append(process.submit(cost, name, picture).result())
    return rows


_SHADOW: tuple[Column[Sequence[Row]], ...] = (
    ("images with shadow", len),
    ("shadow share", lambda rows: f"{mean(rows, 'shadow_share'):.0%}"),
    ("mask IoU, median", lambda rows: number(median(rows, "iou"), 2)),
    ("lowest tenth", lambda rows: number(float(np.quantile(values(rows, "iou"), 0.1)), 2)),
    ("false", lambda rows: f"{mean(rows, 'false_share'):.1%}"),
    ("missed", lambda rows: f"{mean(rows, 'missed_share'):.1%}"),
)
_FREE: tuple[Column[Sequence[Row]], ...] = (
    ("shadow-free images", len),
    ("false shadow, mean", lambda rows: f"{mean(rows, 'false_share'):.2%}"),
    ("largest", lambda rows: f"{max(values(rows, 'false_share')):.2%}"),
)
_COST: tuple[Column[Row], ...] = (
    ("seconds", lambda row: number(row["seconds"], 2)),
    ("CPU seconds", lambda row: number(row["cpu_seconds"], 2)),
    ("additional memory, MB", lambda row: number(row["additional_mb"])),
)


def tables(results: dict[str, Any]) -> str:
    """Markdown of everything measured."""
    rendered = results["rendered"]
    dark = [row for row in rendered if row["shadow_share"] >= WITH_SHADOW]
    free = [row for row in rendered if row["shadow_share"] < WITHOUT_SHADOW]
    parts = [table(("scene",), grouped(dark, "scene"), _SHADOW), table(("scene",), grouped(free, "scene"), _FREE)]
    if rows := results["labels"]:
        points, agree, false, missed, shadow = (
            int(total(rows, key)) for key in ("points", "agree", "false", "missed", "shadow_points")
        )
        text = f"Hand labels, ochota: {agree / points:.1%} of {points} points on {len(rows)} images agree "
        parts.append(f"{text}({shadow} in shadow; {missed} missed, {false} false).")
    lines = (((code(row["strategy"]),), row) for row in results["cost"])
    return "\n\n".join([*parts, table(("20 megapixels, one thread",), lines, _COST)]) + "\n"


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("shadow", __doc__)
    add = parser.add_argument
    options.add_rendered(
        parser, scenes="city,suburb,farmland,hills,grass,desert,water-edge", size="1000x750", images=12
    )
    about = "scenes rendered under a sun at 89 degrees; '' for none"
    add("--open", type=options.names, default="grass,desert,farmland", help=about)
    add("--data", type=Path, metavar="DIR", help="folder of real blocks, for the labelled points on ochota")
    options.add_output(parser)
    args = options.parse(parser, arguments)
    if not (args.scenes or args.open):
        parser.error("give --scenes or --open: without a picture there is nothing to measure")
    rendered = rendered_rows(args)
    darkest = max(rendered, key=lambda row: row["shadow_share"])
    results = {
        "seed": args.seed,
        "rendered": rendered,
        "labels": label_rows(args.data / "ochota" / "images") if args.data else [],
        "cost": cost_rows(args.out / "scenes" / darkest["folder"] / "images" / darkest["image"]),
    }
    write_json(args.out / "shadow.json", results)
    options.publish(
        args, tables(results), args.out / "shadow.md", table="bench_shadow",
        command=options.command_line(parser, args),
        versions=stamps.of_strategies("enhance", *(_ENHANCERS[name]() for name in TIMED)),
    )  # fmt: skip
