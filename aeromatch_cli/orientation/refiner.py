"""The refiner's own process: a COLMAP database, poses and given positions in; adjusted models with their points out.

Run as a module: FOLDER, which holds database.db, sparse/ (poses without points), task.json and priors.npz; model<k>.npz
and result.json are written into it. See `mapping`, and `mapper` for why it is a process of its own.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.adjusting import (
    MIN_OBSERVATIONS,
    Attitudes,
    adjust_in_place,
    adjusted,
    believed_tilts,
    connected_parts,
    drop_weak_images,
    images_by_camera,
    keep_images,
)
from aeromatch_cli.orientation.joining import Part, joined
from aeromatch_cli.orientation.process import quiet_pycolmap
from aeromatch_cli.orientation.results import BEHIND_PX, arrays, figures, image_numbers, sigmas_of, tracks_of
from aeromatch_cli.orientation.spread import take_poses, thinned

# Points are made and poses adjusted again while that takes away this share of the reprojection error.
_WORTH_AGAIN = 0.1
_MAX_ROUNDS = 3
# An adjustment ends when a step lowers the cost by a smaller share. With 1e-4 it takes a third of the time, and heights
# of check points come out four times as bad.
_COST_TOLERANCE = 1e-6
# Fewer images make no group.
_FEWEST_IMAGES = 3
# With fewer points of three images or more, those of two count as well.
_FEW_OBSERVATIONS = 50
# An image is tied by so many points of those that it shares with the block, a quarter of them at least.
_FEWEST_INLIERS = 8
# Elements of rotations that were written and read again.
_SAME = 1e-6
_NONE = np.zeros(0)
_NOWHERE = np.full(3, np.nan)
# Poses that are not exact yet: points of the first round may be so far off, and are filtered as usual from then on.
_FIRST_ERROR_PX = 12.0


def refine(folder: Path) -> None:
    """Triangulate and adjust every group of posed images, and tie further images to it, to the largest group first.

    A group whose parts share no points becomes several, each placed by itself.
    """
    pycolmap = quiet_pycolmap()
    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    priors = {**np.load(folder / "priors.npz"), "level_deg": np.array(np.inf)}
    facts: list[dict[str, Any]] = []
    waiting = deque(task["groups"])
    if len(waiting) > 1 and not task["fixed"]:
        waiting = deque(_joined_groups(pycolmap, folder, task["groups"]))
    grouped = {number for group in task["groups"] for number in group["images"]}
    lenses: dict[int, FloatArray] = {}
    while waiting:
        group = waiting.popleft()
        free = not task["fixed"]
        observed = priors if group["kind"] != "level" else _without_positions(priors)
        model = _posed(pycolmap, folder, set(group["images"]))
        _take(model, lenses)
        model = _triangulated(pycolmap, model, folder, rough=_found(group["kind"]) and free)
        if free and group["kind"] != "given":
            parts = connected_parts(model)
            if not parts:
                continue
            keep_images(model, parts[0])
            waiting.extend({**group, "images": part} for part in parts[1:] if len(part) >= _FEWEST_IMAGES)
        attitudes = _attitudes(model, priors) if group["kind"] == "given" else Attitudes((), np.zeros((0, 3, 3)), _NONE)
        registered: list[int] = []
        if free:
            if task["more"]:
                model, registered = _grown(pycolmap, model, folder, grouped - set(group["images"]))
                grouped |= set(registered)
                model = _triangulated(pycolmap, model, folder, rough=False) if registered else model
            work = _Work(pycolmap, folder, task["cameras"], frozenset(lenses))
            model, observed = _refined(work, model, group["kind"], observed, attitudes)
        model.update_point_3d_errors()
        _once_per_image(model)
        _drop_weak_points(model)
        drop_weak_images(model)
        if not image_numbers(model):
            continue
        lenses |= {n: np.array(model.cameras[n].params) for n in images_by_camera(model) if n not in lenses}
        name = f"model{len(facts)}.npz"
        angles_deg = dict(zip(attitudes.images, attitudes.sigmas_deg.tolist(), strict=True))
        deviations = sigmas_of(model, observed["sigmas_m"], task["cameras"], angles_deg, float(observed["level_deg"]))
        np.savez(folder / name, **arrays(model), **tracks_of(model), **deviations)
        facts.append({"file": name, "kind": group["kind"], "registered": registered, **figures(model)})
    (folder / "result.json").write_text(json.dumps({"models": facts}), encoding="utf-8")


def _joined_groups(pycolmap: ModuleType, folder: Path, groups: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Groups of which those that final matches tie are one; the poses on file are moved with them."""
    parts = []
    for group in sorted(groups, key=lambda one: (one["kind"] == "level", -len(one["images"]))):
        model = _triangulated(pycolmap, _posed(pycolmap, folder, set(group["images"])), folder, rough=True)
        parts.append(_part(group["kind"], model))
    with pycolmap.Database.open(folder / "database.db") as opened:
        seen = zip(*opened.read_two_view_geometries(), strict=True)
        matches = {tuple(pycolmap.pair_id_to_image_pair(k)): found.inlier_matches for k, found in seen}
    found = joined(parts, matches)
    if len(found) < len(parts):
        model = pycolmap.Reconstruction(folder / "sparse")
        for part in found:
            for number, rotation in part.rotations.items():
                pose = np.column_stack([rotation, -rotation @ part.centers_m[number]])
                image = model.images[number]
                image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))
        model.write(folder / "sparse")
    found.sort(key=lambda part: -len(part.rotations))
    return [{"kind": part.kind, "images": sorted(part.rotations)} for part in found]


