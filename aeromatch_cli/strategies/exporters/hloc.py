"""hloc: features.h5, matches.h5, pairs.txt and poses.txt.

features.h5: a group for each image name with keypoints (N, 2) from the middle of the first pixel, scores and
image_size; matches.h5: a group for each pair with matches0 (N0,), -1 for none, and matching_scores0 (hloc/utils/io.py,
parsers.py). Keypoints are float32: hloc's half precision loses what is beyond 2048 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.rotations import to_quaternion
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import Solution, called, matched, summary_of, write, write_world


class Hloc(Strategy):
    """Writes features.h5, matches.h5, pairs.txt, poses.txt (name, cam_from_world quaternion and translation) and
    world.json (CRS and origin that poses count from); needs h5py."""

    version: ClassVar[int] = 4
    name: Literal["hloc"] = "hloc"

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError without h5py, and where two names are one in a pair's."""
        _h5py()
        called(images, _in_key, self.name, "hloc's names of pairs have - for / in those of images")

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ConfigError as `check_images`."""
        h5py = _h5py()
        solution = Solution.of(contents)
        self.check_images(solution.images)
        names = {image.image_id: image.name for image in solution.images}
        with whole_folder(folder) as partial:
            write_world(partial, contents.block)
            found = matched(contents)
            sizes = {}
            with h5py.File(partial / "features.h5", "w", track_order=True) as stream:
                for image in solution.images:
                    places = np.asarray(contents.keypoints_px(image.image_id), np.float32).reshape(-1, 2)
                    sizes[image.image_id] = len(places)
                    group = stream.create_group(image.name)
                    group.create_dataset("keypoints", data=places)
                    group.create_dataset("scores", data=np.ones(len(places), np.float32))
                    group.create_dataset("image_size", data=np.array([image.width_px, image.height_px]))
            with h5py.File(partial / "matches.h5", "w", track_order=True) as stream:
                for id0, id1, rows in found.pairs:
                    partner = np.full(sizes[id0], -1, np.int32)
                    partner[rows[::-1, 0]] = rows[::-1, 1]  # of several partners the first one
                    group = stream.create_group(pair_key(names[id0], names[id1]))
                    group.create_dataset("matches0", data=partner)
                    group.create_dataset("matching_scores0", data=(partner >= 0).astype(np.float16))
            write(partial / "pairs.txt", "".join(f"{names[id0]} {names[id1]}\n" for id0, id1, _ in found.pairs))
            write(partial / "poses.txt", "".join(_pose_lines(solution)))
            return summary_of(folder, partial, contents, len(solution.poses), sum(sizes.values()), found.counts)


def pair_key(name0: str, name1: str) -> str:
    """hloc's name of a pair's group."""
    return "/".join(_in_key(name) for name in (name0, name1))


def _in_key(name: str) -> str:
    return name.replace("/", "-")


def _pose_lines(solution: Solution) -> list[str]:
    lines = []
    for image in solution.images:
        if image.image_id in solution.poses:
            rotation, center_m = solution.poses[image.image_id]
            values = (*to_quaternion(rotation), *(-rotation @ center_m))
            lines.append(f"{image.name} {' '.join(f'{value:.15g}' for value in values)}\n")
    return lines


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise ConfigError("export=hloc writes HDF5, which needs h5py: pip install 'aeromatch[hdf5]'") from None
    return h5py
