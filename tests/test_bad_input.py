"""Bad input: a clear message (what, where, what to do), the right exit code, nothing lost, and the rest goes on."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, IMAGES, UNORIENTED, WIDTH, contents, invoke

from aeromatch_cli.blocks import scan
from aeromatch_cli.formats.features import read_features

pytestmark = pytest.mark.slow
SETTINGS = UNORIENTED

PAIRS = IMAGES * (IMAGES - 1) // 2


def spoil(path: Path, how: str) -> None:
    data = path.read_bytes()
    if how == "corrupt":  # a sound header, then noise
        path.write_bytes(data[: len(data) // 3] + bytes(255 - b for b in data[len(data) // 3 :]))
    elif how == "cut off":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "broken link":
        path.unlink()
        path.symlink_to(path.parent / "nowhere.jpg")


def files(work: Path) -> dict[Path, bytes]:
    """All files but the index, which learns what it was asked."""
    return {path: path.read_bytes() for path in work.rglob("*") if path.is_file() and path.name != "index.sqlite"}


@pytest.mark.parametrize("how", ["corrupt", "cut off", "empty", "broken link"])
def test_one_bad_image_never_stops_the_rest(site, how):
    bad = site.image(2)
    good = site.root / "good.jpg"
    shutil.copy2(bad, good)
    spoil(bad, how)
    outcome = site("run")
    assert outcome.code == 1
    assert outcome.facts["failures"] == 1
    assert outcome.counts("filter")[0] == (IMAGES - 1) * (IMAGES - 2) // 2
    [(stage, item)] = site.failures()
    assert item == bad.name
    assert bad.name in outcome.stderr
    assert bad.name.replace(".", "_") not in outcome.stderr
    links = outcome.facts["stages"]["filter"]["result"]  # of the images that could be read
    assert (links["components"], links["weakly_tied"], links["unconnected"]) == ([IMAGES - 1], [], [])
    assert links["unread"] == ([bad.name] if stage == "extract" else [])
    what = "not read" if stage == "extract" else "left out"
    assert f"(1 {what}): {bad.name}" in outcome.stdout

    before = files(site.work)
    again = site("run")  # it still fails, so it is still reported
    assert again.code == 1
    assert files(site.work) == before
    assert site.failures() == [(stage, item)]
    for command in ("match", "filter", "export", "report"):
        assert site(command).code == 1

    bad.unlink()
    shutil.copy2(good, bad)
    repaired = site("run")
    assert repaired.code == 0
    assert site.failures() == []
    assert repaired.counts("extract")[0] == 1


def test_a_bad_image_is_named_once_by_its_name(site):
    """The first pass meets it, the step of the cascade, and the stage that joins the steps."""
    bad = site.image(2)
    spoil(bad, "cut off")
    outcome = site("run", "--set", "orient=global", "--set", "cascade=guided")
    assert outcome.code == 1
    (line,) = [line for line in outcome.stderr.splitlines() if bad.stem in line]
    assert line.startswith(f"extract: {bad.name}: ")
    assert f"{IMAGES - 1} of {IMAGES} images oriented" in outcome.stdout
    assert f"1 of {IMAGES} images is not in the block, since the pictures could not be read" in outcome.stdout


def test_a_bad_image_that_is_removed_is_no_failure_any_more(site):
    spoil(site.image(2), "cut off")
    assert site("run").code == 1
    site.image(2).unlink()
    site.rewrite_poses(lambda rows: [row for row in rows if (site.images / row["image"]).exists()])
    assert site("run").code == 0
    assert site.failures() == []


def test_folders_and_metadata_with_names_of_images(site):
    (site.images / "x.jpg").mkdir()
    (site.images / "._x.jpg").write_bytes(b"\x00\x05\x16\x07" + bytes(60))
    outcome = site("run")
    assert outcome.code == 0
    assert "x.jpg: is a folder with the name of an image" in outcome.stderr
    assert "._x.jpg" in outcome.stderr
    assert outcome.facts["stages"]["pairs"]["result"]["images"] == IMAGES


def test_image_without_keypoints(site):
    cv2.imwrite(str(site.image(1)), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["extract"]["result"]["images_without_keypoints"] == 1
    assert outcome.facts["stages"]["filter"]["result"]["pairs"]["not verifiable"] == IMAGES - 1
    assert outcome.facts["stages"]["filter"]["result"]["weakly_tied"] == [site.image(1).name]
    assert site("run").done() == {}


def test_no_image_has_keypoints(site):
    for gray, path in enumerate(site.images.iterdir(), start=90):
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), gray, np.uint8))
    outcome = site("run")
    assert outcome.code == 3
    assert "no pair could be verified" in outcome.facts["error"]
    assert (site.work / "report" / "index.html").is_file()


def test_every_image_is_bad(site):
    for path in site.images.iterdir():
        spoil(path, "empty")
    outcome = site("run")
    assert outcome.code == 3
    assert f"none of the {IMAGES} images" in outcome.stderr
    for path in site.images.iterdir():
        path.write_bytes(b"\xff\xd8\xff")
    assert site("run").code == 3


def test_one_image_only(site):
    for path in sorted(site.images.iterdir())[1:]:
        path.unlink()
    outcome = site("run")
    assert outcome.code == 3
    assert f"only one image can be used ({site.names()[0]})" in outcome.stderr
    assert not site.work.exists()


def test_empty_missing_and_wrong_folder(site):
    empty = site.root / "empty"
    empty.mkdir()
    options = ["--poses", "none", "--workspace", site.work, "--json"]
    outcome = invoke("run", "baseline", "--images", empty, *options)
    assert (outcome.code, "no image" in outcome.stderr) == (3, True)
    outcome = invoke("run", "baseline", "--images", site.root / "absent", *options)
    assert (outcome.code, "does not exist" in outcome.stderr) == (2, True)
    outcome = invoke("run", "baseline", "--images", site.poses, *options)
    assert (outcome.code, "is not a folder" in outcome.stderr) == (2, True)
    assert invoke("run", "baseline", "--workspace", site.work, "--json").code == 2


def test_unreadable_folder_and_subfolder(site, monkeypatch):
    """Permissions stop no administrator: the system's answer is simulated."""
    walk = os.walk

    def refusing(top, onerror=None, **options):
        if onerror:
            onerror(PermissionError(errno.EACCES, "Permission denied", str(Path(top) / "closed")))
        return walk(top, onerror=onerror, **options)

    monkeypatch.setattr(scan.os, "walk", refusing)
    outcome = site("run")
    assert outcome.code == 1
    assert site.failures() == [("pairs", "closed")]
    assert "folder cannot be read (Permission denied)" in outcome.stderr

    def closed(self):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(scan.Path, "iterdir", closed)
    outcome = site("run")
    assert outcome.code == 2
    assert "cannot be read (Permission denied)" in outcome.stderr


