"""Thinned real blocks: images in the block's own model beside those that pycolmap's mappers register, from its own SIFT
and from the strongest published chain."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.data import AdjustedBlock
from aeromatch_cli.evaluate.mapping import Mapper, map_database
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.formats.adjusted import read_adjusted
from aeromatch_cli.formats.tables import read_images
from aeromatch_cli.geometry.components import component_labels
from aeromatch_cli.workspace import Workspace
from benchmarks.auto.colmap import matched_by_colmap
from benchmarks.auto.lightglue import CHAIN, matched_by_lightglue
from benchmarks.orientation.cases import worsened
from benchmarks.orientation.figures import attitudes_of, most_alike
from benchmarks.peers.table import missing_weights
from benchmarks.sources import OUR_CODE, PEER_CODE, code_digest, library_versions
from benchmarks.tables import Row, interval, markdown, number, plain, ranged, ratio, ratio_of_sums
from benchmarks.whole import budget_settings, chosen_images, whole_run

# What is given -> case of the benchmark of orientation.
GIVEN = {"positions": "noise", "nothing": "nothing"}
_OWN_CODE = ("benchmarks/auto/real.py", "evaluate/mapping.py")
_CHAINS = ("benchmarks/auto/lightglue.py", "benchmarks/auto/colmap.py", "benchmarks/peers/table.py")
COLMAP = "pycolmap"
MAPPERS: tuple[Mapper, ...] = ("incremental", "global")
# Of attitudes after one common turn.
CORRECT_DEG = 3.0
_FIGURES = ("registered", "attitudes correct", "points", "error px", "s")
HEADS = (
    "block", "given", "preset", "images", *_FIGURES, "from its export",
    *(f"{chain}: {figure}" for chain in (COLMAP, CHAIN) for figure in _FIGURES),
)  # fmt: skip


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    """A row for every block, thinning, what is given, and preset."""
    for block, every in product(args.blocks, args.thin):
        reference = args.data / block / "reference"
        images = chosen_images(args.data / block / "images", every, args.out / "images" / f"{block}-{every}")
        folder = args.out / "real" / f"{block}-{every}"
        folder.mkdir(parents=True, exist_ok=True)
        peers = {}
        for name in asked_peers(args.reference_weights):
            make = partial(_by_peer, args, name, images, reference, folder)
            peers[name] = _kept(args, folder / f"{name}.json", (*PEER_CODE, *_CHAINS), make)
        for given, preset in product(args.given, args.presets):
            own = _kept(
                args, folder / f"{preset}-{given}.json", OUR_CODE,
                lambda: _by_preset(args, images, reference, folder, preset, GIVEN[given]),  # noqa: B023
            )  # fmt: skip
            count = len(list(images.iterdir()))
            head = {"block": block, "every": every, "given": given, "preset": preset, "images": count}
            yield {**head, **own, **peers}


def _kept(args: argparse.Namespace, path: Path, code: Sequence[str], make: Any) -> Row:
    """What a file has of the same options and code, else what `make` returns."""
    asked = {"keypoints": args.keypoints, "max_size": args.max_size, "jobs": args.jobs}
    asked |= {"code": code_digest(*code, *_OWN_CODE)}
    asked |= {"libraries": library_versions()}
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
    row: Row = {"registered": 0, "correct": 0, "seconds": run.seconds, "code": run.code}
    if run.answer:
        held, figures = largest_group(Workspace(work))
        row |= figures
        attitudes = attitudes_of(work / "orientation" / "orientation.csv")
        row["correct"] = _correct({name: attitudes[name] for name in held}, reference)
        database = work / "export" / "colmap" / "database.db"
        row |= {f"by_{m}": map_database(database, images, m).get("registered", 0) for m in MAPPERS}
    shutil.rmtree(work, ignore_errors=True)
    return row


def largest_group(workspace: Workspace) -> tuple[list[str], Row]:
    """Names of the most images that points of the exported model tie together, and figures of these and their points:
    what a mapper says of one model. Images that see no point are not counted there either."""
    path = workspace.final_or_adjusted
    block = read_adjusted(path) if path.is_file() else AdjustedBlock.empty()
    ids, tracks = list(block.tracks), list(block.tracks.values())
    if not block.observations:
        return [], {"registered": 0}
    images = np.repeat(np.arange(len(ids)), [len(track) for track in tracks])
    points = np.concatenate([track[:, 1] for track in tracks])
    part_of = component_labels(len(ids) + len(block.points_m), np.column_stack([images, len(ids) + points]))
    sizes = np.bincount(part_of[np.unique(images)])
    own = part_of == sizes.argmax()
    errors_px = block.errors_px[own[len(ids) :]]
    name_of = {image.image_id: image.name for image in read_images(workspace.images)}
    return [name_of[image] for image, in_group in zip(ids, own, strict=False) if in_group], {
        "registered": int(sizes.max()),
        "points": len(errors_px),
        "track_length": plain(own[images].sum() / len(errors_px)),
        "reprojection_error_px": plain(float(errors_px.mean())),
    }


def asked_peers(weights: Path | None) -> list[str]:
    """Chains beside which presets stand: the published one where its weights are found."""
    return [COLMAP] if missing_weights(CHAIN, weights) else [COLMAP, CHAIN]


def _by_peer(args: argparse.Namespace, name: str, images: Path, reference: Path, folder: Path) -> Row:
    """Both mappers on a peer's own matches; the published chain has as many descriptors as both steps of `auto`."""
    database = folder / "database.db"
    most = {"max_size_px": args.max_size, "jobs": args.jobs}
    if name == COLMAP:
        seconds = matched_by_colmap(images, database, keypoints=args.keypoints, **most)
    else:
        weights = args.reference_weights
        seconds = matched_by_lightglue(images, database, keypoints=2 * args.keypoints, weights=weights, **most)
    row: Row = {}
    for mapper in MAPPERS:
        found = map_database(database, images, mapper, attitudes=True)
        own = {name: np.array(rotation) for name, rotation in found.pop("attitudes", {}).items()}
        row[mapper] = {**found, "correct": _correct(own, reference), "seconds": seconds + found.get("seconds", 0.0)}
    database.unlink()
    return row


