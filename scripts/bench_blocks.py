"""Real blocks: this project's baseline beside pycolmap's own SIFT, same images, pairs, budget and thresholds.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}. For each block and thinning (every k-th
image by name) both sides run in a process of their own on the same exhaustive pair list: extraction, matching and
verification are timed, start-up, pair selection, export and report are not. Verified matches are counted within 3 px
(symmetric epipolar distance on undistorted pixels) of the reference poses, each pair of places once (COLMAP counts a
place with two orientations twice); images registered by pycolmap's incremental mapping are counted from both databases.

The budget is exact on both sides, in COLMAP's sense of a keypoint (a place with two orientations counts twice).
pycolmap's max_num_features is not: it keeps whole scale levels, up to 45 % more. Peer `pycolmap` is therefore cut to
the budget after extraction, untimed, largest scales first as its own rule would; peer `pycolmap-uncut` is not.
Writes OUT/results.json and OUT/table.md; with --readme SECTION also that table of the README.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sqlite3
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from common import write_readme

from aeromatch_cli.blocks.read import read_block_inputs
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, symmetric_distance_px

WITHIN_PX = 3.0
RATIO, THRESHOLD_PX, MIN_INLIERS = 0.8, 4.0, 15
MAX_IMAGE_ID = 2147483647  # COLMAP's pair_id = id1 * MAX_IMAGE_ID + id2
PEERS = ("aeromatch", "pycolmap", "pycolmap-uncut")


def run_aeromatch(args: argparse.Namespace) -> dict[str, Any]:
    """Extract, match and filter; then export, untimed."""
    from aeromatch_cli.config import load
    from aeromatch_cli.executor import Executor
    from aeromatch_cli.stages import export, extract, filter, match, pairs  # noqa: A004

    overrides = [
        "pairs=exhaustive",
        f"extract.keypoints={args.keypoints}",
        f"match.ratio={RATIO}",
        f"filter.poselib.threshold_px={THRESHOLD_PX}",
        f"filter.poselib.min_inliers={MIN_INLIERS}",
        *args.set,
    ]
    block = {"images": str(args.images), "poses": str(args.reference / "poses.csv")}
    block["cameras"] = str(args.reference / "block.json")
    settings = load(args.preset, overrides, block, workspace=str(args.work / "workspace"), run={"jobs": args.jobs})
    with Executor("processes", args.jobs) as executor:
        context, _ = pairs.prepare(settings, executor)
        started = time.perf_counter()
        reports = [stage.run(context) for stage in (extract, match, filter)]
        seconds = time.perf_counter() - started
        export.run(context)
    shutil.copy(context.workspace.export("colmap") / "database.db", args.work / "database.db")
    return {"seconds": seconds, "stages": {report.stage: report.seconds for report in reports}}


def run_pycolmap(args: argparse.Namespace) -> dict[str, Any]:
    """COLMAP's SIFT, exhaustive matching and verification on the CPU, with the reference camera."""
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 2
    camera = next(iter(json.loads((args.reference / "block.json").read_text())["cameras"].values()))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera["model"]
    reader.camera_params = ",".join(repr(float(p)) for p in camera["params"])
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, args.jobs, 100000
    extraction.sift.max_num_features = args.keypoints
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, args.jobs
    matching.sift.max_ratio, matching.sift.cross_check = RATIO, True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.max_error, verification.min_num_inliers = THRESHOLD_PX, MIN_INLIERS
    verification.ransac.random_seed = 0
    database = args.work / "database.db"
    started = time.perf_counter()
    pycolmap.extract_features(
        database,
        args.images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    stages = {"extract": time.perf_counter() - started}
    if args.step == "pycolmap":
        cut_to_budget(database, args.keypoints)
    started = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    stages["match+verify"] = time.perf_counter() - started
    return {"seconds": sum(stages.values()), "stages": stages}


def cut_to_budget(database: Path, budget: int) -> None:
    """Keep the keypoints of the largest scale of every image."""
    with sqlite3.connect(database) as connection:
        for image_id, rows, columns, data in connection.execute("SELECT * FROM keypoints").fetchall():
            if rows <= budget:
                continue
            keypoints = np.frombuffer(data, np.float32).reshape(rows, columns)
            areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
            kept = np.sort(np.argsort(-areas, kind="stable")[:budget])
            query = "SELECT cols, data FROM descriptors WHERE image_id = ?"
            width, descriptors = connection.execute(query, (image_id,)).fetchone()
            described = np.frombuffer(descriptors, np.uint8).reshape(rows, -1)[kept]
            for name, values, cols in (("keypoints", keypoints[kept], columns), ("descriptors", described, width)):
                connection.execute(
                    f"UPDATE {name} SET rows = ?, cols = ?, data = ? WHERE image_id = ?",
                    (budget, cols, np.ascontiguousarray(values).tobytes(), image_id),
                )


def map_database(args: argparse.Namespace) -> dict[str, Any]:
    """Images in the largest model of pycolmap's incremental mapping, its points, track length and error."""
    zlib.compress(b"")
    import pycolmap

    pycolmap.logging.minloglevel = 2
    out = args.work / "sparse"
    out.mkdir(exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, args.jobs
    models = pycolmap.incremental_mapping(args.work / "database.db", args.images, out, options=options)
    if not models:
        return {"registered": 0, "models": 0}
    best = max(models.values(), key=lambda model: model.num_reg_images())
    return {
        "registered": best.num_reg_images(),
        "models": len(models),
        "points": best.num_points3D(),
        "track_length": best.compute_mean_track_length(),
        "reprojection_error_px": best.compute_mean_reprojection_error(),
    }


def count_within(database: Path, images: Path, reference: Path) -> dict[str, Any]:
    """Verified matches of a COLMAP database, and those within 3 px of the reference epipolar lines."""
    inputs = read_block_inputs(
        images,
        str(reference / "poses.csv"),
        str(reference / "block.json"),
        sigma_position_m=1.0,
        sigma_angle_deg=1.0,
    )
    by_name = {image.name: image for image in inputs.images}
    with sqlite3.connect(database) as connection:
        ids = dict(connection.execute("SELECT image_id, name FROM images"))
        points = {}
        for image_id, rows, columns, data in connection.execute("SELECT image_id, rows, cols, data FROM keypoints"):
            image = by_name[ids[image_id]]
            stored = np.frombuffer(data or b"", np.float32).reshape(rows, columns)[:, :2].astype(float) - 0.5
            points[image_id] = undistort(inputs.cameras[image.camera_id], stored)
        query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows >= ?"
        pairs, matches, unique, within = 0, 0, 0, 0
        for pair_id, rows, data in connection.execute(query, (MIN_INLIERS,)):
            id0, id1 = divmod(pair_id, MAX_IMAGE_ID)
            idx = np.frombuffer(data, np.uint32).reshape(rows, 2)
            image0, image1 = by_name[ids[id0]], by_name[ids[id1]]
            matrix = fundamental_from_poses(
                inputs.cameras[image0.camera_id],
                inputs.poses[image0.image_id],
                inputs.cameras[image1.camera_id],
                inputs.poses[image1.image_id],
            )
            places = np.unique(np.hstack([points[id0][idx[:, 0]], points[id1][idx[:, 1]]]), axis=0)
            errors = symmetric_distance_px(matrix, places[:, :2], places[:, 2:])
            pairs, matches, unique = pairs + 1, matches + rows, unique + len(places)
            within += int((errors <= WITHIN_PX).sum())
    counts = [len(p) for p in points.values()]
    sizes = {"keypoints_mean": float(np.mean(counts)), "keypoints_max": max(counts)}
    return {"pairs": pairs, "matches": matches, "unique_matches": unique, "within_3px": within, **sizes}


def thin(images: Path, every: int, folder: Path) -> Path:
    """Folder of links to every k-th image by name."""
    folder.mkdir(parents=True)
    for path in sorted(images.iterdir())[::every]:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def measure(args: argparse.Namespace, block: str, every: int, peer: str) -> dict[str, Any]:
    """One row of the results: each step in a fresh process."""
    root = args.data / block
    work = (args.out / f"{block}-{every}-{peer}").resolve()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    images = thin(root / "images", every, work / "images")
    row: dict[str, Any] = {"block": block, "every": every, "peer": peer, "images": len(list(images.iterdir()))}
    common = ["--images", images, "--reference", root / "reference", "--work", work]
    row |= child(args, peer, common)
    row["cores"] = args.jobs
    row |= count_within(work / "database.db", images, root / "reference")
    if not args.no_mapping:
        row |= child(args, "map", common)
    return row


def child(args: argparse.Namespace, step: str, paths: list[Any]) -> dict[str, Any]:
    command = [sys.executable, __file__, "--step", step, "--jobs", str(args.jobs), "--keypoints", str(args.keypoints)]
    command += ["--preset", args.preset, *(f"--set={text}" for text in args.set), *map(str, paths)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"step {step} failed with exit code {done.returncode}:\n{done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line per block, thinning and peer."""
    lines = [
        "| block | every | peer | keypoints | seconds | pairs | matches | unique | within 3 px | registered |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        registered = f"{row['registered']} of {row['images']}" if "registered" in row else "-"
        cells = [row["block"], row["every"], row["peer"], f"{row['keypoints_mean']:.0f}", f"{row['seconds']:.1f}"]
        cells += [row["pairs"], row["matches"], row["unique_matches"], row["within_3px"], registered]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of blocks")
    parser.add_argument("--blocks", default="sheffield,ochota", help="names, comma-separated")
    parser.add_argument("--thin", default="1", help="keep every k-th image; several k comma-separated")
    parser.add_argument("--keypoints", type=int, default=4000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--preset", default="baseline")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--peers", default=",".join(PEERS))
    parser.add_argument("--no-mapping", action="store_true", help="leave out pycolmap's mapping")
    parser.add_argument("--readme", metavar="SECTION", help="write the table into the README: blocks, thinned")
    parser.add_argument("--out", type=Path, default=Path("bench/blocks"))
    for name in ("--step", "--images", "--reference", "--work"):
        parser.add_argument(name, type=str if name == "--step" else Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step:
        steps = {"aeromatch": run_aeromatch, "map": map_database}
        print(json.dumps(steps.get(args.step, run_pycolmap)(args)))
        return
    if args.data is None:
        parser.error("--data is needed: the folder that holds BLOCK/images and BLOCK/reference")
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for block in args.blocks.split(","):
        for every in (int(k) for k in args.thin.split(",")):
            for peer in args.peers.split(","):
                rows.append(measure(args, block, every, peer))
                print(json.dumps(rows[-1]), flush=True)
                (args.out / "results.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    (args.out / "table.md").write_text(table(rows), encoding="utf-8")
    print(table(rows))
    if args.readme:
        command = f"scripts/bench_blocks --data DIR --blocks {args.blocks} --peers {args.peers} --thin {args.thin}"
        write_readme(f"    {command}\n\n{table(rows)}", f"bench_{args.readme}")


if __name__ == "__main__":
    main()
