"""The shipped LightGlue beside the mutual ratio test, on keypoints that neither was trained on, and what it costs.

Recall: the network's at the precision that the ratio test (0.8) has on the same pairs, and the wrong matches among
which it reaches the ratio test's recall. Pairs: homographies of pictures of --unseen, and rendered blocks of --seed:
scenes, suns and flights of the training's blocks with other numbers. Reliability: share of right ones among matches by
score.

Seconds a pair with 2048 keypoints on either side, features excluded, one process with --threads, median of 20 after a
warm-up: this forward in float32, and in bfloat16 where the processor has it, kornia's with the same weights and of the
official size (9 layers of 256, random weights), then what early exit and pruning add; two processes beside two threads;
and the whole matcher over 16 pairs of a rendered block, with what saves time switched on step by step. Writes
OUT/accuracy.md, OUT/speed.md and OUT/lightglue.json; OUT/data keeps the pairs. In docs/results each part has a table of
its own, and speed two: with and without bfloat16 in the processor.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from trainings.blocks import render
from trainings.lightglue.blocks import Pair, block_pairs
from trainings.lightglue.data import pictures as pictures_of
from trainings.lightglue.data import read_block, read_groups, write_block, write_groups
from trainings.lightglue.validation import LIKE_DEG, LIKE_OCTAVES, Found, answered, judged, recalls, together
from trainings.runs import check_recipe

from aeromatch_cli.config import load
from aeromatch_cli.files import write_text
from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
from aeromatch_cli.nets.lightglue import LightGlue
from aeromatch_cli.nets.lightglue_file import load_lightglue, read_calibration
from aeromatch_cli.nets.precision import has_bfloat16
from benchmarks import options, stamps
from benchmarks.lightglue.costs import BLOCK_PAIRS, MATCHERS, block_table, first_keypoints, forward_table, jobs_table
from benchmarks.processes import limit_threads
from benchmarks.scenes import render_once
from benchmarks.tables import Column, Row, markdown, number, ratio, table

PARTS = ("accuracy", "speed")
LIKE = (
    f"those whose sizes differ by up to {LIKE_OCTAVES:g} octaves and whose turns by up to {LIKE_DEG:.0f} degrees from "
    "what is usual in the pair, and others, which happen to lie within 3 px."
)
TIMED_KEYPOINTS = 2048
FIRST_BLOCK = 1000  # numbers of the blocks, far from those trained on
WEAK = 0.3  # recall of the ratio test below which recalls are compared instead of what is missed


def pairs_of(args: argparse.Namespace) -> dict[str, list[Pair]]:
    """Judged pairs by kind."""
    data = args.out / "data"
    data.mkdir(parents=True, exist_ok=True)
    pictures = pictures_of(args.data / name for name in args.unseen)
    write_groups(data / "homographies.npz", pictures, 10**7 * (1 + args.seed), args.groups)
    rendered: list[Pair] = []
    for index in range(args.blocks):
        folder = render(args.out / "blocks", FIRST_BLOCK + 100 * args.seed + index)
        path = data / f"{folder.name}.npz"
        write_block(path, partial(block_pairs, folder, keypoints=TIMED_KEYPOINTS))
        rendered += read_block(path)
    warped = read_groups(data / "homographies.npz")
    return {
        "homography, any turn": [pair for pair in warped if pair.side0.angles_rad.any()],
        "homography, upright": [pair for pair in warped if not pair.side0.angles_rad.any()],
        "rendered, one sun": [pair for pair in rendered if not pair.two_suns],
        "rendered, two suns": [pair for pair in rendered if pair.two_suns],
    }


def accuracy_rows(network: LightGlue, sets: dict[str, list[Pair]]) -> tuple[list[Row], Found]:
    """Figures of each set, and the network's matches of all of them."""
    rows, everything = [], []
    for name, pairs in sets.items():
        by_ratio, by_network = answered(network, pairs)
        test, own = judged(by_ratio), judged(by_network)
        everything.append(own)
        least = own.least_score_at(test.precision)
        rows.append({
            "pairs": name, "count": len(pairs), "possible": test.possible, "precision": test.precision,
            "ratio_recall": test.recall, "recall": own.recall_at(test.precision),
            "ratio_wrong": int((~test.right).sum()), "wrong": own.wrong_at(test.recall),
            "by_look": {"ratio": recalls(by_ratio, -np.inf), "network": recalls(by_network, least)},
        })  # fmt: skip
    return rows, together(everything)


def _missed(row: Row) -> str:
    missed = ratio(1.0 - row["recall"], 1.0 - row["ratio_recall"])
    return "-" if row["ratio_recall"] < WEAK else number(missed, 2)


def _gained(row: Row) -> str:
    return number(ratio(row["recall"], row["ratio_recall"]), 2) if row["ratio_recall"] < WEAK else "-"


def _wrong(row: Row) -> str:
    return f"{row['wrong'] / max(row['ratio_wrong'], 1):.2f}" if row["wrong"] >= 0 else "never reached"


def _by_look(method: str, part: int) -> Column[Row]:
    """part: 0 share of partners of like look, 1 their recall, 2 that of the others."""
    titles = {"ratio": "recall of the others, ratio test" if part == 2 else "their recall, ratio test"}
    return titles.get(method, "LightGlue"), lambda row: f"{row['by_look'][method][part]:.3f}"


