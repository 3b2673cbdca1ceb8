"""The scenes by name."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.lab.synthetic.scenes import SceneKind, city, desert, farmland, grass, hills, suburb, water_edge

SCENES: Mapping[str, SceneKind] = {
    "city": city.SCENE,
    "suburb": suburb.SCENE,
    "farmland": farmland.SCENE,
    "grass": grass.SCENE,
    "desert": desert.SCENE,
    "hills": hills.SCENE,
    "water-edge": water_edge.SCENE,
}
