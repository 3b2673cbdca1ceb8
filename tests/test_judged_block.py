"""What was given against what the pictures show, on a rendered block: named before the long stages, and put right."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, PAGE, Site, contents

from aeromatch_cli.files import read_json
from aeromatch_cli.formats.tables import read_poses
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.lab.synthetic import load_truth

pytestmark = pytest.mark.slow


def attitude_errors(site: Site, truth: Path) -> list[float]:
    true = {name.replace(".", "_"): pose for name, pose in load_truth(truth).poses.items()}
    found = read_poses(site.work / "poses.csv")
    return [angle_between_deg(pose.world_rotation, true[i].world_rotation) for i, pose in found.items()]


def turned(rows, degrees: float):
    for row in rows:
        row["kappa_deg"] = repr(float(row["kappa_deg"]) + degrees)
        yield row


def test_kappas_off_by_180_degrees_are_named_and_replaced(site: Site, rendered: Path) -> None:
    site.rewrite_poses(lambda rows: turned(rows, 180.0))
    outcome = site("run", *PAGE)
    assert outcome.code == 0
    assert outcome.facts["quality"]["verdict"] == "doubtful"  # of its tilt
    warning = "warning: the given angles do not fit the pictures: all kappas are off by 180 degrees"
    assert warning in outcome.stderr
    errors = attitude_errors(site, rendered)
    assert len(errors) == IMAGES
    assert max(errors) < 10.0  # five positions with 5 m errors level a block of 50 m no better
    page = (site.work / "report" / "index.html").read_text()
    assert "all kappas are off by 180 degrees" in page


def test_a_block_that_falls_into_parts_is_searched_with_more_keypoints(
    site: Site, rendered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy2(rendered / "poses_noisy.csv", site.poses)

    def oriented() -> tuple[list[int], list[dict[str, object]], str]:
        outcome = site("orient", "--set", "orient.keypoints=120", "--overwrite")
        assert outcome.code == 0
        facts = read_json(site.work / "reports" / "orient.json")["result"]
        return [model["images"] for model in facts["models"]], facts["further_first_passes"], outcome.stdout

    more = {"change": "more keypoints", "images": 3}
    monkeypatch.setattr("aeromatch_cli.stages.first_pass._MORE_KEYPOINTS", 1)
    models, tried, said = oriented()
    assert (models, tried) == ([3], [{**more, "images_then": 3, "used": False}])
    assert "further first pass" not in said
    monkeypatch.undo()
    models, tried, said = oriented()
    assert (models, tried) == ([IMAGES], [{**more, "images_then": IMAGES, "used": True}])
    assert f"by a further first pass, with more keypoints: a group of {IMAGES} images, not 3" in said


def test_a_block_of_many_pairs_is_not_searched_with_more_keypoints(
    site: Site, rendered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy2(rendered / "poses_noisy.csv", site.poses)
    monkeypatch.setattr("aeromatch_cli.stages.first_pass._MOST_DEAR_PAIRS", IMAGES * (IMAGES - 1) // 2 - 1)
    assert site("orient", "--set", "orient.keypoints=120").code == 0
    facts = read_json(site.work / "reports" / "orient.json")["result"]
    assert ([model["images"] for model in facts["models"]], facts["further_first_passes"]) == ([3], [])


def test_positions_that_do_not_fit_leave_a_result_in_a_frame_of_its_own(site: Site, rendered: Path) -> None:
    """x and y exchanged: adjusted, exported and labelled without them, and the same command again does nothing."""

    def exchanged(rows):
        for row in rows:
            row["x"], row["y"] = row["y"], row["x"]
            row["omega_deg"] = row["phi_deg"] = row["kappa_deg"] = ""
            yield row

    site.rewrite_poses(exchanged)
    outcome = site("run")
    assert outcome.code == 1
    assert "given positions is used, the pictures contradict them" in outcome.stdout
    assert "given positions fit the pictures only mirrored: are x and y exchanged, or is the sign" in outcome.stderr
    assert "in a frame of its own: scale, north and place are arbitrary" in outcome.stderr
    export = site.work / "export" / "colmap"
    world = json.loads((export / "world.json").read_text())
    assert (world["crs"], world["origin_m"]) == ("local", [0.0, 0.0, 0.0])
    with (export / "orientation.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == IMAGES
    # Upright and level: cameras a hundred units above the ground.
    assert all(abs(float(row["omega_deg"])) < 20.0 for row in rows)
    assert np.median([float(row["z"]) for row in rows]) == pytest.approx(100.0, rel=0.1)
    before = {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()}
    assert site("run").code == 1
    assert {path: path.read_bytes() for path in site.work.rglob("*") if path.is_file()} == before


def test_surveyed_poses_are_held_against_single_wrong_ones(site: Site, rendered: Path) -> None:
    def change(rows):
        for number, row in enumerate(rows):
            if number == 1:
                row["kappa_deg"] = repr(float(row["kappa_deg"]) + 120.0)
            yield row

    site.rewrite_poses(change)
    outcome = site("orient", "--set", "orient=given")
    assert f"wrong attitudes given; kept, as orient=given asks: {site.names()[1]} (1" in outcome.stdout
    assert attitude_errors(site, rendered)[1] > 100.0


def test_surveyed_poses_stay_but_are_judged(site: Site, rendered: Path) -> None:
    site.rewrite_poses(lambda rows: turned(rows, 180.0))
    outcome = site("orient", "--set", "orient=given")
    assert outcome.code == 0
    assert "all kappas are off by 180 degrees" in outcome.stderr
    errors = attitude_errors(site, rendered)
    assert min(errors) > 179.0


def test_surveyed_poses_that_fit_nothing_are_said(site: Site) -> None:
    site.rewrite_poses(lambda rows: turned(rows, 180.0))
    outcome = site("run", "--set", "orient=given", *PAGE)
    assert outcome.code == 1
    assert outcome.facts["quality"]["verdict"] == "bad"
    assert outcome.facts["quality"]["findings"][0]["what"] == "oriented images"
    words = "They do not fit the given poses; use orient=global instead of given"
    assert words in outcome.stdout
    assert words in (site.work / "report" / "index.html").read_text()
    posed = (site.work / "export" / "colmap" / "sparse" / "images.txt").read_text()
    assert all(name in posed for name in site.names())


def test_a_third_of_the_attitudes_wrong_settles_in_one_run(site: Site, rendered: Path) -> None:
    """Every verified pair is exported, and the same command again does nothing: byte by byte."""
    wrong = (1, 4)

    def change(rows):
        for number, row in enumerate(rows):
            if number in wrong:
                row |= {"omega_deg": "35", "phi_deg": "-50", "kappa_deg": "140"}
            yield row

    site.rewrite_poses(change)
    outcome = site("run")
    assert outcome.code == 0
    named = outcome.facts["stages"]["orient"]["result"]["wrong_attitudes"]
    assert sorted(named) == [site.names()[number] for number in wrong]
    assert max(attitude_errors(site, rendered)) < 1.0
    verified = outcome.facts["stages"]["filter"]["result"]["pairs"]["verified"]
    with sqlite3.connect(site.work / "export" / "colmap" / "database.db") as database:
        exported = database.execute("SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0").fetchone()[0]
    assert exported == verified == IMAGES * (IMAGES - 1) // 2
    before = contents(site.work)
    again = site("run")
    assert (again.code, again.done()) == (0, {})
    assert contents(site.work) == before


def ground_of(site: Site) -> float:
    return float(np.median([p.center_m[2] for p in read_poses(site.work / "poses.csv").values()]))


@pytest.mark.parametrize(("share", "used"), [(0.05, "given"), (0.15, "given"), (0.6, "terrain")])
def test_a_stated_ground_is_held_against_the_terrain(site: Site, share: float, used: str) -> None:
    assert site("orient").code == 0
    flying_m = ground_of(site) - np.median(read_json(site.work / "block.json")["ground_z_m"] or 0.0)
    outcome = site("pairs", "--ground", -share * flying_m, "--set", "block.sigma_position_m=1")
    assert outcome.code == 0
    said = "below the terrain that the pictures show" in outcome.stderr
    assert said == (share > 0.1)
    assert ("The terrain of the pictures is used" in outcome.stderr) == (used == "terrain")
    assert read_json(site.work / "block.json")["ground_source"].startswith(used)


def test_the_summary_stands_before_the_stages(site: Site) -> None:
    outcome = site("run")
    lines = outcome.stdout.splitlines()
    starts = [line.split()[0] for line in lines if line.strip()]
    assert starts.index("images") < starts.index("orientation") < starts.index("ground") < starts.index("orient")
    assert starts.count("images") == starts.count("pairs") - 1 == 1


def test_identical_pictures_are_named(site: Site) -> None:
    first = site.image(0).read_bytes()
    for number in range(1, IMAGES):
        site.image(number).write_bytes(first + bytes([number]))  # else they would be copies, which are left out
    outcome = site("orient", "--poses", "none")
    assert outcome.code == 0
    assert (
        "the first pass could orient no image from the pictures: they show the same from the same place"
        in outcome.stderr
    )
    assert "from the pictures: none of 5 images" in outcome.stdout


def test_equal_positions_are_named_and_not_used(site: Site) -> None:
    def same(rows):
        first = rows[0]
        # Their heights go on, as those of a barometer do.
        return [
            {"image": row["image"], "camera": row["camera"], "z": row["z"]} | {k: first[k] for k in "xy"}
            for row in rows
        ]

    site.rewrite_poses(lambda rows: [{k: v for k, v in row.items() if not k.endswith("_deg")} for row in same(rows)])
    outcome = site("orient")
    assert outcome.code == 0
    assert "all 5 positions are identical" in outcome.stderr
    facts = outcome.facts["stages"]["orient"]["result"]
    assert facts["frame"] == "own"
    assert len(read_poses(site.work / "poses.csv")) == facts["models"][0]["images"] >= 3


def test_two_images_are_matched_without_orientation(site: Site) -> None:
    for _ in range(2, IMAGES):
        site.image(2).unlink()
    outcome = site("run", "--poses", "none")
    assert outcome.code == 0
    assert "at least 3 images must have verified matches with others, 2 have some" in outcome.stderr
    assert (site.work / "export" / "colmap" / "database.db").is_file()


@pytest.mark.slow
def test_the_poses_of_two_images_are_too_few_to_be_called_wrong(site: Site) -> None:
    for _ in range(2, IMAGES):
        site.image(2).unlink()
    outcome = site("run")
    assert outcome.code == 0
    (positions,) = [
        group["positions"] for group in outcome.facts["stages"]["adjust"]["result"]["groups"] if group["positions"]
    ]
    assert (positions["images"], positions["used"], positions["wrong"]) == (2, 0, [])
    words = "2 given positions are too few to take part in the adjustment, which takes three"
    assert any(one["sentence"].startswith(words) for one in outcome.facts["quality"]["findings"])
    assert "contradict the pictures" not in outcome.stdout


@pytest.mark.slow
def test_an_image_that_cannot_be_read_counts_once_in_every_stage(site: Site) -> None:
    broken = site.image(0)
    broken.write_bytes(broken.read_bytes()[:3000])
    for count in ("done", "skipped"):
        stages = site("run").facts["stages"]
        for stage in ("orient", "extract"):
            counts = stages[stage]
            assert (counts["items"], counts[count], counts["failed"]) == (IMAGES, IMAGES - 1, 1), (stage, counts)
