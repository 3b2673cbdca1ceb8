"""Where the pictures of a rendered block are taken, how exactly that is known, and what ground they show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.footprints import ground_footprint
from aeromatch_cli.lab.synthetic.flight_plans import FLIGHTS, Order
from aeromatch_cli.lab.synthetic.stations import Exterior, Station, rounded
from aeromatch_cli.lab.synthetic.terrain import Area

# Pose noise of the benchmark: 5 % of the height on every coordinate, 3 degrees on every angle.
NOISE_SHARE_OF_HEIGHT, NOISE_ANGLE_DEG = 0.05, 3.0
# Footprints of a rendered block end at this many flying heights: an upper picture edge may look at the horizon.
MAX_DISTANCE_FACTOR = 4.0


@dataclass(frozen=True)
class Flight:
    """All pictures of a block in the order of taking, and their cameras by camera_id."""

    name: str
    cameras: Mapping[str, Camera]
    stations: tuple[Station, ...]


def plan_flight(
    name: str, *, images: int, width_px: int, height_px: int, height_m: float, lens: str, rng: np.random.Generator
) -> Flight:
    """Exact poses of `images` pictures of width_px x height_px of the flight called `name` in FLIGHTS.

    height_m: flying height of the nadir pictures above z = 0; other cameras fly where they sample the ground alike.
    Poses are rounded first (0.1 mm, 1e-6 degrees), so that their text is exact, too. Raises ConfigError on an unknown
    flight or lens and on numbers that are not positive.
    """
    if name not in FLIGHTS:
        raise ConfigError(f"flight {name!r} is not known; use one of {', '.join(FLIGHTS)}")
    if images < 1:
        raise ConfigError(f"a flight of {images} images has nothing to render; ask for at least 1 image")
    if min(width_px, height_px) < 1 or not height_m > 0.0:
        raise ConfigError(
            f"a picture of {width_px} x {height_px} px from {height_m} m cannot be planned; give positive numbers"
        )
    cameras, stations = FLIGHTS[name](Order(images, width_px, height_px, height_m, lens, rng))
    used = {station.camera_id for station in stations}
    return Flight(name, {key: camera for key, camera in cameras.items() if key in used}, tuple(stations))


def noisy(exterior: Exterior, rng: np.random.Generator, height_m: float) -> Exterior:
    """The exterior orientation as a cheap receiver and gyro would give it from that height (Gaussian, independent)."""
    exact = np.array([exterior.x_m, exterior.y_m, exterior.z_m])
    position = exact + NOISE_SHARE_OF_HEIGHT * height_m * rng.standard_normal(3)
    angles = np.array([exterior.omega_deg, exterior.phi_deg, exterior.kappa_deg])
    return rounded(position, angles + NOISE_ANGLE_DEG * rng.standard_normal(3))


def gsd_m(flight: Flight) -> float:
    """Metres on the ground per pixel in the middle of the first sortie's steepest picture, from its planned height."""

    def steepness(station: Station) -> float:
        """Cosine of the tilt."""
        return float(np.prod(np.cos(np.deg2rad([station.exterior.omega_deg, station.exterior.phi_deg]))))

    steepest = max((s for s in flight.stations if s.sortie == 0), key=steepness)
    return steepest.height_m / steepness(steepest) / focal_px(flight.cameras[steepest.camera_id])


def ground_area(flight: Flight, margin_m: float, z_m: float = 0.0) -> Area:
    """Bounding rectangle of everything that the pictures show of the plane z = z_m, grown by margin_m.

    A picture counts up to MAX_DISTANCE_FACTOR flying heights from its foot point. Raises ConfigError where no picture
    is taken from above the plane.
    """
    polygons = [
        ground_footprint(flight.cameras[s.camera_id], s.exterior.pose(), z_m, MAX_DISTANCE_FACTOR * s.height_m)
        for s in flight.stations
    ]
    points = np.concatenate(polygons)
    if len(points) == 0:
        raise ConfigError(f"flight {flight.name} sees no ground at a height of {z_m:.1f} m; fly higher")
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return Area(x0, y0, x1, y1).grown(margin_m)
