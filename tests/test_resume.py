"""A run may be stopped, split, repeated and changed: what is up to date stays, and the result is always the same."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import IMAGES, Site, contents, heed_interrupts, invoke

from aeromatch_cli.errors import ItemError
from aeromatch_cli.formats.rows import row_fingerprints
from aeromatch_cli.images.source import Source
from aeromatch_cli.stages import enhance
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
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"] == {"verified": PAIRS}
    assert outcome.facts["stages"]["filter"]["facts"]["verified_matches"] > 100 * PAIRS / 2


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
    assert set(rest.done()) == {"adjust", "consistency", "export"}
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
            {"match": PAIRS, "filter": PAIRS, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
        ),
        (
            "filter.poselib.threshold_px=3",
            {"filter": PAIRS, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
        ),
        (
            "extract.keypoints=300",
            {
                "extract": IMAGES,
                "match": PAIRS,
                "filter": PAIRS,
                "adjust": IMAGES,
                "consistency": PAIRS,
                "export": 1,
            },
        ),
        ("seed=5", {"filter": PAIRS, "adjust": IMAGES, "consistency": PAIRS, "export": 1}),
        (
            "block.sigma_position_m=9",
            {"orient": IMAGES, "adjust": IMAGES, "consistency": PAIRS, "export": 1},
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
    for path in (site.work / kind).glob("*.npz"):
        found |= {(path.stem, id1): value for id1, value in row_fingerprints(path).items()}
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


def test_a_touched_image_redoes_itself_and_its_pairs(done_site):
    before = pair_prints(done_site)
    os.utime(done_site.image(2), (1_700_000_000, 1_700_000_000))
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
    image_id = done_site.names()[1].replace(".", "_")
    before = pair_prints(done_site)
    done_site.rewrite_poses(lambda rows: turned(rows, {1}))
    outcome = done_site("run")
    assert outcome.code == 0
    facts = outcome.facts["stages"]["orient"]["facts"]
    assert facts["poses_from"] == "given poses"
    assert facts["corrected"] == [image_id]
    assert facts["wrong_attitudes"] == {image_id: pytest.approx(180, abs=2)}
    # The others keep their poses to the last bit: nothing of theirs is made again.
    assert kept_pairs(before, pair_prints(done_site)) == {pair for pair in before if image_id not in pair}
    assert outcome.facts["stages"]["filter"]["facts"]["pairs"] == {"verified": PAIRS}
    workspace = contents(done_site.work)
    assert done_site("run").done() == {}
    assert contents(done_site.work) == workspace


def test_every_verified_pair_is_exported_where_a_third_of_the_attitudes_is_wrong(done_site):
    done_site.rewrite_poses(lambda rows: turned(rows, {0, 3}))
    outcome = done_site("run")
    assert outcome.code == 0
    assert len(outcome.facts["stages"]["orient"]["facts"]["wrong_attitudes"]) == 2
    verified = outcome.facts["stages"]["filter"]["facts"]["pairs"]["verified"]
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
    assert done_site("run", "--masks", masks).counts("extract") == (1, IMAGES - 1, 0)
    assert done_site("run", "--masks", masks).done() == {}


def test_overwrite_redoes_everything(done_site):
    before = contents(done_site.work)
    outcome = done_site("run", "--overwrite")
    assert outcome.done() == {
        "orient": IMAGES, "pairs": PAIRS, "extract": IMAGES, "match": PAIRS, "filter": PAIRS, "adjust": IMAGES,
        "consistency": PAIRS, "export": 1
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


@pytest.mark.parametrize("damage", ["cut", "empty", "other"])
@pytest.mark.parametrize(
    "name",
    [
        "features/{0}.npz",
        "matches/{0}.npz",
        "verified/{0}.npz",
        "block.json",
        "pairs.csv",
        "images.csv",
        "reports/filter.json",
        "reports/export.json",
        "orientation/orientation.json",
        "orientation/poses.csv",
    ],
)
def test_damaged_files_are_made_again(done_site, name, damage):
    expected = contents(done_site.work)
    path = done_site.work / name.format(done_site.names()[0].replace(".", "_"))
    data = path.read_bytes()
    if damage == "other" and path.suffix == ".npz":
        with path.open("wb") as stream:
            np.savez(stream, fingerprint=np.array("x"), image_id1=np.array(["y"]))
    else:
        damaged = {"cut": data[: len(data) // 2], "empty": b"", "other": b"\x80[1, 2]"}
        path.write_bytes(damaged[damage])
    outcome = done_site("run")
    assert outcome.code == 0
    assert contents(done_site.work) == expected


@pytest.mark.parametrize("name", ["database.db", "sparse/images.txt", "world.json"])
def test_a_lost_file_of_the_export_is_written_again(done_site, name):
    expected = contents(done_site.work)
    (done_site.work / "export" / "colmap" / name).unlink()
    assert done_site("run").done() == {"export": 1}
    assert contents(done_site.work) == expected


@pytest.mark.parametrize("preset", ["baseline", "auto"])
def test_an_image_that_could_not_be_read_for_a_while_leaves_no_trace(
    site: Site, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    """Neither in the orientation, nor in what steps of a cascade have made together."""
    calm = site.another_workspace("calm") / "work"
    assert invoke("run", preset, *site.options("--workspace", calm)).code == 0
    read, absent = enhance.read_source, site.image(1)

    def failing(source: Source, *, colour: bool) -> tuple[np.ndarray, np.ndarray | None]:
        if source.path == absent:
            raise ItemError(f"{source.path} is away")
        return read(source, colour=colour)

    monkeypatch.setattr(enhance, "read_source", failing)
    outcome = invoke("run", preset, *site.options())
    assert outcome.code == 1
    assert "is away" in outcome.stderr
    monkeypatch.undo()
    assert invoke("run", preset, *site.options()).code == 0
    found, expected = contents(site.work), contents(calm)
    passing = {name for name in {*found, *expected} if "first_pass" in name or name == "config.yaml"}
    assert {n for n in {*found, *expected} - passing if found.get(n) != expected.get(n)} == set()


def test_a_flipped_byte_inside_an_array_is_noticed(done_site):
    expected = contents(done_site.work)
    for kind in ("features", "matches", "verified"):
        path = sorted((done_site.work / kind).glob("*.npz"))[1]
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    # Features are read only where something is to be matched anew.
    outcome = done_site("run", "--overwrite")
    assert outcome.code == 0
    assert contents(done_site.work) == expected


# --- killed and interrupted ---------------------------------------------------------------------------------------


def start(site: Site, work: Path, *more: object) -> subprocess.Popen[str]:
    """`run` with two workers in a process group of its own."""
    options = [str(option) for option in site.options("--workspace", work, "--jobs", "2", "--json", *more)]
    command = [sys.executable, "-m", "aeromatch_cli.cli", "run", "baseline", *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    pipes |= {"start_new_session": True, "preexec_fn": heed_interrupts}
    return subprocess.Popen(command, **pipes)  # type: ignore[call-overload,no-any-return]


def wait_for_files(process: subprocess.Popen[str], work: Path, count: int) -> None:
    """Until the workspace holds `count` files, or the process has ended by itself."""
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        if sum(len(files) for _, _, files in os.walk(work)) >= count:
            return
        time.sleep(0.002)


def same(work: Path, expected: Path) -> None:
    found, wanted = contents(work), contents(expected)
    for one in (found, wanted):
        del one["config.yaml"]  # says how many jobs there were
    assert found == wanted


def test_a_run_killed_again_and_again_ends_like_an_uninterrupted_one(done_site):
    work = done_site.root / "killed"
    moments = random.Random(7).sample(range(2, 30), 3)
    killed = 0
    for count in sorted(moments):
        process = start(done_site, work)
        wait_for_files(process, work, count)
        time.sleep(0.01)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            killed += 1
        process.communicate()
        assert nothing_lives(process.pid)
    assert killed >= 2
    outcome = done_site("run", "--workspace", work, "--jobs", "1")
    assert outcome.code == 0
    same(work, done_site.work)


def living(group: int) -> list[str]:
    """Processes of a group that have not ended (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, process_group = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it has ended meanwhile
        if int(process_group) == group and state != "Z":
            found.append(path.parent.name)
    return found


def nothing_lives(group: int) -> bool:
    deadline = time.monotonic() + 10
    while living(group) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not living(group)


def test_workers_do_not_outlive_a_killed_parent(done_site):
    work = done_site.root / "orphans"
    process = start(done_site, work)
    wait_for_files(process, work, 10)
    process.kill()
    process.communicate(timeout=30)  # ends when the last worker has closed the pipes
    assert nothing_lives(process.pid)


def test_sigterm_is_heard_while_pycolmap_is_loaded():
    """Importing pycolmap installs a handler of its own."""
    code = (
        "import os, signal\n"
        "from aeromatch_cli.cli.output import _terminated_like_interrupt\n"
        "from aeromatch_cli.strategies.exporters.colmap_model import import_pycolmap\n"
        "with _terminated_like_interrupt():\n"
        "    import_pycolmap()\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        signal.pause()\n"
        "    except KeyboardInterrupt:\n"
        "        print('heard')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "heard\n", done.stderr


def test_an_interrupt_in_code_made_from_text_leaves_with_130(tmp_path):
    """As while a module with dataclasses is imported: `python -m` would end as if killed by the signal."""
    lines = (
        "import typer",
        "from aeromatch_cli.cli.output import guarded",
        "def main():",
        "    guarded(lambda: exec('raise KeyboardInterrupt'), 'run', quiet=True, as_json=True, log_file=None)",
        "typer.run(main)",
    )
    (tmp_path / "stopped.py").write_text("\n".join(lines), encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "stopped"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 130, done.stderr
    assert "run the same command again" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_leaves_with_130_and_resumes(done_site, number):
    work = done_site.root / "stopped"
    process = start(done_site, work)
    wait_for_files(process, work, 12)
    # Ctrl-C reaches the whole group, a scheduler's SIGTERM only the process that it started.
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "run the same command again" in stderr
    assert "Traceback" not in stderr
    assert stdout.splitlines()[-1].endswith('"exit_code": 130}')
    assert nothing_lives(process.pid)  # no worker is left behind
    assert done_site("run", "--workspace", work).code == 0
    same(work, done_site.work)
