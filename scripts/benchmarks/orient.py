"""Orientation from the pictures: reference poses made worse, what `aeromatch run` finds then, beside the references.

DATA holds blocks as BLOCK/images and BLOCK/reference/{poses.csv,block.json}; SCENE:FLIGHT is rendered, with exact
truth and a camera file. Every case is one run of the preset on every k-th image (--thin):

  reference  the reference poses and camera as they are: what the others are measured against
  noise      positions with 5 m noise in each coordinate, no attitudes, camera from EXIF
  nothing    no poses, camera from EXIF
  third      the attitudes of every third image at random
  yaw        every image turned by 180 degrees about the vertical
  longer     the reference camera's focal length x 2
  shorter    the same x 0.5
  outliers   every tenth position off by 100 m, no attitudes
  columns    omega and phi exchanged
  mirrored   x and y exchanged, no attitudes
  shuffled   every line is that of another image
  ground     a ground height that is wrong by the flying height

Attitude error: median and maximum over the oriented images, after one common turn. Focal: against the reference
camera. Within 3 px: verified matches, by symmetric epipolar distance from the reference poses, and as a share of those
of the case `reference`. Named: images whose attitude was made wrong and is named so, or all where a fault of the whole
list is named, and those named without cause. Said: what the summary says of the fault. Terrain, of rendered blocks:
median distance of the terrain found from the surface that the images show, as a share of the flying height.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.ground import DemGround
from aeromatch_cli.data import FloatArray
from aeromatch_cli.formats.tables import read_cameras, read_images, read_poses
from aeromatch_cli.formats.terrain import read_terrain
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_omega_phi_kappa
from aeromatch_cli.orientation.placing import similarity
from aeromatch_cli.synthetic import load_truth, render_block
from aeromatch_cli.workspace import read_json, write_json
from benchmarks import options, stamps
from benchmarks.blocks.cases import chosen_images
from benchmarks.tables import Row, markdown

CASES = ("reference", "noise", "nothing", "third", "yaw", "longer", "shorter", "outliers", "columns", "mirrored",
         "shuffled", "ground")  # fmt: skip
POSITIONS_ONLY = ("noise", "outliers", "mirrored")
NOISE_M, OUTLIER_M = 5.0, 100.0
RENDERED_PX = 1600, 1200
# Places in every image where the terrain is asked.
_SAMPLES = 60
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")

# Characters of a remark in the table.
_SAID = 80


def worsened(case: str, reference: Path, names: Sequence[str], folder: Path) -> tuple[list[str], set[str]]:
    """Options of the command for one case, and the names of images whose attitude it made wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    with (reference / "poses.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["image"] in set(names)]
    camera = json.loads((reference / "block.json").read_text(encoding="utf-8"))
    ground_z = camera.pop("ground_z", None)  # the terrain is to be found
    rng = np.random.default_rng(len(names))
    wrong = _worsen(case, rows, rng)
    for lens in camera["cameras"].values():
        factor = {"longer": 2.0, "shorter": 0.5}.get(case, 1.0)
        count = 2 if lens["model"] in ("PINHOLE", "OPENCV") else 1
        lens["params"][:count] = [value * factor for value in lens["params"][:count]]
    (folder / "block.json").write_text(json.dumps(camera), encoding="utf-8")
    poses = folder / "poses.csv"
    keep = [key for key in rows[0] if case not in POSITIONS_ONLY or key not in ANGLES]
    with poses.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, keep, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    crs = [] if camera["crs"] == "local" else ["--crs", camera["crs"]]
    if case == "ground":
        below_m = ground_z["p50"] if isinstance(ground_z, dict) else ground_z
        flying_m = float(np.median([float(row["z"]) for row in rows])) - below_m
        crs += ["--ground", repr(below_m - flying_m)]
    exact = (reference / "truth.json").is_file()  # rendered images have no EXIF
    lens = ["--cameras", str(folder / "block.json") if exact or case not in (*POSITIONS_ONLY, "nothing") else "exif"]
    if case == "nothing":
        return ["--poses", "none", *lens], wrong
    return ["--poses", str(poses), *lens, *(crs or ["--crs", "local"])], wrong


def _worsen(case: str, rows: list[dict[str, Any]], rng: np.random.Generator) -> set[str]:
    """Change the rows of a pose list in place; names of images whose attitude is wrong now."""
    wrong = set()
    if case == "shuffled":
        order = rng.permutation(len(rows))
        lines = [{k: v for k, v in rows[n].items() if k != "image"} for n in order]
        for row, line in zip(rows, lines, strict=True):
            row.update(line)
    for number, row in enumerate(rows):
        if case == "mirrored":
            row["x"], row["y"] = row["y"], row["x"]
        if case == "columns":
            row[ANGLES[0]], row[ANGLES[1]] = row[ANGLES[1]], row[ANGLES[0]]
            wrong.add(str(row["image"]))
        off_m = np.zeros(3)
        if case in ("noise", "outliers"):
            off_m = NOISE_M * rng.normal(size=3) if case == "noise" else off_m
        if case == "outliers" and number % 10 == 0:
            turn = rng.uniform(0.0, 2.0 * np.pi)
            off_m = OUTLIER_M * np.array([np.cos(turn), np.sin(turn), 0.0])
        for key, value in zip("xyz", off_m, strict=True):
            row[key] = repr(float(row[key]) + float(value))
        rotation = from_omega_phi_kappa(*(float(row[key]) for key in ANGLES))
        if case == "third" and number % 3 == 0:
            rotation = _random_rotation(rng)
        if case == "yaw":
            rotation = rotation @ np.diag([-1.0, -1.0, 1.0])
        if case == "yaw" or (case == "third" and number % 3 == 0):
            wrong.add(str(row["image"]))
        for key, angle in zip(ANGLES, to_omega_phi_kappa(rotation), strict=True):
            row[key] = repr(float(angle))
    return wrong


def _random_rotation(rng: np.random.Generator) -> FloatArray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


def judged(work: Path, reference: Path, names: Sequence[str], wrong: set[str]) -> Row:
    """Attitudes, focal length and named images of a finished workspace against the reference."""
    name_of = {image.image_id: image.name for image in read_images(work / "images.csv")}
    found = {name_of[i]: pose for i, pose in read_poses(work / "poses.csv").items() if pose.world_rotation is not None}
    with (reference / "poses.csv").open(encoding="utf-8", newline="") as stream:
        truth = {r["image"]: from_omega_phi_kappa(*(float(r[k]) for k in ANGLES)) for r in csv.DictReader(stream)}
    common = [name for name in names if name in found and name in truth]
    turns = [found[name].world_rotation.T @ truth[name] for name in common]
    u, _, vt = np.linalg.svd(sum(turns, np.zeros((3, 3))))
    turn = u * [1.0, 1.0, np.linalg.det(u @ vt)] @ vt
    cosines = [(np.trace(one.T @ turn) - 1.0) / 2.0 for one in turns]
    errors = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
    lens = next(iter(json.loads((reference / "block.json").read_text(encoding="utf-8"))["cameras"].values()))
    focal = max(focal_px(camera) for camera in read_cameras(work / "cameras.csv").values())
    record = work / "reports" / "orient.json"
    facts = read_json(record)["facts"] if record.is_file() else {}
    remarks = facts.get("remarks", [])
    whole = any("angles" in remark for remark in remarks)
    named = wrong if whole else {name_of[i] for i in facts.get("wrong_attitudes", {})}
    return {
        "oriented": len(common),
        "attitude_deg": float(np.median(errors)) if len(errors) else float("nan"),
        "attitude_max_deg": float(errors.max()) if len(errors) else float("nan"),
        "focal_share": focal / float(lens["params"][0]) - 1.0,
        "method": facts.get("method", "none"),
        "named": len(named & wrong),
        "wrong": len(wrong),
        "named_without_cause": len(named - wrong),
        "said": remarks,
        "terrain_share": terrain_error(work, reference) if (reference / "truth.json").is_file() else None,
    }


def terrain_error(work: Path, rendered: Path) -> float:
    """Median height of the terrain found above the rendered surface, without sign, as a share of the flying height.

    Asked at places that the images show. A block in a frame of its own is brought to the truth by its projection
    centres.
    """
    path = work / "orientation" / "terrain.tif"
    if not path.is_file():
        return float("nan")
    truth = load_truth(rendered)
    name_of = {image.image_id: image.name for image in read_images(work / "images.csv")}
    found = read_poses(work / "poses.csv")
    ids = sorted(found)
    own = np.array([found[i].center_m for i in ids])
    origin_m = np.array(read_json(work / "block.json")["origin_m"])
    true = np.array([truth.poses[name_of[i]].center_m for i in ids]) - origin_m
    if read_json(work / "reports" / "orient.json")["facts"].get("frame") == "world":
        scale, rotation, shift_m = 1.0, np.eye(3), np.zeros(3)
    else:
        scale, rotation, shift_m = similarity(true, own)
    rng = np.random.default_rng(0)
    camera = next(iter(truth.cameras.values()))
    pixels = rng.uniform([0, 0], [camera.width_px - 1, camera.height_px - 1], (_SAMPLES, 2))
    seen = np.concatenate([truth.surface_points(name_of[i], pixels) for i in ids]) - origin_m
    seen = seen[np.isfinite(seen).all(axis=1)]
    seen = seen[np.abs(seen[:, :2] - true[:, :2].mean(axis=0)).max(axis=1) <= np.ptp(true[:, :2], axis=0).max()]
    moved = scale * seen @ rotation.T + shift_m
    heights, west_m, north_m, cell_m = read_terrain(path, origin_m)
    ground = DemGround(heights, west_m, north_m, (cell_m, cell_m), float(np.median(heights)))
    off_m = np.abs(ground.height_m(moved[:, :2]) - moved[:, 2]) / scale
    return float(np.median(off_m) / (np.median(true[:, 2]) - np.median(seen[:, 2])))


def run_case(args: Any, block: str, every: int, case: str) -> Row:
    """One run of the command and its figures; kept in OUT, so that a killed benchmark goes on there."""
    folder = args.out / f"{block.replace(':', '-')}-{every}-{case}"
    answer = folder / "answer.json"
    if answer.is_file() and not args.again:
        return read_json(answer)
    source, reference = _folders(args, block)
    images = chosen_images(source, every, 0, args.out / "images" / f"{block.replace(':', '-')}-{every}")
    names = sorted(path.name for path in images.iterdir())
    extra, wrong = worsened(case, reference, names, folder)
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    command = [sys.executable, "-m", "aeromatch_cli.cli", "run", args.preset, "--images", str(images), *extra]
    command += ["--workspace", str(work), "--jobs", str(args.jobs), "--quiet", "--json"]
    command += [f"--set=extract.keypoints={args.keypoints}"]
    started = time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    seconds = time.perf_counter() - started
    head: Row = {"block": block, "every": every, "case": case, "images": len(names), "exit": done.returncode}
    if done.returncode not in (0, 1):
        return head | {"seconds": seconds, "said": done.stderr.strip()[-300:]}
    stages = json.loads(done.stdout.splitlines()[-1])["stages"]
    command = [sys.executable, "-m", "aeromatch_cli.cli", "evaluate", str(work), "--truth", str(reference)]
    command += ["--quiet", "--json", *([] if args.mapping else ["--no-mapping"])]
    evaluated = subprocess.run(command, check=False, capture_output=True, text=True)
    facts = json.loads(evaluated.stdout.splitlines()[-1])
    row = head | judged(work, reference, names, wrong)
    row |= {"correct": facts["totals"]["correct"], "kept": facts["totals"]["kept"]}
    row |= {"pairs": stages["filter"]["facts"]["pairs"].get("verified", 0), "seconds": seconds}
    row |= {"orient_s": stages["orient"]["seconds"], "registered": (facts.get("mapping") or {}).get("registered")}
    write_json(answer, row)
    shutil.rmtree(work, ignore_errors=not args.keep)
    return row


def _folders(args: Any, block: str) -> tuple[Path, Path]:
    """Images and reference of a block of DATA, or of SCENE:FLIGHT, which is rendered where it has not been."""
    scene, _, flight = block.partition(":")
    if not flight:
        return args.data / block / "images", args.data / block / "reference"
    width_px, height_px = RENDERED_PX
    folder = args.out / "rendered" / f"{scene}-{flight}-{args.seed}-{args.rendered}"
    render_block(
        folder, scene, seed=args.seed, width_px=width_px, height_px=height_px, images=args.rendered, flight=flight,
        jobs=args.jobs,
    )  # fmt: skip
    return folder / "images", folder


def rows_of(args: Any) -> Iterator[Row]:
    for block in args.blocks:
        for every in args.thin:
            first: Row = {}
            for case in args.cases:
                row = run_case(args, block, every, case)
                first = row if case == "reference" else first
                if first.get("correct") and "correct" in row:
                    row["share"] = row["correct"] / first["correct"]
                yield row


def table_of(rows: Sequence[Row]) -> str:
    """One line per run."""
    header = (
        "block",
        "case",
        "oriented",
        "attitude error",
        "focal",
        "named",
        "pairs",
        "within 3 px",
        "share",
        "terrain",
        "s",
        "said",
    )
    lines = []
    for row in rows:
        block = row["block"] if row["every"] == 1 else f"{row['block']} / {row['every']}"
        if "correct" not in row:
            lines.append(
                (block, row["case"], f"exit {row['exit']}", "", "", "", "", "", "", f"{row['seconds']:.0f}", "")
            )
            continue
        named = f"{row['named']} of {row['wrong']}" + (f" + {n}" if (n := row["named_without_cause"]) else "")
        lines.append(
            (
                block,
                row["case"],
                f"{row['oriented']} of {row['images']}",
                f"{row['attitude_deg']:.2f} ({row['attitude_max_deg']:.1f})",
                f"{100 * row['focal_share']:+.1f} %",
                named,
                str(row["pairs"]),
                str(row["correct"]),
                f"{100 * row['share']:.0f} %" if "share" in row else "",
                "" if row.get("terrain_share") is None else f"{100 * row['terrain_share']:.1f} %",
                f"{row['seconds']:.0f} ({row['orient_s']:.0f})",
                "; ".join(remark[:_SAID] for remark in row["said"]),
            )
        )
    return markdown(header, lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("orient", __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path(), metavar="DIR", help="folder of blocks")
    add("--blocks", type=options.names, default="lewis,seneca", help="names or SCENE:FLIGHT, comma-separated")
    add("--rendered", type=options.positive, default=24, help="images of a rendered block")
    add("--seed", type=int, default=0, help="of rendered blocks")
    add("--thin", type=options.numbers, default="1", help="keep every k-th image; several k comma-separated")
    add("--cases", type=options.names, default=",".join(CASES), help="comma-separated")
    add("--preset", default="baseline", help="preset of every run")
    add("--keypoints", type=options.positive, default=4000, help="descriptors per image")
    add("--jobs", type=options.positive, default=2)
    add("--mapping", action="store_true", help="also map every result with pycolmap")
    add("--again", action="store_true", help="run what was run before")
    add("--keep", action="store_true", help="keep the workspaces")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"keypoints": 1000})
    rows = []
    for row in rows_of(args):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    options.publish(
        args, table_of(rows) + "\n", args.out / "orient.md", table="bench_orient",
        command=options.command_line(parser, args), versions=stamps.of_settings(),
    )  # fmt: skip
