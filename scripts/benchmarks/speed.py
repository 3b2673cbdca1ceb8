"""Seconds and memory of whole runs: `baseline`, `auto` and pycolmap on rendered blocks, an easy and a hard one.

A block is rendered once, at the smallest size, and enlarged to the others; neither is timed. easy: a suburb, nadir
strips, one sun; hard: a city, two flights at two heights across each other under two suns. All are given the camera;
aeromatch is given positions of 5 m (`poses_gps.csv`) and no attitudes, so that it has to find the block.

pycolmap is its SIFT on the CPU with as many keypoints and its own largest size of 3,200 pixels, its exhaustive
matching with verification, and its global mapping. Its spatial matching takes 50 neighbours: for blocks up to 51
images this is exhaustive matching.

Wall: seconds of the command, start-up and report included. Processor: seconds of all processes together, which other
work on the machine hardly changes; ratios are theirs. Peak: the largest sum of the memory of all processes. Shares
are those of wall seconds: pycolmap's matching includes verification, its adjustment is the mapping; the rest is start,
pairs, consistency, export and report.

Every run is made --repeats times; figures are medians, ranges in brackets lie between the least and the most.

--before CHECKOUT runs another checkout of this project beside, for instance one that `git worktree add CHECKOUT COMMIT`
makes; its rows are named PRESET@COMMIT.

Writes OUT/speed.json and OUT/speed.md. Rows that OUT has are not made again.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.files import write_json
from aeromatch_cli.geometry.cameras import corner_params, from_colmap, resized
from benchmarks import options, stamps
from benchmarks.processes import children_seconds, run_watched
from benchmarks.scenes import render_once
from benchmarks.stamps import REPOSITORY
from benchmarks.tables import (
    Row,
    code,
    extremes,
    grouped,
    markdown,
    median,
    number,
    percent,
    ranged,
    ratio,
    total,
    values,
    write_rows,
)

SCENES = {"easy": ("suburb", "nadir"), "hard": ("city", "two-flights")}
PEER = "pycolmap"
CHAINS = ("baseline", "auto", PEER)
# What the table shows of a chain by itself; extraction, matching and verification of all steps of a cascade together.
STAGES = ("orient", "extract", "match", "filter", "refine", "adjust")
_PEER_STAGES = ("extract", "match", "adjust")
_POSES = "poses_gps.csv"


def size_of(megapixels: int) -> tuple[int, int]:
    """Width and height, pixels, of 4 : 3 pictures."""
    height = round((megapixels * 1e6 * 0.75) ** 0.5)
    return round(height / 0.75), height


def block_of(args: argparse.Namespace, scene: str, megapixels: int, images: int) -> Path:
    """Folder with images, block.json and poses of a block; made unless it is there."""
    width, height = size_of(min(args.megapixels))
    preset, flight = SCENES[scene]
    size = {"width_px": width, "height_px": height, "images": images}
    rendered = render_once(args.out / "scenes", preset, jobs=args.jobs, seed=args.seed, flight=flight, **size)
    if megapixels == min(args.megapixels):
        return rendered
    return enlarged(rendered, args.out / "enlarged" / f"{rendered.name}-{megapixels}", size_of(megapixels))


def enlarged(rendered: Path, out: Path, size: tuple[int, int]) -> Path:
    """The same block with pictures and cameras of another size."""
    if (out / "block.json").is_file():
        return out
    import cv2

    (out / "images").mkdir(parents=True, exist_ok=True)
    for path in sorted((rendered / "images").iterdir()):
        large = cv2.resize(cv2.imread(str(path)), size, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "images" / path.name), large, [cv2.IMWRITE_JPEG_QUALITY, 95])
    shutil.copy(rendered / _POSES, out / _POSES)
    facts = _json(rendered / "block.json")
    for lens in facts["cameras"].values():
        camera = from_colmap(lens["model"], lens["width"], lens["height"], tuple(lens["params"]))
        other = resized(camera, size[0] / camera.width_px, *size)
        lens.update(width=other.width_px, height=other.height_px, params=list(corner_params(other)))
    write_json(out / "block.json", facts)  # last: it says that the rest is there
    return out


def our_chain(args: argparse.Namespace, block: Path, preset: str, folder: Path) -> Row:
    """One whole run, of a preset or of `preset@commit`."""
    preset, _, commit = preset.partition("@")
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    # Modules are looked for in the folder of the run first, then in PYTHONPATH, then in the environment.
    where = ["env", "-C", str(args.before), f"PYTHONPATH={args.before}"] if commit else []
    command = [*where, sys.executable, "-m", "aeromatch_cli.cli", "run", preset, "--quiet", "--json"]
    command += ["--images", str(block / "images"), "--poses", str(block / _POSES), "--workspace", str(work)]
    command += ["--cameras", str(block / "block.json"), "--crs", "local", "--jobs", str(args.jobs)]
    command += ["--set", f"extract.keypoints={args.keypoints}"]
    row, answer = timed(command, folder / "said.log")
    best = max((group["images"] for group in answer["stages"]["adjust"]["result"]["groups"]), default=0)
    if not args.keep:
        shutil.rmtree(work)
    return row | {"oriented": best, "stages": {stage: answer["stages"][stage]["seconds"] for stage in STAGES}}


def peer_chain(args: argparse.Namespace, block: Path, folder: Path) -> Row:
    """The same by pycolmap, in a process of its own."""
    given = str(block), str(folder), args.keypoints, args.jobs
    words = f"import sys; sys.path[:0] = [{str(REPOSITORY / 'scripts')!r}, {str(REPOSITORY)!r}]; "
    words += f"from benchmarks import speed; speed.run_peer{given!r}"
    row, answer = timed([sys.executable, "-c", words], folder / "said.log")
    return row | answer


def timed(command: Sequence[str], log: Path) -> tuple[Row, dict[str, Any]]:
    """Figures of a command, and the JSON object that it prints as its last line. SystemExit where it fails."""
    log.parent.mkdir(parents=True, exist_ok=True)
    used_s = children_seconds()
    exit_code, seconds, peak = run_watched(command, log)
    answers = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line[:1] == "{"]
    if exit_code not in (0, 1) or not answers:
        raise SystemExit(f"{' '.join(command[:5])} ended with exit code {exit_code}: see {log}")
    row = {"seconds": seconds, "processor_seconds": children_seconds() - used_s, "peak_mb": peak}
    return row, json.loads(answers[-1])


def run_peer(block: str, folder: str, keypoints: int, jobs: int) -> None:
    """Extraction, matching and mapping by pycolmap; prints images oriented and seconds of stages as a JSON object."""
    from benchmarks.peers.colmap import colmap_options, imported_pycolmap

    pycolmap = imported_pycolmap()
    images, database, models = Path(block) / "images", Path(folder) / "database.db", Path(folder) / "models"
    database.unlink(missing_ok=True)
    models.mkdir(exist_ok=True)
    (lens,) = _json(Path(block) / "block.json")["cameras"].values()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = lens["model"], ",".join(map(repr, map(float, lens["params"])))
    extraction, matching, verification = colmap_options(keypoints, jobs)
    extraction.max_image_size = -1  # its own default
    marks = [time.perf_counter()]
    single = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, images, camera_mode=single, reader_options=reader, extraction_options=extraction
    )
    marks.append(time.perf_counter())
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    marks.append(time.perf_counter())
    mapping = pycolmap.GlobalPipelineOptions()
    mapping.num_threads = jobs
    found = pycolmap.global_mapping(database, images, models, mapping)
    marks.append(time.perf_counter())
    parts = {name: after - before for name, (before, after) in zip(_PEER_STAGES, pairwise(marks), strict=True)}
    oriented = max((model.num_reg_images() for model in found.values()), default=0)
    print(json.dumps({"oriented": oriented, "stages": parts}), flush=True)


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def rows_of(args: argparse.Namespace, known: Sequence[Row]) -> Iterator[Row]:
    """A row per scene, size and chain; those that are known are not made again."""
    counts = args.images * len(args.megapixels) if len(args.images) == 1 else args.images
    for scene in args.scenes:
        for megapixels, images in zip(args.megapixels, counts, strict=True):
            for chain, repeat in product(args.chains, range(args.repeats)):
                head = {"scene": scene, "megapixels": megapixels, "images": images, "chain": chain, "repeat": repeat}
                head |= {"keypoints": args.keypoints, "jobs": args.jobs, "seed": args.seed}
                found = next((row for row in known if head.items() <= row.items()), None)
                if found is None:
                    block = block_of(args, scene, megapixels, images)
                    folder = args.out / f"{scene}-{megapixels}-{chain}"
                    made = peer_chain(args, block, folder) if chain == PEER else our_chain(args, block, chain, folder)
                    found = head | made
                yield found


def table_of(rows: Sequence[Row]) -> str:
    """A line per block and chain; ratios of processor seconds to `baseline` and to pycolmap on the same block."""
    heads = ("scene", "megapixels", "chain", "oriented", "wall, s", "processor, s", "x `baseline`", "x pycolmap")
    used = {key: values(own, "processor_seconds") for key, own in grouped(rows, "scene", "megapixels", "chain")}
    lines = []
    for (scene, megapixels, chain), own in grouped(rows, "scene", "megapixels", "chain"):
        ours = used[scene, megapixels, chain]
        beside = [_times(ours, used.get((scene, megapixels, other), [])) for other in ("baseline", PEER)]
        shares = [
            ratio(math.fsum(row["stages"].get(stage, 0.0) for row in own), total(own, "seconds")) for stage in STAGES
        ]
        cells = [percent(share) if share else "-" for share in [*shares, 1.0 - sum(shares)]]
        oriented = f"{min(row['oriented'] for row in own)} of {own[0]['images']}"
        lines.append(
            (scene, megapixels, code(chain), oriented, number(median(own, "seconds")),
             ranged(float(np.median(ours)), extremes(ours), 0), *beside,
             number(median(own, "peak_mb")), *cells)
        )  # fmt: skip
    return markdown((*heads, "peak, MB", *STAGES, "rest"), lines)


def _times(ours: Sequence[float], theirs: Sequence[float]) -> str:
    """Ratio of medians; its range is that of any of ours to any of theirs."""
    ratios = [a / b for a, b in product(ours, theirs)]
    if not ratios or ours is theirs:
        return "-"
    return ranged(float(np.median(ours) / np.median(theirs)), extremes(ratios), 2, " x")


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("speed", __doc__)
    add = parser.add_argument
    add("--images", type=options.numbers, default="10,5", help="of each block: one number, or one for each size")
    add("--megapixels", type=options.numbers, default="3,12", help="comma-separated")
    add("--scenes", type=options.names, default=",".join(SCENES), help="comma-separated")
    add("--chains", type=options.names, default=",".join(CHAINS), help="presets and pycolmap, comma-separated")
    add("--keypoints", type=options.positive, default=8000, help="SIFT keypoints per image, of all chains")
    add("--repeats", type=options.positive, default=2, help="runs of each chain")
    add("--before", type=Path, metavar="CHECKOUT", help="of another state of this project, to be run beside")
    add("--keep", action="store_true", help="leave the workspaces in OUT")
    add("--seed", type=int, default=64, help="another seed gives other blocks")
    add("--jobs", type=options.positive, default=2, help="processes at a time")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"images": "6", "megapixels": "1", "keypoints": 2000, "repeats": 1})
    if len(args.images) not in (1, len(args.megapixels)):
        parser.error("--images: give one number, or one for each of --megapixels")
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.before is not None:
        args.before = args.before.resolve()
        if not (args.before / "aeromatch_cli" / "__init__.py").is_file():
            parser.error(f"--before: {args.before} is no checkout of this project")
        others = [f"{chain}@{stamps.commit(args.before)}" for chain in args.chains if chain != PEER]
        args.chains = [*args.chains, *others]
    kept = args.out / "speed.json"
    rows: list[Row] = []
    for row in rows_of(args, _json(kept) if kept.is_file() else []):
        rows.append(row)
        write_rows(kept, rows)
        print(json.dumps(row), file=sys.stderr, flush=True)
    options.publish(
        args, table_of(rows) + "\n", args.out / "speed.md", table="bench_speed_runs",
        command=options.command_line(parser, args), versions=stamps.of_pipeline(),
    )  # fmt: skip
