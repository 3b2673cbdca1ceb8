"""Presets on whole rendered blocks with inexact poses, beside peers on the same pairs, all judged by exact truth.

A preset is one `aeromatch run PRESET` with the block's cameras and its noisy poses (5 % of the flying height, 3
degrees), with --poses their positions alone or nothing: orientation, pairs, features, matches, verification and
consistency. Peers get every pair of the block that overlaps by 20 % or more, those that read poses the noisy ones.
These pairs count, whether a preset tries them or not, and no others. As by default (8,000 and 4,000), methods with SIFT
may have twice the descriptors of those with networks, which take longer for each; a cascade has both.
`auto[cascade=none]` is `auto` without its further steps, and so on: the picture shows what each step brings and takes;
none of them counts as another preset. Correct: within 3 px of the exact place. Best: the preset, or peer, with most
correct matches in that line. Median error: of the medians of pairs. Seconds: of features, each image's once, matching,
verification, least-squares measuring, adjustment and consistency, on --jobs cores; pycolmap's extraction, which has one
thread for an image, counts as if it filled them. Orientation, start-up and export, which peers do without, are in the
seconds of the whole command alone.

Writes OUT/results.json row by row, OUT/presets.md and OUT/quality.svg, correct matches against seconds. What OUT has of
the same size, images, keypoints and settings is not made again: a killed run goes on there. A preset may be
PRESET[key=value,key=value].
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from aeromatch_cli.config import load, parse_method, preset_names
from aeromatch_cli.evaluate.scores import VIEW_ANGLE_CLASSES
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.lab.synthetic import PRESETS
from benchmarks import options, stamps
from benchmarks.methods.worker import measure
from benchmarks.pages import FOLDER
from benchmarks.peers.base import Options
from benchmarks.peers.table import NEED_WEIGHTS, PEERS, check_method, reads_poses, split_methods
from benchmarks.processes import limit_threads
from benchmarks.quality import draw_quality
from benchmarks.scenes import NOISY_POSES, Judged, rendered_scenes, with_noisy_poses
from benchmarks.tables import Row, code, grouped, markdown, median, number, percent, plain, ratio, total, write_rows
from benchmarks.whole import budget_settings, evaluated, whole_run

_JUDGED = "auto"
_ALL_PAIRS = 1_000_000
_NOISY, _POSITIONS, _NOTHING = "noisy", "positions", "nothing"
# Whose seconds count: of all that final matches come from, once the block is oriented.
_STAGES = ("extract", "match", "filter", "refine", "adjust", "consistency")
# Peers whose features take one core.
_ONE_CORE = ("pycolmap", "pycolmap-guided")
_FIGURES = ("possible", "kept", "correct", "median_error_px")


def preset_rows(args: argparse.Namespace, judged: Judged, preset: str, folder: Path) -> list[Row]:
    """One row for each judged pair of a preset's run."""
    scene = judged.scene
    poses = given_poses(scene.poses.with_name(NOISY_POSES), args.poses)
    lens = "exif" if args.lens else str(scene.block)  # the latter would be the exact calibration
    given = [*poses, "--cameras", lens, "--crs", "local"]
    work = folder / "work"
    name, own_settings = parse_method(preset)
    settings = [*budget_settings(load(name, own_settings), args.keypoints), *own_settings, *args.set]
    run = whole_run("run", name, scene.images, work, extra=given, jobs=args.jobs, settings=settings)
    if not run.answer:
        raise SystemExit(f"aeromatch run {preset} on {scene.name} failed with exit code {run.code}:\n{run.said}")
    evaluated(work, scene.images.parent, mapping=False)
    with (work / "evaluation" / "pairs.csv").open(encoding="utf-8", newline="") as stream:
        by_pair = {(row["image0"], row["image1"]): row for row in csv.DictReader(stream)}
    found = [by_pair[pair.images] for pair in judged.pairs]
    shutil.rmtree(work)
    seconds = sum(run.answer["stages"][stage]["seconds"] for stage in _STAGES)
    own = {"seconds": seconds / max(1, len(found)), "run_seconds": run.seconds / max(1, len(found))}
    return [
        {"angle": row["view_angle_class"], **{key: plain(float(row[key] or "nan")) for key in _FIGURES}, **own}
        for row in found
    ]


