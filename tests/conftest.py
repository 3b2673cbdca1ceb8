"""Shared by the tests of whole commands: a small rendered block, and a way to run commands on it."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import forked
import pytest
import threadpoolctl
import typer.testing
from hypothesis import settings
from typer.testing import CliRunner

from aeromatch_cli.cli import app
from aeromatch_cli.config import FAMILIES, Settings
from aeromatch_cli.lab.strategies import add_arms
from aeromatch_cli.lab.synthetic import block, render_block, truth
from aeromatch_cli.lab.synthetic.raycast import RayCaster
from aeromatch_cli.lab.synthetic.scene import build_scene
from aeromatch_cli.sfm import process

# Under load single examples take seconds; what is too slow shows in the durations.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")

IMAGES, WIDTH, HEIGHT = 5, 320, 240
# Quick settings: few keypoints, one process.
# Most tests look at no page, which would take a third of their time.
QUICK = ("--jobs", "1", "--set", "extract.keypoints=400", "--set", "run.report=false")
PAGE = ("--set", "run.report=true")
# A module's SETTINGS for `site` and `done_site`, where its tests are not about orientation: half of a run's time.
UNORIENTED = ("--set", "orient=none")


def heed_interrupts() -> None:
    """In a child before its program starts: background jobs of a shell ignore Ctrl-C, and so would their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@dataclass(frozen=True)
class Outcome:
    """What a shell sees of one command. facts: the JSON line of --json, else empty."""

    code: int
    stdout: str
    stderr: str
    facts: dict[str, Any] = field(default_factory=dict)

    def counts(self, stage: str) -> tuple[int, int, int]:
        """(done, skipped, failed) of a stage."""
        found = self.facts["stages"][stage]
        return found["done"], found["skipped"], found["failed"]

    def done(self) -> dict[str, int]:
        """Stage -> what it made now, stages that made nothing left out."""
        return {name: stage["done"] for name, stage in self.facts["stages"].items() if stage["done"]}


