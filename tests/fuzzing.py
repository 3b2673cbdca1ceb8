"""Damaged input for every reader: what people's files become, and what a hostile one may hold.

Each case takes a sound file and damages it: bytes are flipped, parts are cut, repeated or moved, numbers become words,
infinities, or numbers of absurd size, quotes and brackets get lost. A reader may refuse it by the project's own errors,
and must not raise, hang or fill the memory otherwise. `scripts/fuzz` runs as many cases as are asked for; with
`--guided` the cases are those of atheris, which follows the lines of the program that they reach.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fuzzing_guided import guided_faults
from make_features import random_features
from make_images import DJI_XMP, gps_tags, write_image, write_jpeg_2000
from make_pose_files import LOCAL, WORLD, patb, write_micmac

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.exif import read_exif
from aeromatch_cli.blocks.flight_tracks import read_track
from aeromatch_cli.blocks.left_out import excluded
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.config import load
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, Image, Matches, Pair, Pose, Verdict
from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.files import read_json
from aeromatch_cli.formats.adjusted import read_adjusted, read_dropped, write_adjusted, write_dropped
from aeromatch_cli.formats.features import read_features, write_features
from aeromatch_cli.formats.rows import (
    MatchEntry,
    VerifiedEntry,
    read_match_row,
    read_verified_row,
    write_match_row,
    write_verified_row,
)
from aeromatch_cli.formats.tables import (
    cameras_text,
    images_text,
    pairs_text,
    poses_text,
    read_cameras,
    read_images,
    read_pairs,
    read_poses,
)
from aeromatch_cli.images.files import read_mask, read_pixels

CAMERA = Camera("PINHOLE", 40, 30, (9.0, 9.0, 19.5, 14.5))
# A case that takes longer is a fault, seconds.
SLOWEST_S = 10.0
_TOKENS = (
    b"nan", b"inf", b"-1e308", b"1e999", b"", b"0", b"-0", b"9" * 400, b"x", b"\xff\xfe", b"\0", b"'", b'"', b"<", b"{",
    b"[", b"../../../etc/passwd", b"\xe2\x80\xae", b"1,5", b"18446744073709551616", b"-2147483649", b"&amp;",
    b"!!python",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class Reader:
    """read: raises AeromatchError alone. sound: file names and contents that it reads."""

    read: Callable[[Path], object]
    sound: Mapping[str, bytes]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four faults."""
    for _ in range(int(rng.integers(1, 5))):
        data = _FAULTS[rng.integers(len(_FAULTS))](data, rng)
    return data


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    found = np.frombuffer(data, np.uint8).copy()
    if len(found):
        places = rng.integers(0, len(found), max(1, int(len(found) * 0.002)))
        found[places] ^= rng.integers(1, 256, len(places), dtype=np.uint8)
    return found.tobytes()


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(0, len(data) + 1)]


def _without_part(data: bytes, rng: np.random.Generator) -> bytes:
    first, last = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return data[:first] + data[last:]


def _part_twice(data: bytes, rng: np.random.Generator) -> bytes:
    first, last = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return data[:last] + data[first:]


