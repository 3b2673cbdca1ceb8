"""The shipped LightGlue beside the mutual ratio test, on keypoints that neither was trained on, and what it costs.

Recall: the network's at the precision that the ratio test (0.8) has on the same pairs, and the wrong matches among
which it reaches the ratio test's recall. Pairs: homographies of pictures of --unseen, and rendered blocks of --seed:
scenes, suns and flights of training_blocks with other numbers. Reliability: share of right ones among matches by score.

Seconds a pair with 2048 keypoints on either side, features excluded, one process with --threads, median of 20 after a
warm-up: this forward in both precisions, kornia's with the same weights and kornia's of the official size (9 layers of
256, random weights), then what early exit and pruning add. Writes OUT/lightglue.md and
OUT/lightglue.json; OUT/data keeps the pairs.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import write_readme
from lightglue_training.batches import as_side
from lightglue_training.blocks import Pair, block_pairs
from lightglue_training.data import pictures as pictures_of
from lightglue_training.data import read_block, read_groups, write_block, write_groups
from lightglue_training.validation import Found, by_network, by_ratio, judged
from training_blocks import render

from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.nets.lightglue_file import load_lightglue
from aeromatch_cli.nets.weights import SHIPPED_LIGHTGLUE
from aeromatch_cli.workspace import write_text

OFFICIAL = Dimensions(input_dim=128, descriptor_dim=256, n_layers=9, num_heads=4, add_scale_ori=True)
TIMED_KEYPOINTS, REPEATS = 2048, 20
FIRST_BLOCK = 1000  # numbers of the blocks, far from those trained on
EDGES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
EVERYTHING = {"depth_confidence": -1.0, "width_confidence": -1.0}


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
        ratio = judged((pair, *by_ratio(pair)) for pair in pairs)
        own = judged((pair, *by_network(network, pair)) for pair in pairs)
        everything.append(own)
        recall, wrong = own.recall_at(ratio.precision), own.wrong_at(ratio.recall)
        rows.append({
            "pairs": name, "count": len(pairs), "possible": ratio.possible, "precision": ratio.precision,
            "ratio_recall": ratio.recall, "recall": recall, "ratio_wrong": int((~ratio.right).sum()), "wrong": wrong,
        })  # fmt: skip
    together = Found(
        np.concatenate([f.scores for f in everything]),
        np.concatenate([f.right for f in everything]),
        sum(f.possible for f in everything),
    )
    return rows, together


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


def reliability_table(found: Found) -> str:
    lines = ["| score | matches | mean score | right |", "|---|---|---|---|"]
    for low, high in zip((0.0, *EDGES), EDGES, strict=False):
        which = (found.scores > low) & (found.scores <= high)
        if which.any():
            scores, right = found.scores[which], found.right[which]
            lines.append(f"| {low:.1f}-{high:.1f} | {which.sum()} | {scores.mean():.3f} | {right.mean():.3f} |")
    return "\n".join(lines)


def median_seconds(work: Callable[[], object], device: str) -> float:
    """Of REPEATS calls after one that does not count."""
    taken = []
    for _ in range(1 + REPEATS):
        started = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - started)
    return float(np.median(taken[1:]))


def _kornia(dimensions: Dimensions, device: str, weights: LightGlue | None) -> Callable[[Pair], Any]:
    from kornia.feature import LightGlue as Kornia

    torch.manual_seed(0)
    conf = dict(vars(dimensions)) | {"flash": False} | EVERYTHING
    theirs = Kornia(features=None, **conf).eval().to(device)
    if weights is not None:
        theirs.load_state_dict(weights.state_dict(), strict=False)

    def image(side: Any) -> dict[str, torch.Tensor]:
        arrays = {"keypoints": side.points_px, "scales": side.sizes_px / 2, "oris": side.angles_rad}
        arrays |= {"image_size": side.size_px, "descriptors": side.descriptors / 512.0}
        return {k: torch.from_numpy(np.asarray(v, np.float32))[None].to(device) for k, v in arrays.items()}

    def match(pair: Pair) -> Any:
        with torch.inference_mode():
            return theirs({"image0": image(pair.side0), "image1": image(pair.side1)})

    return match


def _own(network: LightGlue, device: str, **options: float) -> Callable[[Pair], Any]:
    def match(pair: Pair) -> Any:
        sides = [as_side([side]).to(device) for side in (pair.side0, pair.side1)]
        return network.match(*sides, threshold=0.1, **(EVERYTHING | options))

    return match


def speed_table(network: LightGlue, pair: Pair, device: str) -> str:
    """Every way on the same pair; both sides have 2048 keypoints."""
    half = LightGlue(network.dimensions).to(device).eval()
    half.load_state_dict(network.state_dict())
    half = half.to(dtype=torch.bfloat16)
    ways = {
        "kornia, official size, float32": _kornia(OFFICIAL, device, None),
        "kornia, these weights, float32": _kornia(network.dimensions, device, network),
        "own forward, float32": _own(network, device),
        "own forward, bfloat16": _own(half, device),
        "+ early exit": _own(half, device, depth_confidence=0.95),
        "+ early exit and pruning": _own(half, device, depth_confidence=0.95, width_confidence=0.99),
    }
    lines = ["| forward | seconds a pair | x official (goal 0.25) |", "|---|---|---|"]
    base = 0.0
    for name, way in ways.items():
        seconds = median_seconds(partial(way, pair), device)
        base = base or seconds
        lines.append(f"| {name} | {seconds:.3f} | {seconds / base:.2f} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def full_pair(sets: dict[str, list[Pair]]) -> Pair:
    """The first rendered pair of which either side has as many keypoints as are timed."""
    for pair in (*sets["rendered, one sun"], *sets["rendered, two suns"]):
        if min(len(pair.side0.points_px), len(pair.side1.points_px)) >= TIMED_KEYPOINTS:
            rows = np.arange(TIMED_KEYPOINTS)
            return Pair(pair.side0.take(rows), pair.side1.take(rows), pair.truth, pair.two_suns)
    raise SystemExit(f"no rendered pair has {TIMED_KEYPOINTS} keypoints on either side: give more --blocks")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--weights", type=Path, default=SHIPPED_LIGHTGLUE, help="safetensors file (default: those that ship)")
    add("--data", type=Path, required=True, help="folder of real blocks")
    add("--unseen", default="ochota,lewis,seneca", help="real blocks whose pictures are warped")
    add("--groups", type=int, default=30, help="groups of four homography views")
    add("--blocks", type=int, default=8, help="rendered blocks")
    add("--seed", type=int, default=1, help="another seed gives other groups and blocks")
    add("--threads", type=int, default=2)
    add("--parts", default="accuracy,speed", help="comma-separated")
    add("--readme", action="store_true", help="write the tables into the README")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    os.environ["OPENCV_LOG_LEVEL"] = "ERROR"
    torch.set_num_threads(args.threads)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = load_lightglue(args.weights, device=device)
    sets = pairs_of(args)
    text, facts = [], {}
    if "accuracy" in args.parts:
        facts["accuracy"], together = accuracy_rows(network, sets)
        text += [accuracy_table(facts["accuracy"]), "Whether scores mean what they say:", reliability_table(together)]
        print("\n\n".join(text), flush=True)
    if "speed" in args.parts:
        where = f"{args.threads} threads" if device == "cpu" else torch.cuda.get_device_name()
        text += [f"Seconds a pair with {TIMED_KEYPOINTS} keypoints on either side ({where}):"]
        text += [speed_table(network, full_pair(sets), device)]
    write_text(args.out / "lightglue.json", json.dumps(facts, indent=1) + "\n")
    whole = "\n\n".join(text) + "\n"
    write_text(args.out / "lightglue.md", whole)
    if args.readme:
        asked = f"--data DIR --unseen {args.unseen} --groups {args.groups} --blocks {args.blocks} --seed {args.seed}"
        write_readme(f"    scripts/bench_lightglue {asked} --out DIR\n\n{whole}", "bench_lightglue")


if __name__ == "__main__":
    main()
