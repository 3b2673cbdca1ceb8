"""Least-squares registration in dynamic polar coordinates beside SIFT: time, accuracy, and what it says of failures.

known: pairs cut out of large flat grounds by a similarity (any turn, scale 0.8-1.25, overlap from 0.3, gain, offset,
noise): rendered grass, desert and farmland, and mosaics of real blocks. Nothing is told of the poses. SIFT on the same
pictures, and reduced to 1/8. honesty: pairs of different grounds, and of saturated or featureless content. Errors as
in methods: displacement at the overlap's middle in px of picture 1, degrees, relative scale. seconds: decoding
excluded on both sides; seconds_tie_points: lattice and about 1,000 tie points included.

Writes OUT/results.json (a row for every method and pair) and OUT/polar.md. Grounds are kept in OUT/grounds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import write_readme
from polar_bench import own, sift
from polar_bench.grounds import REAL, RENDERED, KnownPair, errors, ground, known_pair

from aeromatch_cli.data import FloatArray
from aeromatch_cli.workspace import write_text

TIE_POINTS = 1000
_GRID = 16  # cells along either side of the overlap that coverage counts
_REDUCED = 0.125
_RIGHT_PX = 3.0


def known_rows(args: argparse.Namespace, size: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """Rows of all methods, pair by pair, of every kind of ground."""
    kinds = args.kinds.split(",")
    # Two pictures side by side in any direction, and room to turn.
    wide = tuple(int(2.0 * size[0]) if axis == 0 else int(2.0 * size[0] * 0.78) for axis in (0, 1))
    for kind in kinds:
        source = ground(kind, wide, args.seed, args.data, args.out / "grounds")
        for number in range(args.pairs // len(kinds) + (kinds.index(kind) < args.pairs % len(kinds))):
            pair = known_pair(source, size, np.random.default_rng([args.seed, kinds.index(kind), number]))
            yield polar_row(kind, number, pair, size)
            if args.sift:
                yield sift_row("sift", kind, number, pair, size, 1.0)
            yield sift_row("sift-1/8", kind, number, pair, size, _REDUCED)


def polar_row(kind: str, number: int, pair: KnownPair, size: tuple[int, int]) -> dict[str, Any]:
    found = own.registered(pair.first, pair.second, TIE_POINTS)
    row = _row("polar", kind, number, found.registration.matrix, pair, size, found.seconds)
    return (
        row
        | _of_points(found.points0_px, found.points1_px, pair, size)
        | {
            "seconds_tie_points": round(found.seconds_tie_points, 4),
            "accepted": found.registration.accepted,
            "reason": found.registration.reason,
        }
    )


def sift_row(
    method: str, kind: str, number: int, pair: KnownPair, size: tuple[int, int], scale: float
) -> dict[str, Any]:
    found = sift.registered(pair.first, pair.second, scale)
    row = _row(method, kind, number, found.matrix, pair, size, found.seconds)
    return (
        row
        | _of_points(found.points0, found.points1, pair, size)
        | {
            "seconds_tie_points": row["seconds"],
            "accepted": found.accepted,
            "reason": "" if found.accepted else f"{found.inliers} matches agree",
        }
    )


def _row(
    method: str, kind: str, number: int, matrix: FloatArray, pair: KnownPair, size: tuple[int, int], seconds: float
) -> dict[str, Any]:
    translation, rotation, scale = errors(matrix, pair.truth, size)
    return {
        "method": method, "kind": kind, "pair": number, "size": f"{size[0]}x{size[1]}", "overlap": pair.overlap,
        "valid": True, "seconds": round(seconds, 4), "translation_error_px": translation,
        "rotation_error_deg": rotation, "scale_error": scale,
    }  # fmt: skip


def _there(points0: FloatArray, truth: FloatArray) -> FloatArray:
    return np.asarray(points0 @ truth[:2, :2].T + truth[:2, 2])


def _of_points(points0: FloatArray, points1: FloatArray, pair: KnownPair, size: tuple[int, int]) -> dict[str, Any]:
    off = np.linalg.norm(_there(points0, pair.truth) - points1, axis=1)
    right = off <= _RIGHT_PX
    return {
        "tie_points": len(off),
        "tie_points_right": int(right.sum()),
        "tie_point_error_px": _median(off),
        "coverage": coverage(points0[right], pair, size),
    }


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None


def coverage(points0: FloatArray, pair: KnownPair, size: tuple[int, int]) -> float:
    """Share of the cells of a 16 x 16 grid over picture 0, of those that picture 1 shows, which hold a right point."""
    cells = np.stack(np.meshgrid(np.arange(_GRID), np.arange(_GRID)), axis=-1).reshape(-1, 2)
    side = np.array(size) / _GRID
    there = _there((cells + 0.5) * side, pair.truth)
    shown = {tuple(cell) for cell in cells[((there >= 0.0) & (there < np.array(size))).all(axis=1)]}
    held = {tuple(cell) for cell in (points0 // side).astype(int)}
    return len(shown & held) / max(len(shown), 1)


def honesty_rows(args: argparse.Namespace, size: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """Pairs of which none can be right: other grounds, saturated and featureless pictures."""
    kinds = args.kinds.split(",")
    wide = (int(2.0 * size[0]), int(2.0 * size[0] * 0.78))
    grounds = {kind: ground(kind, wide, args.seed, args.data, args.out / "grounds") for kind in kinds}
    for number in range(args.negatives):
        rng = np.random.default_rng([args.seed, 77, number])
        names = rng.choice(kinds, 2, replace=False)
        first, second = (known_pair(grounds[str(name)], size, rng).first for name in names)
        what = ("other ground", "other ground", "saturated", "featureless")[number % 4]
        if what == "saturated":
            first, second = (np.where(picture > 40, 255, picture).astype(np.uint8) for picture in (first, second))
        elif what == "featureless":
            second = np.clip(128 + 2.0 * rng.standard_normal(second.shape), 0, 255).astype(np.uint8)
        found = own.registered(first, second, 0)
        yield {
            "method": "polar", "kind": what, "pair": number, "size": f"{size[0]}x{size[1]}", "valid": False,
            "accepted": found.registration.accepted, "reason": found.registration.reason,
            "seconds": round(found.seconds, 4),
        }  # fmt: skip


def known_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| ground | method | pairs | accepted | accepted wrong (> 3 px) | displacement px, median / 95 % "
        "| turn degrees | scale | seconds | with tie points | tie points | right | error px | coverage |",
        "|" + "---|" * 14,
    ]
    for size in dict.fromkeys(row["size"] for row in rows):
        for kind in dict.fromkeys(row["kind"] for row in rows):
            for method in dict.fromkeys(row["method"] for row in rows):
                some = [r for r in rows if (r["size"], r["kind"], r["method"]) == (size, kind, method)]
                if some:
                    lines.append(_known_line(f"{kind} {size}", method, some))
    return "\n".join(lines)


def _known_line(kind: str, method: str, rows: Sequence[dict[str, Any]]) -> str:
    good = [row for row in rows if row["accepted"]]

    def spread(name: str, digits: str) -> str:
        values = [row[name] for row in good]
        return f"{np.median(values):{digits}} / {np.percentile(values, 95):{digits}}" if values else "-"

    wrong = sum(row["translation_error_px"] > _RIGHT_PX for row in good)
    points = [row["tie_point_error_px"] for row in good if row["tie_point_error_px"] is not None]
    cells = [
        kind, method, len(rows), len(good), wrong, spread("translation_error_px", ".3f"),
        spread("rotation_error_deg", ".4f"), spread("scale_error", ".1e"),
        f"{np.median([row['seconds'] for row in rows]):.2f}",
        f"{np.median([row['seconds_tie_points'] for row in rows]):.2f}",
        f"{np.median([row['tie_points'] for row in good]):.0f}" if good else "-",
        f"{sum(r['tie_points_right'] for r in good) / max(sum(r['tie_points'] for r in good), 1):.3f}",
        f"{np.median(points):.3f}" if points else "-",
        f"{np.median([row['coverage'] for row in good]):.2f}" if good else "-",
    ]  # fmt: skip
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def honesty_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = ["| content | pairs | accepted | seconds |", "|---|---|---|---|"]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        some = [row for row in rows if row["kind"] == kind]
        accepted = sum(row["accepted"] for row in some)
        lines.append(f"| {kind} | {len(some)} | {accepted} | {np.median([row['seconds'] for row in some]):.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of real blocks, each with a folder images")
    add("--size", default="1840x1350", help="of the pictures, WxH")
    add("--pairs", type=int, default=20, help="known pairs, over all kinds")
    add("--negatives", type=int, default=0, help="pairs of which none can be right")
    add("--kinds", default=",".join((*RENDERED, *REAL)))
    add("--sift", action="store_true", help="also SIFT at full size, which takes minutes a pair of 40 megapixels")
    add("--threads", type=int, default=2)
    add("--seed", type=int, default=1)
    add("--readme", action="store_true")
    add("--out", type=Path, required=True)
    args = parser.parse_args()
    cv2.setNumThreads(args.threads)
    size = tuple(int(part) for part in args.size.split("x"))
    args.out.mkdir(parents=True, exist_ok=True)
    known, honest = [], []
    for rows, made in ((known, known_rows(args, size)), (honest, honesty_rows(args, size))):
        for row in made:
            rows.append(row)
            print(json.dumps(row), flush=True)
    write_text(args.out / "results.json", json.dumps(known + honest, indent=1) + "\n")
    text = "\n\n".join([known_table(known), *([honesty_table(honest)] if honest else [])]) + "\n"
    write_text(args.out / "polar.md", text)
    if args.readme:
        write_readme(text, "bench_polar")


if __name__ == "__main__":
    main()