def _line_moved(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    line = lines.pop(int(rng.integers(len(lines))))
    lines.insert(int(rng.integers(len(lines) + 1)), line)
    return b"\n".join(lines)


def _number_replaced(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(_NUMBER.finditer(data[:200_000]))
    if not found:
        return data
    match = found[rng.integers(len(found))]
    return data[: match.start()] + _TOKENS[rng.integers(len(_TOKENS))] + data[match.end() :]


def _token_inserted(data: bytes, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(0, len(data) + 1))
    return data[:place] + _TOKENS[rng.integers(len(_TOKENS))] + data[place:]


_FAULTS = (_flipped, _cut, _without_part, _part_twice, _line_moved, _number_replaced, _number_replaced, _token_inserted)


def _archive(write: Callable[..., object], *value: Any) -> bytes:
    with tempfile.TemporaryFile() as stream:
        write(stream, *value)
        stream.seek(0)
        return stream.read()


def _texts(files: Mapping[str, str | bytes]) -> dict[str, bytes]:
    return {name: text if isinstance(text, bytes) else text.encode() for name, text in files.items()}


_OTHER_LISTS = {
    "layer.csv": 'WKT,filename,altitude\n"POINT Z (13.4 52.5 140)",a.jpg,1\n"POINT Z (13.5 52.5 141)",b.jpg,2\n',
    "layer.txt": "geom\timage\nSRID=32633;PointZ (390951.2 5818970.1 140)\ta.jpg\n",
    "tags.csv": 'SourceFile,GPSPosition,GPSAltitude,Yaw,Pitch,Roll\na.jpg,"52 N, 13.4 E",9 m Above Sea Level,1,-90,0\n',
    "both.csv": "Photo,Latitude,Longitude,Ellipsoidal height,Easting,Northing\na.jpg,52.5,13.4,140,390951,5818970.1\n",
    "web.txt": "EPSG:3857\na.jpg 390951.2 5818970.1 140\n",
}
_CAM = (
    "Pix4D camera calibration file 0\n#Focal Length mm assuming a sensor width of 6.2x4.65mm\nF 4.3\n"
    "#Principal Point mm\nPx 3.1\nPy 2.3\nK1 0.01\nK2 0.02\nK3 0\nT1 0.001\nT2 0\n"
)


def readers() -> dict[str, Reader]:
    """Every reader of files that come from outside, or that a fault of the disk may change."""
    rng = np.random.default_rng(0)
    kept = Matches(
        rng.integers(0, 99, (30, 2)).astype(np.int32), rng.random(30).astype(np.float32), np.zeros((30, 2), np.int16)
    )
    verdict = Verdict(np.ones(30, bool), "verified", model_kind="E", errors_px=np.zeros(30, np.float32))
    features = random_features(40)
    pose = AdjustedPose(np.zeros(3), np.eye(3), np.ones(3), np.ones(3))
    block = AdjustedBlock(
        {"1": CAMERA}, {"a": pose}, np.zeros((3, 3)), np.zeros(3),
        {"a": np.array([[0, 1]], np.int32)},
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        image = write_image(Path(scratch) / "a.jpg", gps=gps_tags(52.0, 13.0, 100.0), xmp=DJI_XMP).read_bytes()
        png = write_image(Path(scratch) / "a.png").read_bytes()
        tif = write_image(Path(scratch) / "a.tif").read_bytes()
        jp2 = write_jpeg_2000(Path(scratch) / "a.jp2", np.full((3, 30, 40), 900, np.uint16)).read_bytes()
        ori = {"Orientation-A.jpg.xml": next(write_micmac(Path(scratch)).glob("*.xml")).read_bytes()}
    pictures = {"a.jpg": image, "a.png": png, "a.tif": tif, "a.jp2": jp2}
    camera = '{"1": {"model": "OPENCV", "width": 40, "height": 30, "params": [9, 9, 20, 15, 0, 0, 0, 0]}}'
    control = (
        "EPSG:32633\n390951.2 5818970.1 34.0 512.3 390.8 a.jpg north\n390952.2 5818971.1 34.0 51.3 39.8 a.jpg s check\n"
    )
    images = (Image("a", "a.jpg", 40, 30, "1"),)
    settings = (
        "preset: fusion\nblock: {images: imgs, poses: exif, crs: auto}\nextract: {keypoints: 500}\nexport: colmap\n"
    )
    tables = _texts(
        {
            "images.csv": images_text(images, {"a": "f"}),
            "cameras.csv": cameras_text({"1": CAMERA}),
            "poses.csv": poses_text({"a": Pose(np.ones(3), np.eye(3), 1.0, 1.0)}),
            "pairs.csv": pairs_text([Pair("a", "b", 0.5, 3.0, "overlap")]),
        }
    )
    by_name: dict[str, Callable[[Path], object]] = {
        "images.csv": read_images, "cameras.csv": read_cameras, "poses.csv": read_poses, "pairs.csv": read_pairs,
    }  # fmt: skip
    return {
        "poses": Reader(
            read_pose_file, _texts({**WORLD, **LOCAL, "patb.ori": patb(transposed=False), **ori, **_OTHER_LISTS})
        ),
        "cameras": Reader(
            read_camera_file,
            _texts(
                {"c.json": camera, "c.yaml": camera, "cameras.txt": "1 OPENCV 40 30 9 9 20 15 0 0 0 0\n", "p.cam": _CAM}
            ),
        ),
        "control": Reader(
            lambda path: read_control(str(path), images, "EPSG:32633", (391000.0, 5818000.0, 0.0)),
            _texts(
                {
                    "gcp_list.txt": control,
                    "pix4d.csv": "north,390951.2,5818970.1,34.0,0.02,0.03\nsouth,390990,5818999,33.8,0.02,0.03\n",
                    "layer.csv": "fid;name;geom\n1;north;SRID=32633;POINT Z (390951.2 5818970.1 34.0)\n",
                    "points.txt": "EPSG:32633\nnorth 390951.2 5818970.1 34.0\n",
                    "marks.txt": "a.jpg,north,10.5,9.5,1\na.jpg,south,12.5,9.5,1\n",
                    "markers.xml": "<document><chunk><cameras><camera id='3' label='a'/></cameras><markers>"
                    "<marker id='0' label='north'><reference x='390951.2' y='5818970.1' z='34' sx='0.01' "
                    "enabled='true'/></marker>"
                    "</markers><frames><frame><markers><marker marker_id='0'><location camera_id='3' x='9' y='8' "
                    "pinned='true'/></marker></markers></frame></frames><reference>EPSG:32633</reference></chunk>"
                    "</document>",
                }
            ),
        ),
        "tracks": Reader(
            read_track,
            _texts(
                {
                    "a.srt": "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 47.1] [longitude: 8.5] [rel_alt: 20.1 "
                    "abs_alt: 450.2]\n\n2\n00:00:01,000 --> 00:00:02,000\nGPS(8.5,47.1,16) BAROMETER:1.9\n",
                    "a.gpx": "<gpx><trk><trkseg><trkpt lat='47.0' lon='8.5'><ele>450.0</ele>"
                    "<time>2026-05-01T10:00:00Z</time></trkpt></trkseg></trk></gpx>",
                }
            ),
        ),
        "exclude": Reader(lambda path: excluded(str(path), ["a.jpg", "b/c.jpg"]), {"a.txt": b"a.jpg\nb/*\n# c\n"}),
        "settings": Reader(lambda path: load(str(path)), _texts({"a.yaml": settings})),
        "exif": Reader(read_exif, pictures),
        "pixels": Reader(lambda path: read_pixels(path, colour=True), pictures),
        "masks": Reader(lambda path: read_mask(path, 40, 30), {"a.png": png}),
        "features": Reader(read_features, {"a.npz": _archive(write_features, features, "f")}),
        "matches": Reader(read_match_row, {"a.npz": _archive(write_match_row, [MatchEntry("b", "f", "s", kept)])}),
        "verified": Reader(
            read_verified_row, {"a.npz": _archive(write_verified_row, [VerifiedEntry("b", "f", 40, kept, verdict)])}
        ),
        "adjusted": Reader(read_adjusted, {"adjusted.npz": _archive(write_adjusted, block)}),
        "dropped": Reader(read_dropped, {"d.npz": _archive(write_dropped, {("a", "b"): ("f", np.arange(3))}, 15)}),
        "tables": Reader(lambda path: by_name[path.name](path), tables),
        "json": Reader(read_json, {"a.json": b'{"result": {"images": 3}, "failures": [["a", "b"]]}'}),
    }


def faults(reader: Reader, cases: int, seed: int, folder: Path) -> Iterator[tuple[str, bytes, str]]:
    """File name, content and what happened, of every case that ends in anything but the project's own errors."""
    names = sorted(reader.sound)
    for case in range(cases):
        rng = np.random.default_rng((seed, case))
        name = names[case % len(names)]
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        for beside, content in reader.sound.items():  # what lies beside it in the same folder
            if Path(beside).parent == Path(name).parent:
                (folder / beside).write_bytes(content)
        data = damaged(reader.sound[name], rng)
        path.write_bytes(data)
        started = time.process_time()  # not of the clock: other work may hold the machine up
        try:
            with contextlib.suppress(AeromatchError):
                reader.read(path)
        except Exception:  # noqa: BLE001 - this is what is looked for
            yield name, data, traceback.format_exc(limit=-3)
        if (took := time.process_time() - started) > SLOWEST_S:
            yield name, data, f"took {took:.0f} s of the processor"


def _said(reader: str, found: Iterator[tuple[str, bytes, str]], seen: dict[str, int]) -> None:
    """Prints each kind of fault once, counts all."""
    for file, data, what in found:
        last = what.strip().splitlines()[-1]
        seen[last] = seen.get(last, 0) + 1
        if seen[last] == 1:
            print(f"{reader} {file}: {what}\n{data[:300]!r}\n", file=sys.stderr)


def main() -> None:
    table = readers()
    parser = argparse.ArgumentParser(
        prog="scripts/fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("readers", nargs="*", help=f"of {', '.join(table)}; all by default")
    parser.add_argument("--cases", type=int, default=20_000, help="of each reader (default 20000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true", help="cases of atheris (pip install 'aeromatch[fuzz]')")
    args = parser.parse_args()
    if unknown := set(args.readers) - table.keys():
        parser.error(f"no such reader: {', '.join(sorted(unknown))}")
    whole = 0
    for name in args.readers or table:
        started, seen = time.monotonic(), dict[str, int]()
        with tempfile.TemporaryDirectory() as scratch:
            if args.guided:
                found = guided_faults(name, args.cases, args.seed, Path(scratch))
            else:
                found = faults(table[name], args.cases, args.seed, Path(scratch))
            _said(name, found, seen)
        whole += sum(seen.values())
        print(
            f"{name}: {args.cases} cases, {sum(seen.values())} faults, {time.monotonic() - started:.0f} s", flush=True
        )
    sys.exit(1 if whole else 0)


if __name__ == "__main__":
    main()
