"""Reading and writing of the workspace's files. This docstring is the specification (format version 1).

Text is UTF-8; CSV has a header row, comma separator and "" for unknown. Numbers are written with full float64
precision. Pixels are (x, y) with (0, 0) at the centre of the top-left pixel of the stored raster; metres are in the
world frame (`block.json`: `crs` minus `origin_m`). `.npz` files are uncompressed numpy archives without objects.

block.json      format_version, crs, origin_m [x, y, z], ground_source, ground_z_m (null with a DEM or none), gsd_m
                (null without attitudes), ground_fingerprint: of the settings that ground and GSD come from, basis:
                fingerprint of every image when they were fixed.
images.csv      image_id, name, width_px, height_px, camera_id, exif_orientation, time, fingerprint
cameras.csv     camera_id, model, width_px, height_px, params: space-separated, COLMAP's order, cx and cy in this
                project's pixel frame (COLMAP's minus 0.5).
poses.csv       image_id, x, y, z (metres, world frame, projection centre), qw, qx, qy, qz (cam_from_world, "" where
                the attitude is unknown), sigma_position_m, sigma_angle_deg
pairs.csv       image_id0, image_id1 (id0 < id1), overlap (0-1), view_angle_deg, reason
failures.csv    stage, item, reason
ignored_attitudes.json
                images whose attitude contradicts the pictures: fingerprint (of all that the judgement rests on),
                settings (fingerprint of the strategies), images: image_id -> angle_deg, facts (fingerprint of the
                image and its pose); isolated: image_id -> facts, of images without verified pairs although poses
                predict overlap: they and the images they are paired with are also matched as source images

enhanced/<id>.png|tif        the enhanced picture; <id>.mask.png 255 = treated; <id>.json: fingerprint, picture
                             (whether the picture is kept), and the facts that the strategy states. None of images
                             that are used as they were taken.
simulated/<id>/views.json    fingerprint, pictures (whether they are kept), scale (stored raster to the raster that
                             the views were made from), views:
                             name, width_px, height_px, is_source, angle_deg, enhanced, undistorted_from_view. Source
                             pixel = distort(camera, undistorted_from_view . view pixel); for is_source the view is
                             the raster itself. With scale < 1 the camera is the one resized by scale.
simulated/<id>/<view>.png    gray picture of the view (kept by the single stage and with --keep-images).

features/<id>.npz            fingerprint ()str
  keypoints_px (K,2) float32 source frame, merged over views; sizes_px (K,) float32 diameter; responses (K,) float32
  descriptors (D,C) uint8 (RootSIFT x 512) or float32; descriptor_keypoint_idx (D,) int32
  view_idx (D,) int32; view_keypoints_px (D,2) float32, view_size_px (D,) float32, view_orientation_deg (D,) float32:
  place, diameter and direction in the view's own frame; view_sizes_px (V,2) int32; view_angles_deg (V,) float32;
  view_directions (V,3) float32 unit vectors, world frame, and view_gsd_m (V,) float32, NaN where unknown;
  view_enhanced (V,) bool: views of the enhanced picture beside those of the picture as it was taken
  colours (K,3) uint8 RGB of the enhanced picture around each keypoint, present only with extract.colours

matches/<id0>.npz            one row: all pairs of id0, concatenated; pair p owns entries offsets[p]:offsets[p+1]
  image_id1 (P,) str; fingerprint (P,) str; offsets (P+1,) int64
  indices (M,2) int32 into both keypoint lists, -1 for a point measured without a detector
  scores (M,) float32 in 0-1; view_pairs (M,2) int16; strategy (P,) str
  points0_px, points1_px (M,2) float64, present only where some index is -1
  sigmas_px (M,) float32 standard deviation of a measured place, present only where a matcher states it
  remark (P,) str: why a matcher that judges pairs as a whole found nothing; present only where one did

verified/<id0>.npz           the same row layout, only kept matches
  image_id1, fingerprint, offsets, indices, scores, [points0_px, points1_px, sigmas_px] as above
  errors_px (M,) float32 error to the model; state (P,) str verified | rejected | not verifiable; reason (P,) str
  model_kind (P,) str E | F | H | ""; models (P,3,3) float64 (E on normalised rays, F and H on undistorted px)
  rotations (P,3,3) float64 cam1_from_cam0 of the model, NaN where it has none; matches_in (P,) int64
  rejected (P,) str: JSON object, filter name -> matches that it dropped

reports/<stage>[.i-of-n].json   stage, seconds, items, done, skipped (already up to date), failed, fingerprint, facts,
                             failures: [[item, reason], ...]. facts of pairs: summary lines, block figures, warnings,
                             images, ignored_attitudes, pairs_sha256; of extract: keypoints, images_without_keypoints;
                             of match: matches; of filter: pairs (state -> count), verified_matches, components (sizes),
                             weakly_tied, rotation_contradicts_pose (image_id -> degrees); of export: exporter ->
                             files and counts.

evaluation/                  of `aeromatch evaluate`: evaluation.json (format_version, workspace, truth, truth_kind,
                             images, left_out, min_overlap, totals, conditions, summary, consumer, seconds;
                             figures as in evaluate/totals.py, null where unknown), pairs.csv (a line per pair: names,
                             state, conditions, figures as in evaluate/scores.py), conditions.csv, plots as PNG.

export/colmap/               database.db, sparse/{cameras,images,points3D}.txt in COLMAP's own formats and pixel frame
                             (ours + 0.5); world.json: crs, origin_m; a coordinate in the CRS = here + origin.
"""

