"""What a block looks like in figures, and what in it can hardly be true."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from aeromatch_cli.blocks.plausibility import warnings_of
from aeromatch_cli.data import Block, FloatArray, Pair
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.geometry.frames import length_words
from aeromatch_cli.geometry.rotations import tilt_deg
from aeromatch_cli.words import counted


@dataclass(frozen=True)
class BlockSummary:
    """Figures of a block; NaN where nothing is known. Heights are above the ground below each camera.

    metric: whether lengths are metres; else the frame is the pictures' own. Heights, tilts, gsd_m (median) and extent_m
    (east-west and north-south, of the projection centres) are of so many images `together` whose places to each other
    are known. best_overlap: mean over the paired images of the overlap with their best neighbour. warnings: one
    sentence each: what, which images, what to do.
    """

    images: int
    cameras: int
    positioned: int
    oriented: int
    crs: str
    metric: bool
    origin_m: tuple[float, float, float]
    ground_source: str
    flying_height_m: tuple[float, float, float]
    mean_tilt_deg: float
    max_tilt_deg: float
    gsd_m: float
    extent_m: tuple[float, float]
    together: int
    pairs: int | None
    pairs_by_reason: tuple[tuple[str, int], ...]
    best_overlap: float
    unpaired: tuple[str, ...]
    warnings: tuple[str, ...]

    def given_lines(self) -> list[str]:
        """What a block brings before it is oriented."""
        return [
            f"images           {self.images}, {self.positioned} with position, {self.oriented} with attitude, "
            f"{counted(self.cameras, 'camera')}",
            f"world            {self.crs}, origin {self.origin_m[0]:.0f} {self.origin_m[1]:.0f} {self.origin_m[2]:.0f}",
        ]

    def lines(self, given: BlockSummary | None = None) -> list[str]:
        """The summary of an oriented block for a person, one fact per line, without the warnings. given: of the same
        block before it was oriented."""
        low, median, high = self.flying_height_m
        east, north = self.extent_m
        found = [f"ground           {self.ground_source or 'unknown'}"]
        length = partial(length_words, metric=self.metric)
        if not self.metric:
            found.append("scale            arbitrary: no position ties the frame to metres, or to north")
        if self.positioned:
            along = ("east-west", "north-south") if self.metric else ("along x", "along y")
            parts = ""
            if self.together < self.positioned:
                parts = f", of {self.together} images that hang together; height, tilt and ground sampling are theirs"
            found.append(f"extent           {length(east)} {along[0]}, {length(north)} {along[1]}{parts}")
        if np.isfinite(median):
            found.append(f"flying height    {length(median)} ({low:.1f} to {high:.1f}) above ground")
        if np.isfinite(self.mean_tilt_deg):
            found.append(
                f"tilt             {self.mean_tilt_deg:.1f} degrees on average, {self.max_tilt_deg:.1f} at most"
            )
        if np.isfinite(self.gsd_m):
            spacing = f"{100.0 * self.gsd_m:.2f} cm" if self.metric else length(self.gsd_m, 4)
            found.append(f"ground sampling  {spacing} per pixel")
        if self.positioned < self.images:
            found.append(self._unplaced_line(0 if given is None else given.positioned))
        if self.oriented < self.positioned:
            refuted = given is not None and given.oriented > self.oriented
            why = "those given contradict the pictures and are not used; " if refuted else ""
            found.append(f"without attitude {self.positioned - self.oriented}: {why}paired by position")
        if not self.oriented:
            found.append("views            source images only: no attitudes")
        elif not np.isfinite(median):
            found.append("views            source images only: no ground height")
        if self.pairs is not None:
            reasons = ", ".join(f"{count} by {reason}" for reason, count in self.pairs_by_reason)
            found.append(f"pairs            {self.pairs}" + (f" ({reasons})" if reasons else ""))
        if np.isfinite(self.best_overlap):
            found.append(f"overlap          {100.0 * self.best_overlap:.0f} % with the best neighbour, on average")
        return found

    def _unplaced_line(self, given: int) -> str:
        """Say how many images have no position, or none in a frame of the pictures' own. given: positions given."""
        count, paired = self.images - self.positioned, "paired by name and time"
        if self.metric:
            return f"without position {count}: {paired}"
        lie = "given position is not in it" if given == 1 else f"{given} given positions are not in it"
        return f"outside frame    {count}: {paired}" + (f"; the {lie}" if given else "")

    def figures(self) -> dict[str, Any]:
        """Every field, JSON-ready: pairs_by_reason as a mapping, None for what is unknown, and for lengths that are no
        metres."""
        found = {key: _plain(value) for key, value in asdict(self).items()}
        if not self.metric:
            found |= dict.fromkeys(("flying_height_m", "gsd_m", "extent_m"))
        found.pop("together")
        return found | {"pairs_by_reason": dict(self.pairs_by_reason)}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def summarise(block: Block, pairs: Sequence[Pair] | None = None) -> BlockSummary:
    """Figures and plausibility of a block. pairs: the chosen pairs, or None before they are chosen."""
    names = block.names
    poses = {i: block.poses[i] for i in names if i in block.poses and np.isfinite(block.poses[i].center_m).all()}
    # Lengths and the vertical of a frame of its own are others than those of the first part.
    apart = block.aside(in_world=False)
    together = {image_id: pose for image_id, pose in poses.items() if image_id not in apart}
    centers_m = np.array([pose.center_m for pose in together.values()]).reshape(-1, 3)
    tilts_deg = [tilt_deg(pose.world_rotation) for pose in together.values() if pose.world_rotation is not None]
    gsds_m = [footprint.gsd_m for i, footprint in block_footprints(block).items() if i not in apart]
    unpaired = () if pairs is None else _unpaired(names, pairs)
    return BlockSummary(
        images=len(block.images),
        cameras=len({image.camera_id for image in block.images}),
        positioned=len(poses),
        oriented=sum(pose.world_rotation is not None for pose in poses.values()),
        crs=block.crs,
        metric=block.metric,
        origin_m=block.origin_m,
        ground_source=block.ground_source,
        flying_height_m=_flying_height_m(block, centers_m),
        mean_tilt_deg=_known(np.mean, tilts_deg),
        max_tilt_deg=_known(np.max, tilts_deg),
        gsd_m=_known(np.median, gsds_m),
        extent_m=(_known(np.ptp, centers_m[:, 0]), _known(np.ptp, centers_m[:, 1])),
        together=len(together),
        pairs=None if pairs is None else len(pairs),
        pairs_by_reason=tuple(sorted(Counter(pair.reason for pair in pairs or ()).items())),
        best_overlap=_known(np.mean, list(_best_overlaps(pairs or ()).values())),
        unpaired=unpaired,
        warnings=warnings_of(block, unpaired),
    )