# --- lists and settings -------------------------------------------------------------------------------------------


def test_pose_list_and_folder_disagree(site):
    site.rewrite_poses(lambda rows: [*rows[:-1], {**rows[-1], "image": "elsewhere.jpg"}])
    outcome = site("run")
    assert outcome.code == 0
    assert "elsewhere.jpg" in outcome.stderr
    assert f"1 of {IMAGES} images ({site.names()[-1]}) is not in" in outcome.stderr
    assert any(
        site.names()[-1].replace(".", "_") in line for line in (site.work / "pairs.csv").read_text().splitlines()
    )


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda rows: [*rows, rows[0]], 2, "stands in line 2 already"),
        (lambda rows: [{**row, "image": f"other/{row['image']}x"} for row in rows], 2, "names none of the 5 images"),
        (lambda rows: [{**rows[0], "x": "nan"}, *rows[1:]], 0, "treated as unposed"),
        (lambda rows: [{**rows[0], "x": "twelve"}, *rows[1:]], 2, "'twelve' is not a number"),
        (lambda rows: [{**rows[0], "x": "inf"}, *rows[1:]], 2, "out of range"),
    ],
)
def test_pose_list_with_defects(site, change, code, words):
    site.rewrite_poses(change)
    outcome = site("pairs")
    assert (outcome.code, words in outcome.stderr) == (code, True)
    assert site.poses.name in outcome.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("nothing,of,this\n1,2,3\n", "no header with a column 'image'"),
        ("image,x,y,z\na.jpg,1,2\n", "line 2: 3 values, but the header names 4 columns"),
        ("image,x,y,agl\na.jpg,1,2,3\n", "column 'z' is missing"),
        ("image,x,y,z\n", "no line follows the header"),
        ("\0\0\0", "binary"),
    ],
)
def test_malformed_pose_list(site, text, words):
    site.poses.write_text(text)
    outcome = site("run")
    assert (outcome.code, words in outcome.stderr) == (2, True)
    assert not (site.work / "images.csv").exists()