from __future__ import annotations

import csv
import json
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import (
    Camera,
    Features,
    FloatArray,
    Image,
    IntArray,
    Matches,
    Pair,
    Pose,
    Verdict,
)
from aeromatch_cli.errors import BrokenFileError, WorkspaceError
from aeromatch_cli.geometry.rotations import from_quaternion, to_quaternion

T = TypeVar("T")
_FEATURE_ARRAYS = tuple(field.name for field in fields(Features) if field.name != "colours")
# What numpy and zipfile raise on contents that are no sound archive, or not the arrays that it should hold.
_ARCHIVE_FAULTS = (
    KeyError,
    IndexError,
    ValueError,
    TypeError,
    EOFError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
)


@contextmanager
def readable(path: Path, *faults: type[Exception]) -> Iterator[None]:
    """Turn what reading a file of the workspace raises into BrokenFileError, or into WorkspaceError where the file
    itself may be sound (permissions, a failing disk). faults: what broken contents raise.
    """
    try:
        yield
    except faults as error:
        raise BrokenFileError(str(path), str(error) or type(error).__name__) from None
    except FileNotFoundError as error:
        raise BrokenFileError(str(path), error.strerror or "no such file") from None
    except OSError as error:
        raise WorkspaceError(f"cannot read {path}: {error.strerror or error}; check its permissions and disk") from None


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with every float at full precision; NaN and None become empty."""
    return "".join(",".join(map(_cell, row)) + "\n" for row in (header, *rows))


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    text = repr(float(value)) if isinstance(value, float) else str(value)
    # csv.writer leaves a lone carriage return unquoted, and the reader would end the row there.
    return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in ',"\r\n') else text


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a workspace CSV. Raises BrokenFileError when it is missing or broken."""
    with readable(path, ValueError, csv.Error), path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        if reader.fieldnames is None:
            raise ValueError("it is empty")
        rows = list(reader)
        if any(None in row or None in row.values() for row in rows):
            raise ValueError("a row has not as many cells as the header")
        return rows


