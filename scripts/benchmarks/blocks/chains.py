"""Whole chains from pictures to an oriented block: `aeromatch run` beside pycolmap's own.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}. Of every k-th image (--thin), with cameras
from EXIF in all chains:

  aeromatch       `aeromatch run PRESET`, positions with 5 m noise; the adjusted block of its export
  aeromatch-none  the same without any pose
  incremental     pycolmap: its SIFT, exhaustive matching, incremental mapping
  global          the same matches, global mapping

Registered: images of the largest model. Right: those of them whose attitudes agree with the reference within 3 degrees
after one common turn: a mapper may register images in wrong places. Points, track length, reprojection error: of that
model. Seconds: wall clock, of pycolmap extraction, matching and mapping; of aeromatch the whole command, report
included. Both mappers' images from aeromatch's own database stand behind.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.evaluate.mapping import map_database
from aeromatch_cli.files import read_json, write_json
from benchmarks import options, stamps
from benchmarks.blocks import steps
from benchmarks.blocks.cases import chosen_images
from benchmarks.blocks.steps import run_step
from benchmarks.orient.cases import worsened
from benchmarks.orient.figures import attitudes_of, most_alike
from benchmarks.tables import Row, markdown
from benchmarks.whole import whole_run

RIGHT_DEG = 3.0
OURS = {"aeromatch": "noise", "aeromatch-none": "nothing"}


def our_chain(args: Any, images: Path, reference: Path, folder: Path, case: str) -> Row:
    """One run of the command, and what both mappers make of its database."""
    names = sorted(path.name for path in images.iterdir())
    extra, _ = worsened(case, reference, names, folder)
    work = folder / "work"
    settings = [f"extract.keypoints={args.keypoints}"]
    run = whole_run("run", args.preset, images, work, extra=extra, jobs=args.jobs, settings=settings)
    if not run.answer:
        raise SystemExit(f"aeromatch run {args.preset} failed with exit code {run.code}:\n{run.said[-2000:]}")
    facts = run.answer["stages"]["adjust"]["result"]
    best = max(facts["groups"], key=lambda group: group["images"], default={"images": 0})
    row: Row = {"registered": best["images"], "models": len(facts["groups"]), "seconds": run.seconds}
    row |= {key: best.get(key) for key in ("points", "track_length", "reprojection_error_px")}
    adjusted = attitudes_of(work / "orientation" / "orientation.csv")
    row["right"] = most_alike(adjusted, attitudes_of(reference / "poses.csv"), RIGHT_DEG)
    database = work / "export" / "colmap" / "database.db"
    for mapper in ("incremental", "global"):
        row[f"by_{mapper}"] = map_database(database, images, mapper).get("registered")
    shutil.rmtree(work, ignore_errors=True)
    return row


def pycolmap_chains(args: Any, images: Path, reference: Path, folder: Path) -> dict[str, Row]:
    """Both mappers on the same database."""
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    seconds = run_step(steps.colmap_extract_exif, images, database, args.keypoints, args.jobs)["seconds"]
    seconds += run_step(steps.colmap_match, database, args.jobs, False, None)["seconds"]
    rows = {}
    for mapper in ("incremental", "global"):
        found = map_database(database, images, mapper, attitudes=True)
        own = {name: np.array(rotation) for name, rotation in found.pop("attitudes", {}).items()}
        found["right"] = most_alike(own, attitudes_of(reference / "poses.csv"), RIGHT_DEG)
        rows[mapper] = found | {"seconds": seconds + found.get("seconds", 0.0)}
    database.unlink()
    return rows


def rows_of(args: Any) -> Iterator[Row]:
    """A row per block, thinning and chain; kept in OUT, so that a killed benchmark goes on there."""
    for block in args.blocks:
        for every in args.thin:
            folder = args.out / f"{block}-{every}"
            folder.mkdir(parents=True, exist_ok=True)
            reference = args.data / block / "reference"
            images = chosen_images(args.data / block / "images", every, 0, args.out / "images" / f"{block}-{every}")
            count = len(list(images.iterdir()))
            for chain in (*OURS, "pycolmap"):
                answer = folder / f"{chain}.json"
                if not answer.is_file():
                    found = (
                        {chain: our_chain(args, images, reference, folder, OURS[chain])}
                        if chain in OURS
                        else pycolmap_chains(args, images, reference, folder)
                    )
                    write_json(answer, found)
                for name, row in read_json(answer).items():
                    yield {"block": block, "every": every, "chain": name, "images": count, **row}


def table_of(rows: Sequence[Row]) -> str:
    """One line per chain."""
    header = (
        "block",
        "chain",
        "registered",
        "right",
        "points",
        "track length",
        "error px",
        "s",
        "incremental / global",
    )
    lines = []
    for row in rows:
        both = f"{row['by_incremental']} / {row['by_global']}" if "by_global" in row else ""
        figures = [f"{row[key]:.2f}" if row.get(key) else "-" for key in ("track_length", "reprojection_error_px")]
        block = row["block"] if row["every"] == 1 else f"{row['block']} / {row['every']}"
        registered = f"{row.get('registered', 0)} of {row['images']}"
        points = str(row.get("points", "-"))
        lines.append((block, row["chain"], registered, row["right"], points, *figures, f"{row['seconds']:.0f}", both))
    return markdown(header, lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("blocks orient", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
    add("--blocks", type=options.names, default="lewis,seneca", help="names, comma-separated")
    add("--thin", type=options.numbers, default="1,2,3", help="keep every k-th image; several k comma-separated")
    add("--preset", default="baseline", help="preset of our chains")
    add("--keypoints", type=options.positive, default=4000, help="descriptors per image")
    add("--jobs", type=options.positive, default=2)
    options.add_output(parser)
    args = options.parse(parser, arguments, {"keypoints": 1000})
    rows = []
    for row in rows_of(args):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    options.publish(
        args, table_of(rows) + "\n", args.out / "chains.md", table="bench_chains",
        command=options.command_line(parser, args), versions=stamps.of_chain(args.preset),
    )  # fmt: skip
