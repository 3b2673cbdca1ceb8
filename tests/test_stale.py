"""Nothing stale survives: inputs that change in place, attitudes that lose their standing, files that are missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, UNORIENTED, Site, invoke

from aeromatch_cli.files import read_json
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.stages import context
from aeromatch_cli.workspace import Workspace

pytestmark = pytest.mark.slow
SETTINGS = UNORIENTED


def write_dem(path: Path, far_m: float) -> None:
    """A terrain at 0 m west of x = 20 and at far_m east of it, 1 m cells."""
    import rasterio
    from rasterio.transform import from_origin

    heights = np.zeros((400, 400), np.float32)
    heights[:, 220:] = far_m
    profile = {"driver": "GTiff", "width": 400, "height": 400, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", transform=from_origin(-200.0, 200.0, 1.0, 1.0), **profile) as target:
        target.write(heights, 1)


def test_a_dem_replaced_in_place_does_everything_again(site: Site) -> None:
    dem = site.root / "dem.tif"
    write_dem(dem, 0.0)
    assert site("match", "--ground", dem).code == 0
    before = read_json(Workspace(site.work).block)["gsd_m"]
    write_dem(dem, 30.0)
    again = site("match", "--ground", dem)
    after = read_json(Workspace(site.work).block)["gsd_m"]
    assert again.counts("extract")[0] > 0
    fresh = Site(site.root, site.settings)
    invoke("pairs", "baseline", *fresh.options("--ground", dem, "--workspace", site.root / "fresh"))
    assert after == read_json(Workspace(site.root / "fresh").block)["gsd_m"]
    assert after != before


def test_the_ground_is_where_an_oblique_image_looks() -> None:
    """Camera at (0, 0, 100) looking east at 45 degrees: it stands over 0 m and looks at the step's upper side."""
    from aeromatch_cli.blocks.ground import DemGround
    from aeromatch_cli.data import Block, Camera, Image, Pose

    heights = np.zeros((101, 401))
    heights[:, 220:] = 20.0  # from x = 20 m on
    ground = DemGround(heights, -200.0, 50.0, (1.0, 1.0), 0.0)
    camera = Camera("PINHOLE", 400, 300, (800.0, 800.0, 199.5, 149.5))
    pose = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(0.0, -45.0, 0.0), 1.0, 1.0)
    images = (Image("a", "a.jpg", 400, 300, "1"), Image("b", "b.jpg", 400, 300, "1"))
    position_only = Pose(pose.center_m, None, 1.0, 1.0)
    block = Block(images, {"1": camera}, {"a": pose, "b": position_only}, "local", (0.0, 0.0, 0.0), ground, "DEM", None)
    heights_m = context._ground_heights(block)
    assert heights_m["a"] == pytest.approx(20.0)
    assert heights_m["b"] == 0.0


def test_missing_weights_are_noticed_before_anything_is_made(site: Site) -> None:
    outcome = site("run", "--set", "match=lightglue", "--set", "match.weights=absent.safetensors")
    assert outcome.code == 2
    assert not (site.work / "features").exists()


def test_a_focal_length_that_is_no_guess_any_more_is_exported_anew(site: Site) -> None:
    import sqlite3

    def prior() -> int:
        with sqlite3.connect(site.work / "export" / "colmap" / "database.db") as database:
            return int(database.execute("SELECT prior_focal_length FROM cameras").fetchone()[0])

    guessed = ["--images", site.images, "--poses", site.poses, "--cameras", "exif", "--workspace", site.work]
    guessed += ["--jobs", "1", "--set", "extract.keypoints=400", "--ground", "0"]
    assert invoke("run", "baseline", *guessed).code == 0
    assert prior() == 0
    assert site("run").code == 0
    assert prior() == 1


@pytest.mark.usefixtures("arms")
def test_pictures_of_other_settings_do_not_stay(site: Site) -> None:
    workspace = Workspace(site.work)
    image_id = site.names()[0].replace(".", "_")
    assert site("enhance", "--set", "enhance=shadow").code == 0
    assert workspace.enhanced(image_id, ".mask.png").is_file()
    assert site("simulate", "--set", "simulate=tilts").code == 0
    tilted = {path.name for path in workspace.views(image_id).parent.glob("*.png")}
    assert site("enhance").code == 0
    assert not workspace.enhanced(image_id, ".mask.png").exists()
    assert site("simulate").code == 0
    names = {path.stem for path in workspace.views(image_id).parent.glob("*.png")}
    assert names == {view["name"] for view in read_json(workspace.views(image_id))["views"]}
    assert not tilted <= {f"{name}.png" for name in names}


@pytest.mark.usefixtures("arms")
def test_pictures_of_views_outlive_features_of_other_settings(site: Site) -> None:
    """They were asked for, and features are found without them."""
    workspace = Workspace(site.work)
    image_id = site.names()[0].replace(".", "_")
    folder = workspace.views(image_id).parent

    def shown() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in folder.glob("*.png")}

    assert site("simulate", "--set", "simulate=tilts").code == 0
    tilted = shown()
    assert site("simulate", "--set", "simulate=tilts").done() == {}
    assert site("match").code == 0
    assert shown() == tilted
    told = read_json(workspace.view_pictures(image_id))["views"]
    assert {f"{view['name']}.png" for view in told} == tilted.keys()
    assert [view["name"] for view in read_json(workspace.views(image_id))["views"]] == ["ground"]
    assert site("match").done() == {}
    assert site("match", "--keep-images").code == 0
    assert shown().keys() == {"ground.png"}


@pytest.mark.parametrize("command", ["extract", "run"])
def test_pictures_of_the_same_settings_stay(site: Site, command: str) -> None:
    shadow = ("--set", "enhance=shadow")
    assert site("enhance", *shadow).code == site("simulate", *shadow).code == 0

    def pictures() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in site.work.glob("*ed/**/*.png") if "mask" not in path.name}

    made = pictures()
    assert len(made) >= 2 * IMAGES
    assert site(command, *shadow).counts("extract") == (IMAGES, 0, 0)
    assert pictures() == made
    for stage in ("enhance", "simulate"):
        assert site(stage, *shadow).counts(stage) == (0, IMAGES, 0)
    # Of other settings enhanced ones go: the features come from other pixels. Those that `simulate` has made stay.
    assert site(command, *shadow, "--set", "enhance.max_gain=5").code == 0
    assert pictures() == {path: time for path, time in made.items() if "simulated" in path.parts}
