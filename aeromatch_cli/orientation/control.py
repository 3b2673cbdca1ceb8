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


def control_figures(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], points: Sequence[ControlPoint]
) -> dict[str, Any]:
    """Transformation from the adjusted block to the points, and root mean square errors; JSON-ready.

    cameras: image_id -> adjusted camera. `check_rmse_m` (x, y, z) is of the check points; without any, of every control
    point under the transformation of the others (leave-one-out). `offset_m`: from the block as it is to the surveyed
    positions, median over the control points. `doubtful`: control points that the others contradict.
    `residuals`: name -> x, y, z after the transformation; `checks`: names; `point_sigmas_m`, `sigmas_m`: standard
    deviations stated of each, and the median of those at which errors count. `rays_do_not_meet`: points whose rays are
    parallel or meet behind a camera, which are left out. None where too few are left.
    """
    rays = {point.name: _rays(adjusted, cameras, point) for point in points}
    found = {point.name: intersected(*rays[point.name]) for point in points}
    seen = [point for point in points if found[point.name] is not None]
    control = [point for point in seen if not point.check]
    checks = [point for point in seen if point.check]
    figures: dict[str, Any] = {
        "points": len(points),
        "control": len(control),
        "check": len(checks),
        "not_measured_in_two_images": sorted(name for name, (_, directions) in rays.items() if len(directions) < 2),
        "rays_do_not_meet": sorted(
            name for name, (_, directions) in rays.items() if len(directions) > 1 and found[name] is None
        ),
    }
    if len(control) < _LEAST_POINTS:
        unknown = ("offset_m", "transformation", "control_rmse_m", "check_rmse_m", "check_kind")
        return figures | dict.fromkeys(unknown) | {"doubtful": []}
    in_block = {name: place for name, place in found.items() if place is not None}
    fit = _fit(control, in_block)
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
        "offset_m": [round(float(v), 3) for v in np.median(off_m, axis=0)],
        "transformation": _described(fit),
        "control_rmse_m": _rmse(own),
        "check_rmse_m": _rmse(independent),
        "check_kind": kind,
        "doubtful": _doubtful(control, in_block),
        "residuals": {
            point.name: [round(float(v), 4) for v in error]
            for point, error in zip([*control, *checks], _errors(fit, [*control, *checks], in_block), strict=True)
        },
        "checks": [point.name for point in checks],
        "point_sigmas_m": {point.name: list(point.sigmas_m) for point in [*control, *checks]},
        "sigmas_m": np.median([point.sigmas_m for point in checks or control], axis=0).tolist(),
        "reprojection_error_px": _pixel_error(adjusted, cameras, seen, in_block),
    }


def offset_words(figures: Mapping[str, Any]) -> str:
    """How the block, as it is exported, lies to the control points."""
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


def _pixel_error(
    adjusted: AdjustedBlock,
    cameras: Mapping[str, Camera],
    points: Sequence[ControlPoint],
    found: Mapping[str, FloatArray],
) -> float | None:
    """Root mean square distance of the measured pixels from those of the intersected points."""
    off = []
    for point in points:
        for image_id, pixel in point.pixels.items():
            pose = adjusted.poses.get(image_id)
            if pose is not None:
                off.append(project(cameras[image_id], pose.rotation, pose.center_m, found[point.name][None])[0] - pixel)
    # Where a point is far off, it may lie outside what the lens model holds for.
    squares = (np.array(off).reshape(-1, 2) ** 2).sum(axis=1)
    squares = squares[np.isfinite(squares)]
    return round(float(np.sqrt(squares.mean())), 3) if len(squares) else None