def _known(function: Callable[[Any], Any], values: Sequence[float] | FloatArray) -> float:
    """Return a figure of values (N,), NaN where there are none."""
    return float(function(values)) if len(values) else float("nan")


def _flying_height_m(block: Block, centers_m: FloatArray) -> tuple[float, float, float]:
    """Return the least, the median and the largest height of projection centres (N, 3) above the ground below each."""
    if block.ground is None or not len(centers_m):
        return float("nan"), float("nan"), float("nan")
    heights_m = centers_m[:, 2] - block.ground.height_m(centers_m[:, :2])
    low, median, high = np.percentile(heights_m, [0, 50, 100]).tolist()
    return low, median, high


def _unpaired(names: Mapping[str, str], pairs: Sequence[Pair]) -> tuple[str, ...]:
    """Return the names of the images that no pair has. names: by image_id."""
    paired = {image_id for pair in pairs for image_id in (pair.image_id0, pair.image_id1)}
    return tuple(name for image_id, name in names.items() if image_id not in paired)


def _best_overlaps(pairs: Sequence[Pair]) -> Mapping[str, float]:
    """Largest known overlap of each paired image."""
    best: dict[str, float] = {}
    for pair in pairs:
        if np.isfinite(pair.overlap):
            for image_id in (pair.image_id0, pair.image_id1):
                best[image_id] = max(best.get(image_id, 0.0), pair.overlap)
    return best
