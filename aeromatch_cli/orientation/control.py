"""How well an adjusted block lies on surveyed points: a similarity, and its errors at points that it does not use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, ControlPoint, FloatArray
from aeromatch_cli.geometry.cameras import project, world_rays
from aeromatch_cli.orientation.placing import similarity

# A similarity has seven unknowns: three points determine it, a fourth tells how well.
_LEAST_POINTS = 3
# A point is doubtful without which, of so many, the errors of the others are smaller by this factor.
_TELLING_POINTS, _DOUBTFUL = 5, 5.0
# Derivatives are those of steps of this share of the distance from the camera.
_STEP = 1e-5


def control_figures(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], points: Sequence[ControlPoint], *, metric: bool = True
) -> dict[str, Any]:
    """Transformation from the adjusted block to the points, and root mean square errors; JSON-ready.

    cameras: image_id -> adjusted camera. metric: whether lengths of the block are metres. `check_rmse_m` (x, y, z) is
    of the check points; without any, of every control point under the transformation of the others (leave-one-out).
    `offset_m`: from the block as it is to the surveyed positions, median over the control points, None of a block
    without metres. `doubtful`: control points that the others contradict. `residuals`: name -> x, y, z after the
    transformation, of a block that none is known of as it is; `checks`: names; `point_sigmas_m`, `sigmas_m`: standard
    deviations of these residuals by what was stated of survey and image measurements, and the median of those at which
    errors count. `image_residuals_px`: name -> image_id -> x, y, measured less seen where the rays meet.
    `ground_pixel_m`: what a pixel is at the points. `rays_do_not_meet`: points whose rays are parallel or meet behind a
    camera, which are left out. None where too few are left.
    """
    rays = {point.name: _rays(adjusted, cameras, point) for point in points}
    found = {point.name: intersected(*rays[point.name]) for point in points}
    seen = [point for point in points if found[point.name] is not None]
    in_block = {name: place for name, place in found.items() if place is not None}
    control = [point for point in seen if not point.check]
    checks = [point for point in seen if point.check]
    fit = _fit(control, in_block) if len(control) >= _LEAST_POINTS else None
    image_residuals = {p.name: _image_residuals(adjusted, cameras, p, in_block[p.name]) for p in seen}
    figures: dict[str, Any] = {
        "points": len(points),
        "control": len(control),
        "check": len(checks),
        "not_measured_in_two_images": sorted(name for name, (_, directions) in rays.items() if len(directions) < 2),
        "rays_do_not_meet": sorted(
            name for name, (_, directions) in rays.items() if len(directions) > 1 and found[name] is None
        ),
        "image_residuals_px": image_residuals,
        "reprojection_error_px": _rms_length([one for own in image_residuals.values() for one in own.values()]),
    }
    if seen and (metric or fit is not None):
        placed = fit if fit is not None else (1.0, np.eye(3), np.zeros(3))
        turned = np.linalg.inv(placed[0] * placed[1])
        moves = {p.name: _pixel_moves(adjusted, cameras, p, in_block[p.name]) @ turned for p in seen}
        sigmas_m = {p.name: np.hypot(p.sigmas_m, _measured_sigmas_m(moves[p.name], p.sigma_px)) for p in seen}
        figures |= {
            "point_sigmas_m": {name: [float(f"{v:.4g}") for v in own] for name, own in sigmas_m.items()},
            "sigmas_m": np.median([sigmas_m[p.name] for p in checks or control], axis=0).tolist(),
            "residuals": {
                point.name: [round(float(v), 4) for v in error]
                for point, error in zip(
                    [*control, *checks], _errors(placed, [*control, *checks], in_block), strict=True
                )
            },
            "checks": [point.name for point in checks],
            "ground_pixel_m": 1.0 / float(np.median(np.linalg.norm(np.concatenate([*moves.values()]), axis=1))),
        }
    if fit is None:
        unknown = ("offset_m", "transformation", "control_rmse_m", "check_rmse_m", "check_kind")
        return figures | dict.fromkeys(unknown) | {"doubtful": []}
    own = _errors(fit, control, in_block)
    if checks:
        kind, independent = "check points", _errors(fit, checks, in_block)
    elif len(control) > _LEAST_POINTS:
        kind = "leave one out"
        others = [[one for one in control if one is not point] for point in control]
        independent = np.concatenate(
            [_errors(_fit(rest, in_block), [point], in_block) for rest, point in zip(others, control, strict=True)]
        )
    else:
        kind, independent = None, np.zeros((0, 3))
    off_m = np.array([point.position_m - in_block[point.name] for point in control])
    return figures | {
        "offset_m": [round(float(v), 3) for v in np.median(off_m, axis=0)] if metric else None,
        "transformation": _described(fit),
        "control_rmse_m": _rmse(own),
        "check_rmse_m": _rmse(independent),
        "check_kind": kind,
        "doubtful": _doubtful(control, in_block),
    }


def offset_words(figures: Mapping[str, Any]) -> str:
    """How the block, as it is exported, lies to the control points."""
    if figures["offset_m"] is None:
        return f"to fit them the exported block is to be scaled to {figures['transformation']['scale']:.4g} m per unit"
    offset = ", ".join(f"{axis} {off:+.2f}" for axis, off in zip("xyz", figures["offset_m"], strict=True))
    share = 100.0 * (figures["transformation"]["scale"] - 1.0)
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
    """World point (3,) nearest to the rays; None below two, where they are parallel or meet behind a camera."""
    if len(rays) < 2 or not np.isfinite(rays).all():
        return None
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e10:
        return None
    place = np.asarray(np.linalg.solve(normal, np.einsum("nij,nj->i", across, centers_m)))
    return place if (((place - centers_m) * rays).sum(axis=1) > 0.0).all() else None


def _fit(points: Sequence[ControlPoint], found: Mapping[str, FloatArray]) -> tuple[float, FloatArray, FloatArray]:
    return similarity(np.array([found[p.name] for p in points]), np.array([p.position_m for p in points]))


def _errors(
    fit: tuple[float, FloatArray, FloatArray], points: Sequence[ControlPoint], found: Mapping[str, FloatArray]
) -> FloatArray:
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
        rest_m = [float(np.linalg.norm(_errors(_fit(rest, found), rest, found))) for rest in rests]
        worst = int(np.argmin(rest_m))
        if _DOUBTFUL * rest_m[worst] >= whole_m:
            break
        names.append(left[worst].name)
        left = rests[worst]
    return names


def _described(fit: tuple[float, FloatArray, FloatArray]) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    scale, rotation, shift_m = fit
    turn_deg = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    return {"scale": scale, "rotation_vector_deg": turn_deg.tolist(), "shift_m": shift_m.tolist()}


def _rmse(errors: FloatArray) -> list[float] | None:
    return [round(float(v), 4) for v in np.sqrt((errors**2).mean(axis=0))] if len(errors) else None


def _image_residuals(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], point: ControlPoint, place: FloatArray
) -> dict[str, list[float]]:
    """image_id -> x, y of the measured pixel less that of a place in the block. Where a point is far off, it may lie
    outside what the lens model holds for: such images are left out."""
    found = {}
    for image_id, pixel in point.pixels.items():
        pose = adjusted.poses.get(image_id)
        if pose is not None:
            off_px = pixel - project(cameras[image_id], pose.rotation, pose.center_m, place[None])[0]
            if np.isfinite(off_px).all():
                found[image_id] = [round(float(v), 3) for v in off_px]
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