def given_poses(noisy: Path, known: str) -> list[str]:
    """Options that give a preset the camera of every image and so much of its noisy pose: a value of --poses."""
    if known == _NOISY:
        return ["--poses", str(noisy)]
    with noisy.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    place = ("x", "y", "z") if known == _POSITIONS else ()
    columns = ("image", "x", "y", "z", "camera")
    lines = [[row[key] if key in ("image", "camera", *place) else "" for key in columns] for row in rows]
    found = noisy.with_name(f"poses_{known}.csv")
    found.write_text("\n".join(",".join(line) for line in [columns, *lines]) + "\n", encoding="utf-8")
    return ["--poses", str(found)]


def peer_rows(args: argparse.Namespace, judged: Judged, peer: str) -> list[Row]:
    """One row for each pair that a peer has answered."""
    most = args.keypoints // 2 if peer in NEED_WEIGHTS else args.keypoints
    limits = Options(most, "image", args.jobs, args.seed, args.reference_weights)
    noisy = with_noisy_poses(judged) if reads_poses(peer) else None
    rows: list[Row] = []
    known: set[str] = set()
    answers = measure(peer, noisy or judged, limits, args.out / "found")
    for pair, (_, measured) in zip(judged.pairs, answers, strict=True):
        found = measured.found
        answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
        score = judged.truth.judge(*pair.images, *answer).row()
        again = [s for image, s in zip(pair.images, measured.features_seconds, strict=True) if image in known]
        known.update(pair.images)
        figures = {key: plain(score[key]) for key in _FIGURES}
        seconds = measured.seconds - sum(again)
        if peer in _ONE_CORE:
            seconds -= (1.0 - 1.0 / args.jobs) * (sum(measured.features_seconds) - sum(again))
        own = {"seconds": seconds}
        rows.append({"angle": pair.conditions.view_angle_class, **figures, **own})
    return rows


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    """Of every method on every block, pair by pair."""
    first = args.seed
    asked = {name: getattr(args, name) for name in ("size", "images", "keypoints", "set")}
    for seed in (first + k for k in range(args.seeds)):
        args.seed = seed
        for flight, judged in rendered_scenes(args, "all"):
            for method in (*args.presets, *args.peers):
                ours = method in args.presets
                given = f"-{args.poses}" if ours and args.poses != _NOISY else ""
                folder = args.out / "runs" / f"{judged.scene.name}-{flight}-{seed}-{method}{given}"
                path = folder / "rows.json"
                known = read_json(path) if path.is_file() else {}
                if known.get("asked") != asked:
                    found = preset_rows(args, judged, method, folder) if ours else peer_rows(args, judged, method)
                    folder.mkdir(parents=True, exist_ok=True)
                    known = {"asked": asked, "rows": found}
                    write_json(path, known)
                for row in known["rows"]:
                    yield {"seed": seed, "flight": flight, "scene": judged.scene.name, "method": method, **row}
    args.seed = first


def _compared(args: argparse.Namespace, rows: Sequence[Row], label: str) -> list[object]:
    """A line: the judged preset beside the best other preset and the best peer."""
    of = {method[0]: own for method, own in grouped(rows, "method")}
    correct = {method: total(own, "correct") for method, own in of.items()}
    ours = of[_JUDGED]
    line: list[object] = [
        label, number(correct[_JUDGED]), percent(ratio(correct[_JUDGED], total(ours, "kept")), 1),
        f"{median(ours, 'median_error_px'):.2f}",
    ]  # fmt: skip
    for names in (args.presets, args.peers):
        others = [name for name in names if parse_method(name)[0] != _JUDGED and name in of]
        if not others:
            line += ["-", "-", "-"]
            continue
        best = max(others, key=lambda name: correct[name])
        right = percent(ratio(correct[best], total(of[best], "kept")), 1)
        line += [f"{code(best)} {number(correct[best])}", right, f"{ratio(correct[_JUDGED], correct[best]):.2f}"]
    return line


def _seconds(args: argparse.Namespace, rows: Sequence[Row], label: str) -> list[object]:
    """A line: seconds of the judged preset beside those of the fastest and the slowest other one."""
    known = {method[0]: total(own, "seconds") for method, own in grouped(rows, "method") if method[0] in args.presets}
    others = {method: seconds for method, seconds in known.items() if parse_method(method)[0] != _JUDGED}
    line: list[object] = [label, f"{known[_JUDGED]:.1f}"]
    for pick in (min, max):
        if not others:
            line += ["-", "-"]
            continue
        other = pick(others, key=lambda method: others[method])
        line += [f"{code(other)} {others[other]:.1f}", f"{ratio(known[_JUDGED], others[other]):.2f}"]
    return line


