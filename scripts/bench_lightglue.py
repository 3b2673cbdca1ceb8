"""The shipped LightGlue beside the mutual ratio test, on keypoints that neither was trained on, and what it costs.

Recall: the network's at the precision that the ratio test (0.8) has on the same pairs, and the wrong matches among
which it reaches the ratio test's recall. Pairs: homographies of pictures of --unseen, and rendered blocks of --seed:
scenes, suns and flights of training_blocks with other numbers. Reliability: share of right ones among matches by score.

Seconds a pair with 2048 keypoints on either side, features excluded, one process with --threads, median of 20 after a
warm-up: this forward in float32, and in bfloat16 where the processor has it, kornia's with the same weights and of the
official size (9 layers of 256, random weights), then what early exit and pruning add; two processes beside two threads;
and the whole matcher over 16 pairs of a rendered block, with what saves time switched on step by step. Writes
OUT/accuracy.md, OUT/speed.md and OUT/lightglue.json; OUT/data keeps the pairs. In the README each part has a place of
its own, and speed two: with and without bfloat16 in the processor.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import write_readme
from lightglue_training.blocks import Pair, block_pairs
from lightglue_training.costs import BLOCK_PAIRS, block_table, first_keypoints, forward_table, jobs_table
from lightglue_training.data import pictures as pictures_of
from lightglue_training.data import read_block, read_groups, write_block, write_groups
from lightglue_training.validation import (
    LIKE_DEG,
    LIKE_OCTAVES,
    Found,
    answered,
    judged,
    recalls,
    together,
)
from training_blocks import render
from training_runs import at_least_one, check_recipe

from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
from aeromatch_cli.nets.lightglue import LightGlue
from aeromatch_cli.nets.lightglue_file import Calibration, load_lightglue, read_calibration
from aeromatch_cli.nets.precision import has_bfloat16
from aeromatch_cli.synthetic import render_block
from aeromatch_cli.workspace import write_text

PARTS = ("accuracy", "speed")
LIKE = (
    f"those whose sizes differ by up to {LIKE_OCTAVES:g} octaves and whose turns by up to {LIKE_DEG:.0f} degrees from "
    "what is usual in the pair, and others, which happen to lie within 3 px."
)
TIMED_KEYPOINTS = 2048
FIRST_BLOCK = 1000  # numbers of the blocks, far from those trained on


def pairs_of(args: argparse.Namespace) -> dict[str, list[Pair]]:
    """Judged pairs by kind."""
    data = args.out / "data"
    data.mkdir(parents=True, exist_ok=True)
    pictures = pictures_of(args.data / name for name in args.unseen.split(","))
    write_groups(data / "homographies.npz", pictures, 10**7 * (1 + args.seed), args.groups)
    warped = read_groups(data / "homographies.npz")
    rendered: list[Pair] = []
    for index in range(args.blocks):
        folder = render(args.out / "blocks", FIRST_BLOCK + 100 * args.seed + index)
        path = data / f"{folder.name}.npz"
        write_block(path, partial(block_pairs, folder, keypoints=TIMED_KEYPOINTS))
        rendered += read_block(path)
    turned = {name: [p for p in warped if bool(p.side0.angles_rad.any()) is flag] for name, flag in _TURNED.items()}
    return {
        **{f"homography, {name}": found for name, found in turned.items()},
        "rendered, one sun": [pair for pair in rendered if not pair.two_suns],
        "rendered, two suns": [pair for pair in rendered if pair.two_suns],
    }


_TURNED = {"any turn": True, "upright": False}


def accuracy_rows(network: LightGlue, sets: dict[str, list[Pair]]) -> tuple[list[dict[str, Any]], Found]:
    """Figures of each set, and the network's matches of all of them."""
    rows, everything = [], []
    for name, pairs in sets.items():
        by_ratio, by_network = answered(network, pairs)
        ratio, own = judged(by_ratio), judged(by_network)
        everything.append(own)
        recall, wrong = own.recall_at(ratio.precision), own.wrong_at(ratio.recall)
        least = own.least_score_at(ratio.precision)
        rows.append({
            "pairs": name, "count": len(pairs), "possible": ratio.possible, "precision": ratio.precision,
            "ratio_recall": ratio.recall, "recall": recall, "ratio_wrong": int((~ratio.right).sum()), "wrong": wrong,
            "by_look": {"ratio": recalls(by_ratio, -np.inf), "network": recalls(by_network, least)},
        })  # fmt: skip
    return rows, together(everything)


def accuracy_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| pairs | number | precision of both | recall, ratio test | recall, LightGlue | missed x (goal 0.5) "
        "| recall x (goal 2) | wrong at the ratio test's recall x (goal 0.5) |",
        "|" + "---|" * 8,
    ]
    for r in rows:
        missed = (1.0 - r["recall"]) / (1.0 - r["ratio_recall"])
        fewer = f"{r['wrong'] / max(r['ratio_wrong'], 1):.2f}" if r["wrong"] >= 0 else "never reached"
        weak = r["ratio_recall"] < 0.3
        cells = [r["pairs"], r["count"], *(f"{r[key]:.3f}" for key in ("precision", "ratio_recall", "recall"))]
        cells += ["-" if weak else f"{missed:.2f}", f"{r['recall'] / r['ratio_recall']:.2f}" if weak else "-", fewer]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def look_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| pairs | partners of like look | their recall, ratio test | LightGlue | missed x "
        "| recall of the others, ratio test | LightGlue |",
        "|" + "---|" * 7,
    ]
    for r in rows:
        (share, ratio, ratio_others), (_, own, own_others) = r["by_look"]["ratio"], r["by_look"]["network"]
        values = (ratio, own, (1.0 - own) / (1.0 - ratio))
        lines.append(f"| {r['pairs']} | {share:.1%} | {' | '.join(f'{value:.3f}' for value in values)} | ")
        lines[-1] += f"{ratio_others:.3f} | {own_others:.3f} |"
    return "\n".join(lines)