def test_missing_files_of_the_block(site):
    for option, words in (
        ("--poses", "pose list"),
        ("--cameras", "cameras"),
        ("--masks", "masks"),
        ("--ground", "DEM"),
    ):
        outcome = site("run", option, site.root / "absent.csv")
        assert (outcome.code, words.lower() in outcome.stderr.lower()) == (2, True), outcome.stderr
        assert "absent.csv" in outcome.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "extract.keypoint=5"], "did you mean 'keypoints'"),
        (["--set", "extrat.keypoints=5"], "extrat"),
        (["--set", "extract.keypoints=many"], "extract.keypoints"),
        (["--set", "extract"], "key.sub=value"),
        (["--set", "filter=poslib"], "poselib"),
        (["--shard", "3/2"], "--shard '3/2'"),
        (["--shard", "half"], "--shard 'half'"),
        (["--jobs", "-1"], "--jobs"),
        (["--executor", "threads"], "threads"),
        (["--crs", "EPSG:99999999"], "99999999"),
        (["--ground", "deep"], "deep"),
        (["--no-such-option"], "--no-such-option"),
    ],
)
def test_wrong_arguments_name_themselves(site, arguments, words):
    outcome = site("run", *arguments)
    assert outcome.code == 2
    assert words in outcome.stderr
    assert not (site.work / "features").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--crs", "EPSG:99999"], "crs 'EPSG:99999' is unknown"),
        (["--crs", "EPSG:4326"], "is not projected"),
        (["--set", "block.heights=EPSG:32633"], "heights 'EPSG:32633' are unknown"),
        (["--ground", "none.tif"], "none.tif: no such file, and no number: give metres, a DEM or auto"),
        (["--ground", "2e6"], "--ground 2e6: no height of any ground"),
        (["--gcp", "none.txt"], "none.txt cannot be read (No such file or directory): give ODM's gcp_list.txt"),
        (
            ["--gcp", __file__, "--gcp-marks", "none.csv"],
            "none.csv cannot be read (No such file or directory): give a table of image, label",
        ),
    ],
)
def test_what_is_wrong_with_any_images_is_refused_before_the_images_are_read(site, arguments, words, monkeypatch):
    read = []
    monkeypatch.setattr("aeromatch_cli.stages.block.scan_images", lambda *given: read.append(given))
    outcome = site("run", *arguments)
    assert (outcome.code, words in outcome.stderr, read) == (2, True, []), outcome.stderr


def test_wrong_configuration_files(site):
    for text, words in (
        ("extract: {keypoint: 3}\n", "unknown key"),
        ("extract: [\n", "is not YAML"),
        ("- a\n- b\n", "keys and values"),
        ("seed: often\n", "seed"),
    ):
        path = site.root / "config.yaml"
        path.write_text(text)
        outcome = invoke("run", path, *site.options("--json"))
        assert (outcome.code, words in outcome.stderr, str(path) in outcome.stderr) == (2, True, True)
    outcome = invoke("run", "baselin", *site.options("--json"))
    assert (outcome.code, "baseline" in outcome.stderr) == (2, True)
    assert invoke("run", site.root / "absent.yaml", "--json").code == 2


def test_shards_do_not_fit_what_needs_everything(site):
    for command in ("export", "report", "check"):
        outcome = site(command, "--shard", "1/2")
        assert (outcome.code, "--shard does not work with" in outcome.stderr) == (2, True)


# --- masks --------------------------------------------------------------------------------------------------------


def test_masks_inside_the_images_folder(site):
    masks = site.images / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / f"{site.names()[0]}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    outcome = site("run", "--masks", masks)
    assert outcome.code == 0
    assert outcome.facts["stages"]["pairs"]["result"]["images"] == IMAGES


def test_masks_beside_the_images_are_used_where_that_is_asked_for(site):
    for name in site.names():
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, WIDTH // 2 :] = 0
        cv2.imwrite(str(site.images / f"{Path(name).stem}_mask.png"), mask)
    first = site.names()[0]
    outcome = site("extract", "--masks", site.images)
    assert outcome.code == 0
    assert outcome.facts["stages"]["pairs"]["result"]["images"] == IMAGES
    assert "masks of images" not in outcome.stderr
    points = read_features(site.work / "features" / f"{first.replace('.', '_')}.npz").keypoints_px
    assert len(points) > 20
    assert points[:, 0].max() < WIDTH // 2
    assert f"passed over {IMAGES}: {Path(first).stem}_mask.png" in site("pairs").stderr