def table_of(args: argparse.Namespace, rows: Sequence[Row]) -> str:
    """Blocks, classes of view angle, seconds, and methods."""
    heads = ["correct", "of kept", "error px", "best preset", "of kept", "auto / it", "best peer", "of kept",
             "auto / it"]  # fmt: skip
    blocks = [
        _compared(args, own, f"{scene}:{flight}, seed {seed}")
        for (scene, flight, seed), own in grouped(rows, "scene", "flight", "seed")
    ]
    classes = [name for name, _ in VIEW_ANGLE_CLASSES]
    angles = [
        _compared(args, own, f"{name} degrees")
        for name in classes
        if (own := [row for row in rows if row["angle"] == name])
    ]
    seconds_of = [
        _seconds(args, own, str(label)) for key in ("scene", "flight") for (label,), own in grouped(rows, key)
    ]
    beside = ["", "s", "fastest other preset, s", "auto / it", "slowest, s", "auto / it"]
    methods = []
    for (method,), own in grouped(rows, "method"):
        seconds, whole = (f"{total(own, key):.0f}" if key in own[0] else "-" for key in ("seconds", "run_seconds"))
        right = percent(ratio(total(own, "correct"), total(own, "kept")), 1)
        found = percent(ratio(total(own, "correct"), total(own, "possible")), 1)
        tied = sum((row["correct"] or 0) >= 30 for row in own)
        methods.append(
            [code(method), number(total(own, "correct")), right, f"{median(own, 'median_error_px'):.2f}", found,
             f"{tied} of {len(own)}", seconds, whole]
        )  # fmt: skip
    return "\n\n".join(
        [
            "#### By block\n\n" + markdown(["block", *heads], blocks),
            "#### By view angle\n\n" + markdown(["view angle", *heads], angles),
            "#### Seconds by scene and by flight\n\n" + markdown(beside, seconds_of),
            "#### By method\n\n"
            + markdown(
                [
                    "method",
                    "correct",
                    "of kept",
                    "error px",
                    "of possible",
                    "pairs with 30 correct",
                    "s",
                    "whole run, s",
                ],
                methods,
            ),
        ]
    )


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("presets", __doc__)
    add = parser.add_argument
    steps = "auto[cascade=none],auto[cascade=guided]"
    add("--presets", type=split_methods, default=f"auto,{steps},baseline,fusion,oblique", help="comma-separated")
    add("--peers", type=options.names, default="pycolmap-guided", help=f"comma-separated of {', '.join(PEERS)}")
    options.add_rendered(parser, scenes=",".join(PRESETS), size="800x600", images=12, flights="nadir,mixed,oblique")
    add("--seeds", type=options.positive, default=1, help="so many, from --seed on")
    add(
        "--keypoints",
        type=options.positive,
        default=4096,
        help="SIFT descriptors per image; networks have half as many",
    )
    given = (_NOISY, _POSITIONS, _NOTHING)
    add("--poses", choices=given, default=_NOISY, help="what presets know of them")
    add("--lens", choices=("real",), help="pictures through lenses of which EXIF says the focal length alone")
    add("--set", type=options.names, default="", metavar="KEY=VALUE", help="settings of every preset, comma-separated")
    add("--jobs", type=options.positive, default=2)
    add("--reference-weights", type=Path, metavar="DIR", help="weights of the peers that are networks")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"scenes": "suburb", "flights": "nadir", "size": "480x360"})
    args.pairs = _ALL_PAIRS
    if _JUDGED not in args.presets:
        parser.error(f"--presets must hold {_JUDGED}, which the others are compared with")
    if unknown := [name for name in args.presets if parse_method(name)[0] not in preset_names()]:
        parser.error(f"--presets: {', '.join(unknown)} are none of {', '.join(preset_names())}")
    for peer in args.peers:
        check_method(peer)
    limit_threads(2)
    rows = []
    for row in rows_of(args):
        rows.append(row)
        if len(rows) == 1 or any(rows[-2][key] != row[key] for key in ("seed", "flight", "scene", "method")):
            print(json.dumps({key: row[key] for key in ("scene", "flight", "seed", "method")}), file=sys.stderr)
            write_rows(args.out / "results.json", rows)
    write_rows(args.out / "results.json", rows)
    del args.pairs
    draw_quality(args.out / "quality.svg", rows)
    if args.docs == "":  # the page's picture is that of its first table
        draw_quality(FOLDER / "auto.svg", rows)
    versions: dict[str, stamps.Version] = {}
    for preset in args.presets:
        versions |= stamps.of_chain(*parse_method(preset))
    options.publish(
        args, table_of(args, rows) + "\n", args.out / "presets.md", table="bench_presets",
        command=options.command_line(parser, args), versions=versions,
    )  # fmt: skip
