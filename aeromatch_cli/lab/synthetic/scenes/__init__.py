"""Scenes: what stands where, and how the ground looks. One file each, one line each in SCENES (scenes/table.py).

A scene is a pair of pure functions. `plan(seed, area)` says the terrain and the solids of an area; what it puts at a
place depends on the seed and that place only, so that a larger area adds and changes nothing. `paint_ground(samples)`
colours the terrain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from aeromatch_cli.lab.synthetic.paint import Painter
from aeromatch_cli.lab.synthetic.solids import Surface
from aeromatch_cli.lab.synthetic.terrain import Area, Terrain


@dataclass(frozen=True, eq=False)
class Plan:
    """What a scene puts into an area.

    heading_deg: the plan's own u axis, counter-clockwise from east; ground painters get u, v turned by it.
    surfaces: solids, without the ground. solids: how many of each kind, by name.
    """

    terrain: Terrain
    heading_deg: float
    surfaces: list[Surface] = field(default_factory=list)
    solids: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneKind:
    """plan: what stands in an area. paint_ground: how its ground looks."""

    plan: Callable[[int, Area], Plan]
    paint_ground: Painter
