"""Masks of the strategy `shadow` beside rendered truth, on shadow-free pictures and beside hand labels; its cost.

Each of --scenes is rendered with the `mixed` flight (two sorties, two suns); a picture counts as one with shadow where
truth says so of 5 % of its pixels or more, sky left out, and as shadow-free below 0.5 %. Each of --open is rendered
from above under a sun at 89 degrees, for more shadow-free pictures. IoU: intersection over union of mask and truth
(direct sun below half). False: share of a shadow-free picture's pixels that the mask calls shadow.

With --data, points labelled by hand in tests/ochota_shadow_labels.csv (image, x_px, y_px, lit or shadow) are asked of
the masks of DATA/ochota/images. Seconds and memory are those of a process of its own with one thread, on the rendered
picture with most shadow, enlarged to 20 megapixels, in memory. Writes OUT/results.json and OUT/table.md; OUT/scenes
keeps what was rendered, so that a killed run goes on where it was.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from common import peak_mb, publish, size_px
from numpy.typing import NDArray

from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.strategies.enhancers import ENHANCERS
from aeromatch_cli.synthetic import PRESETS, render_block
from aeromatch_cli.synthetic.write import depth_path, read_raster, sun_path
from aeromatch_cli.workspace import write_text

WITH_SHADOW, WITHOUT_SHADOW = 0.05, 0.005
LABELS = Path(__file__).parent.parent / "tests" / "ochota_shadow_labels.csv"
LARGE_PX = (5164, 3873)
TIMED = ("shadow", "clahe", "wallis")
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def mask_of(pixels: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) bool, what the strategy with its defaults calls shadow."""
    return np.asarray(ENHANCERS["shadow"]()(pixels, None).mask) > 0


def scene_rows(folder: Path, scene: str) -> Iterator[dict[str, Any]]:
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


def rendered_rows(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of all pictures of all scenes; blocks are rendered unless they are there."""
    width_px, height_px = size_px(args.size)
    rows: list[dict[str, Any]] = []
    wanted = [(preset, "mixed", None) for preset in filter(None, args.scenes.split(","))]
    wanted += [(preset, "nadir", (180.0, 89.0)) for preset in filter(None, args.open.split(","))]
    for preset, flight, sun_deg in wanted:
        images = args.images if sun_deg is None else max(4, args.images // 3)
        folder = args.out / "scenes" / f"{preset}-{flight}-{args.size}-{images}-seed{args.seed}"
        if not (folder / "truth.json").is_file():
            render_block(
                folder, preset, seed=args.seed, width_px=width_px, height_px=height_px, images=images,
                flight=flight, sun_deg=sun_deg,
            )  # fmt: skip
        rows += scene_rows(folder, preset if sun_deg is None else f"{preset}, sun at 89°")
    return rows


def label_rows(images: Path) -> list[dict[str, Any]]:
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


def cost(name: str, picture: Path) -> dict[str, Any]:
    """Seconds and additional memory of one strategy on a picture enlarged; to be called in a fresh process."""
    import cv2

    cv2.setNumThreads(1)
    small = read_pixels(picture, colour=True)
    pixels = cv2.resize(small, LARGE_PX, interpolation=cv2.INTER_CUBIC)
    strategy = ENHANCERS[name]()
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


def cost_rows(picture: Path) -> list[dict[str, Any]]:
    """Each strategy in a process of its own, one thread."""
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    rows = []
    for name in TIMED:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            rows.append(process.submit(cost, name, picture).result())
    return rows


def tables(results: dict[str, Any]) -> str:
    """Markdown of everything measured."""
    text = "| scene | images with shadow | shadow share | mask IoU, median | lowest tenth | false | missed |\n"
    text += "|---|---|---|---|---|---|---|\n"
    scenes = list(dict.fromkeys(row["scene"] for row in results["rendered"]))
    for scene in scenes:
        rows = [r for r in results["rendered"] if r["scene"] == scene and r["shadow_share"] >= WITH_SHADOW]
        if rows:
            share, iou, false, missed = (
                np.array([r[k] for r in rows]) for k in ("shadow_share", "iou", "false_share", "missed_share")
            )
            text += f"| {scene} | {len(rows)} | {share.mean():.0%} | {np.median(iou):.2f} "
            text += f"| {np.quantile(iou, 0.1):.2f} "
            text += f"| {false.mean():.1%} | {missed.mean():.1%} |\n"
    text += "\n| scene | shadow-free images | false shadow, mean | largest |\n|---|---|---|---|\n"
    for scene in scenes:
        free = [r for r in results["rendered"] if r["scene"] == scene and r["shadow_share"] < WITHOUT_SHADOW]
        false = np.array([r["false_share"] for r in free])
        if len(false):
            text += f"| {scene} | {len(false)} | {false.mean():.2%} | {false.max():.2%} |\n"
    if rows := results["labels"]:
        points, agree, false, missed, shadow = (
            sum(r[k] for r in rows) for k in ("points", "agree", "false", "missed", "shadow_points")
        )
        text += f"\nHand labels, ochota: {agree / points:.1%} of {points} points on {len(rows)} images agree "
        text += f"({shadow} in shadow; {missed} missed, {false} false).\n"
    text += "\n| 20 megapixels, one thread | seconds | CPU seconds | additional memory, MB |\n|---|---|---|---|\n"
    for row in results["cost"]:
        text += f"| `{row['strategy']}` | {row['seconds']:.2f} | {row['cpu_seconds']:.2f} "
        text += f"| {row['additional_mb']:.0f} |\n"
    return text


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = f"scripts/bench_shadow --scenes {args.scenes or repr('')} --open {args.open or repr('')} --seed {args.seed}"
    parts += f" --size {args.size} --images {args.images}"
    return parts + (" --data DIR" if args.data else "") + " --out DIR"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--scenes", default="city,suburb,farmland,hills,grass,desert,water-edge", help=f"of {', '.join(PRESETS)}")
    add("--open", default="grass,desert,farmland", help="scenes rendered under a sun at 89 degrees; '' for none")
    add("--seed", type=int, default=0)
    add("--size", default="1000x750", metavar="WxH", help="of rendered images")
    add("--images", type=int, default=12, help="of each rendered block")
    add("--data", type=Path, metavar="DIR", help="folder of real blocks, for the labelled points on ochota")
    add("--readme", action="store_true", help="write the tables into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    if not (args.scenes or args.open):
        parser.error("give --scenes or --open: without a picture there is nothing to measure")
    try:
        rendered = rendered_rows(args)
        darkest = max(rendered, key=lambda row: row["shadow_share"])
        results = {
            "seed": args.seed,
            "rendered": rendered,
            "labels": label_rows(args.data / "ochota" / "images") if args.data else [],
            "cost": cost_rows(args.out / "scenes" / darkest["folder"] / "images" / darkest["image"]),
        }
    except AeromatchError as error:
        raise SystemExit(f"error: {error}") from error
    write_text(args.out / "results.json", json.dumps(results, indent=1) + "\n")
    text = tables(results)
    publish(text, args.out / "table.md", "bench_shadow" if args.readme else None, command(args))


if __name__ == "__main__":
    main()
