"""Named blocks: a scene, how high it is flown, and the light of the day, drawn from the seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.lab.synthetic.light import Light
from aeromatch_cli.lab.synthetic.sensor import Development

# Independent random streams of one seed; scenes use small numbers of their own.
_LIGHT_STREAM, _IMAGE_STREAM = 101, 102
_EXPOSURE_SIGMA, _BALANCE_SIGMA = 0.05, 0.015
# The second sortie of a day is taken with a darker setting, as ochota's second series.
_SORTIE_EXPOSURE = (1.0, 0.6)


@dataclass(frozen=True)
class Preset:
    """scene: one of scenes.table.SCENES. height_m: flying height above the datum (z = 0). sun_elevation_deg: lowest
    and highest of the first sortie; the second flies under a lower sun from another side."""

    scene: str
    height_m: float
    sun_elevation_deg: tuple[float, float] = (38.0, 55.0)


PRESETS: Mapping[str, Preset] = {
    "city": Preset("city", 150.0, (58.0, 68.0)),
    "suburb": Preset("suburb", 110.0, (50.0, 62.0)),
    "farmland": Preset("farmland", 120.0),
    "grass": Preset("grass", 80.0),
    "desert": Preset("desert", 120.0, (28.0, 42.0)),
    "hills": Preset("hills", 180.0, (30.0, 50.0)),
    "water-edge": Preset("water-edge", 100.0),
}


def lights(preset: Preset, seed: int) -> tuple[Light, Light]:
    """The light of both sorties: late morning and, in another season, afternoon."""
    rng = np.random.default_rng([seed, _LIGHT_STREAM])
    first = Light(
        sun_azimuth_deg=round(float(rng.uniform(110.0, 160.0)), 3),
        sun_elevation_deg=round(float(rng.uniform(*preset.sun_elevation_deg)), 3),
        haze_per_km=round(float(rng.uniform(0.05, 0.15)), 3),
        season=round(float(rng.uniform(0.0, 0.2)), 3),
    )
    second = Light(
        sun_azimuth_deg=round(first.sun_azimuth_deg + float(rng.uniform(70.0, 120.0)), 3),
        sun_elevation_deg=round(float(rng.uniform(24.0, 36.0)), 3),
        haze_per_km=round(float(rng.uniform(0.08, 0.22)), 3),
        sky=round(float(rng.uniform(0.8, 1.3)), 3),
        season=round(float(rng.uniform(0.5, 0.9)), 3),
    )
    return first, second


def development(seed: int, image_idx: int, sortie: int, metered: float) -> Development:
    """How one picture of a sortie is taken, around the exposure that was metered for it."""
    rng = np.random.default_rng([seed, _IMAGE_STREAM, image_idx])
    red, blue = 1.0 + _BALANCE_SIGMA * rng.standard_normal(2)
    return Development(
        exposure=metered * _SORTIE_EXPOSURE[sortie] * float(np.exp(_EXPOSURE_SIGMA * rng.standard_normal())),
        white_balance=(float(red), 1.0, float(blue)),
        blur_px=float(rng.uniform(0.35, 0.6)),
    )


def image_rng(seed: int, image_idx: int) -> np.random.Generator:
    """The noise of one picture."""
    return np.random.default_rng([seed, _IMAGE_STREAM, image_idx, 1])