def images_text(images: Iterable[Image], fingerprints: Mapping[str, str]) -> str:
    columns = ("image_id", "name", "width_px", "height_px", "camera_id", "exif_orientation", "time")
    rows = ((*(getattr(image, name) for name in columns), fingerprints[image.image_id]) for image in images)
    return csv_text((*columns, "fingerprint"), rows)


def cameras_text(cameras: Mapping[str, Camera]) -> str:
    rows = (
        (k, c.model, c.width_px, c.height_px, " ".join(repr(float(p)) for p in c.params))
        for k, c in sorted(cameras.items())
    )
    return csv_text(("camera_id", "model", "width_px", "height_px", "params"), rows)


def poses_text(poses: Mapping[str, Pose]) -> str:
    header = ("image_id", "x", "y", "z", "qw", "qx", "qy", "qz", "sigma_position_m", "sigma_angle_deg")
    rows = []
    for image_id, pose in sorted(poses.items()):
        q: Sequence[float | None] = (None,) * 4 if pose.world_rotation is None else to_quaternion(pose.world_rotation)
        rows.append((image_id, *map(float, pose.center_m), *q, pose.sigma_position_m, pose.sigma_angle_deg))
    return csv_text(header, rows)


def pairs_text(pairs: Iterable[Pair]) -> str:
    header = ("image_id0", "image_id1", "overlap", "view_angle_deg", "reason")
    return csv_text(header, ((p.image_id0, p.image_id1, p.overlap, p.view_angle_deg, p.reason) for p in pairs))


def _parsed(path: Path, parse: Callable[[Mapping[str, str]], T]) -> list[T]:
    """Rows of a workspace CSV, parsed. Raises BrokenFileError also where a cell cannot be parsed."""
    with readable(path, KeyError, ValueError, TypeError, AttributeError):
        return [parse(row) for row in read_csv(path)]


def read_images(path: Path) -> tuple[Image, ...]:
    return tuple(_parsed(path, _image))


def _image(row: Mapping[str, str]) -> Image:
    return Image(
        row["image_id"],
        row["name"],
        int(row["width_px"]),
        int(row["height_px"]),
        row["camera_id"],
        int(row["exif_orientation"]),
        row["time"],
    )


def read_cameras(path: Path) -> dict[str, Camera]:
    return dict(_parsed(path, _camera))


def _camera(row: Mapping[str, str]) -> tuple[str, Camera]:
    params = tuple(float(value) for value in row["params"].split())
    return row["camera_id"], Camera(row["model"], int(row["width_px"]), int(row["height_px"]), params)


def read_poses(path: Path) -> dict[str, Pose]:
    return dict(_parsed(path, _pose))


def _pose(row: Mapping[str, str]) -> tuple[str, Pose]:
    rotation = from_quaternion(*(float(row[k]) for k in ("qw", "qx", "qy", "qz"))) if row["qw"] else None
    center = np.array([float(row[key]) for key in "xyz"])
    return row["image_id"], Pose(center, rotation, float(row["sigma_position_m"]), float(row["sigma_angle_deg"]))


def read_pairs(path: Path) -> list[Pair]:
    return _parsed(path, _pair)


def _pair(row: Mapping[str, str]) -> Pair:
    overlap, angle = float(row["overlap"] or "nan"), float(row["view_angle_deg"] or "nan")
    return Pair(row["image_id0"], row["image_id1"], overlap, angle, row["reason"])


# --- archives ---------------------------------------------------------------------------------------------------


def write_features(stream: BinaryIO, features: Features, fingerprint: str) -> None:
    arrays: dict[str, Any] = {name: getattr(features, name) for name in _FEATURE_ARRAYS}
    if features.colours is not None:
        arrays["colours"] = features.colours
    np.savez(stream, fingerprint=np.array(fingerprint), **arrays)


def read_features(path: Path) -> Features:
    """All arrays. Raises BrokenFileError when the file is missing or broken."""
    return Features(**_load(path, _FEATURE_ARRAYS, ("colours",)))