@pytest.fixture(autouse=True, scope="module")
def one_thread_each() -> None:
    """Two processes run the tests, on two cores: what earlier tests set makes them wait for each other."""
    cv2.setNumThreads(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def scenes_built_once() -> Iterator[Callable[[], None]]:
    """Tests judge the same few blocks again and again: a scene is built for the first of them, which takes most of a
    second. Commands do not keep scenes, a large one is a gigabyte. Gives what forgets them, for a test that must build
    again."""
    build, cast = lru_cache(maxsize=2)(build_scene), lru_cache(maxsize=2)(RayCaster)

    def forget() -> None:
        for kept in (build, cast, block._scene, block._stage):
            kept.cache_clear()

    with pytest.MonkeyPatch.context() as patched:
        for module in (block, truth):
            patched.setattr(module, "build_scene", build)
            patched.setattr(module, "RayCaster", cast)
        yield forget


@pytest.fixture
def arms() -> Iterator[None]:
    """Settings can name the laboratory's strategies, for one test."""
    own = {family: dict(table) for family, table in FAMILIES.items()}
    add_arms()
    yield
    FAMILIES.update(own)
    Settings.model_rebuild(force=True)


@pytest.fixture(autouse=True, scope="session")
def command_line_made_once() -> Iterator[None]:
    """The runner would make all commands with their options anew for every command that it runs, 27 ms each time; a
    process of a user's makes them once."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(typer.testing, "_get_command", lru_cache(typer.testing._get_command))
        yield


@pytest.fixture(autouse=True, scope="session")
def mappers_forked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Mappers and adjustments of commands that run in this process do not load their libraries each time, and are run
    once for the same input."""
    kept = _shared(tmp_path_factory) / "mapped"
    with forked.server(), pytest.MonkeyPatch.context() as patched:
        patched.setattr(process, "subprocess", SimpleNamespace(run=partial(forked.kept_run, kept)))
        yield


@pytest.fixture(autouse=True, scope="session")
def libraries_listed_once() -> Iterator[None]:
    """Serial work asks for the threads of all loaded libraries, whose list takes 8 ms to make, a dozen times in a
    run."""
    listed = lru_cache(maxsize=1)(lambda _modules: threadpoolctl.ThreadpoolController())

    def limited(limits: int) -> Any:
        return listed(len(sys.modules)).limit(limits=limits)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(threadpoolctl, "threadpool_limits", limited)
        yield


def invoke(*arguments: object) -> Outcome:
    """Run a command in this process; every line of a traceback is a failure of the test."""
    given = [str(argument) for argument in arguments]
    result = CliRunner().invoke(app, given)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert "Traceback" not in result.stderr
    assert "this is a defect" not in result.stderr
    facts = json.loads(result.stdout.splitlines()[-1]) if "--json" in given else {}
    if facts:
        assert facts["exit_code"] == result.exit_code
    return Outcome(result.exit_code, result.stdout, result.stderr, facts)


@dataclass(frozen=True)
class Site:
    """A block that a test may change, and a workspace. settings: of all its commands, besides QUICK."""

    root: Path
    settings: tuple[str, ...] = ()

    @property
    def images(self) -> Path:
        return self.root / "images"

    @property
    def poses(self) -> Path:
        return self.root / "poses.csv"

    @property
    def work(self) -> Path:
        return self.root / "work"

    def options(self, *more: object) -> list[object]:
        block = ["--images", self.images, "--poses", self.poses, "--cameras", self.root / "block.json"]
        return [*block, "--workspace", self.work, *QUICK, *self.settings, *more]

    def __call__(self, command: str, *more: object) -> Outcome:
        return invoke(command, "baseline", *self.options("--json", *more))

    def names(self) -> list[str]:
        return sorted(path.name for path in self.images.iterdir())

    def image(self, index: int) -> Path:
        return self.images / self.names()[index]

    def rewrite_poses(self, change: Callable[[list[dict[str, str]]], Iterable[dict[str, str]]]) -> None:
        with self.poses.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        changed = list(change(rows))
        with self.poses.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(changed)

    def failures(self) -> list[tuple[str, str]]:
        """(stage, item) of failures.csv."""
        with (self.work / "failures.csv").open(newline="") as stream:
            return [(row["stage"], row["item"]) for row in csv.DictReader(stream)]

    def another_workspace(self, name: str) -> Path:
        return self.root / name


def _shared(factory: pytest.TempPathFactory) -> Path:
    """The folder of a session, of all its processes."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def _made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """The folder of a session, made by whichever process of pytest-xdist needs it first; the others wait for it."""
    folder = _shared(factory) / name
    finished = folder.with_name(f"{name}.made")
    with folder.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of a process that dies it is taken
        if not finished.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            finished.touch()
    return folder


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five overlapping images with poses; tests copy it and leave this one alone."""

    def make(folder: Path) -> None:
        render_block(folder, "suburb", seed=3, width_px=WIDTH, height_px=HEIGHT, images=IMAGES)

    return _made_once(tmp_path_factory, "rendered", make)


def _finished(rendered: Path, folder: Path, settings: tuple[str, ...] = ()) -> None:
    assert _copied(rendered, folder, settings)("run").code == 0


@pytest.fixture(scope="session")
def finished(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site on which `run` has been through once; tests copy it."""
    return _made_once(tmp_path_factory, "finished", lambda folder: _finished(rendered, folder))


@pytest.fixture(scope="session")
def finished_unoriented(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without orientation."""
    return _made_once(tmp_path_factory, "unoriented", lambda folder: _finished(rendered, folder, UNORIENTED))


@pytest.fixture
def site(rendered: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Site:
    """A fresh copy of the block, without workspace."""
    return _copied(rendered, tmp_path, _settings(request))


@pytest.fixture
def done_site(tmp_path: Path, request: pytest.FixtureRequest) -> Site:
    """A copy of the block whose workspace is complete."""
    settings = _settings(request)
    done = request.getfixturevalue("finished_unoriented" if settings else "finished")
    shutil.copytree(done, tmp_path / "site")  # modification times come along: images count as unchanged
    site = Site(tmp_path / "site", settings)
    assert site("run").done() == {}
    return site


def _settings(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Of the test's module."""
    found: tuple[str, ...] = getattr(request.module, "SETTINGS", ())
    assert found in ((), UNORIENTED)
    return found


def _copied(rendered: Path, folder: Path, settings: tuple[str, ...] = ()) -> Site:
    shutil.copytree(rendered / "images", folder / "images")
    for name in ("poses.csv", "block.json"):
        shutil.copy2(rendered / name, folder / name)
    return Site(folder, settings)


# --- comparing workspaces -----------------------------------------------------------------------------------------

# The page tells the time at which it was made, the index those of all files.
_NOT_COMPARED = ("report/index.html", "reports/report.json", "index.sqlite")


def contents(work: Path) -> dict[str, Any]:
    """Every file of a workspace by relative name, as something that two equal workspaces have in common."""
    found: dict[str, Any] = {}
    for path in sorted(work.rglob("*")):
        name = path.relative_to(work).as_posix()
        if path.is_file() and name not in _NOT_COMPARED:
            found[name] = _content(path, work)
    return found


def _content(path: Path, work: Path) -> Any:
    if path.suffix == ".db":
        return _tables(path)
    text = path.read_bytes().replace(str(work).encode(), b"WORK")
    if "reports" in path.relative_to(work).parts:
        report = json.loads(text)
        # How it came about differs between a run and its resumption, seconds and so its checksum do too; what it is
        # about does not.
        return {key: report[key] for key in ("stage", "items", "failed", "fingerprint", "failures")}
    return hashlib.sha256(text).hexdigest()


def _tables(path: Path) -> dict[str, list[Any]]:
    with sqlite3.connect(f"file:{path}?immutable=1", uri=True) as database:
        names = [row[0] for row in database.execute("select name from sqlite_master where type = 'table'")]
        return {name: sorted(database.execute(f"select * from {name}").fetchall(), key=repr) for name in names}
