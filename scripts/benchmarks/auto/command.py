"""Whether `auto`, one command without a preset's name, gives at least what the best preset gives. Sections:

  rendered    presets and peers on rendered blocks with exact truth, by condition: one sun, two suns, two exposures
              (every second picture got an eighth of the light, with noise, in 8 bits), five cameras, texture-poor
              ground, rows and facades. Presets get the block's cameras and noisy poses (5 % of the flying height, 3
              degrees); peers every pair of the block that overlaps by 20 % or more. These pairs count, whether a preset
              tries them or not, and no others. `polar` is asked where all pictures look straight down
  strategies  `auto` with other settings (--strategies, each KEY=VALUE or auto[KEY=VALUE,...]) on the same blocks,
              beside `auto`: accepted where it brings 2 % more correct matches at no lower correctness (to 0.1 percent
              points), or a fifth fewer wrong ones for at most 1 % fewer correct ones; the interval of that ratio must
              not hold 1
  real        every k-th image of real blocks (DATA/BLOCK/images, DATA/BLOCK/reference/{poses.csv,block.json}), with
              positions that are off by 5 m or nothing, cameras from EXIF: images in the largest group of the exported
              block, beside what both of pycolmap's mappers (incremental / global) register from the same run's export
              and from two other chains. One is pycolmap's: its SIFT of the same size and number, exhaustive guided
              matching. The other is ALIKED with LightGlue on all pairs of the same images, verified by pycolmap, with
              as many descriptors as both steps of `auto` together (where its weights are found). Correct
              attitudes: within 3 degrees of the reference after one common turn. They, points and error are of the
              images of the largest group here, of the largest model of the mapper that registers more there;
              its seconds are those of the whole chain

Correct: within 3 px of the exact place in both directions. Correctness: share of the kept matches that is correct, in
the block where it is least, too. Auto / it: correct matches on the same pairs. Seconds: of whole runs without report on
one core, of peers of features, matching and verification. Every method has --keypoints descriptors an image, `auto` in
both of its steps with features. In brackets: 90 % intervals by bootstrap, over pairs in rendered
blocks, over thinned blocks in real ones. What OUT has of the same code and options is not made again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from aeromatch_cli.config import parse_method
from benchmarks import options, stamps
from benchmarks.auto import real, rendered, strategies
from benchmarks.auto.blocks import PLACES
from benchmarks.auto.runs import JUDGED
from benchmarks.peers.table import PEERS, check_method, missing_weights, split_methods
from benchmarks.processes import limit_threads
from benchmarks.tables import Row, write_rows

METHODS = "auto,baseline,fusion,oblique,polar,pycolmap-guided"
# The conditions under which a strategy may help; both sections share the runs of `auto`.
STRATEGY_PLACES = "city:mixed,city:exposed,city:oblique,grass:nadir"
# What is open; docs/decisions.md says what others brought.
STRATEGIES = "cascade.learned.lightglue=false"


def _rendered(section: str, arguments: Sequence[str]) -> None:
    parser = options.make_parser(f"auto {section}", __doc__)
    add = parser.add_argument
    places = ",".join(PLACES) if section == "rendered" else STRATEGY_PLACES
    add("--places", type=options.names, default=places, metavar="SCENE:FLIGHT", help="comma-separated")
    add("--seeds", type=options.numbers, default="1,2", help="of the blocks, comma-separated")
    add("--size", metavar="WxH", default="640x480", help="of rendered images")
    add("--images", type=options.positive, default=5, help="of each rendered block, twice as many of five cameras")
    add("--keypoints", type=options.positive, default=4096, help="descriptors per image, of every step")
    if section == "rendered":
        add("--methods", type=split_methods, default=METHODS, help=f"presets, and of {', '.join(PEERS)}")
    else:
        add("--strategies", type=split_methods, default=STRATEGIES, help="settings of auto, comma-separated")
    add("--jobs", type=options.positive, default=2, help="methods at a time, on one core each")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of peers that are networks")
    options.add_output(parser)
    quick = {"places": "suburb:nadir,city:exposed", "seeds": "1", "size": "320x240", "images": 4, "keypoints": 1000}
    args = options.parse(parser, arguments, quick)
    if unknown := sorted(set(args.places) - set(PLACES)):
        parser.error(f"--places: {', '.join(unknown)} are none of {', '.join(PLACES)}")
    methods = args.methods if section == "rendered" else [JUDGED, *strategies.asked_of(args.strategies)]
    if JUDGED not in methods:
        parser.error(f"--methods must hold {JUDGED}, which the others are compared with")
    for method in methods:
        check_method(method)
    limit_threads(1)
    rows: list[Row] = []
    for own in rendered.measured(args, methods):
        rows += own
        print(f"{own[0]['block']}: {own[0]['method']}" if own else "no pair", file=sys.stderr, flush=True)
        write_rows(args.out / f"{section}.json", rows)
    make, table = (
        (rendered.table_of, "bench_auto") if section == "rendered" else (strategies.table_of, "bench_auto_strategies")
    )
    presets = [method for method in methods if parse_method(method)[0] not in PEERS]
    options.publish(
        args, make(rows) + "\n", args.out / f"{section}.md", table=table,
        command=options.command_line(parser, args), versions=stamps.of_chain(*presets),
    )  # fmt: skip


def _real(arguments: Sequence[str]) -> None:
    parser = options.make_parser("auto real", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of blocks")
    add("--blocks", type=options.names, default="ochota,lewis,seneca,brighton", help="names, comma-separated")
    add("--thin", type=options.numbers, default="4", help="keep every k-th image; several k comma-separated")
    add("--given", type=options.names, default="positions,nothing", help=f"of {', '.join(real.GIVEN)}")
    add("--presets", type=split_methods, default=JUDGED, help="comma-separated")
    add("--keypoints", type=options.positive, default=4000, help="descriptors per image, of every step")
    add("--max-size", type=options.positive, default=1600, help="longer side of images, px")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    add(
        "--reference-weights",
        type=Path,
        metavar="DIR",
        help="folder of aliked-n16.pth and its LightGlue; else without that chain",
    )
    options.add_output(parser)
    quick = {"blocks": "seneca", "thin": "5", "presets": "baseline", "keypoints": 1000, "max_size": 800}
    args = options.parse(parser, arguments, quick)
    if unknown := sorted(set(args.given) - set(real.GIVEN)):
        parser.error(f"--given: {', '.join(unknown)} are none of {', '.join(real.GIVEN)}")
    for method in args.presets:
        check_method(method, ())
    if unknown := [name for name in args.blocks if not (args.data / name / "images").is_dir()]:
        parser.error(f"--blocks: {', '.join(unknown)} not found in {args.data}, each with a folder images")
    if args.reference_weights is not None and not args.reference_weights.is_dir():
        parser.error(f"--reference-weights: {args.reference_weights} is no folder")
    if lacking := missing_weights(real.CHAIN, args.reference_weights):
        print(f"left out: {real.CHAIN}, for want of {', '.join(lacking)} (--reference-weights DIR)", file=sys.stderr)
    limit_threads(2)
    rows = []
    for row in real.rows_of(args):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        write_rows(args.out / "real.json", rows)
    options.publish(
        args, real.table_of(rows) + "\n", args.out / "real.md", table="bench_auto_real",
        command=options.command_line(parser, args), versions=stamps.of_chain(*args.presets, exported=True),
    )  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    section, rest = options.section_of("auto", __doc__, ("rendered", "strategies", "real"), arguments)
    if section == "real":
        _real(rest)
    else:
        _rendered(section, rest)
