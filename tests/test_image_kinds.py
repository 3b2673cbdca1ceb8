"""Images of all kinds: odd names, copies, mixed sizes, depths and formats, without poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, IMAGES, UNORIENTED, WIDTH, Site
from make_images import write_bands, write_jpeg_2000

from aeromatch_cli.files import read_json
from aeromatch_cli.workspace import Workspace

pytestmark = pytest.mark.slow

SETTINGS = UNORIENTED

PAIRS = IMAGES * (IMAGES - 1) // 2


def test_equal_names_in_two_folders(site):
    for index, name in enumerate(site.names()):
        folder = site.images / ("a" if index < 3 else "b")
        folder.mkdir(exist_ok=True)
        (site.images / name).rename(folder / f"{index % 3}.jpg")
    names = [f"{'a' if index < 3 else 'b'}/{index % 3}.jpg" for index in range(IMAGES)]
    site.rewrite_poses(lambda rows: [{**row, "image": name} for row, name in zip(rows, names, strict=True)])
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}
    assert sorted(path.stem for path in (site.work / "features").iterdir()) == sorted(
        name.replace("/", "--").replace(".", "_") for name in names
    )
    site.rewrite_poses(lambda rows: [{**row, "image": Path(row["image"]).name + str(i)} for i, row in enumerate(rows)])
    assert site("run").code == 2


def oriented(site: Site) -> Site:
    """The same with orientation, which has its own use of names, copies and poses."""
    return Site(site.root)


def test_unicode_and_blanks_in_names(site):
    site = oriented(site)
    names = [f"Flug über Łódź {index} #1.JPG" for index in range(IMAGES)]
    for old, new in zip(site.names(), names, strict=True):
        (site.images / old).rename(site.images / new)
    site.rewrite_poses(lambda rows: [{**row, "image": name} for row, name in zip(rows, names, strict=True)])
    outcome = site("run", "--workspace", site.root / "Arbeit für mich")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}
    assert site("run", "--workspace", site.root / "Arbeit für mich").done() == {}


def test_the_same_picture_twice(site):
    site = oriented(site)
    shutil.copy(site.image(0), site.images / "copy.jpg")
    first = next(name for name in site.names() if name != "copy.jpg")
    site.rewrite_poses(lambda rows: [*rows, {**rows[0], "image": "copy.jpg"}])
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["result"]["components"] == [IMAGES]
    later, earlier = sorted(("copy.jpg", first), reverse=True)
    assert (
        f"warning: 1 of {IMAGES + 1} images has the same contents as another ({later} is a copy of {earlier}): the "
        "copy is left out and can be deleted"
    ) in outcome.stderr
    assert outcome.facts["lost"] == {later: f"a copy of {earlier}"}
    assert (site.work / "lost.csv").read_text().splitlines() == [
        "image,what,reason",
        f"{later},left out,a copy of {earlier}",
    ]


def test_of_two_copies_the_one_with_a_pose_is_kept(site):
    """A pose file may name only one of them."""
    shutil.copy(site.image(0), site.images / "a copy.jpg")
    named = sorted(name for name in site.names() if name != "a copy.jpg")[0]
    outcome = site("pairs")
    assert f"(a copy.jpg is a copy of {named})" in outcome.stderr


def test_sizes_depths_and_formats_mixed(site):
    """A 16-bit TIFF and JPEG 2000, a gray PNG and a smaller JPEG among the others, with cameras from EXIF defaults."""
    deep, gray, small, deeper = (site.image(index) for index in range(4))
    renamed = {deep.name: deep.with_suffix(".tif").name, gray.name: gray.with_suffix(".png").name}
    renamed[deeper.name] = deeper.with_suffix(".jp2").name
    bands = np.moveaxis(cv2.imread(str(deeper))[..., ::-1], 2, 0).astype(np.uint16) * 200
    write_jpeg_2000(deeper.with_suffix(".jp2"), bands)
    deeper.unlink()
    cv2.imwrite(str(deep.with_suffix(".tif")), cv2.imread(str(deep)).astype(np.uint16) * 200)
    cv2.imwrite(str(gray.with_suffix(".png")), cv2.imread(str(gray), cv2.IMREAD_GRAYSCALE))
    cv2.imwrite(str(small), cv2.resize(cv2.imread(str(small)), (WIDTH * 3 // 4, HEIGHT * 3 // 4)))
    deep.unlink()
    gray.unlink()
    site.rewrite_poses(lambda rows: [{**row, "image": renamed.get(row["image"], row["image"])} for row in rows])
    outcome = site("run", "--cameras", "exif")
    assert outcome.code == 0, outcome.stderr
    assert outcome.facts["stages"]["extract"]["items"] == IMAGES
    assert outcome.facts["stages"]["filter"]["result"]["pairs"].get("verified", 0) >= PAIRS // 2


@pytest.mark.usefixtures("arms")
def test_tiffs_of_five_bands_of_floats_and_of_signed_numbers(site):
    """With an enhancement and colours, so that every stage sees them."""
    renamed = {}
    for index, (dtype, scale, count) in enumerate([("uint16", 200, 5), ("float32", 1 / 255, 3), ("int16", 100, 1)]):
        path = site.image(index)
        bands = np.moveaxis(cv2.imread(str(path))[..., ::-1], 2, 0).astype(float) * scale
        bands = np.concatenate([bands, bands[:2]])[:count]
        renamed[path.name] = write_bands(path.with_suffix(".tif"), bands.astype(dtype)).name
        path.unlink()
    site.rewrite_poses(lambda rows: [{**row, "image": renamed.get(row["image"], row["image"])} for row in rows])
    outcome = site("run", "--set", "enhance=clahe", "--set", "extract.colours=true")
    assert outcome.code == 0, outcome.stderr
    assert outcome.facts["stages"]["extract"]["items"] == IMAGES
    assert outcome.facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}


def test_images_that_do_not_fit_their_camera(site):
    cv2.imwrite(str(site.image(0)), np.zeros((HEIGHT + 50, WIDTH, 3), np.uint8))
    outcome = site("run")
    assert outcome.code == 1
    assert site.failures() == [("pairs", site.names()[0])]
    assert f"{WIDTH}" in outcome.stderr


def test_images_without_any_pose(site):
    site = oriented(site)
    outcome = site("run", "--poses", "none")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["result"]["verified_matches"] > 100
    views = read_json(Workspace(site.work).views(site.names()[0].replace(".", "_")))["views"]
    assert outcome.facts["stages"]["orient"]["result"]["poses_from"] == "pictures"
    assert [view["is_source"] for view in views] == [False]  # a ground view: the pictures gave the attitude