def reliability_table(found: Found, calibration: Calibration) -> str:
    lines = ["| score | matches | mean score | right |", "|---|---|---|---|"]
    for low, high, matches, mean, right in found.reliability(calibration):
        lines.append(f"| {low:.1f}-{high:.1f} | {matches} | {mean:.3f} | {right:.3f} |")
    return "\n".join(lines)


def full_pair(sets: dict[str, list[Pair]]) -> Pair:
    """The first rendered pair of which either side has as many keypoints as are timed."""
    for pair in (*sets["rendered, one sun"], *sets["rendered, two suns"]):
        if min(len(pair.side0.points_px), len(pair.side1.points_px)) >= TIMED_KEYPOINTS:
            return first_keypoints(pair, TIMED_KEYPOINTS)
    raise SystemExit(f"no rendered pair has {TIMED_KEYPOINTS} keypoints on either side: give more --blocks")


def rendered_block(args: argparse.Namespace) -> Path:
    folder: Path = args.out / "blocks" / f"city-mixed-seed{args.seed}"
    if not (folder / "truth.json").is_file():
        render_block(folder, "city", seed=args.seed, width_px=1000, height_px=750, images=12, flight="mixed")
    return folder


def accuracy(
    args: argparse.Namespace, network: LightGlue, sets: dict[str, list[Pair]]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Figures, and what the README says."""
    facts, found = accuracy_rows(network, sets)
    text = [accuracy_table(facts)]
    text += [f"The same matches by what the truth, which knows places alone, takes for partners: {LIKE}"]
    text += [look_table(facts), "Whether scores mean what they say:"]
    return facts, [*text, reliability_table(found, read_calibration(args.weights))]


def speed(args: argparse.Namespace, network: LightGlue, sets: dict[str, list[Pair]], device: str) -> list[str]:
    """What the README says."""
    where = f"{args.threads} threads" if device == "cpu" else torch.cuda.get_device_name()
    where += ", bfloat16 native" if has_bfloat16(device) else ", no bfloat16 of its own"
    text = []
    # A GPU is asked for what a block takes of it as well: fewer keypoints, many pairs.
    for count in (TIMED_KEYPOINTS,) if device == "cpu" else (1024, TIMED_KEYPOINTS):
        text += [f"Seconds a pair with {count} keypoints on either side ({where}):"]
        text += [forward_table(network, first_keypoints(full_pair(sets), count), device)]
    of_block = f"{BLOCK_PAIRS} pairs of a rendered block of 12 images"
    text += [f"{of_block}, features of preset `baseline`, {TIMED_KEYPOINTS} keypoints:"]
    text += [block_table(rendered_block(args), args.weights, TIMED_KEYPOINTS)]
    return [*text, jobs_table(args.weights, full_pair(sets))] if device == "cpu" else text


def publish_part(args: argparse.Namespace, part: str, marker: str, text: Sequence[str]) -> None:
    """Into OUT, and with --readme into the README."""
    whole = "\n\n".join(text) + "\n"
    write_text(args.out / f"{part}.md", whole)
    print(whole, flush=True)
    if args.readme:
        asked = f"--data DIR --unseen {args.unseen} --groups {args.groups} --blocks {args.blocks} --seed {args.seed}"
        write_readme(f"    scripts/bench_lightglue {asked} --parts {part} --out DIR\n\n{whole}", marker)


def check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuses unknown parts, and a folder that holds other pairs."""
    args.parts = args.parts.split(",")
    if unknown := set(args.parts) - set(PARTS):
        parser.error(f"--parts: {', '.join(sorted(unknown))} is none of {', '.join(PARTS)}")
    check_recipe(parser, args, ("data", "unseen", "groups", "blocks", "seed"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--weights", type=Path, default=SHIPPED_LIGHTGLUE, help="safetensors file (default: those that ship)")
    add("--data", type=Path, required=True, help="folder of real blocks")
    add("--unseen", default="ochota,lewis,seneca", help="real blocks whose pictures are warped")
    add("--groups", type=at_least_one, default=30, help="groups of four homography views")
    add("--blocks", type=at_least_one, default=8, help="rendered blocks")
    add("--seed", type=int, default=1, help="another seed gives other groups and blocks")
    add("--threads", type=at_least_one, default=2)
    add("--parts", default=",".join(PARTS), help=f"comma-separated: {', '.join(PARTS)}")
    add("--readme", action="store_true", help="write the tables into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    check(parser, args)
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    torch.set_num_threads(args.threads)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = load_lightglue(args.weights, device=device)
    sets = pairs_of(args)
    if "accuracy" in args.parts:
        facts, text = accuracy(args, network, sets)
        write_text(args.out / "lightglue.json", json.dumps({"accuracy": facts}, indent=1) + "\n")
        publish_part(args, "accuracy", "bench_lightglue", text)
    if "speed" in args.parts:
        kind = "" if has_bfloat16(device) else "_float32"
        publish_part(args, "speed", f"bench_lightglue_speed{kind}", speed(args, network, sets, device))


if __name__ == "__main__":
    main()