def _correct(found: Mapping[str, Any], reference: Path) -> int:
    """Images whose attitudes agree with the reference's after one common turn."""
    return most_alike(found, attitudes_of(reference / "poses.csv"), CORRECT_DEG)


def best_mapper(peer: Row) -> Row:
    """Of a peer's chain the mapper that registers most images."""
    found: Row = max((peer[mapper] for mapper in MAPPERS), key=lambda row: (row.get("registered", 0), row["correct"]))
    return found


def table_of(rows: Sequence[Row]) -> str:
    """A line for every case, and the sums."""
    lines: list[list[object]] = []
    most: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        best = best_mapper(row[COLMAP])
        export = " / ".join(str(row.get(f"by_{mapper}", 0)) for mapper in MAPPERS)
        head = [_thinned(row), row["given"], f"`{row['preset']}`", row["images"], row["registered"]]
        lines.append([*head, *_figures(row), export, *_of_chain(row, COLMAP), *_of_chain(row, CHAIN)])
        others = [best.get("registered", 0)] + [row.get(f"by_{m}", 0) for m in MAPPERS]
        most.setdefault(_thinned(row), []).append((row["registered"], max(others)))
    fewer = sum(own < other for cases in most.values() for own, other in cases)
    parts = [
        f"{_points_beside(rows, COLMAP)}. Images in the preset's model over the most that any mapper registers from "
        f"its export or from pycolmap's chain: {_beside(most)}; fewer in {fewer} of {len(rows)} cases.",
        *([_beside_published(rows)] if any(CHAIN in row for row in rows) else []),
        markdown(HEADS, lines),
    ]
    return "\n\n".join(parts)


def _thinned(row: Row) -> str:
    return str(row["block"]) if row["every"] == 1 else f"{row['block']} / {row['every']}"


def _figures(row: Row) -> list[object]:
    """All columns of a model after its registered images."""
    error = number(row.get("reprojection_error_px") or np.nan, 2)
    return [row["correct"], row.get("points") or 0, error, number(row["seconds"])]


def _of_chain(row: Row, chain: str) -> list[object]:
    """Columns of another chain, empty where it was not run."""
    if chain not in row:
        return [""] * len(_FIGURES)
    registered = " / ".join(str(row[chain][mapper].get("registered", 0)) for mapper in MAPPERS)
    return [registered, *_figures(best_mapper(row[chain]))]


def _points_beside(rows: Sequence[Row], peer: str) -> str:
    points: dict[str, list[tuple[float, float]]] = {}
    alike: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        best = best_mapper(row[peer])
        both = (row.get("points") or 0, best.get("points", 0))
        points.setdefault(_thinned(row), []).append(both)
        if best.get("registered", 0) == row["registered"]:
            alike.setdefault(_thinned(row), []).append(both)
    return (
        f"Points over those of {peer}, all cases: {_beside(points)}; where it registers as many images by itself: "
        f"{_beside(alike)}"
    )


def _beside_published(rows: Sequence[Row]) -> str:
    cases = [(row, best_mapper(row[CHAIN])) for row in rows if CHAIN in row]
    images = sum(row["registered"] < best.get("registered", 0) for row, best in cases)
    points = sum((row.get("points") or 0) < best.get("points", 0) for row, best in cases)
    return (
        f"{_points_beside([row for row, _ in cases], CHAIN)}. Fewer images than it in {images}, fewer points in "
        f"{points} of {len(cases)} cases."
    )


def _beside(cases: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Ratio of sums, with its interval over thinned blocks: what is given to the same images makes no further case."""
    sums = np.array([np.sum(own, axis=0) for own in cases.values()]).reshape(-1, 2)
    return ranged(ratio(*sums.sum(axis=0)), interval(sums, ratio_of_sums), 2)
