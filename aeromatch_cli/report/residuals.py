"""Camera positions beside those given: a table of errors and a plan of them. No disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import AdjustedBlock, FloatArray, PoseResidual
from aeromatch_cli.geometry.frames import length_words
from aeromatch_cli.report.figures import COLOURS, PlanSize, plan_axes, round_length, svg
from aeromatch_cli.results.adjustment import GroupResult

_PLAN = PlanSize(9.0, (3.4, 6.0), bar=1.5)
# The arrow of this quantile is as long as this share of the usual distance between neighbouring cameras.
_USUAL, _SHARE = 0.9, 0.6
# Steps of the colours.
_COLOURS = 9
# Where all residuals are smaller than this, in metres, positions were held as they were given.
_NOTHING_M = 1e-6


@dataclass(frozen=True)
class ResidualSection:
    """What the page shows of given positions. rows: (what, X, Y, Z, XY, total) in words. plan: SVG, "" for none."""

    rows: tuple[tuple[str, ...], ...]
    plan: str
    words: str


def residual_section(
    adjusted: AdjustedBlock,
    residuals: Mapping[str, PoseResidual],
    names: Mapping[str, str],
    gsd_m: float | None,
    groups: Sequence[GroupResult] = (),
) -> ResidualSection | None:
    """Root mean squares of the position residuals and where they are, None where no position was given.

    names: of the files, by image_id. gsd_m: metres per pixel on the ground. groups: results of the adjustment.
    """
    ids = [i for i, one in residuals.items() if np.isfinite(one.position_m).all() and i in adjusted.poses]
    if not ids:
        return None
    offsets_m = np.array([residuals[i].position_m for i in ids])
    in_sigmas = np.array([residuals[i].position_sigmas for i in ids])
    rows = [("metres", *_errors(offsets_m, 3))]
    if gsd_m:
        rows.append(("pixels on the ground", *_errors(offsets_m / gsd_m, 2)))
    rows.append(("stated standard deviations", *_errors(in_sigmas, 2)[:3], "", ""))
    if np.abs(offsets_m).max() < _NOTHING_M:
        return ResidualSection(tuple(rows), "", "Positions stay as they were given.")
    worst = int(np.argmax(np.linalg.norm(offsets_m, axis=1)))
    far = length_words(float(np.linalg.norm(offsets_m[worst])), 3, metric=True)
    words = f"Root mean squares of {len(ids):,} positions, adjusted less given. Farthest: {names[ids[worst]]}, {far}."
    words += _weights(groups)
    centers_m = np.array([adjusted.poses[i].center_m for i in ids])
    if np.ptp(centers_m[:, :2], axis=0).max() <= 0.0:  # one camera, or all in one place: no plan
        return ResidualSection(tuple(rows), "", words)
    titles = [
        f"{names[i]}: x {x:+.3f} m, y {y:+.3f} m, z {z:+.3f} m" for i, (x, y, z) in zip(ids, offsets_m, strict=True)
    ]
    return ResidualSection(tuple(rows), _plan(centers_m, offsets_m, titles), words)


def _weights(groups: Sequence[GroupResult]) -> str:
    """How the adjustment weighs positions, in the group with most, and what its own residuals leave out."""
    most = max(groups, key=lambda one: one.positions.used if one.positions else 0, default=None)
    if most is None or most.positions is None:
        return ""
    across, up = most.positions.factors
    return (
        f" By what they are off the adjustment weighs them with {across:.1f} times the stated standard deviations "
        f"horizontally and {up:.1f} times vertically. Unlike in the verdict, drifts, shifts and delays of flights, "
        "antenna offsets and positions that are not used count here."
    )


def _errors(values: FloatArray, digits: int) -> tuple[str, ...]:
    """X, Y, Z, XY and total: root mean squares of residuals (N, 3)."""
    squares = (values**2).mean(axis=0)
    return tuple(f"{np.sqrt(one):,.{digits}f}" for one in (*squares, squares[:2].sum(), squares.sum()))


def _plan(centers_m: FloatArray, offsets_m: FloatArray, titles: list[str]) -> str:
    """An arrow for each camera (N, 3) from its given position, enlarged, and its residual in z as a colour. Not all
    cameras may be in one place."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
    from scipy.spatial import cKDTree

    low, high = centers_m[:, :2].min(axis=0), centers_m[:, :2].max(axis=0)
    near, _ = cKDTree(centers_m[:, :2]).query(centers_m[:, :2], k=2)
    spacing_m = float(np.median(near[:, 1])) or float((high - low).max())
    across_m = np.linalg.norm(offsets_m[:, :2], axis=1)
    usual_m = max(float(np.quantile(across_m, _USUAL)), _NOTHING_M)
    enlarged = _SHARE * spacing_m / usual_m
    axes = plan_axes(low - spacing_m, high + spacing_m, _PLAN, in_world=True)
    largest = max(float(np.abs(offsets_m[:, 2]).max()), _NOTHING_M)
    scale = LinearSegmentedColormap.from_list("height", [COLOURS["k0"], COLOURS["grid"], COLOURS["k4"]], N=_COLOURS)
    norm = BoundaryNorm(np.linspace(-largest, largest, _COLOURS + 1), _COLOURS)
    given = centers_m[:, :2] - offsets_m[:, :2]
    colour = np.clip(norm(offsets_m[:, 2]), 0, _COLOURS - 1)
    shown = {}
    for k in np.unique(colour):  # the cameras of one gid look alike
        style = {"facecolor": scale(k), "edgecolor": COLOURS["ink"], "linewidth": 0.7}
        axes.scatter(*given[colour == k].T, 34.0, zorder=4, gid=f"height{k}", **style)
        shown[f"height{k}"] = [title for title, own in zip(titles, colour == k, strict=True) if own]
    arrows = axes.quiver(
        *given.T, *(enlarged * offsets_m[:, :2]).T, angles="xy", scale_units="xy", scale=1.0, width=0.0028,
        color=COLOURS["ink"], zorder=3, gid="residual",
    )  # fmt: skip
    length_m = round_length(usual_m)
    axes.quiverkey(arrows, 0.88, 1.02, enlarged * length_m, f"{length_m:g} m", labelpos="E", color=COLOURS["ink"])
    place = axes.get_position()
    beside = axes.figure.add_axes((place.x1 + 0.02, place.y0, 0.022, place.height))
    bar = axes.figure.colorbar(ScalarMappable(norm, scale), cax=beside, format="{x:.2g}")
    bar.set_label("z, adjusted less given, metres")
    axes.set_title(f"positions, adjusted less given; arrows enlarged {enlarged:.3g} times", fontsize=10, loc="left")
    axes.ticklabel_format(useOffset=False, style="plain")
    return svg(axes.figure, "Residuals of the camera positions", "residuals", shown)
