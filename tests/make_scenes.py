"""Small scenes whose truth can be worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aeromatch_cli.data import Camera
from aeromatch_cli.lab.synthetic.light import Light
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, shades
from aeromatch_cli.lab.synthetic.raycast import RayCaster
from aeromatch_cli.lab.synthetic.render import View
from aeromatch_cli.lab.synthetic.scene import Scene, assemble
from aeromatch_cli.lab.synthetic.scenes import Plan
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface, box
from aeromatch_cli.lab.synthetic.stations import Exterior
from aeromatch_cli.lab.synthetic.terrain import Area, Flat, Terrain
from aeromatch_cli.lab.synthetic.truth import Truth

PLAIN = (Material.PAINT, (0.4, 0.4, 0.4))
NOON_WEST = Light(sun_azimuth_deg=270.0, sun_elevation_deg=45.0, haze_per_km=0.0)


def paint_gray(samples: Samples) -> Painted:
    return Painted(shades((0.4, 0.4, 0.4), 1.0 + 0.1 * samples.patch))


def make_scene(*solids: Surface, terrain: Terrain | None = None, half_m: float = 200.0) -> Scene:
    """Solids on gray ground (a plane where no terrain is given)."""
    plan = Plan(terrain or Flat(), 0.0, list(solids), {})
    return assemble("by hand", 0, Area(-half_m, -half_m, half_m, half_m), plan, paint_gray)


def one_box() -> Scene:
    """A box of 10 m x 10 m x 20 m around the origin on the plane z = 0."""
    return make_scene(*box(Footprint(0.0, 0.0, 10.0, 10.0, 0.0), 0.0, 20.0, PLAIN, PLAIN))


def make_truth(scene: Scene, camera: Camera, **exteriors: Exterior) -> Truth:
    """The truth of pictures of a scene, without files."""
    poses = {name: exterior.pose() for name, exterior in exteriors.items()}
    return Truth(Path(), scene, RayCaster(scene), dict.fromkeys(poses, camera), poses, dict.fromkeys(poses, 0))


def make_view(camera: Camera, exterior: Exterior) -> View:
    pose = exterior.pose()
    assert pose.world_rotation is not None
    return View(camera, np.asarray(pose.world_rotation), pose.center_m, 0)
