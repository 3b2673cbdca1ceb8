"""Orientation from the pictures: reference poses made worse, what `aeromatch run` finds then, beside the references.

Sections: real, of DATA/BLOCK/images and DATA/BLOCK/reference/{poses.csv,block.json}; rendered, of SCENE:FLIGHT, with
exact truth and a camera file. Every case is one run of the preset on every k-th image (--thin):

  reference  the reference poses and camera as they are: what the others are measured against
  noisy      noise in all poses, 5 % of the flying height in each coordinate and 3 degrees in each angle
  unoriented the same with orient=none and the reference's ground height
  noise      positions with 5 m noise in each coordinate, no attitudes, camera from EXIF
  nothing    no poses, camera from EXIF
  third      the attitudes of every third image at random
  yaw        every image turned by 180 degrees about the vertical
  longer     the reference camera's focal length x 2
  shorter    the same x 0.5
  outliers   every tenth position off by 100 m, no attitudes
  columns    omega and phi exchanged
  mirrored   x and y exchanged, no attitudes
  shuffled   every line is that of another image
  ground     a ground height that is wrong by the flying height
  level      as noise, without heights

Attitude error: median and maximum over the images that `orient` has oriented, after one common turn of the whole block.
In brackets: the 90 % interval of the median by bootstrap over images. Adjusted: median after the final adjustment.
Turn: the common one, degrees, of results in the world frame; on real blocks it holds the errors of both GPS and the
reference. Focal length: against the reference camera. Within 3 px: verified matches, by symmetric epipolar distance
from the reference poses, and as a share of those of the case `reference`. Named: images whose attitude was made wrong
and is named so, or all where a fault of the whole list is named, and those named without cause. Said: what the summary
says of the fault. Terrain, of rendered blocks: median distance of the terrain found from the surface that the images
show, as a share of the flying height. Images: those that the adjusted block holds; lost: those of them that it holds
with the reference poses only. Seconds: of the whole command, of the stage orient, of the stage match.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.lab.synthetic import render_block
from benchmarks import options, stamps
from benchmarks.orientation.cases import CASES, worsened
from benchmarks.orientation.figures import judged
from benchmarks.tables import Column, Row, markdown, percent, ranged, ratio
from benchmarks.whole import chosen_images, evaluated, whole_run


def run_case(args: Any, block: str, every: int, case: str) -> Row:
    """One run of the command and its figures; kept in OUT, so that a killed benchmark goes on there."""
    folder = args.out / f"{block.replace(':', '-')}-{every}-{case}"
    answer = folder / "answer.json"
    if answer.is_file() and not args.again:
        return read_json(answer)
    source, reference = _folders(args, block)
    images = chosen_images(source, every, args.out / "images" / f"{block.replace(':', '-')}-{every}")
    names = sorted(path.name for path in images.iterdir())
    extra, wrong = worsened(case, reference, names, folder)
    work = folder / "work"
    settings = [f"extract.keypoints={args.keypoints}", *args.set]
    run = whole_run("run", args.preset, images, work, extra=extra, jobs=args.jobs, settings=settings)
    row: Row = {"block": block, "every": every, "case": case, "images": len(names), "exit": run.code}
    if not run.answer:
        return row | {"seconds": run.seconds, "said": [run.said[-300:]]}
    stages = run.answer["stages"]
    facts = evaluated(work, reference, mapping=False)
    found = judged(work, reference, names, wrong)
    row |= {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in found.items()}
    if case == "level":  # heights count from the flight
        row["terrain_share"] = None
    row |= {"correct": facts["totals"]["correct"], "kept": facts["totals"]["kept"]}
    row |= {"pairs": stages["filter"]["result"]["pairs"].get("verified", 0), "seconds": run.seconds}
    row |= {"stages": {name: stage["seconds"] for name, stage in stages.items()}}
    row |= {"unregistered": sorted(stages["adjust"]["result"].get("outside", names))}
    write_json(answer, row)
    shutil.rmtree(work)
    return row


def _folders(args: Any, block: str) -> tuple[Path, Path]:
    """Images and reference of a block of DATA, or of SCENE:FLIGHT, which is rendered where it has not been."""
    scene, _, flight = block.partition(":")
    if not flight:
        return args.data / block / "images", args.data / block / "reference"
    width_px, height_px = args.size
    folder = args.out / "rendered" / f"{scene}-{flight}-{args.seed}-{args.rendered}-{width_px}x{height_px}"
    render_block(
        folder, scene, seed=args.seed, width_px=width_px, height_px=height_px, images=args.rendered, flight=flight,
        jobs=args.jobs,
    )  # fmt: skip
    return folder / "images", folder


def rows_of(args: Any) -> Iterator[Row]:
    for block in args.blocks:
        for every in args.thin:
            first: Row = {}
            for case in args.cases:
                row = run_case(args, block, every, case)
                first = row if case == "reference" else first
                if "correct" in first and "correct" in row:
                    row["share"] = ratio(row["correct"], first["correct"])
                    row["lost"] = len(set(row["unregistered"]) - set(first["unregistered"]))
                yield row


def _of_images(row: Row) -> str:
    """Images that the adjusted block holds, and how many fewer than with the reference poses."""
    lost = f", {row['lost']} lost" if row.get("lost") else ""
    return f"{row['images'] - len(row['unregistered'])} of {row['images']}{lost}"


def _attitude(row: Row) -> str:
    """Median and maximum of the errors, nothing where no image was oriented."""
    if row["attitude_deg"] is None:
        return ""
    return f"{_with_interval(row, 'attitude')}, {row['attitude_max_deg']:.2f}"


def _adjusted(row: Row) -> str:
    return "" if row.get("adjusted_deg") is None else _with_interval(row, "adjusted")


def _with_interval(row: Row, what: str) -> str:
    low, high = (math.nan if value is None else value for value in row[f"{what}_interval_deg"])
    return ranged(row[f"{what}_deg"], (low, high), 3)


def _named(row: Row) -> str:
    extra = f" + {row['named_without_cause']}" if row["named_without_cause"] else ""
    return f"{row['named']} of {row['wrong']}{extra}" if row["wrong"] or extra else ""


def _seconds(row: Row) -> str:
    stages = row["stages"]
    return f"{row['seconds']:.0f}, {stages['orient']:.1f}, {stages['match']:.1f}"


COLUMNS: Sequence[Column[Row]] = (
    ("images", _of_images),
    ("attitude, degrees", _attitude),
    ("adjusted", _adjusted),
    ("turn", lambda row: "" if row["turn_deg"] is None else f"{row['turn_deg']:.1f}"),
    ("focal length", lambda row: f"{100 * row['focal_share']:+.1f} %"),
    ("named", _named),
    ("pairs", lambda row: row["pairs"]),
    ("within 3 px", lambda row: row["correct"]),
    ("share", lambda row: percent(row["share"], 1) if "share" in row else ""),
    ("terrain", lambda row: "" if row.get("terrain_share") is None else percent(row["terrain_share"], 1)),
    ("s", _seconds),
)


def table_of(rows: Sequence[Row]) -> str:
    """One line per run."""
    shown = [column for column in COLUMNS if any("correct" in row and str(column[1](row)) for row in rows)]
    lines = []
    for row in rows:
        block = row["block"] if row["every"] == 1 else f"{row['block']} / {row['every']}"
        failed = [f"exit {row['exit']}", *[""] * (len(shown) - 1)]
        cells = [cell(row) for _, cell in shown] if "correct" in row else failed
        lines.append([block, row["case"], *cells])
    return markdown(["block", "case", *(title for title, _ in shown)], lines)


# What a section does where an option is not given, and with --quick.
_DEFAULTS = {
    "real": {"blocks": "seneca,ochota,lewis", "thin": "2", "cases": "reference,noise,nothing,third", "keypoints": 3000},
    "rendered": {
        "blocks": "city:nadir,grass:nadir,hills:nadir,suburb:mixed", "thin": "1",
        "cases": "reference,noise,noisy", "keypoints": 2000,
    },
}  # fmt: skip
_QUICK = {
    "real": {"blocks": "seneca", "thin": "5", "cases": "reference,nothing", "keypoints": 1000},
    "rendered": {"blocks": "grass:nadir", "rendered": 5, "size": "400x300", "cases": "reference,noise"},
}


def main(arguments: Sequence[str]) -> None:
    section, rest = options.section_of("orientation", __doc__, tuple(_DEFAULTS), arguments)
    parser = options.make_parser(f"orientation {section}", __doc__)
    add = parser.add_argument
    if section == "real":
        add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
        add("--blocks", type=options.names, help="names, comma-separated")
    else:
        add("--blocks", type=options.names, help="SCENE:FLIGHT, comma-separated")
        add("--rendered", type=options.positive, default=12, help="images of a block")
        add("--size", type=options.size_px, metavar="WxH", default="800x600", help="of images")
        add("--seed", type=int, default=0, help="another seed gives other blocks")
    add("--thin", type=options.numbers, help="keep every k-th image; several k comma-separated")
    add("--cases", type=options.names, help=f"comma-separated, of {', '.join(CASES)}")
    add("--preset", default="baseline", help="preset of every run")
    add("--keypoints", type=options.positive, help="descriptors per image")
    add("--set", type=options.names, default="", metavar="KEY=VALUE", help="settings of every run, comma-separated")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    add("--again", action="store_true", help="run what was run before")
    options.add_output(parser)
    parser.set_defaults(**_DEFAULTS[section])
    args = options.parse(parser, rest, _QUICK[section])
    if unknown := sorted(set(args.cases) - set(CASES)):
        parser.error(f"--cases: {', '.join(unknown)} are none of {', '.join(CASES)}")
    rows = []
    for row in rows_of(args):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    shown = {"size": "{}x{}".format(*args.size)} if section == "rendered" else {}
    options.publish(
        args, table_of(rows) + "\n", args.out / f"{section}.md", table=f"bench_orientation_{section}",
        command=options.command_line(parser, args, **shown),
        versions=stamps.of_chain(f"{args.preset}[{','.join(args.set)}]" if args.set else args.preset),
    )  # fmt: skip