def test_masks_that_fit_no_image_are_mentioned(site):
    masks = site.root / "masks"
    masks.mkdir()
    outcome = site("pairs", "--masks", masks)
    assert outcome.code == 0
    assert f"the mask of {site.names()[0]} would be {site.names()[0]}.png" in outcome.stderr


def test_unreadable_mask_fails_one_image(site):
    masks = site.root / "masks"
    masks.mkdir()
    (masks / f"{site.names()[0]}.png").write_bytes(b"no picture")
    outcome = site("run", "--masks", masks)
    assert outcome.code == 1
    assert site.failures() == [("extract", site.names()[0])]


def test_a_mask_that_leads_out_of_its_folder_is_refused(site):
    masks = site.root / "masks"
    masks.mkdir()
    cv2.imwrite(str(site.root / "one.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    mask = masks / f"{site.names()[0]}.png"
    mask.symlink_to(site.root / "one.png")
    outcome = site("pairs", "--masks", masks)
    assert outcome.code == 2
    assert f"mask {mask} is a link that leads out of {masks}" in outcome.stderr
    mask.unlink()
    (masks / "kept.png").write_bytes((site.root / "one.png").read_bytes())
    mask.symlink_to(masks / "kept.png")
    assert site("pairs", "--masks", masks).code == 0


def test_a_mask_that_is_no_file_is_refused(site):
    masks = site.root / "masks"
    masks.mkdir()
    mask = masks / f"{site.names()[0]}.png"
    os.mkfifo(mask)
    outcome = site("pairs", "--masks", masks)
    assert (outcome.code, f"mask {mask} is no file" in outcome.stderr) == (2, True)
    outcome = site("pairs", "--masks", "/dev/zero")
    assert (outcome.code, "masks /dev/zero are neither a folder nor a file" in outcome.stderr) == (2, True)


# --- what goes wrong on the way -----------------------------------------------------------------------------------


def test_image_deleted_between_two_stages(done_site):
    done_site.image(0).unlink()
    for command in ("match", "filter", "export", "report"):
        assert done_site(command).code == 0
    assert len(contents(done_site.work)["export/colmap/database.db"]["images"]) == IMAGES - 1


def test_image_deleted_during_a_run(site, monkeypatch):
    from aeromatch_cli.stages import extract

    victim, run = site.image(3), extract.run

    def vanishing(context, *arguments):
        victim.unlink(missing_ok=True)
        return run(context, *arguments)

    monkeypatch.setattr(extract, "run", vanishing)
    outcome = site("run")
    assert outcome.code == 1
    assert site.failures() == [("extract", victim.name)]
    assert str(victim) in outcome.stderr
    assert outcome.counts("filter")[0] == (IMAGES - 1) * (IMAGES - 2) // 2


def test_a_defect_in_one_pair_costs_that_pair_only(site, monkeypatch):
    from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest

    ids = [name.replace(".", "_") for name in site.names()]
    call = Nearest.__call__

    def failing(self, features0, features1, geometry):
        if (geometry.pair.image_id0, geometry.pair.image_id1) == (ids[0], ids[2]):
            raise ZeroDivisionError("on purpose")
        return call(self, features0, features1, geometry)

    monkeypatch.setattr(Nearest, "__call__", failing)
    outcome = site("run")
    assert outcome.code == 1
    assert outcome.counts("match") == (PAIRS - 1, 0, 1)
    assert site.failures() == [("match", f"{site.names()[0]} and {site.names()[2]}")]
    assert "unexpected ZeroDivisionError" in outcome.stderr
    monkeypatch.undo()
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.counts("match") == (1, PAIRS - 1, 0)
    assert site.failures() == []


def test_failures_of_shards_vanish_when_a_later_run_repairs_them(site):
    bad = site.image(2)
    good = bad.read_bytes()
    spoil(bad, "cut off")
    codes = [site("run", "--shard", part).code for part in ("1/2", "2/2")]
    assert 1 in codes
    assert site.failures() == [("extract", bad.name)]
    assert site("export").code == 1
    bad.write_bytes(good)
    assert site("run").code == 0
    assert site.failures() == []
    assert site("run", "--shard", "1/2").code == 0
