"""Polar: registration of two pictures by least squares in dynamic polar coordinates, and tie points on its ground.

For grass, sand and ploughed fields, where few features are found twice: every pixel of the overlap takes part. The
similarity between both pictures is searched for from coarse to fine, with the poses as a start where they are known
and without them where they are not; where it is right, the grid of image 0 is measured in image 1.

Source: dynamic polar parameterisation of least-squares registration for nadir images, J. Geo-inf. Sci. 2019(10),
1586-1593.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from aeromatch_cli.data import Features, FloatArray, IntArray, Matches, PairGeometry, Raster
from aeromatch_cli.geometry.frames import apply_homography, closest_similarity
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.polar.points import Limits, TiePoints, lattice, tie_points
from aeromatch_cli.strategies.matchers.polar.pyramid import Pyramid
from aeromatch_cli.strategies.matchers.polar.registration import SCALES, Prior, Registration, register
from aeromatch_cli.strategies.matchers.polar.sides import Side, grounded

# What poses must promise for a pair to be compared without them, where nothing was found with them.
_LEAST_UNPOSED_OVERLAP = 0.3
# Of a similarity from tie points: standard deviations are no smaller, and weights are settled in so many rounds.
_LEAST_SIGMA_PX, _ROUNDS = 0.02, 5
# Windows of full-size pixels that a similarity is measured in: about so many, half their side, and the fewest. They
# hold 16 times the pixels of a tie point's, so that noise counts less, and their correlation may be lower.
_PATCHES, _PATCH_HALF, _LEAST_PATCHES = 100, 40, 12
_PATCH_LIMITS = Limits(_PATCH_HALF, 0.2, 0.5)


@dataclass(frozen=True, eq=False)
class Registered:
    """A pair's sides in their frames, their pictures from coarse to fine, and the registration between the frames."""

    side0: Side
    side1: Side
    levels: Pyramid
    registration: Registration

    def turned(self) -> Registered:
        """The same seen from image 1."""
        return Registered(self.side1, self.side0, self.levels.turned(), self.registration.turned())


@dataclass(frozen=True, eq=False)
class Measured:
    """Tie points of a pair. indices: (M, 2) int32, the grid point of one image, -1 for the other. points0_px,
    points1_px: (M, 2) stored pixels. correlations: (M,). sigmas_px: (M,) in the image where it was measured.
    """

    indices: IntArray
    points0_px: FloatArray
    points1_px: FloatArray
    correlations: FloatArray
    sigmas_px: FloatArray

    @property
    def sigma_px(self) -> float:
        """Of the similarity's shift, from the points' own; infinite without points."""
        weight = float((1.0 / np.maximum(self.sigmas_px, _LEAST_SIGMA_PX) ** 2).sum())
        return float(np.sqrt(1.0 / weight)) if weight else float("inf")

    def similarity(self) -> FloatArray:
        """(3, 3) similarity of stored pixels, image 1 from image 0, by least squares over the tie points.

        That of the registration is measured on reduced pictures; this one is as exact as stored pixels allow, where the
        ground is flat. Weights by the points' standard deviations, and less and less for those that lie off (Cauchy).
        Raises ValueError with fewer than two tie points.
        """
        if len(self.points0_px) < 2:
            raise ValueError(f"a similarity needs two tie points, there are {len(self.points0_px)}")
        own = 1.0 / np.maximum(self.sigmas_px, _LEAST_SIGMA_PX) ** 2
        matrix = closest_similarity(self.points0_px, self.points1_px, own)
        for _ in range(_ROUNDS):
            off = np.linalg.norm(apply_homography(matrix, self.points0_px) - self.points1_px, axis=1)
            usual = max(float(np.median(off)), _LEAST_SIGMA_PX)
            matrix = closest_similarity(self.points0_px, self.points1_px, own / (1.0 + (off / (2.0 * usual)) ** 2))
        return matrix


