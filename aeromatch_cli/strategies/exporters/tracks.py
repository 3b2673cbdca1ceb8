"""Tracks as a table, for tools of one's own: one line for every image that sees a point."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import Solution, keypoints_of, matched, summary_of, write

_COLUMNS = ("track", "image", "keypoint", "x_px", "y_px", "x_m", "y_m", "z_m")


class Tracks(Strategy):
    """Writes tracks.csv: track, image, keypoint, place in the image (the middle of the first pixel is 0, 0) and, of
    an adjusted block, the point in its CRS."""

    version: ClassVar[int] = 3
    name: Literal["tracks"] = "tracks"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        with whole_folder(folder) as partial:
            found = matched(contents, adjusted_tracks=True)
            keypoints = keypoints_of(contents)
            stream = io.StringIO()
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(_COLUMNS)
            origin_m = np.array(contents.block.origin_m)
            for track, image_idx, keypoint in zip(found.track, found.image_idx, found.keypoint, strict=True):
                image = solution.images[image_idx]
                x, y = keypoints[image.image_id][keypoint]
                point = found.points_m[track] + origin_m
                place = [f"{value:.4f}" for value in point] if np.isfinite(point).all() else ["", "", ""]
                writer.writerow([track, image.name, keypoint, f"{x:.4f}", f"{y:.4f}", *place])
            write(partial / "tracks.csv", stream.getvalue())
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts)
