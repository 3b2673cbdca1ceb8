"""The observations of a bundle adjustment with their standard deviations, and its unknowns.

Frames: world metres (x east, y north, z up); camera x right, y down, z forward; pixels in one frame of the caller's
choice, which the principal points share. All arrays are float64 and rows are dense, zero-based.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray

# Unknowns of a camera, in this order. The first ten are those of geometry.cameras.BROWN. Of a fisheye lens p1 is k4,
# and p2 and b2 are zero. readout_s: seconds from the exposure of the first row to that of the last.
LENS = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2", "readout_s", "unused")
READOUT = LENS.index("readout_s")
# Unknowns of what is mounted on a camera: the boresight, small angles in radians about the camera's axes by which
# measured attitudes are off, and the lever arm, metres in the camera's frame from the projection centre to the antenna.
MOUNT = ("boresight_x", "boresight_y", "boresight_z", "lever_x", "lever_y", "lever_z")
# Unknowns of a flight: by how much its positions are off, metres in the world, the time by which they lag behind the
# exposures, seconds, and how steeply their heights rise to the east and north against the true ones: the drift of a
# receiver without corrections, metres per metre.
FLIGHT = ("shift_x", "shift_y", "shift_z", "lag_s", "slope_x", "slope_y")
SLOPES = slice(FLIGHT.index("slope_x"), FLIGHT.index("slope_y") + 1)

# Errors of a receiver without corrections are the same for seconds and drift within minutes: where less exact positions
# than this were stated, metres.
_UNCORRECTED_M = 0.5


def drift_of(sigma_m: float, arms_m: FloatArray) -> float:
    """Return the standard deviation of the slope of heights stated to sigma_m, metres per metre; 0 of a receiver with
    corrections.

    Errors at two ends of the block have nothing in common. arms_m: (N, 2) from the middle of the positions, in plan.
    """
    reach_m = float(np.linalg.norm(arms_m, axis=1).max(initial=0.0))
    return sigma_m / (np.sqrt(2.0) * reach_m) if is_uncorrected(sigma_m) and reach_m > 0.0 else 0.0


def is_uncorrected(sigma_m: float) -> bool:
    """Whether a receiver whose positions are stated to sigma_m had no corrections."""
    return sigma_m > _UNCORRECTED_M


@dataclass(frozen=True, eq=False)
class Network:
    """Observations of M image points of P object points in N images of K cameras and F flights.

    image, point: (M,) rows. xy_px: (M, 2) measured, sigma_px: (M,) of a coordinate; that of tie points is estimated.
    camera, flight: (N,) rows.
    fisheye: (K,) whether the lens is OPENCV_FISHEYE. rows_px: (K,) height of the pictures.
    positions_m: (N, 3), NaN where there is none; position_sigmas_m: (N, 3) of each axis.
    attitudes: (N, 3, 3) measured cam_from_world; attitude_sigmas: (N, 3) radians about the world's axes, inf where an
    angle is not measured.
    velocities_m_s: (N, 3) in the world, zero where they are not known.
    lens_prior, lens_sigmas: (K, 12) by LENS. mount_sigmas: (K, 6) by MOUNT, flight_sigmas: (F, 6) by FLIGHT, about 0.
    A standard deviation of 0 holds the unknown, an infinite one says nothing of it.
    control: (Q,) rows of points that were surveyed, control_m: (Q, 3), control_sigmas_m: (Q, 3).
    held: (N,) images whose poses stay.
    """

    image: IntArray
    point: IntArray
    xy_px: FloatArray
    sigma_px: FloatArray
    camera: IntArray
    flight: IntArray
    fisheye: BoolArray
    rows_px: FloatArray
    positions_m: FloatArray
    position_sigmas_m: FloatArray
    attitudes: FloatArray
    attitude_sigmas: FloatArray
    velocities_m_s: FloatArray
    lens_prior: FloatArray
    lens_sigmas: FloatArray
    mount_sigmas: FloatArray
    flight_sigmas: FloatArray
    control: IntArray
    control_m: FloatArray
    control_sigmas_m: FloatArray
    held: BoolArray

    @property
    def images(self) -> int:
        return len(self.camera)

    @property
    def cameras(self) -> int:
        return len(self.lens_prior)

    @property
    def flights(self) -> int:
        return len(self.flight_sigmas)

    @property
    def tie_points(self) -> BoolArray:
        """(M,) image points that are not those of control points."""
        return ~np.isin(self.point, self.control)

    @property
    def tie_sigma_px(self) -> float:
        """Standard deviation of a coordinate of a tie point."""
        return float(self.sigma_px[self.tie_points].mean()) if self.tie_points.any() else 1.0

    @property
    def located(self) -> BoolArray:
        """(N,) whether an image has a position that counts."""
        return np.asarray(np.isfinite(self.positions_m).all(axis=1) & np.isfinite(self.position_sigmas_m).any(axis=1))

    @property
    def arms_m(self) -> FloatArray:
        """(N, 2) from the middle of the positions of its flight to that of an image, east and north; 0 without one."""
        arms_m = np.zeros((self.images, 2))
        for flight in range(self.flights):
            own = self.located & (self.flight == flight)
            if own.any():
                arms_m[own] = self.positions_m[own, :2] - self.positions_m[own, :2].mean(axis=0)
        return arms_m

    @property
    def levelled(self) -> BoolArray:
        """(N,) whether an image has an attitude that counts."""
        finite = np.isfinite(self.attitudes).all(axis=(1, 2))
        return np.asarray(finite & np.isfinite(self.attitude_sigmas).any(axis=1))


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Values of all unknowns.

    rotations: (N, 3, 3) cam_from_world; centers_m: (N, 3); points_m: (P, 3); lens: (K, 12); mount: (K, 6);
    flight: (F, 6).
    """

    rotations: FloatArray
    centers_m: FloatArray
    points_m: FloatArray
    lens: FloatArray
    mount: FloatArray
    flight: FloatArray