class Polar(Strategy):
    """Least-squares registration of the whole overlap in dynamic polar coordinates, and least-squares tie points."""

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma", "ground"})
    reads_pixels: ClassVar[bool] = True
    name: Literal["polar"] = "polar"
    sigmas: float = Field(
        3.0,
        gt=0.0,
        description="Largest error of the poses, in their standard deviations. Larger: a wider search for the start, "
        "more time.",
    )
    min_scale: float = Field(
        SCALES[0], gt=0.0, description="Without poses: smallest scale of image 1 relative to image 0."
    )
    max_scale: float = Field(
        SCALES[1],
        gt=0.0,
        description="Without poses: largest scale of image 1 relative to image 0. A wider range takes more time.",
    )
    window_px: int = Field(
        21,
        ge=7,
        le=101,
        description="Side of the window by which a tie point is measured, odd, pixels. Larger: more robust, less "
        "local.",
    )
    min_correlation: float = Field(
        0.6,
        ge=0.0,
        lt=1.0,
        description="Smallest correlation (0-1) of a tie point's windows. Larger: fewer, better tie points.",
    )
    max_sigma_px: float = Field(
        0.5,
        gt=0.0,
        description="Largest standard deviation of a tie point, from its residuals, pixels. Larger: more, less "
        "accurate tie points.",
    )

    @model_validator(mode="after")
    def _possible(self) -> Polar:
        if self.min_scale > self.max_scale:
            raise ValueError(f"min_scale {self.min_scale:g} is larger than max_scale {self.max_scale:g}")
        if self.window_px % 2 == 0:
            raise ValueError(f"window_px {self.window_px} is even: give {self.window_px + 1}, which has a middle")
        return self

    def __call__(
        self,
        features0: Features,
        features1: Features,
        geometry: PairGeometry,
        rasters: tuple[Raster, Raster] | None = None,
    ) -> Matches:
        """Each image's keypoints_px are measured in the other. Scores are correlations."""
        if rasters is None:
            raise ValueError("polar compares pixels: it needs both rasters")
        found = self.registered(rasters[0], rasters[1], geometry)
        points = self.measured(found, features0.keypoints_px, features1.keypoints_px)
        return Matches(
            indices=points.indices,
            scores=np.clip(points.correlations, 0.0, 1.0).astype(np.float32),
            view_pairs=np.zeros((len(points.indices), 2), np.int16),
            points0_px=points.points0_px,
            points1_px=points.points1_px,
            sigmas_px=points.sigmas_px.astype(np.float32),
            remark=found.registration.reason,
        )

    def registered(self, raster0: Raster, raster1: Raster, geometry: PairGeometry) -> Registered:
        """Registration of one pair, in the frames of its sides, with what tie points need afterwards."""
        posed = grounded(raster0, raster1, geometry, self.sigmas)
        if posed is not None:
            found = self._compared(posed.side0, posed.side1, posed.prior)
            if found.registration.accepted or geometry.pair.overlap < _LEAST_UNPOSED_OVERLAP:
                return found
            reason = f"{found.registration.reason}, within {self.sigmas:g} sigma of the poses"
            found = replace(found, registration=replace(found.registration, reason=reason))
        # An attitude may be wrong altogether, which is told from what the pictures say.
        free = self._compared(Side.stored(raster0), Side.stored(raster1), None)
        return free if posed is None or free.registration.accepted else found

    def _compared(self, side0: Side, side1: Side, prior: Prior | None) -> Registered:
        longest = max(side0.width_px, side0.height_px, side1.width_px, side1.height_px)
        levels = Pyramid(side0.read, side1.read, longest, min(side0.finest, side1.finest))
        registration = register(levels, prior, (self.min_scale, self.max_scale))
        return Registered(side0, side1, levels, registration)

    def exact(self, found: Registered) -> FloatArray:
        """(3, 3) similarity of stored pixels, image 1 from image 0, of an accepted registration measured once more.

        That of the registration ends on reduced pictures. Here about 100 windows of full-size pixels, spread over the
        overlap, are measured by least squares. Where they say less than the registration (noise, no detail that small),
        its own is given, of tilted pictures the closest.
        """
        side0, side1, registration = found.side0, found.side1, found.registration
        places = lattice(side0, side1, registration.warp, _PATCHES, 2 * _PATCH_HALF)
        points = tie_points(side0, side1, found.levels, registration, places, _PATCH_LIMITS)
        patches = Measured(points.rows, places[points.rows], points.places_px, points.correlations, points.sigmas_px)
        fit = registration.fit
        own = np.inf if fit is None else float(np.sqrt(np.trace(fit.covariance[:2, :2]))) / registration.scale
        if len(points.rows) >= _LEAST_PATCHES and patches.sigma_px < own:
            return patches.similarity()
        if side0.camera is None or len(places) < 2:
            return registration.matrix
        there = apply_homography(registration.warp, side0.frame_from_source(places))
        return closest_similarity(places, side1.source_from_frame(there))

    def measured(self, found: Registered, grid0_px: FloatArray, grid1_px: FloatArray) -> Measured:
        """Points (K, 2) of either image, stored pixels, measured in the other: so that every image's points are seen in
        all that overlap it, whichever comes first. None where the registration is not accepted.
        """
        ways = [self._one_way(found, grid0_px), self._one_way(found.turned(), grid1_px)]
        columns = []
        for side, (grid_px, points) in enumerate(zip((grid0_px, grid1_px), ways, strict=True)):
            indices = np.full((len(points.rows), 2), -1, np.int32)
            indices[:, side] = points.rows
            places = [grid_px[points.rows].astype(np.float64), points.places_px]
            columns.append((indices, places[side], places[1 - side], points.correlations, points.sigmas_px))
        return Measured(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))

    def _one_way(self, found: Registered, points_px: FloatArray) -> TiePoints:
        points = points_px.astype(np.float64) if found.registration.accepted else np.zeros((0, 2))
        limits = Limits(self.window_px // 2, self.min_correlation, self.max_sigma_px)
        return tie_points(found.side0, found.side1, found.levels, found.registration, points, limits)
