"""Real blocks: this project's presets beside pycolmap's own SIFT, same images, budget and thresholds.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}; a block that it lacks is rendered, nadir,
where it is the name of a preset of synth. A method is a preset, with settings in
brackets as in `--set` and a label before it where the name gets long ('plain=fusion[enhance=none]'), or COLMAP's CPU
SIFT: pycolmap, pycolmap-uncut, and each with -guided. Sections:

  blocks    every k-th image (--thin); extraction, matching and verification are timed, start-up and export are not;
            then pycolmap's incremental mapping from each database. COLMAP matches all pairs, a preset those it chooses
  thinned   the same where ordinary matching falls apart
  cross     only pairs across a block's darker and brighter series that share a fifth of the smaller footprint
  easy      wall clock of `aeromatch run`, everything included, against the first method

Every step runs in a process of its own. The budget is exact for all, in COLMAP's sense of a keypoint (a place with two
orientations counts twice). pycolmap's max_num_features is not: it keeps whole scale levels, up to 45 % more. It is
therefore cut to the budget after extraction, untimed, largest scales first as its own rule would; pycolmap-uncut is
not. Verified matches are those of pairs with at least 15, each pair of places once (COLMAP counts a place with two
orientations twice); within 3 and 5 px: by symmetric epipolar distance from the reference poses.
Writes OUT/SECTION.json and OUT/SECTION.md; OUT/answers keeps what every method answered: a killed run goes on there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from common import errors_as_exits, fill_in, publish
from methods.table import Named, named_methods
from realblocks.cases import Case, answer, check_method, chosen_images, cross_pairs
from realblocks.counts import count_matches
from realblocks.tables import Row, blocks_table, cross_table, easy_table

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.synthetic import render_block
from aeromatch_cli.synthetic.presets import PRESETS
from aeromatch_cli.workspace import write_text


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
}
QUICK_IMAGES, QUICK_KEYPOINTS = 8, 1000
RENDERED_IMAGES, RENDERED_SEED = 20, 3_000_001


def rows_of(args: argparse.Namespace, names: Sequence[Named]) -> Iterator[Row]:
    """Rows in the order of the table."""
    for block in args.blocks.split(","):
        source, reference = block_folders(args, block)
        for every in (int(k) for k in args.thin.split(",")):
            limit = QUICK_IMAGES if args.quick else 0
            folder = args.out / "images" / f"{block}-{every}-{limit or 'all'}"
            images = chosen_images(source / "images", every, limit, folder)
            pairs = cross_pairs(images, reference) if args.section == "cross" else None
            mapping = SECTIONS[args.section].mapping and not args.no_mapping
            case = Case(images, reference, pairs, args.keypoints, args.jobs, args.section == "easy", mapping)
            for name in names:
                found, database = answer(case, name, args.out / "answers")
                only = None if pairs is None else set(pairs)
                head = {"block": block, "every": every, "method": name.label, "spec": name.spec}
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
    folder = args.out / "rendered" / f"{block}-{RENDERED_SEED}"
    if not (folder / "truth.json").is_file():
        images = RENDERED_IMAGES
        render_block(folder, block, seed=RENDERED_SEED, images=images, width_px=1600, height_px=1200, jobs=args.jobs)
    return folder, folder


def command(args: argparse.Namespace) -> str:
    """This run's command line without machine paths."""
    parts = [f"scripts/bench_blocks {args.section} --data DIR --blocks {args.blocks} --thin {args.thin}"]
    parts += [f"--keypoints {args.keypoints} --methods '{args.methods}' --jobs {args.jobs}"]
    parts += ["--no-mapping"] if args.no_mapping else []
    return " ".join([*parts, "--out DIR"])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("section", choices=tuple(SECTIONS))
    add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
    add("--blocks", help="names, comma-separated")
    add("--thin", help="keep every k-th image; several k comma-separated")
    add("--keypoints", type=int, help="descriptors per image")
    add("--methods", help="comma-separated; the first is what others are compared with")
    add("--jobs", type=int, default=2)
    add("--no-mapping", action="store_true", help="leave out pycolmap's mapping")
    add("--quick", action="store_true", help=f"{QUICK_IMAGES} images a block, {QUICK_KEYPOINTS} keypoints")
    add("--readme", nargs="?", const="", metavar="NAME", help="write the table between the README's markers bench_NAME")
    add("--out", type=Path, default=Path("bench/blocks"))
    args = parser.parse_args()
    section = SECTIONS[args.section]
    if args.quick:
        args.keypoints = args.keypoints or QUICK_KEYPOINTS
    fill_in(args, {key: getattr(section, key) for key in ("blocks", "thin", "keypoints", "methods")})
    return args


def main() -> None:
    args = parse()
    table = SECTIONS[args.section].table
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    with errors_as_exits():
        names = named_methods(args.methods)
        for name in names:
            check_method(name.spec)
        for row in rows_of(args, names):
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
            write_text(args.out / f"{args.section}.json", json.dumps(rows, indent=1) + "\n")
    text = table(rows) + "\n"
    markers = None if args.readme is None else f"bench_{args.readme or args.section}"
    publish(text, args.out / f"{args.section}.md", markers, command(args))


if __name__ == "__main__":
    main()
