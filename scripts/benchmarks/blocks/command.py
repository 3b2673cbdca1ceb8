"""Real blocks: this project's presets beside pycolmap's own SIFT, same images, budget and thresholds.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}; a block that it lacks is rendered, nadir,
where it is the name of a preset of synth. A method is a preset, with settings in
brackets as in `--set` and a label before it where the name gets long ('plain=fusion[enhance=none]'), or COLMAP's CPU
SIFT: pycolmap, pycolmap-uncut, and each with -guided. Sections:

  blocks    every k-th image (--thin); `aeromatch run` without its report, of which orientation, pairs, extraction,
            matching and verification are timed; start-up, least-squares measuring, adjustment, consistency and
            export are not; then both of pycolmap's mappings from each database. COLMAP matches all pairs, a preset
            those it chooses
  thinned   the same where ordinary matching falls apart
  cross     only pairs across a block's darker and brighter series that share a fifth of the smaller footprint
  easy      wall clock of `aeromatch run`, everything included, against the first method
  speed     the same as a rate: pairs and matches a minute, COLMAP beside presets, and the share of every stage
  orient    whole chains from pictures to an oriented block: `scripts/bench blocks orient --help`

Presets are given (--poses) the reference poses, positions alone with 5 m noise, or nothing; COLMAP uses none. All have
the reference's cameras. The budget is exact but for distant ground of strongly oblique images, which has its own, in
COLMAP's sense of a keypoint (a place with two orientations counts twice); networks, which take longer for each, have
half as many, as by default, and `auto` has both. pycolmap's max_num_features is not: it keeps whole scale levels, up to
45 % more. It is therefore cut to the budget after extraction, untimed, largest scales first as its own rule would;
pycolmap-uncut is not. Verified matches are those of pairs with at least 15, each pair of places once (COLMAP counts a
place with two orientations twice); within 3 and 5 px: by symmetric epipolar distance from the reference poses, after
matches are thinned one-to-one to 2 px. Cells filled: of 16 x 16 of each image, and ninths of 3 x 3, that hold a match
within 3 px.
Writes OUT/SECTION.json and OUT/SECTION.md; OUT/answers keeps what every method answered: a killed run goes on there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic.presets import PRESETS
from benchmarks import options, stamps
from benchmarks.blocks import chains
from benchmarks.blocks.cases import COLMAP, GIVEN, Case, answer, chosen_images, count_matches, cross_pairs
from benchmarks.blocks.tables import blocks_table, cross_table, easy_table, speed_table
from benchmarks.peers.table import Named, check_method, named_methods, settings_of
from benchmarks.scenes import render_once
from benchmarks.tables import Row, write_rows


@dataclass(frozen=True)
class Section:
    """What a section does where an option is not given."""

    blocks: str
    thin: str
    keypoints: int
    methods: str
    table: Callable[[Sequence[Row]], str]
    mapping: bool


EXHAUSTIVE = "baseline[pairs=exhaustive]"
SECTIONS = {
    "blocks": Section("sheffield,ochota,brighton", "1", 4000, f"{EXHAUSTIVE},pycolmap", blocks_table, True),
    "thinned": Section("ochota,lewis,seneca,caliterra", "2,3", 3000, "pycolmap-uncut,baseline", blocks_table, True),
    "cross": Section("ochota", "1", 4500, "pycolmap-uncut-guided,baseline", cross_table, False),
    "easy": Section("sheffield,brighton", "1", 4000, "baseline", easy_table, False),
    "speed": Section("seneca,ochota", "1", 4000, "pycolmap,baseline,fusion,auto", speed_table, False),
}
# Sections whose seconds are those of the whole command.
WHOLE = ("easy", "speed")
QUICK_IMAGES, QUICK = 8, {"keypoints": 1000}
RENDERED = {"seed": 3_000_001, "images": 20, "width_px": 1600, "height_px": 1200}


def rows_of(args: argparse.Namespace, section: str, methods: Sequence[Named]) -> Iterator[Row]:
    """Rows in the order of the table."""
    for block in args.blocks:
        source, reference = block_folders(args, block)
        for every in args.thin:
            limit = QUICK_IMAGES if args.quick else 0
            folder = args.out / "images" / f"{block}-{every}-{limit or 'all'}"
            images = chosen_images(source / "images", every, limit, folder)
            pairs = cross_pairs(images, reference) if section == "cross" else None
            mapping = SECTIONS[section].mapping and not args.no_mapping
            for poses, name in product(args.poses, methods):
                if name.spec in COLMAP and poses != args.poses[0]:
                    continue  # the same answer
                case = Case(images, reference, pairs, args.keypoints, args.jobs, section in WHOLE, mapping, poses)
                found, database = answer(case, name, args.out / "answers")
                only = None if pairs is None else set(pairs)
                head = {"block": block, "every": every, "poses": None if name.spec in COLMAP else poses}
                head |= {"method": name.label, "spec": name.spec}
                head |= {"images": len(case.pictures), "asked_keypoints": args.keypoints, "cores": args.jobs}
                asked = {} if pairs is None else {"asked_pairs": len(pairs)}
                yield head | asked | found | count_matches(database, reference, only)


def block_folders(args: argparse.Namespace, block: str) -> tuple[Path, Path]:
    """Folders of a block, with a folder images, and of its reference poses. One that DATA lacks is rendered where it
    is the name of a preset of synth.
    """
    source = args.data / block
    if (source / "reference" / "block.json").is_file():
        return source, source / "reference"
    if block not in PRESETS or source.exists():
        raise ConfigError(f"{source} is no block with reference poses: give --data and --blocks of such a folder")
    folder = render_once(args.out / "rendered", block, jobs=args.jobs, **RENDERED)
    return folder, folder


def make_options(section: str) -> argparse.ArgumentParser:
    default = SECTIONS[section]
    parser = options.make_parser(f"blocks {section}", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
    add("--blocks", type=options.names, default=default.blocks, help="names, comma-separated")
    add("--thin", type=options.numbers, default=default.thin, help="keep every k-th image; several k comma-separated")
    add("--keypoints", type=options.positive, default=default.keypoints, help="descriptors per image")
    add("--methods", default=default.methods, help="comma-separated; the first is what others are compared with")
    add("--poses", type=options.names, default="reference", help=f"what presets get: {', '.join(GIVEN)}")
    add("--jobs", type=options.positive, default=2)
    add("--no-mapping", action="store_true", help="leave out pycolmap's mapping")
    options.add_output(parser)
    return parser


def main(arguments: Sequence[str]) -> None:
    first = options.make_parser("blocks", __doc__)
    first.add_argument("section", choices=(*SECTIONS, "orient"))
    section = first.parse_args(arguments[:1]).section
    if section == "orient":
        chains.main(arguments[1:])
        return
    parser = make_options(section)
    args = options.parse(parser, arguments[1:], QUICK)
    methods = named_methods(args.methods)
    for name in methods:
        check_method(name.spec, COLMAP)
    if unknown := [poses for poses in args.poses if poses not in GIVEN]:
        parser.error(f"--poses: {', '.join(unknown)} are none of {', '.join(GIVEN)}")
    rows: list[Row] = []
    for row in rows_of(args, section, methods):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        write_rows(args.out / f"{section}.json", rows)
    options.publish(
        args, SECTIONS[section].table(rows) + "\n", args.out / f"{section}.md", table=f"bench_{section}",
        command=options.command_line(parser, args), versions=stamps.of_whole_runs(*settings_of(methods)),
    )  # fmt: skip
