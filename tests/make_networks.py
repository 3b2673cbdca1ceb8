"""Simulated networks with exact truth, for the tests of the bundle adjustment.

Pictures of 1200 x 900 pixels from 100 m above ground with some relief: a pixel is 0.1 m. Networks come with nothing
known but image points: poses are free, lenses, mounts and flights are held at the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.bundle.network import FLIGHT, LENS, MOUNT, Network, Unknowns
from aeromatch_cli.sfm.bundle.projection import project
from aeromatch_cli.sfm.model_adjustment import Given

WIDTH_PX, HEIGHT_PX = 1200, 900
SPEED_M_S = 10.0


def seeds(count: int) -> pytest.MarkDecorator:
    """Parametrises `seed` from 0 on; all but the first are slow."""
    more = [pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, count)]
    return pytest.mark.parametrize("seed", [0, *more])


def values_of(names: Sequence[str], **values: float) -> FloatArray:
    """(len(names),) values by name, zero where none is given."""
    return np.array([values.get(name, 0.0) for name in names])


def lens(**values: float) -> FloatArray:
    """(12,) by LENS: 1000 px, the principal point in the middle, and what is given."""
    return values_of(LENS, **{"f": 1000.0, "cx": 599.5, "cy": 449.5, **values})


def mount(**values: float) -> FloatArray:
    return values_of(MOUNT, **values)


def flight(**values: float) -> FloatArray:
    return values_of(FLIGHT, **values)


PLAIN = lens()
BENT = lens(cx=612.0, cy=441.0, k1=-0.08, k2=0.05, k3=-0.01, p1=0.0007, p2=-0.0004)


@dataclass(frozen=True, eq=False)
class Plan:
    """Where images are taken: (N, 3) centres, (N,) headings of flight in degrees from east, (N,) flights."""

    centers_m: FloatArray
    headings_deg: FloatArray
    flights: IntArray

    def and_then(self, other: Plan) -> Plan:
        names = ("centers_m", "headings_deg", "flights")
        return Plan(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


def strips(count: int = 3, images: int = 5, *, height_m: float = 100.0, flights: bool = False) -> Plan:
    """Parallel strips to and fro along x, overlapping by three quarters along and two thirds across. flights: whether
    each strip is one of its own."""
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(images), indexing="ij"))
    heights_m = np.full(len(row), height_m)
    centers_m = np.column_stack([25.0 * column, 30.0 * row, heights_m])
    return Plan(centers_m, 180.0 * (row % 2), row if flights else np.zeros_like(row))


def cross_strips(count: int = 3, images: int = 5, *, height_m: float = 80.0) -> Plan:
    """Two more strips over the same area, along y and lower."""
    across_m = 30.0 * (count - 1)
    y_m = np.linspace(0.0, across_m, max(3, int(across_m / 20.0)))
    parts = [
        np.column_stack([np.full(len(y_m), x), y_m, np.full(len(y_m), height_m)]) for x in (15.0, 25.0 * images - 40.0)
    ]
    headings_deg = np.repeat([90.0, -90.0], len(y_m))
    return Plan(np.concatenate(parts), headings_deg, np.zeros(2 * len(y_m), dtype=int))


def simulated(
    plan: Plan,
    *,
    seed: int = 0,
    points: int = 120,
    true_lens: FloatArray = PLAIN,
    true_mount: FloatArray | None = None,
    true_flights: FloatArray | None = None,
    fisheye: bool = False,
    noise_px: float = 0.0,
    tilt_deg: float = 3.0,
    relief_m: float = 20.0,
) -> tuple[Network, Unknowns]:
    """A network of one camera and its truth. Velocities are SPEED_M_S along the headings."""
    rng = np.random.default_rng(seed)
    images, low, high = len(plan.centers_m), plan.centers_m.min(axis=0), plan.centers_m.max(axis=0)
    headings = np.deg2rad(plan.headings_deg)
    angles_deg = rng.normal(0.0, tilt_deg, (images, 3)) + plan.headings_deg[:, None] * [0.0, 0.0, 1.0]
    poses = Unknowns(
        rotations=np.array([from_omega_phi_kappa(*one) for one in angles_deg]),
        centers_m=plan.centers_m + rng.normal(0.0, 1.0, (images, 3)),
        points_m=np.column_stack([
            rng.uniform(low[0] - 40, high[0] + 40, points), rng.uniform(low[1] - 35, high[1] + 35, points),
            rng.uniform(0.0, relief_m, points),
        ]),
        lens=true_lens[None].copy(),
        mount=np.zeros((1, 6)) if true_mount is None else true_mount[None],
        flight=np.zeros((int(plan.flights.max()) + 1, 6)) if true_flights is None else true_flights,
    )  # fmt: skip
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(images), np.arange(points), indexing="ij"))
    network = Network(
        image=image,
        point=point,
        xy_px=np.full((len(image), 2), (HEIGHT_PX - 1) / 2.0),
        sigma_px=np.full(len(image), max(noise_px, 0.1)),
        camera=np.zeros(images, dtype=int),
        flight=plan.flights,
        fisheye=np.array([fisheye]),
        rows_px=np.array([float(HEIGHT_PX)]),
        positions_m=np.full((images, 3), np.nan),
        position_sigmas_m=np.full((images, 3), np.inf),
        attitudes=np.full((images, 3, 3), np.nan),
        attitude_sigmas=np.full((images, 3), np.inf),
        velocities_m_s=SPEED_M_S * np.column_stack([np.cos(headings), np.sin(headings), np.zeros(images)]),
        lens_prior=true_lens[None].copy(),
        lens_sigmas=np.zeros((1, 12)),
        mount_sigmas=np.zeros((1, 6)),
        flight_sigmas=np.zeros_like(poses.flight),
        control=np.zeros(0, dtype=int),
        control_m=np.zeros((0, 3)),
        control_sigmas_m=np.zeros((0, 3)),
        held=np.zeros(images, dtype=bool),
    )
    for _ in range(4):  # a row is read out by where a point is, and that depends on the row
        network = replace(network, xy_px=np.nan_to_num(project(network, poses), nan=-1e4))
    network, truth = _seen(network, poses)
    noise = rng.normal(0.0, noise_px, network.xy_px.shape) if noise_px else 0.0
    return replace(network, xy_px=network.xy_px + noise), truth


def _seen(network: Network, truth: Unknowns) -> tuple[Network, Unknowns]:
    """Image points within the pictures alone, of points that two images see at least."""
    inside = ((network.xy_px >= 0) & (network.xy_px < (WIDTH_PX, HEIGHT_PX))).all(axis=1)
    often: BoolArray = np.bincount(network.point[inside], minlength=len(truth.points_m)) >= 2
    keep = inside & often[network.point]
    row = np.cumsum(often) - 1
    part = {"image": network.image[keep], "point": row[network.point[keep]]}
    part |= {"xy_px": network.xy_px[keep], "sigma_px": network.sigma_px[keep]}
    return replace(network, **part), replace(truth, points_m=truth.points_m[often])


def with_positions(
    network: Network, truth: Unknowns, rng: np.random.Generator, sigma_m: float, *, noise_m: float | None = None
) -> Network:
    """Positions of the antenna as receivers measure them. noise_m: their true standard deviation, where not sigma_m."""
    lever_m = np.einsum("nji,nj->ni", truth.rotations, truth.mount[network.camera, 3:])
    late = truth.flight[network.flight]
    exact_m = truth.centers_m + lever_m + late[:, :3] + network.velocities_m_s * late[:, 3:4]
    noise = rng.normal(0.0, sigma_m if noise_m is None else noise_m, exact_m.shape)
    return replace(network, positions_m=exact_m + noise, position_sigmas_m=np.full(exact_m.shape, sigma_m))


def with_lens_prior(network: Network, prior: FloatArray, **sigmas: float) -> Network:
    """The unknowns of the lens that are named are free, with these standard deviations about the prior (12,)."""
    return replace(network, lens_prior=prior[None].copy(), lens_sigmas=values_of(LENS, **sigmas)[None])


# What is known of a lens that nobody has calibrated, see `calibration`.
UNKNOWN_LENS = {
    "f": 30.0, "cx": 24.0, "cy": 24.0, "k1": 0.09, "k2": 0.16, "k3": 0.28, "p1": 0.001, "p2": 0.001,
    "b1": 0.2, "b2": 0.2,
}  # fmt: skip


def disturbed(
    network: Network, truth: Unknowns, rng: np.random.Generator, *, metres: float = 1.0, degrees: float = 0.5
) -> Unknowns:
    """Where an adjustment starts: poses and points off, what is not held of the rest at its prior."""
    turns = Rotation.from_rotvec(rng.normal(0.0, degrees, (network.images, 3)), degrees=True).as_matrix()
    free = ~network.held[:, None]
    return Unknowns(
        rotations=np.where(free[:, :, None], turns @ truth.rotations, truth.rotations),
        centers_m=truth.centers_m + free * rng.normal(0.0, metres, truth.centers_m.shape),
        points_m=truth.points_m + rng.normal(0.0, metres, truth.points_m.shape),
        lens=network.lens_prior.copy(),
        mount=np.zeros_like(truth.mount),
        flight=np.zeros_like(truth.flight),
    )


def given_positions(positions_m: FloatArray, sigmas_m: FloatArray, **other: FloatArray) -> Given:
    """Positions alone, with standard deviations (N,) of each axis, and what else is named."""
    count = len(positions_m)
    nowhere = np.full((count, 3), np.nan)
    known = {
        "positions_m": positions_m,
        "sigmas_m": np.repeat(np.asarray(sigmas_m)[:, None], 3, axis=1),
        "ups": nowhere,
        "rotations": np.full((count, 3, 3), np.nan),
        "sigmas_deg": np.full(count, np.nan),
        "flights": np.zeros(count, dtype=int),
        "velocities_m_s": np.zeros((count, 3)),
    }
    return Given(**{**known, **other})


def moved(state: Unknowns, change: FloatArray) -> Unknowns:
    """Unknowns with a small change (6 B + 3 P,): of images, lenses, mounts, flights, points, in the order of the normal
    equations."""
    sizes = [6 * len(state.centers_m), state.lens.size, state.mount.size, state.flight.size]
    images, of_lens, of_mount, of_flight, points = np.split(change, np.cumsum(sizes))
    poses = images.reshape(-1, 6)
    return Unknowns(
        Rotation.from_rotvec(poses[:, :3]).as_matrix() @ state.rotations,
        state.centers_m + poses[:, 3:],
        state.points_m + points.reshape(-1, 3),
        state.lens + of_lens.reshape(state.lens.shape),
        state.mount + of_mount.reshape(state.mount.shape),
        state.flight + of_flight.reshape(state.flight.shape),
    )