def _part(kind: str, model: Any) -> Part:
    images = {number: model.images[number] for number in image_numbers(model)}
    points_m = {
        number: np.array([model.points3D[p.point3D_id].xyz if p.has_point3D() else _NOWHERE for p in image.points2D])
        for number, image in images.items()
    }
    return Part(
        kind,
        {number: image.cam_from_world().rotation.matrix() for number, image in images.items()},
        {number: image.projection_center() for number, image in images.items()},
        {number: points.reshape(-1, 3) for number, points in points_m.items()},
    )


def _without_positions(priors: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Of a group in a frame of its own: given positions are not observations there."""
    unknown = {name: np.full_like(priors[name], np.nan) for name in ("positions_m", "sigmas_m")}
    return {**priors, **unknown}


@dataclass(frozen=True)
class _Work:
    """What the adjustments of a group share. cameras: priors by number. held: those that a larger group has found."""

    pycolmap: ModuleType
    folder: Path
    cameras: dict[str, Any]
    held: frozenset[int]


def _take(model: Any, lenses: Mapping[int, FloatArray]) -> None:
    """Give a model the cameras that a larger group has found: each is one and the same for all groups."""
    for number, params in lenses.items():
        if number in model.cameras:
            model.cameras[number].params = params


def _refined(
    work: _Work, model: Any, kind: str, observed: dict[str, FloatArray], attitudes: Attitudes
) -> tuple[Any, dict[str, FloatArray]]:
    """The model adjusted and triangulated in turn, while that makes it better; and the observations that it used."""
    pycolmap, cameras = work.pycolmap, work.cameras
    positions_m, sigmas_m = observed["positions_m"], observed["sigmas_m"]
    if kind == "positions":
        tilts = believed_tilts(pycolmap, model, positions_m, sigmas_m, observed["ups"], observed["rotations"])
        observed = {**observed, "ups": tilts}
    used, level_deg, factor = image_numbers(model), np.inf, 1.0
    for number in range(_MAX_ROUNDS):
        if model.num_points3D() < MIN_OBSERVATIONS:
            break
        thin = thinned(model)
        moved = model if thin is None else thin
        moved.update_point_3d_errors()
        before = moved.compute_mean_reprojection_error()
        given = positions_m, sigmas_m
        if kind == "positions":
            placement = adjusted(pycolmap, moved, cameras, *given, observed["ups"], _COST_TOLERANCE, work.held)
            level_deg, factor = placement.level_sigma_deg, placement.sigma_factor
            used = [i for i, agrees in zip(image_numbers(moved), placement.agreeing, strict=True) if agrees]
        else:
            used = adjust_in_place(pycolmap, moved, cameras, *given, attitudes, _COST_TOLERANCE, work.held)
        moved.update_point_3d_errors()
        settled = moved.compute_mean_reprojection_error() > (1.0 - _WORTH_AGAIN) * before
        settled = settled and not (number == 0 and _found(kind))
        if settled and thin is None:
            break
        if thin is not None:
            take_poses(model, thin)
        model = _triangulated(pycolmap, model, work.folder, rough=False)
        if settled:
            break
    unused = np.setdiff1d(np.arange(len(sigmas_m)), np.array(used, dtype=int) - 1)
    # Precision rests on these. An adjustment bends a weak block to its positions: that they fit shows nothing better.
    sigmas_m = max(factor, 1.0) * sigmas_m
    sigmas_m[unused] = np.nan
    return model, {**observed, "sigmas_m": sigmas_m, "level_deg": np.array(level_deg)}


def _found(kind: str) -> bool:
    """Whether the poses of a group come from the first pass, and are less exact than matches of the final one."""
    return kind != "given"


def _posed(pycolmap: ModuleType, folder: Path, numbers: set[int]) -> Any:
    """The given poses of some images."""
    model = pycolmap.Reconstruction(folder / "sparse")
    for image in list(model.images.values()):
        if image.has_pose and image.image_id not in numbers:
            model.deregister_frame(image.frame_id)
    return model


def _attitudes(model: Any, priors: Mapping[str, FloatArray]) -> Attitudes:
    """Given attitudes of the images that have them still: those that were corrected tell nothing."""
    rows, now = [], model.images
    for row, given in enumerate(priors["rotations"]):
        if row + 1 in now and now[row + 1].has_pose and np.isfinite(given).all():
            found = now[row + 1].cam_from_world().rotation.matrix()
            if np.abs(found - given).max() < _SAME:
                rows.append(row)
    return Attitudes(tuple(row + 1 for row in rows), priors["rotations"][rows], priors["sigmas_deg"][rows])


def _triangulated(pycolmap: ModuleType, model: Any, folder: Path, rough: bool) -> Any:
    """The model with points of three images and more, and of two where an image has few others."""
    options = _options(pycolmap)
    if rough:
        options.mapper.filter_max_reproj_error = _FIRST_ERROR_PX
        options.triangulation.create_max_angle_error *= 3.0
        options.triangulation.continue_max_angle_error *= 3.0
        options.triangulation.complete_max_reproj_error = _FIRST_ERROR_PX
        options.triangulation.merge_max_reproj_error = _FIRST_ERROR_PX
    # The poses stand: `adjusted` weighs them with the given positions.
    out = folder / "triangulated"
    out.mkdir(exist_ok=True)
    model = pycolmap.triangulate_points(model, folder / "database.db", out, out, True, options, False)
    if _weak_images(model):
        options.triangulation.ignore_two_view_tracks = False
        model = pycolmap.triangulate_points(model, folder / "database.db", out, out, True, options, False)
    return model


def _weak_images(model: Any) -> set[int]:
    """Numbers of images with few points that three images see."""
    strong: Counter[int] = Counter()
    for point in model.points3D.values():
        seen = [element.image_id for element in point.track.elements]
        if len(seen) > 2:
            strong.update(seen)
    return {number for number in image_numbers(model) if strong[number] < _FEW_OBSERVATIONS}


def _once_per_image(model: Any) -> None:
    """Of two keypoints of an image that see one point the nearer to its projection stays: merged tracks have both."""
    for number, point in list(model.points3D.items()):
        images = [element.image_id for element in point.track.elements]
        if len(set(images)) == len(images):
            continue
        off: dict[int, list[tuple[float, int]]] = {}
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.project_point(point.xyz)
            apart = np.inf if seen is None else float(np.linalg.norm(image.points2D[element.point2D_idx].xy - seen))
            off.setdefault(element.image_id, []).append((apart, element.point2D_idx))
        for image_id, places in off.items():
            for _, keypoint in sorted(places)[1:]:
                if number in model.points3D:
                    model.delete_observation(image_id, keypoint)


def _drop_weak_points(model: Any) -> None:
    """Points behind a camera or without a place, by errors that are up to date, go; those of two images hold only
    images that have few others."""
    weak = _weak_images(model)
    for number, point in list(model.points3D.items()):
        seen = {element.image_id for element in point.track.elements}
        if not point.error < BEHIND_PX or (len(seen) < 3 and not seen & weak):
            model.delete_point3D(number)


def _grown(pycolmap: ModuleType, model: Any, folder: Path, others: set[int]) -> tuple[Any, list[int]]:
    """The model with further images resected from its points, and their numbers. others: images of other groups."""
    before = {image.image_id for image in model.images.values() if image.has_pose}
    start, out = folder / "grown_from", folder / "grown"
    for path in (start, out):
        path.mkdir(exist_ok=True)
    model.write(start)
    options = _options(pycolmap)
    options.fix_existing_frames = True  # the frame of the world, and the time
    options.multiple_models = False
    with pycolmap.Database.open(folder / "database.db") as opened:
        options.image_names = [image.name for image in opened.read_all_images() if image.image_id not in others]
    options.mapper.abs_pose_min_num_inliers = _FEWEST_INLIERS
    found = pycolmap.incremental_mapping(folder / "database.db", out, out, options=options, input_path=start)
    grown = max(found.values(), key=lambda one: one.num_reg_images(), default=model)
    return grown, sorted({i.image_id for i in grown.images.values() if i.has_pose} - before)


def _options(pycolmap: ModuleType) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    return options


if __name__ == "__main__":
    refine(Path(sys.argv[1]))
