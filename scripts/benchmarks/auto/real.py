"""Thinned real blocks: images in the block's own model beside those that pycolmap's mappers register."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.evaluate.mapping import Mapper, map_database
from aeromatch_cli.files import read_json, write_json
from benchmarks.auto.colmap import matched_by_colmap
from benchmarks.orientation.cases import worsened
from benchmarks.orientation.figures import attitudes_of, most_alike
from benchmarks.sources import OUR_CODE, PEER_CODE, code_digest
from benchmarks.tables import Row, interval, markdown, number, ranged, ratio, ratio_of_sums
from benchmarks.whole import budget_settings, chosen_images, whole_run

# What is given -> case of the benchmark of orientation.
GIVEN = {"positions": "noise", "nothing": "nothing"}
MAPPERS: tuple[Mapper, ...] = ("incremental", "global")
# Of attitudes after one common turn.
RIGHT_DEG = 3.0
HEADS = (
    "block", "given", "preset", "images", "in our model", "right", "from our export", "by pycolmap alone", "right",
    "points", "its points", "error px", "its error px", "s", "its s",
)  # fmt: skip


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    """A row for every block, thinning, what is given, and preset."""
    for block, every in product(args.blocks, args.thin):
        reference = args.data / block / "reference"
        images = chosen_images(args.data / block / "images", every, args.out / "images" / f"{block}-{every}")
        folder = args.out / "real" / f"{block}-{every}"
        folder.mkdir(parents=True, exist_ok=True)
        peer = _kept(args, folder / "pycolmap.json", PEER_CODE, lambda: _by_pycolmap(args, images, reference, folder))  # noqa: B023
        for given, preset in product(args.given, args.presets):
            own = _kept(
                args, folder / f"{preset}-{given}.json", OUR_CODE,
                lambda: _by_preset(args, images, reference, folder, preset, GIVEN[given]),  # noqa: B023
            )  # fmt: skip
            count = len(list(images.iterdir()))
            head = {"block": block, "every": every, "given": given, "preset": preset, "images": count}
            yield {**head, **own, "pycolmap": peer}


def _kept(args: argparse.Namespace, path: Path, code: Sequence[str], make: Any) -> Row:
    """What a file has of the same options and code, else what `make` returns."""
    asked = {"keypoints": args.keypoints, "max_size": args.max_size, "code": code_digest(*code)}
    known = read_json(path) if path.is_file() else {}
    if known.get("asked") != asked:
        known = {"asked": asked, "row": make()}
        write_json(path, known)
    row: Row = known["row"]
    return row


def _by_preset(args: argparse.Namespace, images: Path, reference: Path, folder: Path, method: str, case: str) -> Row:
    """One run of the command, and what both mappers make of its database."""
    preset, own = parse_method(method)
    names = sorted(path.name for path in images.iterdir())
    extra, _ = worsened(case, reference, names, folder)
    work = folder / "work"
    settings = [*budget_settings(load(preset, own), args.keypoints), *own]
    extra = [*extra, "--max-size", str(args.max_size)]
    run = whole_run("run", preset, images, work, extra=extra, jobs=args.jobs, settings=settings)
    row: Row = {"registered": 0, "right": 0, "seconds": run.seconds, "code": run.code}
    if run.answer:
        groups = run.answer["stages"]["adjust"]["result"].get("groups", [])
        best = max(groups, key=lambda group: group["images"], default={"images": 0})
        row["registered"] = best["images"]
        row |= {key: best.get(key) for key in ("track_length", "reprojection_error_px")}
        row["points"] = run.answer["stages"]["consistency"]["result"].get("points_left", best.get("points"))
        row["right"] = _right(attitudes_of(work / "orientation" / "orientation.csv"), reference)
        database = work / "export" / "colmap" / "database.db"
        row |= {f"by_{m}": map_database(database, images, m).get("registered", 0) for m in MAPPERS}
    shutil.rmtree(work, ignore_errors=True)
    return row


def _by_pycolmap(args: argparse.Namespace, images: Path, reference: Path, folder: Path) -> Row:
    """Both mappers on pycolmap's own matches."""
    database = folder / "database.db"
    seconds = matched_by_colmap(images, database, keypoints=args.keypoints, max_size_px=args.max_size, jobs=args.jobs)
    row: Row = {}
    for mapper in MAPPERS:
        found = map_database(database, images, mapper, attitudes=True)
        own = {name: np.array(rotation) for name, rotation in found.pop("attitudes", {}).items()}
        row[mapper] = {**found, "right": _right(own, reference), "seconds": seconds + found.get("seconds", 0.0)}
    database.unlink()
    return row


def _right(found: Mapping[str, Any], reference: Path) -> int:
    """Images whose attitudes agree with the reference's after one common turn."""
    return most_alike(found, attitudes_of(reference / "poses.csv"), RIGHT_DEG)


def best_mapper(peer: Row) -> Row:
    """Of pycolmap's own chain the mapper that registers most images."""
    found: Row = max((peer[mapper] for mapper in MAPPERS), key=lambda row: (row.get("registered", 0), row["right"]))
    return found


def table_of(rows: Sequence[Row]) -> str:
    """A line for every case, and the sums."""
    lines: list[list[object]] = []
    points, images = [], []
    for row in rows:
        peer = row["pycolmap"]
        best = best_mapper(peer)
        export = " / ".join(str(row.get(f"by_{mapper}", 0)) for mapper in MAPPERS)
        alone = " / ".join(str(peer[mapper].get("registered", 0)) for mapper in MAPPERS)
        block = row["block"] if row["every"] == 1 else f"{row['block']} / {row['every']}"
        errors = [number(one.get("reprojection_error_px") or np.nan, 2) for one in (row, best)]
        lines.append(
            [block, row["given"], f"`{row['preset']}`", row["images"], row["registered"], row["right"], export, alone,
             best["right"], row.get("points") or 0, best.get("points", 0), *errors, number(row["seconds"]),
             number(best["seconds"])]
        )  # fmt: skip
        points.append((row.get("points") or 0, best.get("points", 0)))
        images.append((row["registered"], max([best.get("registered", 0)] + [row.get(f"by_{m}", 0) for m in MAPPERS])))
    fewer = sum(own < most for own, most in images)
    parts = [
        f"Points over pycolmap's, all cases: {_beside(points)}. Images in our model over the most that any mapper "
        f"registers from either: {_beside(images)}; fewer in {fewer} of {len(rows)} cases.",
        markdown(HEADS, lines),
    ]
    return "\n\n".join(parts)


def _beside(cases: Sequence[tuple[float, float]]) -> str:
    """Ratio of sums, with its interval over cases."""
    return ranged(ratio(*np.sum(cases, axis=0)), interval(cases, ratio_of_sums), 2)