def read_keypoints(path: Path) -> tuple[FloatArray, FloatArray, NDArray[np.uint8] | None]:
    """keypoints_px (K, 2), sizes_px (K,) and colours (K, 3) or None; the rest stays on disk."""
    arrays = _load(path, ("keypoints_px", "sizes_px"), ("colours",))
    return arrays["keypoints_px"], arrays["sizes_px"], arrays.get("colours")


def features_fingerprint(path: Path) -> str | None:
    """Fingerprint recorded in a feature file, None when the file is absent or broken."""
    try:
        return str(_load(path, ("fingerprint",))["fingerprint"])
    except BrokenFileError:
        return None


def _load(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    with readable(path, *_ARCHIVE_FAULTS), np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in (*names, *(name for name in optional if name in archive))}


@dataclass(frozen=True, eq=False)
class MatchEntry:
    """One pair of a matches row."""

    image_id1: str
    fingerprint: str
    strategy: str
    matches: Matches


@dataclass(frozen=True, eq=False)
class VerifiedEntry:
    """One pair of a verified row: the kept matches and what the filters said (verdict.keep is all True here)."""

    image_id1: str
    fingerprint: str
    matches_in: int
    matches: Matches
    verdict: Verdict


def write_match_row(stream: BinaryIO, entries: Sequence[MatchEntry]) -> None:
    arrays = _row_arrays(entries)
    arrays["strategy"] = _strings([e.strategy for e in entries])
    arrays["view_pairs"] = _joined([e.matches.view_pairs for e in entries], (0, 2), np.int16)
    if any(e.matches.remark for e in entries):
        arrays["remark"] = _strings([e.matches.remark for e in entries])
    np.savez(stream, **arrays)  # type: ignore[arg-type]


def read_match_row(path: Path) -> dict[str, MatchEntry]:
    """Entries by image_id1; empty when the file is absent. Raises BrokenFileError when it is broken."""
    if not path.exists():
        return {}
    row = _Row(path)
    with readable(path, *_ARCHIVE_FAULTS):
        view_pairs, strategy = row["view_pairs"], row["strategy"]
        return {
            id1: MatchEntry(id1, fp, str(strategy[p]), row.matches(p, view_pairs))
            for p, (id1, fp) in enumerate(row.keys())
        }


def write_verified_row(stream: BinaryIO, entries: Sequence[VerifiedEntry]) -> None:
    verdicts = [e.verdict for e in entries]
    rotations = [np.full((3, 3), np.nan) if v.relative_rotation is None else v.relative_rotation for v in verdicts]
    errors = [
        np.full(len(e.matches.indices), np.nan) if e.verdict.errors_px is None else e.verdict.errors_px for e in entries
    ]
    np.savez(
        stream,
        **_row_arrays(entries),  # type: ignore[arg-type]
        errors_px=_joined(errors, (0,), np.float32),
        state=_strings([v.state for v in verdicts]),
        reason=_strings([v.reason for v in verdicts]),
        model_kind=_strings([v.model_kind for v in verdicts]),
        models=np.array([v.model for v in verdicts], dtype=np.float64).reshape(-1, 3, 3),
        rotations=np.array(rotations, dtype=np.float64).reshape(-1, 3, 3),
        matches_in=np.array([e.matches_in for e in entries], dtype=np.int64),
        rejected=_strings([json.dumps(dict(v.rejected)) for v in verdicts]),
    )


def read_verified_row(path: Path) -> dict[str, VerifiedEntry]:
    """Entries by image_id1; empty when the file is absent. Raises BrokenFileError when it is broken."""
    if not path.exists():
        return {}
    row = _Row(path)
    with readable(path, *_ARCHIVE_FAULTS):
        return {id1: _verified_entry(row, p, id1, fp) for p, (id1, fp) in enumerate(row.keys())}


