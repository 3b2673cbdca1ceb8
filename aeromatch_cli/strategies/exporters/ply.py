"""PLY: the tie points of the adjusted block as a point cloud, for CloudCompare, MeshLab and others.

Binary, little endian, coordinates in float64. They are those of the CRS less the block's origin, which the header and
world.json name: MeshLab and many viewers keep float32, in which a northing has steps of half a metre.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Block
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Solution,
    colours_of,
    keypoints_of,
    matched,
    summary_of,
    track_colours,
    write_world,
)

# Name, type in the file, and type of PLY.
_PROPERTIES = (
    ("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double"),
    ("red", "u1", "uchar"), ("green", "u1", "uchar"), ("blue", "u1", "uchar"),
    ("images", "<i4", "int"), ("error_px", "<f4", "float"),
)  # fmt: skip


class Ply(Strategy):
    """Writes points.ply (the points of the adjusted block with the colours of the pictures, how many images see each,
    and its mean reprojection error) and world.json (CRS and origin that coordinates count from)."""

    version: ClassVar[int] = 2
    name: Literal["ply"] = "ply"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution, adjusted = Solution.of(contents), contents.adjusted
        with whole_folder(folder) as partial:
            found = matched(contents, adjusted_tracks=True)
            keypoints = keypoints_of(contents)
            images = np.diff(found.starts)
            known = np.flatnonzero(np.isfinite(found.points_m).all(axis=1) & (images > 0))
            points = np.zeros(len(known), np.dtype([(name, kind) for name, kind, _ in _PROPERTIES]))
            if adjusted is not None:
                points["x"], points["y"], points["z"] = found.points_m[known].T
                colours = track_colours(found, colours_of(contents, keypoints))
                points["red"], points["green"], points["blue"] = colours[known].T
                points["images"], points["error_px"] = images[known], adjusted.errors_px[known]
            with (partial / "points.ply").open("wb") as stream:
                stream.write(_header(contents.block, len(points)).encode())
                stream.write(points.tobytes())
            write_world(partial, contents.block)
            remarks = (
                () if len(points) else ("points.ply has no point: no block was adjusted whose points have a place",)
            )
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts, remarks)


def _header(block: Block, count: int) -> str:
    x, y, z = block.origin_m
    return "".join(
        f"{line}\n"
        for line in (
            "ply", "format binary_little_endian 1.0", "comment tie points of aeromatch",
            f"comment crs {block.crs}", f"comment offset {x:.12g} {y:.12g} {z:.12g}",
            "comment coordinate in crs = coordinate here + offset", f"element vertex {count}",
            *(f"property {kind} {name}" for name, _, kind in _PROPERTIES), "end_header",
        )
    )  # fmt: skip
