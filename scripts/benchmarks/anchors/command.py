"""Pairs of photographs whose truth others have measured, matched without any pose.

Every method matches the same pictures, reduced to --size pixels on their longer side, with --keypoints descriptors
each. From its matches, before any verification of its own, one MAGSAC++ (3 px) estimates a homography; where a scene is
not planar (wxbs) a fundamental matrix (1 px). Error: mean distance in the reduced picture 1 of the true places from
where the homography puts them, or from their epipolar lines. A pair without a model counts as failed. In brackets: 90 %
intervals by bootstrap over pairs.

Data sets are read as they are handed out (--layout):
  homogr    NAMEA.jpg, NAMEB.jpg and NAME.csv, hand-measured points of one plane
  hpatches  SEQUENCE/1.ppm to 6.ppm and SEQUENCE/H_1_2 to H_1_6
  evd       1/NAME.png, 2/NAME.png and h/NAME.txt
  wxbs      SET/PAIR/01.png, 02.png and corrs.txt, hand-measured points
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import InputError
from aeromatch_cli.files import read_json, write_json
from aeromatch_cli.fingerprints import file_digest, fingerprint
from aeromatch_cli.images.scaling import shrink
from benchmarks import options, stamps
from benchmarks.anchors.judge import error_px
from benchmarks.anchors.layouts import LAYOUTS, Anchor, anchors_in
from benchmarks.peers.base import Options, Scene
from benchmarks.peers.command import with_weights
from benchmarks.peers.table import FROM_PICTURES, Named, check_method, method, named_methods, settings_of
from benchmarks.processes import limit_threads
from benchmarks.sources import OUR_CODE, PEER_CODE, code_digest, library_versions
from benchmarks.tables import Column, Row, code, grouped, interval, means, median, number, plain, ranged, table, values

SOLVED_PX = (5.0, 10.0)
_OWN_CODE = ("benchmarks/anchors/layouts.py", "benchmarks/anchors/judge.py")
_THREADS = 1
_PUBLISHED = "homogr"  # the layout whose table stands in docs/results
METHODS = (
    "oblique,oblique+nearest=oblique[match=bidirectional,match.ratio=0.9,match.guided=true],"
    "own on SIFT=oblique[match=bidirectional,match.ratio=0.9,extract.detector=sift,extract.orientation=gradient],"
    "gradients=oblique[extract.orientation=gradient],"
    "baseline,SIFT=opencv-sift,aliked,aliked+lightglue,aliked-rot+lightglue,disk+lightglue,xfeat+lighterglue"
)


def rows_of(args: argparse.Namespace, methods: Sequence[Named]) -> Iterator[Row]:
    """Of every method, pair by pair; what OUT has of the same code is not made again."""
    anchors = anchors_in(args.layout, args.data)
    scene = Scene(
        args.layout,
        args.out / f"{args.layout}-{args.size}",
        Path("none"),
        Path("folder"),
        {},
        tuple(_named(anchor) for anchor in anchors),
    )
    shown = [_written(args, scene.images, anchor) for anchor in anchors]
    for name in methods:
        print(f"{name.label}: {len(anchors)} pairs", file=sys.stderr, flush=True)
        ours = name.spec not in FROM_PICTURES
        settings = load(*parse_method(name.spec)).model_dump(mode="json") if ours else None
        basis = [name.spec, settings, args.size, args.keypoints, args.seed, library_versions()]
        basis += [code_digest(*(OUR_CODE if ours else PEER_CODE), *_OWN_CODE)]
        path = args.out / f"{fingerprint(basis, [anchor.name for anchor in anchors])[:16]}.json"
        if not path.is_file():
            write_json(path, {"rows": list(_by_method(args, scene, anchors, shown, name.spec))})
        yield from ({"method": name.label, **row} for row in read_json(path)["rows"])


def _by_method(
    args: argparse.Namespace, scene: Scene, anchors: Sequence[Anchor], truth: Sequence[tuple[FloatArray, FloatArray]],
    spec: str,
) -> Iterator[Row]:  # fmt: skip
    run = method(spec)(scene, Options(args.keypoints, "image", _THREADS, args.seed, args.reference_weights))
    # Data sets list the pairs of one picture beside each other: it is described for the first of them.
    features_of = lru_cache(2)(run.features)
    for anchor, images, places in zip(anchors, scene.pairs, truth, strict=True):
        started = time.perf_counter()
        features = [features_of(image) for image in images]
        points0, points1, _ = run.candidates(*images, *features)
        seconds = time.perf_counter() - started
        error, explained = error_px(points0, points1, *places, planar=anchor.planar)
        yield {
            "pair": anchor.name, "matches": len(points0), "explained": explained, "error_px": plain(error),
            "seconds": plain(seconds),
        }  # fmt: skip


def _named(anchor: Anchor) -> tuple[str, str]:
    """Names of the reduced pictures of a pair, by their content: data sets have some of them several times."""
    return f"{file_digest(anchor.image0)[:16]}.png", f"{file_digest(anchor.image1)[:16]}.png"


def _written(args: argparse.Namespace, folder: Path, anchor: Anchor) -> tuple[FloatArray, FloatArray]:
    """The true places of a pair in its reduced pictures, which are written where they are missing."""
    import cv2

    sizes, scales = [], []
    folder.mkdir(parents=True, exist_ok=True)
    for path, name in zip((anchor.image0, anchor.image1), _named(anchor), strict=True):
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            raise InputError(f"{path} cannot be decoded: unpack the data set again")
        height, width = pixels.shape[:2]
        scale = min(1.0, args.size / max(width, height))
        if not (folder / name).is_file():
            cv2.imwrite(str(folder / name), shrink(pixels, scale))
        sizes.append((width, height))
        scales.append(scale)
    places = anchor.truth(*sizes)
    first, second = ((one + 0.5) * by - 0.5 for one, by in zip(places, scales, strict=True))
    return first, second


def _solved(rows: Sequence[Row], below_px: float) -> str:
    solved = [row["error_px"] is not None and row["error_px"] < below_px for row in rows]
    return ranged(float(np.sum(solved)), tuple(len(rows) * end for end in interval(solved, means)), 0)  # type: ignore[arg-type]


COLUMNS: tuple[Column[Sequence[Row]], ...] = (
    ("pairs", len),
    *((f"below {below_px:.0f} px", lambda rows, below_px=below_px: _solved(rows, below_px)) for below_px in SOLVED_PX),
    ("median error px", lambda rows: number(_middle(rows), 2)),
    ("matches", lambda rows: number(median(rows, "matches"))),
    ("s", lambda rows: number(median(rows, "seconds"), 2)),
)


def _middle(rows: Sequence[Row]) -> float:
    """Median error; that of pairs without a model is infinite."""
    errors = values(rows, "error_px")
    return float(np.median([*errors, *[np.inf] * (len(rows) - len(errors))]))


def table_of(rows: Sequence[Row]) -> str:
    """A line for every method."""
    return table(("method",), [((code(name),), own) for (name,), own in grouped(rows, "method")], COLUMNS)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("anchors", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of the data set")
    add("--layout", choices=LAYOUTS, default=_PUBLISHED, help="how the data set is laid out")
    add("--methods", default=METHODS, help=f"presets, and of {', '.join(FROM_PICTURES)}")
    add("--size", type=options.positive, default=800, help="longer side of the pictures, pixels")
    add("--keypoints", type=options.positive, default=1500, help="descriptors of each picture")
    add("--seed", type=int, default=0, help="of the presets' samples")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of peers that are networks")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"methods": "opencv-sift,baseline", "size": 400, "keypoints": 500})
    if args.docs and args.layout != _PUBLISHED:
        parser.error(f"--docs: the pages have a table of --layout {_PUBLISHED} alone; leave --docs out")
    asked = named_methods(args.methods)
    for name in asked:
        check_method(name.spec, FROM_PICTURES)
    methods = with_weights(asked, args.reference_weights)
    limit_threads(_THREADS)
    rows = list(rows_of(args, methods))
    write_json(args.out / "rows.json", {"rows": rows})
    shown = ",".join(name.spec if name.label == name.spec else f"{name.label}={name.spec}" for name in methods)
    options.publish(
        args, table_of(rows), args.out / f"{args.layout}.md", table=f"bench_anchors_{args.layout}",
        command=options.command_line(parser, args, methods=shown),
        versions=stamps.of_matching(*settings_of(methods)),
    )  # fmt: skip