def _verified_entry(row: _Row, p: int, image_id1: str, fingerprint: str) -> VerifiedEntry:
    matches = row.matches(p, None)
    rotation = row["rotations"][p]
    verdict = Verdict(
        keep=np.ones(len(matches.indices), dtype=bool),
        state=str(row["state"][p]),  # type: ignore[arg-type]
        reason=str(row["reason"][p]),
        model_kind=str(row["model_kind"][p]),
        model=row["models"][p],
        errors_px=row["errors_px"][row.span(p)],
        rejected=json.loads(str(row["rejected"][p])),
        relative_rotation=None if np.isnan(rotation).any() else rotation,
    )
    return VerifiedEntry(image_id1, fingerprint, int(row["matches_in"][p]), matches, verdict)


def row_fingerprints(path: Path) -> dict[str, str]:
    """image_id1 -> fingerprint of a matches or verified row; empty when absent or broken."""
    if not path.exists():
        return {}
    try:
        arrays = _load(path, ("image_id1", "fingerprint"))
        with readable(path, *_ARCHIVE_FAULTS):
            return {str(i): str(f) for i, f in zip(arrays["image_id1"], arrays["fingerprint"], strict=True)}
    except BrokenFileError:
        return {}


class _Row:
    """A row archive, read once."""

    def __init__(self, path: Path) -> None:
        with readable(path, *_ARCHIVE_FAULTS), np.load(path, allow_pickle=False) as archive:
            self._arrays = {name: archive[name] for name in archive.files}
            self._offsets = self._arrays["offsets"]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._arrays[name]

    def keys(self) -> list[tuple[str, str]]:
        return [(str(i), str(f)) for i, f in zip(self["image_id1"], self["fingerprint"], strict=True)]

    def span(self, p: int) -> slice:
        return slice(int(self._offsets[p]), int(self._offsets[p + 1]))

    def matches(self, p: int, view_pairs: IntArray | None) -> Matches:
        span = self.span(p)
        indices = self["indices"][span]
        measured = "points0_px" in self._arrays
        return Matches(
            indices,
            self["scores"][span],
            np.zeros((len(indices), 2), np.int16) if view_pairs is None else view_pairs[span],
            self["points0_px"][span] if measured else None,
            self["points1_px"][span] if measured else None,
            self["sigmas_px"][span] if "sigmas_px" in self._arrays else None,
            str(self["remark"][p]) if "remark" in self._arrays else "",
        )


def _row_arrays(entries: Sequence[MatchEntry] | Sequence[VerifiedEntry]) -> dict[str, NDArray[Any]]:
    matches = [e.matches for e in entries]
    arrays: dict[str, NDArray[Any]] = {
        "image_id1": _strings([e.image_id1 for e in entries]),
        "fingerprint": _strings([e.fingerprint for e in entries]),
        "offsets": np.cumsum([0, *(len(m.indices) for m in matches)], dtype=np.int64),
        "indices": _joined([m.indices for m in matches], (0, 2), np.int32),
        "scores": _joined([m.scores for m in matches], (0,), np.float32),
    }
    if any(m.points0_px is not None for m in matches):
        for name in ("points0_px", "points1_px"):
            parts = [getattr(m, name) for m in matches]
            filled = [
                np.full((len(m.indices), 2), np.nan) if x is None else x for m, x in zip(matches, parts, strict=True)
            ]
            arrays[name] = _joined(filled, (0, 2), np.float64)
    if any(m.sigmas_px is not None for m in matches):
        sigmas = [np.full(len(m.indices), np.nan) if m.sigmas_px is None else m.sigmas_px for m in matches]
        arrays["sigmas_px"] = _joined(sigmas, (0,), np.float32)
    return arrays


def _joined(parts: Sequence[NDArray[Any]], empty_shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(empty_shape, dtype)


def _strings(values: Sequence[str]) -> NDArray[Any]:
    return np.array(values, dtype=np.str_) if values else np.zeros(0, dtype="<U1")
