"""This module compares an adjusted block with surveyed points: a similarity, and its errors at points that it does not
use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, ControlPoint, FloatArray
from aeromatch_cli.geometry.cameras import project, world_rays
from aeromatch_cli.results.adjustment import Control, Similarity, Xyz, xyz
from aeromatch_cli.sfm.georeferencing import similarity

# A similarity has seven unknowns: three points determine it, a fourth tells how well.
_LEAST_POINTS = 3
# Coordinates of image points that determine a point: of two images, inside what their lens models hold for.
_LEAST_RAYS = 4
# Points lie on one line, or in one place, where their extent across it is a smaller share of that along it.
_LINE = 1e-3
# A point is doubtful without which, of so many, the errors of the others are smaller by this factor.
_TELLING_POINTS, _DOUBTFUL = 5, 5.0
# Derivatives are those of steps of this share of the distance from the camera.
_STEP = 1e-5


def control_figures(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], points: Sequence[ControlPoint], *, metric: bool = True
) -> Control:
    """Return the similarity from the adjusted block to surveyed points, and errors at them.

    cameras: image_id -> adjusted camera. metric: whether lengths of the block are metres. Errors are determined at the
    check points; without any, at every control point under the transformation of the others (leave-one-out). Without
    three control points residuals are those of the block as it is.
    """
    rays = {point.name: _rays(adjusted, cameras, point) for point in points}
    in_block = _in_block(adjusted, cameras, points, rays)
    seen = [point for point in points if point.name in in_block]
    control = [point for point in seen if not point.check]
    checks = [point for point in seen if point.check]
    fit = _fit(control, in_block) if _determine_similarity(control, in_block) else None
    result = Control(
        points=len(points),
        control=len(control),
        check=len(checks),
        **_figures_in_images(adjusted, cameras, seen, rays, in_block),
    )
    if seen and (metric or fit is not None):
        result = result.model_copy(update=_residuals(adjusted, cameras, [*control, *checks], in_block, fit))
    if fit is None:
        return result
    kind, independent = _independent_errors(fit, control, checks, in_block)
    off_m = np.array([point.position_m - in_block[point.name] for point in control])
    return result.model_copy(
        update={
            "offset_m": xyz(np.round(np.median(off_m, axis=0), 3)) if metric else None,
            "transformation": _described(fit),
            "control_rmse_m": _rmse(_errors(fit, control, in_block)),
            "check_rmse_m": _rmse(independent),
            "check_kind": kind,
            "doubtful": _doubtful(control, in_block),
        }
    )


def _figures_in_images(
    adjusted: AdjustedBlock,
    cameras: Mapping[str, Camera],
    seen: Sequence[ControlPoint],
    rays: Mapping[str, tuple[FloatArray, FloatArray]],
    in_block: Mapping[str, FloatArray],
) -> dict[str, Any]:
    """Return fields of Control: points that their images do not determine, and residuals in images of those seen."""
    in_images = {name: len(directions) for name, (_, directions) in rays.items()}
    residuals_px = {p.name: _image_residuals(adjusted, cameras, p, in_block[p.name]) for p in seen}
    return {
        "not_measured_in_two_images": sorted(name for name, count in in_images.items() if count < 2),
        "rays_do_not_meet": sorted(name for name, count in in_images.items() if count > 1 and name not in in_block),
        "image_residuals_px": residuals_px,
        "reprojection_error_px": _rms_length([one for own in residuals_px.values() for one in own.values()]),
    }


def _in_block(
    adjusted: AdjustedBlock,
    cameras: Mapping[str, Camera],
    points: Sequence[ControlPoint],
    rays: Mapping[str, tuple[FloatArray, FloatArray]],
) -> dict[str, FloatArray]:
    """Return name -> place (3,) in the block of the points that enough image coordinates determine. rays: by name."""
    found = {}
    for point in points:
        place = intersected(*rays[point.name])
        if place is not None and len(_pixel_moves(adjusted, cameras, point, place)) >= _LEAST_RAYS:
            found[point.name] = place
    return found


_Fit = tuple[float, FloatArray, FloatArray]


def _determine_similarity(points: Sequence[ControlPoint], in_block: Mapping[str, FloatArray]) -> bool:
    """Whether there are three points, neither as surveyed nor in the block on one line."""
    if len(points) < _LEAST_POINTS:
        return False
    for places in ([point.position_m for point in points], [in_block[point.name] for point in points]):
        centred = np.array(places) - np.mean(places, axis=0)
        along, across, _ = np.linalg.svd(centred, compute_uv=False)
        if across <= _LINE * along:
            return False
    return True


def _residuals(
    adjusted: AdjustedBlock,
    cameras: Mapping[str, Camera],
    points: Sequence[ControlPoint],
    in_block: Mapping[str, FloatArray],
    fit: _Fit | None,
) -> dict[str, Any]:
    """Fields of Control: residuals after the transformation, and their standard deviations by what was stated of survey
    and image measurements. points: those that are seen. fit: None for the block as it is."""
    placed = fit if fit is not None else (1.0, np.eye(3), np.zeros(3))
    turned = np.linalg.inv(placed[0] * placed[1])
    moves = {p.name: _pixel_moves(adjusted, cameras, p, in_block[p.name]) @ turned for p in points}
    sigmas_m = {p.name: np.hypot(p.sigmas_m, _measured_sigmas_m(moves[p.name], p.sigma_px)) for p in points}
    checks = [point.name for point in points if point.check]
    counting = checks or [point.name for point in points]
    errors_m = _errors(placed, points, in_block)
    return {
        "point_sigmas_m": {name: xyz(float(f"{v:.4g}") for v in own) for name, own in sigmas_m.items()},
        "sigmas_m": xyz(np.median([sigmas_m[name] for name in counting], axis=0)),
        "residuals": {point.name: xyz(np.round(error, 4)) for point, error in zip(points, errors_m, strict=True)},
        "checks": checks,
        "ground_pixel_m": 1.0 / float(np.median(np.linalg.norm(np.concatenate([*moves.values()]), axis=1))),
    }


def _independent_errors(
    fit: _Fit, control: Sequence[ControlPoint], checks: Sequence[ControlPoint], in_block: Mapping[str, FloatArray]
) -> tuple[Literal["check points", "leave one out"] | None, FloatArray]:
    """At which points errors are independent of the fit, and these errors (N, 3)."""
    if checks:
        return "check points", _errors(fit, checks, in_block)
    if len(control) <= _LEAST_POINTS:
        return None, np.zeros((0, 3))
    others = [[one for one in control if one is not point] for point in control]
    errors = [
        _errors(_fit(rest, in_block), [point], in_block)
        for rest, point in zip(others, control, strict=True)
        if _determine_similarity(rest, in_block)
    ]
    return ("leave one out", np.concatenate(errors)) if errors else (None, np.zeros((0, 3)))


def offset_words(control: Control) -> str:
    """Say in words how the exported block lies to the control points, of which there are three or more."""
    assert control.transformation is not None
    scale = control.transformation.scale
    if control.offset_m is None:
        return f"to fit them the exported block is to be scaled to {scale:.4g} m per unit"
    offset = ", ".join(f"{axis} {off:+.2f}" for axis, off in zip("xyz", control.offset_m, strict=True))
    share = 100.0 * (scale - 1.0)
    size = f"{abs(share):.2f} % {'larger' if share >= 0.0 else 'smaller'}"
    return f"to fit them the exported block is to be moved by {offset} m and made {size}"


def _rays(adjusted: AdjustedBlock, cameras: Mapping[str, Camera], point: ControlPoint) -> tuple[FloatArray, FloatArray]:
    """Projection centres and unit directions (N, 3) in the world of all oriented images that measure a point."""
    rays, centers = [], []
    for image_id, pixel in point.pixels.items():
        pose = adjusted.poses.get(image_id)
        if pose is not None:
            rays.append(world_rays(cameras[image_id], pose.rotation, pixel[None])[0])
            centers.append(pose.center_m)
    return np.array(centers).reshape(-1, 3), np.array(rays).reshape(-1, 3)


def intersected(centers_m: FloatArray, rays: FloatArray) -> FloatArray | None:
    """Return the world point (3,) nearest to the rays; None below two, where they are parallel or meet behind a
    camera."""
    if len(rays) < 2 or not np.isfinite(rays).all():
        return None
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e10:
        return None
    place = np.asarray(np.linalg.solve(normal, np.einsum("nij,nj->i", across, centers_m)))
    return place if (((place - centers_m) * rays).sum(axis=1) > 0.0).all() else None


def _fit(points: Sequence[ControlPoint], found: Mapping[str, FloatArray]) -> _Fit:
    return similarity(np.array([found[p.name] for p in points]), np.array([p.position_m for p in points]))


def _errors(fit: _Fit, points: Sequence[ControlPoint], found: Mapping[str, FloatArray]) -> FloatArray:
    """(N, 3) transformed minus surveyed, metres."""
    scale, rotation, shift_m = fit
    moved = np.array([scale * rotation @ found[p.name] + shift_m for p in points]).reshape(-1, 3)
    return np.asarray(moved - np.array([p.position_m for p in points]).reshape(-1, 3))


def _doubtful(control: Sequence[ControlPoint], found: Mapping[str, FloatArray]) -> list[str]:
    """Names of points without which the others agree much better, the worst first."""
    names: list[str] = []
    left = list(control)
    while len(left) >= _TELLING_POINTS:
        whole_m = float(np.linalg.norm(_errors(_fit(left, found), left, found)))
        rests = [[one for one in left if one is not point] for point in left]
        if not all(_determine_similarity(rest, found) for rest in rests):
            break
        rest_m = [float(np.linalg.norm(_errors(_fit(rest, found), rest, found))) for rest in rests]
        worst = int(np.argmin(rest_m))
        if _DOUBTFUL * rest_m[worst] >= whole_m:
            break
        names.append(left[worst].name)
        left = rests[worst]
    return names


def _described(fit: _Fit) -> Similarity:
    from scipy.spatial.transform import Rotation

    scale, rotation, shift_m = fit
    turn_deg = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    return Similarity(scale=float(scale), rotation_vector_deg=xyz(turn_deg), shift_m=xyz(shift_m))


def _rmse(errors: FloatArray) -> Xyz | None:
    return xyz(np.round(np.sqrt((errors**2).mean(axis=0)), 4)) if len(errors) else None


def _image_residuals(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], point: ControlPoint, place: FloatArray
) -> dict[str, tuple[float, float]]:
    """image_id -> x, y of the measured pixel less that of a place in the block. Where a point is far off, it may lie
    outside what the lens model holds for: such images are left out."""
    found = {}
    for image_id, pixel in point.pixels.items():
        pose = adjusted.poses.get(image_id)
        if pose is not None:
            off_px = pixel - project(cameras[image_id], pose.rotation, pose.center_m, place[None])[0]
            if np.isfinite(off_px).all():
                found[image_id] = round(float(off_px[0]), 3), round(float(off_px[1]), 3)
    return found


def _rms_length(residuals: Sequence[Sequence[float]]) -> float | None:
    """Root mean square of the lengths of residuals (x, y); None of none."""
    return round(float(np.sqrt((np.array(residuals) ** 2).sum(axis=1).mean())), 3) if residuals else None


def _pixel_moves(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], point: ControlPoint, place: FloatArray
) -> FloatArray:
    """(2 n, 3) by how many pixels the images of a point move where it moves by one unit along x, y and z."""
    moves = []
    for image_id in point.pixels:
        pose = adjusted.poses.get(image_id)
        if pose is not None:
            step = _STEP * float(np.linalg.norm(place - pose.center_m))
            ends = place + step * np.concatenate([np.eye(3), -np.eye(3)])
            pixels = project(cameras[image_id], pose.rotation, pose.center_m, ends)
            moves.append((pixels[:3] - pixels[3:]).T / (2.0 * step))
    found = np.concatenate(moves)
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def _measured_sigmas_m(moves: FloatArray, sigma_px: float) -> FloatArray:
    """(3,) standard deviations of a point whose image measurements have `sigma_px`. moves: as of _pixel_moves."""
    return np.asarray(sigma_px * np.sqrt(np.diag(np.linalg.pinv(moves.T @ moves))))
