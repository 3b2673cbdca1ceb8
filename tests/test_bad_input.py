"""Bad input: a clear message (what, where, what to do), the right exit code, nothing lost, and the rest goes on."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, IMAGES, WIDTH, contents, invoke

from aeromatch_cli import workspace as workspace_module
from aeromatch_cli.blocks import scan
from aeromatch_cli.workspace import Workspace, read_json

PAIRS = IMAGES * (IMAGES - 1) // 2


def spoil(path: Path, how: str) -> None:
    data = path.read_bytes()
    if how == "corrupt":  # a sound header, then noise
        path.write_bytes(data[: len(data) // 3] + bytes(255 - b for b in data[len(data) // 3 :]))
    elif how == "cut off":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "no picture":
        path.write_bytes(b"this is text, not a picture\n" * 50)
    elif how == "broken link":
        path.unlink()
        path.symlink_to(path.parent / "nowhere.jpg")


@pytest.mark.parametrize("how", ["corrupt", "cut off", "empty", "no picture", "broken link"])
def test_one_bad_image_never_stops_the_rest(site, how):
    bad = site.image(2)
    good = site.root / "good.jpg"
    shutil.copy2(bad, good)
    spoil(bad, how)
    outcome = site("run")
    assert outcome.code == 1
    assert outcome.facts["failures"] == 1
    assert outcome.counts("filter")[0] == (IMAGES - 1) * (IMAGES - 2) // 2
    [(_, item)] = site.failures()
    assert item in (bad.name, bad.name.replace(".", "_"))
    assert bad.name.partition(".")[0] in outcome.stderr

    again = site("run")  # it still fails, so it is still reported
    assert again.code == 1
    assert site.failures() == [("pairs" if item == bad.name else "extract", item)]
    for command in ("match", "filter", "export", "report"):
        assert site(command).code == 1

    bad.unlink()
    shutil.copy2(good, bad)
    repaired = site("run")
    assert repaired.code == 0
    assert site.failures() == []
    assert repaired.counts("extract")[0] == 1


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
    assert outcome.facts["stages"]["pairs"]["facts"]["images"] == IMAGES


def test_image_without_keypoints(site):
    cv2.imwrite(str(site.image(1)), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["extract"]["facts"]["images_without_keypoints"] == 1
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"]["not verifiable"] == IMAGES - 1
    assert outcome.facts["stages"]["filter"]["facts"]["weakly_tied"] == [site.image(1).name.replace(".", "_")]
    assert site("run").done() == {}


def test_no_image_has_keypoints(site):
    for path in site.images.iterdir():
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 90, np.uint8))
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
    assert "no pairs: 1 image" in outcome.stderr


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
    assert f"1 of {IMAGES} images are not in" in outcome.stderr
    assert site.names()[-1] in outcome.stderr
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
        ("image,x,y\na.jpg,1,2\n", "column 'z' is missing"),
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


# --- the workspace ------------------------------------------------------------------------------------------------


def test_workspace_below_a_file(site):
    (site.root / "file").write_text("")
    for place in (site.root / "file", site.root / "file" / "work"):
        outcome = site("run", "--workspace", place)
        assert (outcome.code, "a file stands where a folder is needed" in outcome.stderr) == (3, True)


def test_read_only_workspace(site, monkeypatch):
    def refuse(self, *arguments, **options):
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    monkeypatch.setattr(workspace_module.Path, "touch", refuse)
    outcome = site("run")
    assert outcome.code == 3
    assert "Read-only file system" in outcome.stderr
    assert "choose another --workspace" in outcome.stderr


def test_full_disk_stops_and_resumes(done_site, monkeypatch):
    work = done_site.root / "full"
    write = workspace_module.write_atomically
    left = [9]

    def limited(path, fill):
        def filled(stream):
            left[0] -= 1
            if left[0] < 0:
                stream.write(b"half of")
                raise OSError(errno.ENOSPC, "No space left on device")
            fill(stream)

        write(path, filled)

    for module in ("workspace", "stages.extract", "stages.match", "stages.filter", "stages.enhance", "stages.simulate"):
        monkeypatch.setattr(f"aeromatch_cli.{module}.write_atomically", limited)
    outcome = done_site("run", "--workspace", work)
    assert outcome.code == 3
    assert "disk full" in outcome.stderr
    assert "free space" in outcome.stderr
    assert not list(work.rglob("*.tmp"))
    monkeypatch.undo()
    outcome = done_site("run", "--workspace", work)
    assert outcome.code == 0
    assert contents(work) == contents(done_site.work)


def test_workspace_of_another_version(done_site):
    block = read_json(done_site.work / "block.json")
    (done_site.work / "block.json").write_text(json.dumps({**block, "format_version": 99}))
    before = contents(done_site.work)
    for command in ("run", "check", "pairs", "export"):
        outcome = done_site(command)
        assert outcome.code == 3
        assert "format version 99" in outcome.stderr
        assert "choose another --workspace" in outcome.stderr
    assert contents(done_site.work) == before


def test_workspace_inside_the_images_folder(site):
    inside = site.images / "work"
    assert site("run", "--keep-images", "--workspace", inside).code == 0
    assert list(inside.rglob("*.png"))
    again = site("run", "--keep-images", "--workspace", inside)
    assert (again.code, again.done()) == (0, {})
    other = site("run", "--workspace", site.root / "other")  # nor are those of another workspace
    assert other.facts["stages"]["pairs"]["facts"]["images"] == IMAGES
    outcome = site("run", "--workspace", site.images)
    assert (outcome.code, "choose another --workspace" in outcome.stderr) == (2, True)


def test_masks_inside_the_images_folder(site):
    masks = site.images / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / f"{site.names()[0]}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    outcome = site("run", "--masks", masks)
    assert outcome.code == 0
    assert outcome.facts["stages"]["pairs"]["facts"]["images"] == IMAGES


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
    assert site.failures() == [("extract", site.names()[0].replace(".", "_"))]


# --- images of all kinds ------------------------------------------------------------------------------------------


def test_equal_names_in_two_folders(site):
    for index, name in enumerate(site.names()):
        folder = site.images / ("a" if index < 3 else "b")
        folder.mkdir(exist_ok=True)
        (site.images / name).rename(folder / f"{index % 3}.jpg")
    names = [f"{'a' if index < 3 else 'b'}/{index % 3}.jpg" for index in range(IMAGES)]
    site.rewrite_poses(lambda rows: [{**row, "image": name} for row, name in zip(rows, names, strict=True)])
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"] == {"verified": PAIRS}
    assert sorted(path.stem for path in (site.work / "features").iterdir()) == sorted(
        name.replace("/", "--").replace(".", "_") for name in names
    )
    site.rewrite_poses(lambda rows: [{**row, "image": Path(row["image"]).name + str(i)} for i, row in enumerate(rows)])
    assert site("run").code == 2


def test_unicode_and_blanks_in_names(site):
    names = [f"Flug über Łódź {index} #1.JPG" for index in range(IMAGES)]
    for old, new in zip(site.names(), names, strict=True):
        (site.images / old).rename(site.images / new)
    site.rewrite_poses(lambda rows: [{**row, "image": name} for row, name in zip(rows, names, strict=True)])
    outcome = site("run", "--workspace", site.root / "Arbeit für mich")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"] == {"verified": PAIRS}
    assert site("run", "--workspace", site.root / "Arbeit für mich").done() == {}


def test_the_same_picture_twice(site):
    shutil.copy(site.image(0), site.images / "copy.jpg")
    site.rewrite_poses(lambda rows: [*rows, {**rows[0], "image": "copy.jpg"}])
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["facts"]["components"] == [IMAGES + 1]


def test_sizes_depths_and_formats_mixed(site):
    """A 16-bit TIFF, a gray PNG and a smaller JPEG among the others, with cameras from EXIF defaults."""
    deep, gray, small = (site.image(index) for index in range(3))
    renamed = {deep.name: deep.with_suffix(".tif").name, gray.name: gray.with_suffix(".png").name}
    cv2.imwrite(str(deep.with_suffix(".tif")), cv2.imread(str(deep)).astype(np.uint16) * 200)
    cv2.imwrite(str(gray.with_suffix(".png")), cv2.imread(str(gray), cv2.IMREAD_GRAYSCALE))
    cv2.imwrite(str(small), cv2.resize(cv2.imread(str(small)), (WIDTH * 3 // 4, HEIGHT * 3 // 4)))
    deep.unlink()
    gray.unlink()
    site.rewrite_poses(lambda rows: [{**row, "image": renamed.get(row["image"], row["image"])} for row in rows])
    outcome = site("run", "--cameras", "exif")
    assert outcome.code == 0, outcome.stderr
    assert outcome.facts["stages"]["extract"]["items"] == IMAGES
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"].get("verified", 0) >= PAIRS // 2


def test_images_that_do_not_fit_their_camera(site):
    cv2.imwrite(str(site.image(0)), np.zeros((HEIGHT + 50, WIDTH, 3), np.uint8))
    outcome = site("run")
    assert outcome.code == 1
    assert site.failures() == [("pairs", site.names()[0])]
    assert f"{WIDTH}" in outcome.stderr


def test_images_without_any_pose(site):
    outcome = site("run", "--poses", "none")
    assert outcome.code == 0
    assert outcome.facts["stages"]["filter"]["facts"]["verified_matches"] > 100
    views = read_json(Workspace(site.work).views(site.names()[0].replace(".", "_")))["views"]
    assert [view["is_source"] for view in views] == [True]


def test_reduced_images_give_keypoints_in_stored_pixels(site):
    assert site("run", "--max-size", WIDTH // 2).code == 0
    with np.load(sorted((site.work / "features").glob("*.npz"))[0]) as archive:
        assert archive["keypoints_px"][:, 0].max() > WIDTH * 0.75
    assert site("run").counts("extract")[0] == IMAGES


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
    assert site.failures() == [("extract", victim.name.replace(".", "_"))]
    assert str(victim) in outcome.stderr
    assert outcome.counts("filter")[0] == (IMAGES - 1) * (IMAGES - 2) // 2


def test_a_defect_in_one_pair_costs_that_pair_only(site, monkeypatch):
    from aeromatch_cli.strategies.matchers.nearest import Nearest

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
    assert site.failures() == [("match", f"{ids[0]} {ids[2]}")]
    assert "unexpected ZeroDivisionError" in outcome.stderr
    monkeypatch.undo()
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.counts("match") == (1, PAIRS - 1, 0)
    assert site.failures() == []


# --- failures of shards -------------------------------------------------------------------------------------------


def test_failures_of_shards_vanish_when_a_later_run_repairs_them(site):
    bad = site.image(2)
    good = bad.read_bytes()
    spoil(bad, "cut off")
    codes = [site("run", "--shard", part).code for part in ("1/2", "2/2")]
    assert 1 in codes
    assert site.failures() == [("extract", bad.name.replace(".", "_"))]
    assert site("export").code == 1
    bad.write_bytes(good)
    assert site("run").code == 0
    assert site.failures() == []
    assert site("run", "--shard", "1/2").code == 0