_ACCURACY: tuple[Column[Row], ...] = (
    ("number", lambda row: row["count"]),
    ("precision of both", lambda row: f"{row['precision']:.3f}"),
    ("recall, ratio test", lambda row: f"{row['ratio_recall']:.3f}"),
    ("recall, LightGlue", lambda row: f"{row['recall']:.3f}"),
    ("missed x (goal 0.5)", _missed),
    ("recall x (goal 2)", _gained),
    ("wrong at the ratio test's recall x (goal 0.5)", _wrong),
)
_LOOK: tuple[Column[Row], ...] = (
    ("partners of like look", lambda row: f"{row['by_look']['ratio'][0]:.1%}"),
    _by_look("ratio", 1),
    _by_look("network", 1),
    ("missed x", lambda row: number(ratio(*(1.0 - row["by_look"][one][1] for one in ("network", "ratio"))), 3)),
    _by_look("ratio", 2),
    _by_look("network", 2),
)


def accuracy(args: argparse.Namespace, network: LightGlue, sets: dict[str, list[Pair]]) -> str:
    """What a page says; the figures go to OUT/lightglue.json."""
    rows, found = accuracy_rows(network, sets)
    write_text(args.out / "lightglue.json", json.dumps(rows, indent=1) + "\n")  # with NaN where a set is empty
    lines = [((row["pairs"],), row) for row in rows]
    bins = found.reliability(read_calibration(args.weights))
    scores = [
        (f"{low:.1f}-{high:.1f}", matches, f"{mean:.3f}", f"{right:.3f}") for low, high, matches, mean, right in bins
    ]
    return "\n\n".join([
        table(("pairs",), lines, _ACCURACY),
        f"The same matches by what the truth, which knows places alone, takes for partners: {LIKE}",
        table(("pairs",), lines, _LOOK),
        "Whether scores mean what they say:",
        markdown(("score", "matches", "mean score", "right"), scores),
    ])  # fmt: skip


def full_pair(sets: dict[str, list[Pair]]) -> Pair:
    """The first rendered pair of which either side has as many keypoints as are timed."""
    for pair in (*sets["rendered, one sun"], *sets["rendered, two suns"]):
        if min(len(pair.side0.points_px), len(pair.side1.points_px)) >= TIMED_KEYPOINTS:
            return first_keypoints(pair, TIMED_KEYPOINTS)
    raise SystemExit(f"no rendered pair has {TIMED_KEYPOINTS} keypoints on either side: give more --blocks")


def speed(args: argparse.Namespace, network: LightGlue, sets: dict[str, list[Pair]], device: str) -> str:
    """What a page says."""
    where = f"{args.threads} threads" if device == "cpu" else torch.cuda.get_device_name()
    where += ", bfloat16 native" if has_bfloat16(device) else ", no bfloat16 of its own"
    text = []
    # A GPU is asked for what a block takes of it as well: fewer keypoints, many pairs.
    for count in (TIMED_KEYPOINTS,) if device == "cpu" else (1024, TIMED_KEYPOINTS):
        text += [f"Seconds a pair with {count} keypoints on either side ({where}):"]
        text += [forward_table(network, first_keypoints(full_pair(sets), count), device)]
    size = {"width_px": 1000, "height_px": 750, "images": 12, "flight": "mixed"}
    block = render_once(args.out / "blocks", "city", seed=args.seed, **size)
    of_block = f"{BLOCK_PAIRS} pairs of a rendered block of 12 images"
    text += [f"{of_block}, features of preset `baseline`, {TIMED_KEYPOINTS} keypoints:"]
    text += [block_table(block, args.weights, TIMED_KEYPOINTS)]
    return "\n\n".join([*text, *([jobs_table(args.weights, full_pair(sets))] if device == "cpu" else [])])


def make_options() -> argparse.ArgumentParser:
    parser = options.make_parser("lightglue", __doc__)
    add = parser.add_argument
    add("--weights", type=Path, default=SHIPPED_LIGHTGLUE, help="safetensors file (default: those that ship)")
    add("--data", type=Path, required=True, help="folder of real blocks")
    about = "real blocks whose pictures are warped"
    add("--unseen", type=options.names, default="ochota,lewis,seneca", help=about)
    add("--groups", type=options.positive, default=30, help="groups of four homography views")
    add("--blocks", type=options.positive, default=8, help="rendered blocks")
    add("--seed", type=int, default=1, help="another seed gives other groups and blocks")
    add("--threads", type=options.positive, default=2)
    add("--parts", type=options.names, default=",".join(PARTS), help=f"comma-separated: {', '.join(PARTS)}")
    options.add_output(parser, tables=2)
    return parser


def main(arguments: Sequence[str]) -> None:
    parser = make_options()
    args = options.parse(parser, arguments)
    if unknown := set(args.parts) - set(PARTS):
        parser.error(f"--parts: {', '.join(sorted(unknown))} is none of {', '.join(PARTS)}")
    check_recipe(parser, args, ("data", "unseen", "groups", "blocks", "seed"))
    limit_threads(args.threads)
    torch.set_num_threads(args.threads)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = load_lightglue(args.weights, device=device)
    sets = pairs_of(args)
    kind = "" if has_bfloat16(device) else "_float32"
    for part, name, make in (
        ("accuracy", "bench_lightglue", lambda: accuracy(args, network, sets)),
        ("speed", f"bench_lightglue_speed{kind}", lambda: speed(args, network, sets, device)),
    ):
        if part in args.parts:
            asked = argparse.Namespace(**vars(args) | {"parts": [part]})
            versions = stamps.of_settings(load("baseline"), families=("simulate", "extract"))
            versions |= stamps.of_strategies("match", *MATCHERS)
            options.publish(
                args, make() + "\n", args.out / f"{part}.md", table=name,
                command=options.command_line(parser, asked), versions=versions,
            )  # fmt: skip
