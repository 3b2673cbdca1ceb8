"""What a workspace, one of its images, a pair or a file holds, in words; pictures of images and pairs."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aeromatch_cli import graph
from aeromatch_cli.data import BoolArray, FloatArray, Image, Pose, Verdict
from aeromatch_cli.errors import ConfigError, InputError, WorkspaceError
from aeromatch_cli.files import read_json, read_record
from aeromatch_cli.formats.archives import ARCHIVE_FAULTS
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.geometry.cameras import corner_params, undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, symmetric_distance_px
from aeromatch_cli.geometry.rotations import tilt_deg, to_omega_phi_kappa
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.images.remote import is_remote
from aeromatch_cli.report.pictures import image_picture, pair_picture
from aeromatch_cli.report.rows import seconds_by_stage
from aeromatch_cli.report.tiles import Tile, aligned, tiles_of_image, write_tiles
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import (
    AdjustResult,
    ConsistencyResult,
    ExportResult,
    FilterResult,
    OrientResult,
    PairsResult,
)
from aeromatch_cli.sfm.georeferencing import LOCAL_FLYING_HEIGHT
from aeromatch_cli.sfm.quality.finding import Quality
from aeromatch_cli.stages.cascade import feature_workspaces
from aeromatch_cli.stages.inspect_image import steps_of_image
from aeromatch_cli.stages.quality import quality_on_file
from aeromatch_cli.stages.stage_report import result_of, result_on_file
from aeromatch_cli.store.matches import match_points
from aeromatch_cli.store.opened import OpenedBlock
from aeromatch_cli.words import counted, listed
from aeromatch_cli.workspace import Workspace

# Partners that are listed one by one.
_LISTED = 30
# Pairs that are looked at to tell whether matches are of the present keypoints.
_TRIED = 50


@dataclass(frozen=True)
class Shown:
    """lines: in words. facts: the same for machines. picture: the PNG that was written, None for none."""

    lines: list[str]
    facts: dict[str, Any]
    picture: Path | None = None


class _Work(OpenedBlock):
    """The workspace that is shown."""

    def image(self, text: str) -> Image:
        """By name, file name, stem or id. Raises ConfigError where none or several fit."""
        folder = self.settings.block.images
        here = Path(text).resolve()
        if not is_remote(folder) and here.is_file() and here.is_relative_to(Path(folder).resolve()):
            text = here.relative_to(Path(folder).resolve()).as_posix()  # as a shell's completion writes it
        wanted = text.replace("\\", "/").lower()
        fitting = [
            image
            for image in self.images.values()
            if wanted in {image.image_id.lower(), image.name.lower(), Path(image.name).name.lower(),
                          Path(image.name).stem.lower()}
        ]  # fmt: skip
        exact = [image for image in fitting if image.name == text]
        if len(exact or fitting) != 1:
            what = (
                f"fits several images ({listed(image.name for image in fitting)})"
                if fitting
                else "is none of the images"
            )
            example = next(iter(self.images.values())).name if self.images else "none"
            raise ConfigError(f"{text!r} {what} of {self.workspace.root}: give a name such as {example}")
        return (exact or fitting)[0]


def show(
    path: Path, names: Sequence[str], out: Path | None = None, *, rejected: bool = False, views: bool = False
) -> Shown:
    """A file, or a workspace with up to two of its images. rejected: draw the matches that were dropped, too. views: of
    an image also its enhanced picture, masks and views. out: a .png, .html or, of a pair, .gif.

    Raises ConfigError or InputError where there is no such thing.
    """
    if path.is_file():
        if names:
            raise ConfigError(f"{path} is a file: images are named behind a workspace")
        return Shown(list(_file_lines(path)), {"file": str(path)})
    work = _Work(path)
    if not names:
        if out is not None or views or rejected:
            raise ConfigError("a workspace as a whole has no picture: name an image, or the two of a pair")
        return _workspace(work)
    if len(names) == 1:
        return _image(work, work.image(names[0]), out, views=views)
    first, second = sorted((work.image(name) for name in names), key=lambda image: image.image_id)
    if first.image_id == second.image_id:
        raise ConfigError(f"both names mean the image {first.name}: a pair has two")
    return _pair(work, first, second, out, rejected=rejected)


def _workspace(work: _Work) -> Shown:
    """Show a workspace as a whole: its block, stages, exports and verdict."""
    workspace = work.workspace
    quality = quality_on_file(workspace, work.names)
    lines = [*_block_lines(work), *_stage_lines(workspace), *_export_lines(workspace)]
    if stale := _stale(work):
        lines.append(f"matches     of keypoints of {stale} that were found again since: run match, then filter")
    block = result_on_file(workspace, PairsResult)
    left_out = [] if block is None else block.left_out
    if left_out:
        lines.append(f"left out    to end in time (run --within): {'; '.join(left_out)}")
    lines += _verdict_lines(workspace, quality)
    if workspace.report.is_file():
        lines.append(f"report      {workspace.report}")
    lines.append("one image: aeromatch show WORK IMAGE; a pair: aeromatch show WORK IMAGE IMAGE")
    facts: dict[str, Any] = {"workspace": str(workspace.root), "images": len(work.images), "pairs": len(work.pairs)}
    facts |= {"left_out": left_out} if left_out else {}
    if quality is not None:
        facts["quality"] = quality.as_facts()
    return Shown(lines, facts)


def _block_lines(work: _Work) -> Iterator[str]:
    orient = result_on_file(work.workspace, OrientResult)
    given = len(work.poses) if orient is None else orient.positions_given
    attitudes = sum(pose.world_rotation is not None for pose in work.poses.values())
    oriented = attitudes if work.adjusted is None else len(work.adjusted.poses)
    yield f"images      {len(work.images)}, {given} with position given; {oriented} oriented"
    block = read_json(work.workspace.block)
    scale = "" if block.get("metric", True) else ", of arbitrary scale"
    yield f"world       {block['crs']}{scale}, origin {' '.join(f'{v:.0f}' for v in block['origin_m'])}"
    yield f"pairs       {len(work.pairs)}"


def _stage_lines(workspace: Workspace) -> Iterator[str]:
    """Say what every stage that has run made, and the counts of matches that were verified and that are left."""
    seconds = seconds_by_stage(workspace)
    for stage in graph.ORDER:
        path = workspace.stage_report(stage)
        found = read_record(path, StageRecord)
        if found is None:
            continue
        yield f"{stage:<11} {counted(found.items, 'item')}, {found.failed} failed, {seconds[stage]:.1f} s"
        match result_of(found):
            case FilterResult() as judged:
                states = ", ".join(f"{count:,} {state}" for state, count in judged.pairs.items())
                yield f"            {states}; {counted(judged.verified_matches, 'verified match', 'verified matches')}"
            case ConsistencyResult(verified_matches=int(left)) as final:
                when = ", of earlier matches: run aeromatch adjust" if workspace.ran_since(path, "filter") else ""
                dropped = f"{final.dropped_matches:,} of them dropped, {counted(final.rejected_pairs, 'pair')} rejected"
                yield f"            {dropped}; {counted(left, 'is', 'are')} left{when}"


def _export_lines(workspace: Workspace) -> Iterator[str]:
    exported = result_on_file(workspace, ExportResult)
    written = set() if exported is None else set(exported.exporters)
    older = ", of an earlier adjustment: run aeromatch export" if workspace.export_is_older else ""
    for one in workspace.exported():
        earlier = ", of earlier results" if workspace.is_older_export(one) else ""
        yield f"export      {one}{older if one.name in written else earlier}"


def _verdict_lines(workspace: Workspace, quality: Quality | None) -> Iterator[str]:
    if quality is None:
        if workspace.stage_report("adjust").is_file() and result_on_file(workspace, AdjustResult) is None:
            yield "result      of an earlier version of aeromatch: run `aeromatch run` again for the verdict"
        return
    first, *others = [one.sentence for one in quality.faults] or ["nothing speaks against it"]
    yield f"result      {quality.verdict}: {first}"
    for sentence in others:
        yield f"            {sentence}"
    if quality.unchecked:
        yield f"            not checked: {'; '.join(quality.unchecked)}"


def _stale(work: _Work) -> str:
    """An image whose matches point into keypoints that are gone, "" where there is none among some pairs."""
    every = max(1, len(work.pairs) // _TRIED)
    for pair in work.pairs[::every]:
        if image_id := work.stale(pair):
            return work.names[image_id]
    return ""


def _image(work: _Work, image: Image, out: Path | None, *, views: bool) -> Shown:
    """Show an image: its camera, poses, keypoints and partners, and a picture of its keypoints."""
    workspace, image_id = work.workspace, image.image_id
    camera = work.cameras[image.camera_id]
    lines = [f"image       {image.name}, {image.width_px} x {image.height_px} px, id {image_id}"]
    lines.append(f"camera      {image.camera_id}: {camera.model} {' '.join(f'{v:.6g}' for v in corner_params(camera))}")
    lines += _pose_lines(work, image_id)
    keypoints = work.keypoints_px(image_id)
    partners, matched = _partners(work, image_id, len(keypoints))
    verified = sum(partner.matches > 0 for partner in partners)
    lines.append(f"keypoints   {len(keypoints)}, {int(matched.sum())} of them in verified matches")
    lines.append(f"partners    {len(partners)}, {verified} of them verified")
    for partner in sorted(partners, key=lambda one: (-one.matches, one.name))[:_LISTED]:
        lines.append(f"            {partner.words}")
    for made in feature_workspaces(work.settings, workspace):
        for what, path in (("enhanced", made.enhanced(image_id, ".png")), ("views", made.views(image_id))):
            if path.exists():
                lines.append(f"{what:<11} {path}")
    target = out or _own_file(workspace, f"{image_id}.png")
    picture = image_picture(read_pixels(work.picture(image), colour=True), keypoints, matched)
    tiles = [Tile("keypoints: in verified matches green, others pale", picture)]
    if views:
        tiles += tiles_of_image(steps_of_image(work.settings, image_id))
    write_tiles(target, tiles, lines, image.name)
    also = f"; {', '.join(tile.title for tile in tiles[1:])}" if views else ""
    lines.append(f"picture     {target}: keypoints in verified matches green, others pale{also}")
    matches = {partner.name: partner.matches for partner in partners}
    facts = {"image": image.name, "keypoints": len(keypoints), "partners": matches, "picture": str(target)}
    return Shown(lines, facts, target)


def _pose_lines(work: _Work, image_id: str) -> Iterator[str]:
    """Say the pose of an image as it was given or as the first pass found it, and as it was adjusted."""
    world = read_json(work.workspace.block)
    origin_m = world["origin_m"]
    # Those of earlier versions do not say what frames are.
    frame = world.get("frames", {}).get(image_id, 0)
    metric = world.get("metric", True) and not frame
    orient = result_on_file(work.workspace, OrientResult)
    found = orient is not None and orient.poses_from == "pictures"
    for words in _pose_words(work.poses.get(image_id), origin_m, frame, metric=metric, rough=found):
        yield f"{'first pass' if found else 'given':<11} {words}"
    if work.adjusted is None or image_id not in work.adjusted.poses:
        return
    adjusted = work.adjusted.poses[image_id]
    sigmas = float(np.mean(adjusted.sigmas_m)), float(np.mean(adjusted.sigmas_deg))
    known = Pose(adjusted.center_m, adjusted.rotation, *sigmas)
    frame = work.adjusted.frames.get(image_id, 0)
    for words in _pose_words(known, origin_m, frame, metric=not frame):
        yield f"adjusted    {words}"


class _Partner(NamedTuple):
    """An image that is paired with another. matches: verified ones that are left. state: of the pair."""

    name: str
    matches: int
    state: str
    overlap: float

    @property
    def words(self) -> str:
        share = "overlap unknown" if np.isnan(self.overlap) else f"overlap {100 * self.overlap:.0f} %"
        return f"{self.name}: {counted(self.matches, 'match', 'matches')}, {self.state}, {share}"


def _partners(work: _Work, image_id: str, keypoints: int) -> tuple[list[_Partner], BoolArray]:
    """Return the images that an image is paired with, and which of its keypoints (K,) are in verified matches."""
    partners, matched = [], np.zeros(keypoints, dtype=bool)
    for pair in work.pairs:
        ids = pair.image_id0, pair.image_id1
        if image_id not in ids:
            continue
        side = ids.index(image_id)
        name = work.images[ids[1 - side]].name
        found = work.final(pair)
        if found is None:
            partners.append(_Partner(name, 0, "not judged", pair.overlap))
            continue
        own = found.matches.indices[:, side] if found.verdict.state == "verified" else np.zeros(0, np.int32)
        matched[own[own >= 0]] = True
        partners.append(_Partner(name, len(own), found.verdict.state, pair.overlap))
    return partners, matched


def _own_file(workspace: Workspace, name: str) -> Path:
    """Where a picture goes that no --out names. Raises WorkspaceError where nobody may write, as in an archive."""
    folder = workspace.root / "show"
    if not os.access(folder if folder.exists() else workspace.root, os.W_OK):
        raise WorkspaceError(f"cannot write {folder}: name a file elsewhere, as in --out {name}")
    return folder / name


def _pose_words(
    pose: Pose | None, origin_m: Sequence[float], frame: int, *, metric: bool, rough: bool = False
) -> Iterator[str]:
    """frame: number of the frame of its own that the pose lies in, 0 in the world. rough: how exact it is, nobody has
    estimated."""
    if pose is None:
        yield "unknown"
        return
    # An origin of the CRS would make places of a frame that has none look like those of a map.
    x, y, z = np.array(pose.center_m) + np.array(origin_m) * metric
    unit = "m" if metric else "units of arbitrary length"
    where = f" in frame own {frame}" if frame else ""
    exact = "" if rough else f", standard deviation {pose.sigma_position_m:.3g} {unit}"
    if not metric and pose.sigma_position_m > LOCAL_FLYING_HEIGHT:
        exact = ", its distance is not determined by the matches"
    yield f"x {x:.3f}, y {y:.3f}, z {z:.3f} {unit}{where}{exact}"
    if pose.world_rotation is not None:
        angles = ", ".join(f"{v:.4f}" for v in to_omega_phi_kappa(pose.world_rotation))
        yield f"omega, phi, kappa {angles} degrees, {tilt_deg(pose.world_rotation):.1f} from straight down"


def _pair(work: _Work, image0: Image, image1: Image, out: Path | None, *, rejected: bool) -> Shown:
    """Show a pair: how its matches were verified, and a picture of them."""
    workspace, ids = work.workspace, (image0.image_id, image1.image_id)
    pair = next((p for p in work.pairs if (p.image_id0, p.image_id1) == ids), None)
    if pair is None:
        raise InputError(
            f"{image0.name} and {image1.name} are not paired in {workspace.root}: pairs.csv lists the pairs"
        )
    found, raw = work.final(pair), work.matches(pair)
    if found is None or raw is None:
        raise InputError(f"{image0.name} and {image1.name} have no matches on file: run aeromatch match and filter")
    lines = [f"pair        {image0.name} and {image1.name}, paired by {pair.reason}"]
    if not np.isnan(pair.overlap):
        share = f"{100 * pair.overlap:.0f} % of the smaller footprint"
        lines.append(f"overlap     {share}, view angle {pair.view_angle_deg:.1f} degrees")
    verdict = found.verdict
    kept = found.matches if verdict.state == "verified" else None
    count = 0 if kept is None else len(kept.indices)
    lines.append(f"matches     {len(raw.matches.indices):,} by {raw.strategy}, {verdict.state}: {count:,} verified")
    sides = [work.keypoints_px(i) for i in ids]
    points = match_points(kept, *sides) if kept is not None else (np.zeros((0, 2)), np.zeros((0, 2)))
    lines += [*_verdict_of_pair(verdict), *_adjusted_lines(work, ids, points), *_pass_lines(workspace, ids)]
    dropped = match_points(raw.matches, *sides) if rejected or kept is None else None
    target = out or _own_file(workspace, f"{ids[0]}--{ids[1]}.png")
    words = f"green to yellow by error{', dropped ones red' if dropped is not None else ''}"
    pixels = [read_pixels(work.picture(image), colour=True) for image in (image0, image1)]
    tiles = [Tile(f"matches: {words}", pair_picture(pixels, points, verdict.errors_px, dropped))]
    kind, both = target.suffix.lower(), f"{image0.name} and {image1.name}"
    laid = aligned(pixels, points) if kind != ".png" else None
    if laid is not None:
        tiles.append(laid)
    elif kind == ".gif":
        raise InputError(f"{both} have too few matches to lay them on each other")
    write_tiles(target, tiles, lines, both)
    if kind != ".png":
        words = tiles[-1].title if kind == ".gif" else f"{words}; {tiles[-1].title}"
    lines.append(f"picture     {target}: {words}")
    facts = {"pair": [image0.name, image1.name], "verified": count, "state": verdict.state, "picture": str(target)}
    return Shown(lines, facts, target)


def _verdict_of_pair(verdict: Verdict) -> Iterator[str]:
    """Say why matches of a pair were dropped, and how large the errors of the others are."""
    if verdict.reason:
        yield f"            {verdict.reason}"
    for name, number in verdict.rejected.items():
        if number:
            stage = f"the stage {name}" if name == "consistency" else f"{name} of the stage filter"
            yield f"dropped     {number} by {stage}"
    if verdict.errors_px is not None and len(verdict.errors_px):
        low, middle, high = np.nanpercentile(verdict.errors_px, [5, 50, 95])
        yield f"errors      median {middle:.2f} px, 90 % between {low:.2f} and {high:.2f} px"


def _adjusted_lines(work: _Work, ids: tuple[str, str], points: tuple[FloatArray, FloatArray]) -> Iterator[str]:
    """Say how far the matches (M, 2) of a pair that are left lie off the adjusted poses, and why the stage consistency
    has left matches that contradict these."""
    block = work.adjusted
    if block is None or not len(points[0]) or not block.poses.keys() >= set(ids):
        return
    if block.frames.get(ids[0], 0) == block.frames.get(ids[1], 0):
        camera0, camera1 = (block.cameras[work.images[i].camera_id] for i in ids)
        pose0, pose1 = (Pose(block.poses[i].center_m, block.poses[i].rotation, 0.0, 0.0) for i in ids)
        matrix = fundamental_from_poses(camera0, pose0, camera1, pose1)
        places = undistort(camera0, points[0]), undistort(camera1, points[1])
        middle, far = np.nanpercentile(symmetric_distance_px(matrix, *places), [50, 95])
        off = f"median {middle:.2f} px off the epipolar lines of the adjusted poses, 95 % within {far:.2f} px"
        yield f"adjusted    {off}"
    found = result_on_file(work.workspace, ConsistencyResult)
    for image_id in sorted(set(ids) & set([] if found is None else found.doubtful)):
        yield (
            f"consistency most matches of {work.names[image_id]} contradict its adjusted pose: the stage doubts the "
            "pose, and has dropped none of its matches"
        )


def _pass_lines(workspace: Workspace, ids: tuple[str, str]) -> Iterator[str]:
    """Say which steps of a cascade a pair took, and why."""
    rows = read_csv(workspace.steps) if workspace.steps.is_file() else []
    row = next((row for row in rows if (row["image_id0"], row["image_id1"]) == ids), None)
    if row is not None:
        before = " (counted before the stage consistency dropped matches)"
        yield f"steps       {row['steps']}{': ' + row['reasons'] + before if row['reasons'] else ''}"


def _file_lines(path: Path) -> Iterator[str]:
    """Arrays of an .npz, keys of a .json, columns of a .csv."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with readable(path, *ARCHIVE_FAULTS), np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                yield f"{name:<28} {array.dtype!s:<10} {array.shape}{_range(array)}"
    elif suffix == ".json":
        yield from json.dumps(_stated(path), indent=2, ensure_ascii=False).splitlines()
    elif suffix == ".csv":
        rows = read_csv(path)
        yield counted(len(rows), "row")
        for name in rows[0] if rows else ():
            values = Counter(row[name] for row in rows)
            often = ", ".join(f"{value or 'empty'} ({count})" for value, count in values.most_common(3))
            yield f"{name:<20} {len(values)} different: {often}"
    else:
        raise ConfigError(f"{path}: show reads .npz, .json and .csv files of a workspace, and workspaces")


def _stated(path: Path) -> Any:
    """Contents of a JSON file: the workspace's own with their checksum, exported ones have none."""
    with readable(path, ValueError):
        value = json.loads(path.read_text(encoding="utf-8"))
    return read_json(path) if isinstance(value, dict) and "checksum" in value else value


def _range(array: Any) -> str:
    """Return the range of an array of numbers, the first values of one of text."""
    if not array.size:
        return ""
    if array.dtype.kind in "fiu":
        return f", {np.nanmin(array):.6g} to {np.nanmax(array):.6g}"
    if array.dtype.kind == "U":
        return f", {', '.join(map(str, array.ravel()[:3]))}"
    return ""
