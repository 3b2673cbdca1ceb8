"""report: cameras as the adjustment has found them, what remains of the image points, and expected errors of heights.
No disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import normalise, project
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.report.figures import (
    COLOURS,
    PlanSize,
    evenly_chosen,
    new_axes,
    plan_axes,
    round_length,
    svg,
)
from aeromatch_cli.results.adjustment import Calibration, HeightErrors, Parameter
from aeromatch_cli.results.stages import AdjustResult
from aeromatch_cli.sfm.bundle.network import LENS
from aeromatch_cli.sfm.calibration import camera_of
from aeromatch_cli.sfm.quality.finding import WHOLE_BLOCK, part_words
from aeromatch_cli.words import counted

# Cells along the longer side of a picture; a mean of fewer residuals shows their noise.
_CELLS, _FEWEST = 16, 5
# Images whose residuals stand for all of a camera.
_MOST_IMAGES = 200
# The arrow of this quantile is as long as this share of a cell.
_USUAL, _SHARE = 0.9, 0.8
_FIELD_IN, _FIELD_EDGES_IN = 6.6, (0.62, 0.12, 0.5, 0.55)  # left, right, bottom, top
_MAP = PlanSize(7.0, (3.0, 6.5), bar=1.1)
_UNITS = {**dict.fromkeys(("f", "cx", "cy", "b1", "b2"), "px"), "readout_s": "s"}
# Model parameters by their names in the table.
_NAMES = {
    "f": "f, focal length",
    "cx": "cx, principal point",
    "cy": "cy, principal point",
    "readout_s": "read-out time",
}


@dataclass(frozen=True)
class CameraSection:
    """One camera of the page. rows: (parameter, unit, value, deviation, known before, its deviation, change in standard
    deviations, strongest correlations) in words; fields: (SVG, words)."""

    name: str
    words: str
    rows: tuple[tuple[str, ...], ...]
    fields: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class HeightsSection:
    """Expected errors of heights of one group: of what, a map (SVG) and what it means."""

    title: str
    plan: str
    words: str


def camera_sections(
    found: AdjustResult,
    adjusted: AdjustedBlock,
    images: Sequence[Image],
    keypoints_px: Callable[[str], FloatArray],
) -> list[CameraSection]:
    """One of every camera that was adjusted. keypoints_px: image_id -> (K, 2)."""
    sections: dict[str, CameraSection] = {}
    for group in found.groups:
        for camera_id, calibration in group.calibration.items():
            camera = adjusted.cameras.get(camera_id)
            if camera is None or camera_id in sections:
                continue
            own = [image.image_id for image in images if image.camera_id == camera_id]
            fields = (
                _moved(calibration.parameters, camera, camera_id),
                _remaining(adjusted, camera, camera_id, own, keypoints_px),
            )
            count = calibration.images
            words = f"{counted(count, 'image')}, {camera.model}, {camera.width_px} x {camera.height_px} px"
            shown = tuple(field for field in fields if field is not None)
            rows = tuple(_rows(calibration, found.held_by))
            sections[camera_id] = CameraSection(camera_id, words, rows, shown)
    return [sections[camera_id] for camera_id in sorted(sections)]


def _rows(calibration: Calibration, held_by: Mapping[str, str]) -> Iterator[tuple[str, ...]]:
    related: dict[str, list[str]] = {}
    for first, second, value in calibration.correlations:
        related.setdefault(first, []).append(f"{second} {value:+.2f}")
        related.setdefault(second, []).append(f"{first} {value:+.2f}")
    for name, (value, sigma, prior, prior_sigma) in calibration.parameters.items():
        held = sigma == 0.0
        change = f"{round((value - prior) / prior_sigma, 1) + 0.0:+.1f}" if prior_sigma > 0.0 and not held else ""
        digits = 2 if _UNITS.get(name) == "px" else 6
        found = f"{sigma:.{digits}f}"
        if held:
            found = f"held by {held_by[name]}" if name in held_by else "held"
        yield (
            _NAMES.get(name, name),
            _UNITS.get(name, ""),
            f"{value:.{digits}f}",
            found,
            f"{prior:.{digits}f}",
            f"{prior_sigma:.{digits}f}" if prior_sigma > 0.0 else "",
            change,
            ", ".join(related.get(name, [])),
        )


def _grid(camera: Camera) -> tuple[int, int, float]:
    """Columns, rows and size of a cell, pixels."""
    cell_px = max(camera.width_px, camera.height_px) / _CELLS
    return max(1, round(camera.width_px / cell_px)), max(1, round(camera.height_px / cell_px)), cell_px


def _moved(parameters: Mapping[str, Parameter], camera: Camera, camera_id: str) -> tuple[str, str] | None:
    """By how much the adjusted camera moves image points against the one known before."""
    lens = np.array([parameters[name].prior if name in parameters else 0.0 for name in LENS])
    lens[[LENS.index("cx"), LENS.index("cy")]] -= COLMAP_OFFSET_PX
    before = camera_of(lens, camera)
    columns, rows, cell_px = _grid(camera)
    middles = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * cell_px
    places = middles + 0.5 * (cell_px - 1.0)
    rays = np.column_stack([normalise(camera, places), np.ones(len(places))])
    moved_px = places - project(before, np.eye(3), np.zeros(3), rays)
    known = np.isfinite(moved_px).all(axis=1)
    if not known.any() or np.abs(moved_px[known]).max() < 1e-3:
        return None
    longest = float(np.linalg.norm(moved_px[known], axis=1).max())
    words = (
        f"What the calibration does: where the adjusted camera puts image points, against the camera known before "
        f"(focal length, principal point and distortion together); up to {longest:.1f} px."
    )
    return _arrows(camera, places[known], moved_px[known], camera_id, "adjusted less known before", "moved"), words


def _remaining(
    adjusted: AdjustedBlock,
    camera: Camera,
    camera_id: str,
    image_ids: Sequence[str],
    keypoints_px: Callable[[str], FloatArray],
) -> tuple[str, str] | None:
    """Mean residuals of image points over the picture, of all images of a camera."""
    columns, rows, cell_px = _grid(camera)
    sums, counts = np.zeros((rows * columns, 2)), np.zeros(rows * columns)
    seen = [i for i in image_ids if len(adjusted.tracks.get(i, ())) and i in adjusted.poses]
    for k in evenly_chosen(len(seen), _MOST_IMAGES) if seen else ():
        pose, track = adjusted.poses[seen[k]], adjusted.tracks[seen[k]]
        measured = np.asarray(keypoints_px(seen[k]), np.float64)[track[:, 0]]
        off_px = measured - project(camera, pose.rotation, pose.center_m, adjusted.points_m[track[:, 1]])
        good = np.isfinite(off_px).all(axis=1)
        column, row = np.clip(((measured[good] + 0.5) // cell_px).astype(int), 0, (columns - 1, rows - 1)).T
        np.add.at(sums, row * columns + column, off_px[good])
        counts += np.bincount(row * columns + column, minlength=len(counts))
    filled = np.flatnonzero(counts >= _FEWEST)
    if not len(filled):
        return None
    means_px = sums[filled] / counts[filled, None]
    places = np.column_stack([filled % columns, filled // columns]) * cell_px + 0.5 * (cell_px - 1.0)
    largest = float(np.linalg.norm(means_px, axis=1).max())
    words = (
        f"What remains: means of the residuals of image points, measured less adjusted, in cells of {cell_px:.0f} px; "
        f"up to {largest:.2f} px. Arrows without order are noise; a pattern is distortion that the camera model lacks."
    )
    return _arrows(camera, places, means_px, camera_id, "means of residuals", "remaining"), words


def _arrows(camera: Camera, places: FloatArray, vectors_px: FloatArray, camera_id: str, title: str, css: str) -> str:
    """An arrow at every place (N, 2) of a picture. The camera, whose name may be long, is named above the figure."""
    left, right, bottom, top = _FIELD_EDGES_IN
    height = (_FIELD_IN - left - right) * camera.height_px / camera.width_px + bottom + top
    margins = {
        "left": left / _FIELD_IN, "right": 1.0 - right / _FIELD_IN,
        "bottom": bottom / height, "top": 1.0 - top / height,
    }  # fmt: skip
    axes = new_axes(_FIELD_IN, height, margins=margins)
    lengths = np.linalg.norm(vectors_px, axis=1)
    usual = max(float(np.quantile(lengths, _USUAL)), 1e-6)
    enlarged = _SHARE * _grid(camera)[2] / usual
    arrows = axes.quiver(
        *places.T, *(enlarged * vectors_px).T, angles="xy", scale_units="xy", scale=1.0, width=0.0028,
        color=COLOURS["accent"], gid=css,
    )  # fmt: skip
    axes.set(xlim=(-0.5, camera.width_px - 0.5), ylim=(camera.height_px - 0.5, -0.5), xlabel="x, px", ylabel="y, px")
    axes.set_aspect("equal")
    shown = round_length(usual)
    axes.quiverkey(arrows, 0.86, 1.045, enlarged * shown, f"{shown:g} px", labelpos="E", color=COLOURS["accent"])
    axes.set_title(f"{title}; arrows enlarged {enlarged:.3g} times", fontsize=10, loc="left")
    return svg(axes.figure, f"camera {camera_id}, {title}", "lens", {})


def heights_sections(found: AdjustResult, names: Mapping[str, str]) -> list[HeightsSection]:
    """One of every group whose errors are known. names: of the files, by image_id."""
    return [
        _heights_section(group.heights, part_words(group, found.groups, names))
        for group in found.groups
        if group.heights is not None
    ]


def _heights_section(heights: HeightErrors, part: str) -> HeightsSection:
    """part: what these are the errors of, in words."""
    points = np.array(heights.points, dtype=np.float64).reshape(-1, 3)

    def length(value: float) -> str:
        pixels = f"{heights.in_pixels(value):.1f} ground pixels"
        return f"{value:.3f} m ({pixels})" if heights.metric else pixels

    words = (
        f"Standard deviations of the heights of {len(points)} points, as measurements and geometry let expect them; "
        f"median {length(heights.sigma)}. The middle of {part} may lie {length(heights.bowl)} above or "
        f"below its border, one side {length(heights.tilt)} above or below the middle."
    )
    title = "Expected errors of heights" + ("" if part == WHOLE_BLOCK else f" in {part}")
    return HeightsSection(title, _height_map(points, heights.pixel, in_world=heights.metric), words)


def _height_map(points: FloatArray, pixel: float, *, in_world: bool) -> str:
    """(P, 3) x, y and standard deviation of points."""
    from matplotlib.colors import LinearSegmentedColormap

    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    margin = 0.06 * float((high - low).max()) or 1.0
    axes = plan_axes(low - margin, high + margin, _MAP, in_world=in_world)
    scale = LinearSegmentedColormap.from_list("error", [COLOURS["k4"], COLOURS["k2"], COLOURS["k0"], COLOURS["bad"]])
    values = points[:, 2] if in_world else points[:, 2] / pixel
    drawn = axes.scatter(*points[:, :2].T, 42.0, c=values, cmap=scale, linewidth=0)
    place = axes.get_position()
    beside = axes.figure.add_axes((place.x1 + 0.02, place.y0, 0.028, place.height))
    bar = axes.figure.colorbar(drawn, cax=beside, format="{x:.3g}")
    bar.set_label("standard deviation, metres" if in_world else "standard deviation, ground pixels")
    axes.set_title("expected errors of heights", fontsize=10, loc="left")
    axes.ticklabel_format(useOffset=False, style="plain")
    return svg(axes.figure, "expected errors of heights", "heights", {})
