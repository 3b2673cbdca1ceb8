"""Calibration: what is known of a camera before the adjustment, and the camera that an adjustment has found.

Every parameter of Brown's model is an unknown with a prior: its stated value and a standard deviation by where that
comes from. What the block does not determine stays near its prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import BROWN, FISHEYE, MODELS, as_brown, focal_px, is_fisheye, parameters
from aeromatch_cli.sfm.bundle.network import LENS

Calibration = Literal["auto", "given", "focal", "brown"]

# Standard deviations of what nobody has stated: the principal point as a share of the picture's width; the radial terms
# each by what they move the corner of the picture, as a share of its distance from the middle; decentring likewise;
# affinity and skew as a share of the focal length. Lenses of consumer cameras: Luhmann et al., Close-Range
# Photogrammetry, section 3.3; principal points 15 to 24 px off in pictures of 1,000 to 4,000 px.
_CENTRE, _RADIAL, _DECENTRING, _AFFINITY = 0.02, 0.05, 0.002, 0.0002
# A calibration that was stated is this much nearer to the truth than nothing; it was made at another time, temperature
# and focus.
_STATED = 0.25
# Fewer images determine no more than the focal length, and none of it.
_FOCAL_IMAGES, _LENS_IMAGES = 3, 4
_SKEW = LENS.index("b2")


@dataclass(frozen=True, eq=False)
class LensPrior:
    """lens, sigmas: (12,) by `network.LENS`, pixels in this project's frame; fisheye: the model of both."""

    lens: FloatArray
    sigmas: FloatArray
    fisheye: bool


def lens_of(camera: Camera) -> FloatArray:
    """Return the values (12,) of a camera by `network.LENS`."""
    values = dict.fromkeys(LENS, 0.0)
    if is_fisheye(camera):
        p = parameters(camera)
        values |= {name: p[name] for name in ("cx", "cy", "k1", "k2", "k3")}
        values |= {"f": p["fy"], "b1": p["fx"] - p["fy"], "p1": p["k4"]}
    else:
        values |= dict(zip(MODELS[BROWN], as_brown(camera).params, strict=True))
    return np.array([values[name] for name in LENS])


def camera_of(lens: FloatArray, given: Camera) -> Camera:
    """Return the camera of these values (12,): of the given one's model where that holds them exactly, else of
    BROWN."""
    values = dict(zip(LENS, (float(value) for value in lens), strict=True))
    if is_fisheye(given):
        named = {**values, "fx": values["f"] + values["b1"], "fy": values["f"], "k4": values["p1"]}
        return Camera(FISHEYE, given.width_px, given.height_px, tuple(named[name] for name in MODELS[FISHEYE]))
    brown = Camera(BROWN, given.width_px, given.height_px, tuple(values[name] for name in MODELS[BROWN]))
    named = {**parameters(brown), **values}
    same = Camera(given.model, given.width_px, given.height_px, tuple(named[n] for n in MODELS[given.model]))
    return same if np.array_equal(lens_of(same)[:10], lens_of(brown)[:10]) else brown


def lens_prior(camera: Camera, focal_sigma: float) -> LensPrior:
    """Return what is known of a camera before the adjustment: values and standard deviations of its parameters.
    focal_sigma: standard deviation of its focal length, as a share of it."""
    lens, focal = lens_of(camera), focal_px(camera)
    middle = (camera.width_px - 1) / 2.0, (camera.height_px - 1) / 2.0
    centred = np.allclose(lens[1:3], middle, atol=1.0)
    stated = bool(lens[3:10].any()) or not centred
    radius = float(np.hypot(camera.width_px, camera.height_px)) / (2.0 * focal)
    if is_fisheye(camera):
        radius = float(np.arctan(radius))
    sigmas = {
        "cx": _CENTRE * camera.width_px,
        "cy": _CENTRE * camera.width_px,
        **{name: _RADIAL / radius**power for name, power in (("k1", 2), ("k2", 4), ("k3", 6))},
        **dict.fromkeys(("p1", "p2"), _DECENTRING / min(radius, 1.0)),
        **dict.fromkeys(("b1", "b2"), _AFFINITY * focal),
    }
    if is_fisheye(camera):
        sigmas |= {"p1": _RADIAL / radius**8, "p2": 0.0, "b2": 0.0}
    if stated:
        # SIMPLE_RADIAL says nothing of decentring; a principal point in the middle is one that nobody has looked for.
        known = _terms(camera) - ({"cx", "cy"} if centred else set())
        sigmas |= {name: _STATED * sigmas[name] for name in known}
    sigmas["f"] = focal_sigma * focal
    return LensPrior(lens, np.array([sigmas.get(name, 0.0) for name in LENS]), is_fisheye(camera))


def _terms(camera: Camera) -> set[str]:
    """Names in `network.LENS` of what the camera's model has, but for the focal length."""
    names = set(MODELS[camera.model])
    if is_fisheye(camera):
        return {"cx", "cy", "k1", "k2", "k3", "p1", "b1"}
    return (names & set(LENS) - {"f"}) | ({"b1"} if "fx" in names else set())


def freed(prior: LensPrior, calibration: Calibration, switches: Mapping[str, bool], images: int) -> FloatArray:
    """Return the standard deviations (12,) of the unknowns, 0 where one is held.

    calibration: "given" holds all, "focal" all but the focal length; "brown" frees all, whatever the block says of
    them; "auto" leaves it to the adjustment, but for a skew that nobody has stated. switches: by name, what is free or
    held in any case. images: that the camera has taken.
    """
    free = np.zeros(len(LENS), dtype=bool)
    if calibration != "given" and images >= _FOCAL_IMAGES:
        free[LENS.index("f")] = True
    if calibration in ("auto", "brown") and images >= _LENS_IMAGES:
        free[:10] = True
        # Pixels of sensors are square: what looks like skew is a rolling shutter or positions that are off (sheffield,
        # caliterra), and COLMAP and others have no place for it.
        free[_SKEW] = calibration == "brown" or prior.lens[_SKEW] != 0.0
    for name, on in switches.items():
        free[LENS.index(name)] = on
    return np.where(free, prior.sigmas, 0.0)


def held_by(calibration: Calibration, switches: Mapping[str, bool]) -> dict[str, str]:
    """Name of a parameter -> the setting that holds it as it was stated; nothing of what the block may free."""
    left = {"given": MODELS[BROWN], "focal": MODELS[BROWN][1:]}.get(calibration, ())
    found = {name: f"adjust.calibration={calibration}" for name in left if name not in switches}
    return found | {name: "adjust.hold" for name, free in switches.items() if not free}
