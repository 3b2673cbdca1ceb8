"""Pairs by image retrieval: several blocks in one folder, no poses, against the overlaps of the reference poses.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}. `aeromatch orient` runs on all of them
together with pairs=similar and as many candidates an image as asked. Overlapping: pairs of one block whose footprints
share so much of the smaller one (--overlap), whatever the angle between their views; found: those among the pairs that
retrieval proposes. Seconds: of the whole command.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from aeromatch_cli.files import read_json
from aeromatch_cli.formats.tables import read_images
from aeromatch_cli.strategies.pairings.overlap import Overlap
from benchmarks import options, stamps
from benchmarks.blocks.cases import read_block
from benchmarks.tables import Row, markdown, percent
from benchmarks.whole import whole_run

Names = tuple[str, str]


def together(data: Path, blocks: Sequence[str], folder: Path) -> Path:
    """One folder with links to the images of all blocks, each named after its block."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for block in blocks:
        for path in sorted((data / block / "images").iterdir()):
            (folder / f"{block}-{path.name}").symlink_to(path.resolve())
    return folder


def overlapping(data: Path, blocks: Sequence[str], least: float) -> set[Names]:
    """Pairs of images, by name in the common folder, whose footprints overlap by `least` or more."""
    pairs = set()
    for name in blocks:
        block = read_block(data / name / "images", data / name / "reference")
        wanted = Overlap(min_overlap=least, max_view_angle_deg=180.0, max_neighbours=len(block.images))
        names = {image.image_id: f"{name}-{image.name}" for image in block.images}
        pairs |= {_ordered(names[p.image_id0], names[p.image_id1]) for p in wanted(block) if p.reason == "overlap"}
    return pairs


def _ordered(one: str, other: str) -> Names:
    return (one, other) if one < other else (other, one)


def rows_of(args: Any) -> Iterator[Row]:
    images = together(args.data, args.blocks, args.out / "images")
    wanted = overlapping(args.data, args.blocks, args.overlap)
    for candidates in args.candidates:
        work = args.out / f"work-{candidates}"
        settings = ["pairs=similar", f"pairs.candidates={candidates}"]
        extra = ["--poses", "none"]
        run = whole_run("orient", "baseline", images, work, extra=extra, jobs=args.jobs, settings=settings)
        if not run.answer:
            raise SystemExit(f"aeromatch orient failed with exit code {run.code}:\n{run.said[-2000:]}")
        names = {image.image_id: image.name for image in read_images(work / "images.csv")}
        record = read_json(work / "orientation" / "orientation.json")
        proposed = {_ordered(names[id0], names[id1]) for id0, id1 in record["similar"]}
        across = sum(one.split("-")[0] != other.split("-")[0] for one, other in proposed)
        shutil.rmtree(work)
        yield {
            "candidates": candidates,
            "images": len(names),
            "all": len(list(combinations(names, 2))),
            "proposed": len(proposed),
            "across": across,
            "overlapping": len(wanted),
            "found": len(proposed & wanted),
            "groups": sorted((len(group["images"]) for group in record["groups"]), reverse=True),
            "seconds": run.seconds,
        }


def table_of(rows: Sequence[Row]) -> str:
    """One line per number of candidates."""
    header = (
        "candidates",
        "images",
        "pairs proposed",
        "between blocks",
        "overlapping",
        "found",
        "oriented groups",
        "s",
    )
    lines = [
        (
            row["candidates"],
            row["images"],
            f"{row['proposed']} of {row['all']}",
            row["across"],
            row["overlapping"],
            f"{row['found']} ({percent(row['found'] / row['overlapping'], 1)})",
            ", ".join(map(str, row["groups"])),
            f"{row['seconds']:.0f}",
        )
        for row in rows
    ]
    return markdown(header, lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("similar", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
    add("--blocks", type=options.names, default="ochota,lewis,seneca", help="names, comma-separated")
    add("--candidates", type=options.numbers, default="20", help="pairs per image; several comma-separated")
    add("--overlap", type=float, default=0.3, help="share of the smaller footprint")
    add("--jobs", type=options.positive, default=2)
    options.add_output(parser)
    args = options.parse(parser, arguments)
    rows = list(rows_of(args))
    print(json.dumps(rows))
    options.publish(
        args, table_of(rows) + "\n", args.out / "similar.md", table="bench_similar",
        command=options.command_line(parser, args),
        versions=stamps.of_chain("baseline", ["pairs=similar"]),
    )  # fmt: skip
