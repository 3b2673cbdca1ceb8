"""A run may be split, repeated and changed: what is up to date stays, and the result is always the same."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, Site, contents

from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.store.index import Index
from aeromatch_cli.workspace import Workspace

pytestmark = pytest.mark.slow

PAIRS = IMAGES * (IMAGES - 1) // 2


def verified(work: Path) -> dict[str, dict[str, bytes]]:
    found = {}
    for path in sorted((work / "verified").glob("*.npz")):
        with np.load(path) as archive:
            found[path.name] = {
                name: archive[name].tobytes()
                for name in archive.files
                if name not in ("fingerprint", "features0", "features1")
            }
    return found


def test_block_is_fully_connected(done_site):
    outcome = done_site("run")
    assert outcome.facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}
    assert outcome.facts["stages"]["filter"]["result"]["verified_matches"] > 100 * PAIRS / 2


def test_second_run_does_nothing_and_touches_nothing(done_site):
    def written() -> dict[Path, int]:
        """When every file was; the lock is held, and empty again."""
        return {p: p.stat().st_mtime_ns for p in done_site.work.rglob("*") if p.is_file() and p.name != ".lock"}

    before = written()
    outcome = done_site("run")
    assert outcome.code == 0
    assert outcome.done() == {}
    assert outcome.counts("match") == (0, PAIRS, 0)
    assert written() == before


def test_processes_shards_and_file_order_give_identical_matches(done_site, rendered, tmp_path):
    expected = verified(done_site.work)
    assert len(expected) == IMAGES - 1

    two_jobs = done_site.root / "two-jobs"
    assert done_site("run", "--jobs", "2", "--workspace", two_jobs).code == 0
    assert verified(two_jobs) == expected

    halves = done_site.root / "halves"
    for part in ("2/2", "1/2"):
        assert done_site("run", "--shard", part, "--workspace", halves).code == 0
    assert not (halves / "export").exists()
    assert verified(halves) == expected
    rest = done_site("run", "--workspace", halves)
    assert rest.code == 0
    assert set(rest.done()) == {"refine", "adjust", "consistency", "export"}
    assert contents(halves)["export/colmap/database.db"] == contents(done_site.work)["export/colmap/database.db"]

    swapped = Site(tmp_path / "swapped")
    swapped.images.mkdir(parents=True)
    for path in sorted((rendered / "images").iterdir(), reverse=True):
        shutil.copy(path, swapped.images / path.name)
    for name in ("poses.csv", "block.json"):
        shutil.copy(rendered / name, swapped.root / name)
    swapped.rewrite_poses(lambda rows: random.Random(0).sample(rows, len(rows)))
    assert swapped("run").code == 0
    assert verified(swapped.work) == expected


@pytest.mark.parametrize(
    ("change", "redone"),
    [
        (
            "match.ratio=0.75",
            {"match": PAIRS, "filter": PAIRS, "refine": IMAGES, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
        ),
        (
            "filter.poselib.threshold_px=3",
            {"filter": PAIRS, "refine": IMAGES, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
        ),
        (
            "extract.keypoints=300",
            {
                "extract": IMAGES,
                "match": PAIRS,
                "filter": PAIRS,
                "refine": IMAGES,
                "adjust": IMAGES,
                "consistency": PAIRS,
                "export": 1,
            },
        ),
        ("seed=5", {"filter": PAIRS, "refine": IMAGES, "adjust": IMAGES, "consistency": PAIRS, "export": 1}),
        (
            "block.sigma_position_m=9",
            {"orient": IMAGES, "refine": IMAGES, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
        ),
        ("export.colmap.pose_priors=false", {"export": 1}),
    ],
)
def test_a_setting_redoes_exactly_what_depends_on_it(done_site, change, redone):
    outcome = done_site("run", "--set", change)
    assert outcome.code == 0
    assert outcome.done() == redone
    assert done_site("run", "--set", change).done() == {}


def pair_prints(site: Site, kind: str = "matches") -> dict[tuple[str, str], str]:
    """(id0, id1) -> fingerprint of the pairs on file."""
    found = {}
    store = BlockStore(Workspace(site.work), Index())
    for path in (site.work / kind).glob("*.npz"):
        row = store.matches(path.stem) if kind == "matches" else store.verdicts(path.stem)
        found |= {(path.stem, id1): one.fingerprint for id1, one in row.items()}
    return found


def kept_pairs(before: dict[tuple[str, str], str], after: dict[tuple[str, str], str]) -> set[tuple[str, str]]:
    return {pair for pair in before if after.get(pair) == before[pair]}


def test_a_setting_of_pairs_keeps_the_matches_of_pairs_that_stay(done_site):
    before = pair_prints(done_site)
    overlaps = sorted(float(line.split(",")[2]) for line in (done_site.work / "pairs.csv").read_text().splitlines()[1:])
    limit = (overlaps[2] + overlaps[3]) / 2
    fewer = done_site("run", "--set", f"pairs.min_overlap={limit}", "--set", "pairs.fallback_neighbours=1")
    assert fewer.counts("pairs")[0] == PAIRS - 3
    assert fewer.counts("match") == (0, PAIRS - 3, 0)
    assert fewer.counts("filter") == (0, PAIRS - 3, 0)
    assert set(pair_prints(done_site)) < set(before)
    again = done_site("run")
    assert again.counts("match") == (3, PAIRS - 3, 0)
    assert pair_prints(done_site) == before


def test_a_new_image_redoes_only_its_own_pairs(site):
    last = site.image(-1)
    away = site.root / last.name
    last.rename(away)
    assert site("run").code == 0
    before = pair_prints(site)
    away.rename(last)
    outcome = site("run")
    assert outcome.code == 0
    assert outcome.counts("extract") == (1, IMAGES - 1, 0)
    assert outcome.counts("match") == (IMAGES - 1, PAIRS - IMAGES + 1, 0)
    assert outcome.counts("filter") == (IMAGES - 1, PAIRS - IMAGES + 1, 0)
    assert kept_pairs(before, pair_prints(site)) == set(before)


def test_a_removed_image_leaves_the_rest_alone(done_site):
    before = pair_prints(done_site)
    gone = done_site.image(1)
    image_id = gone.name.replace(".", "_")
    gone.unlink()
    outcome = done_site("run")
    assert outcome.code == 0
    assert outcome.counts("extract") == (0, IMAGES - 1, 0)
    assert outcome.counts("match") == (0, PAIRS - IMAGES + 1, 0)
    database = contents(done_site.work)["export/colmap/database.db"]
    assert len(database["images"]) == IMAGES - 1
    rows = [path.stem for path in (done_site.work / "matches").glob("*.npz")]
    left = {pair for pair in pair_prints(done_site) if pair[0] != image_id}
    assert image_id in rows  # its own row is stale, and nothing reads it
    assert left == {pair for pair in before if image_id not in pair}


def test_a_touched_image_redoes_nothing(done_site):
    before = pair_prints(done_site)
    for row in range(IMAGES):
        os.utime(done_site.image(row), (1_700_000_000, 1_700_000_000))
    assert done_site("export", "--set", "export=geojson").code == 0
    outcome = done_site("run")
    assert outcome.counts("extract") == (0, IMAGES, 0)
    assert outcome.counts("match") == (0, PAIRS, 0)
    assert pair_prints(done_site) == before
    # What other settings ask for is made of the touched files.
    outcome = done_site("run", "--set", "extract.keypoints=150")
    assert outcome.code == 0
    assert outcome.counts("extract") == (IMAGES, 0, 0)


def test_an_edited_image_redoes_itself_and_its_pairs(done_site):
    before = pair_prints(done_site)
    path = done_site.image(2)
    path.write_bytes(path.read_bytes() + b"x")
    outcome = done_site("run")
    assert outcome.counts("extract") == (1, IMAGES - 1, 0)
    assert outcome.counts("match") == (IMAGES - 1, PAIRS - IMAGES + 1, 0)
    image_id = done_site.image(2).name.replace(".", "_")
    assert kept_pairs(before, pair_prints(done_site)) == {pair for pair in before if image_id not in pair}


def test_an_edited_pose_redoes_one_image(done_site):
    def shift(rows):
        rows[1]["x"] = str(float(rows[1]["x"]) + 0.5)
        return rows

    done_site.rewrite_poses(shift)
    outcome = done_site("run")
    assert outcome.counts("extract") == (1, IMAGES - 1, 0)
    assert outcome.counts("match") == (IMAGES - 1, PAIRS - IMAGES + 1, 0)


def turned(rows, which):
    return [{**row, "kappa_deg": str((float(row["kappa_deg"]) + 360) % 360 - 180)} if i in which else row
            for i, row in enumerate(rows)]  # fmt: skip


def test_a_wrong_attitude_is_corrected_once_and_the_second_run_does_nothing(done_site):
    name = done_site.names()[1]
    image_id = name.replace(".", "_")
    before = pair_prints(done_site)
    done_site.rewrite_poses(lambda rows: turned(rows, {1}))
    outcome = done_site("run")
    assert outcome.code == 0
    facts = outcome.facts["stages"]["orient"]["result"]
    assert facts["poses_from"] == "given poses"
    assert facts["corrected"] == [name]
    assert facts["wrong_attitudes"] == {name: pytest.approx(180, abs=2)}
    # The others keep their poses to the last bit: nothing of theirs is made again.
    assert kept_pairs(before, pair_prints(done_site)) == {pair for pair in before if image_id not in pair}
    assert outcome.facts["stages"]["filter"]["result"]["pairs"] == {"verified": PAIRS}
    workspace = contents(done_site.work)
    assert done_site("run").done() == {}
    assert contents(done_site.work) == workspace


def test_every_verified_pair_is_exported_where_a_third_of_the_attitudes_is_wrong(done_site):
    done_site.rewrite_poses(lambda rows: turned(rows, {0, 3}))
    outcome = done_site("run")
    assert outcome.code == 0
    assert len(outcome.facts["stages"]["orient"]["result"]["wrong_attitudes"]) == 2
    verified = outcome.facts["stages"]["filter"]["result"]["pairs"]["verified"]
    assert verified == PAIRS
    assert len(contents(done_site.work)["export/colmap/database.db"]["two_view_geometries"]) == verified
    assert done_site("run").done() == {}


def test_replaced_masks_redo_the_images_that_they_mask(done_site):
    import cv2

    masks = done_site.root / "masks"
    masks.mkdir()
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :100] = 0
    cv2.imwrite(str(masks / f"{done_site.names()[0]}.png"), mask)
    assert done_site("run", "--masks", masks).counts("extract") == (1, IMAGES - 1, 0)
    with np.load(Workspace(done_site.work).features(done_site.names()[0].replace(".", "_"))) as archive:
        assert archive["keypoints_px"][:, 0].min() > 95
    cv2.imwrite(str(masks / f"{done_site.names()[0]}.png"), 255 - mask)
    outcome = done_site("run", "--masks", masks)
    assert (outcome.counts("orient"), outcome.counts("extract")) == ((IMAGES, 0, 0), (1, IMAGES - 1, 0))
    assert done_site("run", "--masks", masks).done() == {}
    # The masks count, not where they lie.
    assert done_site("orient", "--masks", masks.rename(masks.with_name("moved"))).counts("orient") == (0, IMAGES, 0)


def test_overwrite_redoes_everything(done_site):
    before = contents(done_site.work)
    outcome = done_site("run", "--overwrite")
    assert outcome.done() == {
        "orient": IMAGES, "pairs": PAIRS, "extract": IMAGES, "match": PAIRS, "filter": PAIRS, "refine": IMAGES,
        "adjust": IMAGES, "consistency": PAIRS, "export": 1,
    }  # fmt: skip
    assert contents(done_site.work) == before


def test_keep_images_makes_the_pictures_of_features_that_exist(done_site):
    assert not list(done_site.work.glob("simulated/*/*.png"))
    outcome = done_site("run", "--keep-images")
    assert outcome.counts("extract") == (IMAGES, 0, 0)
    assert outcome.counts("match") == (0, PAIRS, 0)
    assert len(list(done_site.work.glob("simulated/*/*.png"))) == IMAGES
    assert done_site("run", "--keep-images").done() == {}
    for command in ("enhance", "simulate"):
        assert done_site(command).counts(command) == (0, IMAGES, 0)
