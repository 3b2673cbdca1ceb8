"""Whether a camera has the same calibration in all of its flights, and that at which a setting holds it: the block with
further unknowns of lenses beside the block as it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.sfm.bundle.network import READOUT, Network, Unknowns
from aeromatch_cli.sfm.bundle.solve import solve

# A flight with fewer images or image points tells nothing of its lens: four of one heading (8 images of sheffield) take
# the tilt of the block for the lens' centre.
_FEWEST_IMAGES, _FEWEST_POINTS = 6, 500
# A lens of its own is another one where it lowers the sum of squares by so much for each of its unknowns. By chance it
# is 1; errors of real matches have causes in common, and halves of one flight reach 9 (seneca, every third image).
_WORTH_SQUARES = 15.0


@dataclass(frozen=True, eq=False)
class FlightLens:
    """The lens of a camera in one of its flights, against that in its flight of most images.

    camera, flight: rows. change: (12,) by `network.LENS`. worth: by how much a lens of its own lowers the sum of
    squares, over what is asked for: another lens beyond 1.
    """

    camera: int
    flight: int
    change: FloatArray
    worth: float


def lenses_by_flight(network: Network, state: Unknowns, tolerance: float) -> list[FlightLens]:
    """Return a separate lens for every flight of the cameras with several flights that each determine a lens. state: a
    solution of the network."""
    found = []
    apart = list(_apart(network))
    as_it_is = solve(network, state, tolerance, near=True).cost if apart else 0.0
    for camera, flight in apart:
        own = (network.camera == camera) & (network.flight == flight)
        split, start = _split(network, state, camera, own)
        solved = solve(split, start, tolerance, near=True)
        gain = 2.0 * (as_it_is - solved.cost)
        asked = _WORTH_SQUARES * np.count_nonzero(split.lens_sigmas[-1])
        found.append(FlightLens(camera, flight, solved.state.lens[-1] - solved.state.lens[camera], float(gain / asked)))
    return found


def lenses_if_freed(
    network: Network, state: Unknowns, sigmas: FloatArray, tolerance: float
) -> tuple[FloatArray, float]:
    """Return the changes (K, 12) of lenses with further unknowns, and by how much these lower the sum of squares,
    over what is asked for. sigmas: (K, 12) of the further unknowns, else 0. state: a solution of the network."""
    further = (sigmas > 0.0) & (network.lens_sigmas == 0.0)
    if not further.any():
        return np.zeros_like(sigmas), 0.0
    solved = solve(replace(network, lens_sigmas=np.where(further, sigmas, network.lens_sigmas)), state, tolerance)
    gain = 2.0 * (solve(network, state, tolerance, near=True).cost - solved.cost)
    return (solved.state.lens - state.lens) * further, float(gain / (_WORTH_SQUARES * np.count_nonzero(further)))


def _apart(network: Network) -> Iterator[tuple[int, int]]:
    """Cameras with those of their flights that tell of a lens, but for that of most images."""
    for camera in range(network.cameras):
        if not network.lens_sigmas[camera].any():
            continue
        images = np.bincount(network.flight[network.camera == camera], minlength=network.flights)
        of_camera = network.image[network.camera[network.image] == camera]
        points = np.bincount(network.flight[of_camera], minlength=network.flights)
        telling = np.flatnonzero((images >= _FEWEST_IMAGES) & (points >= _FEWEST_POINTS))
        if len(telling) > 1:
            most = telling[np.argmax(images[telling])]
            yield from ((camera, int(flight)) for flight in telling if flight != most)


def _split(network: Network, state: Unknowns, camera: int, own: BoolArray) -> tuple[Network, Unknowns]:
    """The network with a further lens for the images (N,) of a camera, which is known as well as the camera's was."""
    again = np.append(np.arange(network.cameras), camera)
    sigmas = network.lens_sigmas[again]
    sigmas[-1, READOUT] = 0.0  # of the shutter, which no flight changes
    split = replace(
        network,
        camera=np.where(own, network.cameras, network.camera),
        fisheye=network.fisheye[again],
        rows_px=network.rows_px[again],
        lens_prior=np.vstack([network.lens_prior, state.lens[camera]]),
        lens_sigmas=sigmas,
        mount_sigmas=network.mount_sigmas[again],
    )
    return split, replace(state, lens=state.lens[again], mount=state.mount[again])
