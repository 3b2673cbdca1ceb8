"""Where everything lies in a workspace, and who may use it.

Resume rests on evidence: a result counts as done when it is present and its fingerprint equals the one that the
current settings and inputs give.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aeromatch_cli.errors import ConfigError, InputError, WorkspaceError
from aeromatch_cli.files import (
    changed_files,
    json_object,
    read_record,
    remove_stale_temporaries,
    temporary_name,
    translated_os_errors,
)
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.results.record import StageRecord

FORMAT_VERSION = 1
# Stages whose results exports hold.
_EXPORTED = ("filter", "refine", "adjust", "consistency")


@dataclass(frozen=True)
class Workspace:
    """Every path and file name below one root folder. Holds no state.

    step: the step of a cascade whose matches, verdicts and reports are meant, "" for those of the block. features_of:
    the step whose pictures, views and features these are, "" for those of the block. The step `guided` has none:
    it uses those of `first`.
    """

    root: Path
    step: str = ""
    features_of: str = ""

    @property
    def lock(self) -> Path:
        return self.root / ".lock"

    @property
    def index(self) -> Path:
        """What is known of the files."""
        return self.root.absolute() / "index.sqlite"

    def shard_index(self, label: str) -> Path:
        return self.root.absolute() / f"index.{label}.sqlite"

    def shard_indexes(self) -> list[Path]:
        return sorted(self.root.absolute().glob("index.*-of-*.sqlite"))

    @property
    def config(self) -> Path:
        return self.root / "config.yaml"

    @property
    def asked(self) -> Path:
        return self.root / "asked.yaml"

    @property
    def block(self) -> Path:
        return self.root / "block.json"

    @property
    def images(self) -> Path:
        return self.root / "images.csv"

    @property
    def cameras(self) -> Path:
        return self.root / "cameras.csv"

    @property
    def poses(self) -> Path:
        return self.root / "poses.csv"

    @property
    def pairs(self) -> Path:
        return self.root / "pairs.csv"

    @property
    def failures(self) -> Path:
        return self.root / "failures.csv"

    @property
    def lost(self) -> Path:
        """Images that the result does not hold."""
        return self.root / "lost.csv"

    @property
    def orientation(self) -> Path:
        return self.root / "orientation"

    @property
    def adjusted(self) -> Path:
        return self.orientation / "adjusted.npz"

    @property
    def residuals(self) -> Path:
        """Adjusted poses beside those given."""
        return self.orientation / "residuals.csv"

    @property
    def final(self) -> Path:
        """The adjusted block without what only dropped matches have held; absent where that is nothing."""
        return self.orientation / "final.npz"

    def ran_since(self, path: Path, *stages: str) -> bool:
        """Whether one of these stages has made something since a file was written; by the times of files."""
        written_s, reports = path.stat().st_mtime, map(self.stage_report, stages)
        return any(report.is_file() and report.stat().st_mtime > written_s for report in reports)

    @property
    def final_or_adjusted(self) -> Path:
        return self.final if self.final.is_file() else self.adjusted

    @property
    def dropped(self) -> Path:
        """Verified matches that contradict the adjusted block."""
        return self.orientation / "dropped.npz"

    @property
    def first_pass(self) -> Workspace:
        """The first pass is a small workspace of its own."""
        return Workspace(self.orientation / "first_pass")

    def of_step(self, name: str, features_of: str) -> Workspace:
        """Return the paths of what a step of a cascade makes, in folders of its name. features_of: the step whose
        features it uses."""
        return replace(self, step=name, features_of=features_of)

    @property
    def steps(self) -> Path:
        return self.root / "steps.csv"

    @property
    def reports(self) -> Path:
        return self.root / "reports" / self.step

    @property
    def evaluation(self) -> Path:
        return self.root / "evaluation"

    @property
    def report(self) -> Path:
        return self.root / "report" / "index.html"

    def enhanced(self, image_id: str, suffix: str) -> Path:
        return self.root / "enhanced" / self.features_of / f"{image_id}{suffix}"

    def views(self, image_id: str) -> Path:
        return self.root / "simulated" / self.features_of / image_id / "views.json"

    def view_pictures(self, image_id: str) -> Path:
        """Which pictures of views are kept, and of what."""
        return self.root / "simulated" / self.features_of / image_id / "pictures.json"

    def view(self, image_id: str, view_name: str) -> Path:
        return self.root / "simulated" / self.features_of / image_id / f"{view_name}.png"

    def features(self, image_id: str) -> Path:
        return self.root / "features" / self.features_of / f"{image_id}.npz"

    def matches(self, image_id0: str) -> Path:
        return self.root / "matches" / self.step / f"{image_id0}.npz"

    def verified(self, image_id0: str) -> Path:
        return self.root / "verified" / self.step / f"{image_id0}.npz"

    def refined(self, image_id: str) -> Path:
        """Where its keypoints were measured anew."""
        return self.root / "refined" / f"{image_id}.npz"

    def measured(self, image_id: str) -> Path:
        """The measurements themselves, as they are before they are carried from image to image."""
        return self.root / "refined" / "measured" / f"{image_id}.npz"

    def export(self, exporter: str) -> Path:
        return self.root / "export" / exporter

    def exported(self) -> list[Path]:
        """Folders of all exports, also of earlier ones."""
        return sorted(path for path in (self.root / "export").glob("[!.]*") if path.is_dir())

    @property
    def export_is_older(self) -> bool:
        """Whether stages before the last export have made something since."""
        made = self.stage_report("export")
        return made.is_file() and self.ran_since(made, *_EXPORTED)

    def is_older_export(self, folder: Path) -> bool:
        """Whether stages before an export have made something since its folder was written, by whatever settings."""
        times_s = [(path.stat().st_mtime, path) for path in folder.rglob("*") if path.is_file()]
        return not times_s or self.ran_since(max(times_s)[1], *_EXPORTED)

    def changed_tables(self) -> list[str]:
        """Names of the tables of the block that are not as they were written, or gone. Raises as `check_version`."""
        self.check_version()
        record = read_record(self.stage_report("pairs"), StageRecord)
        return [] if record is None else changed_files(self.root, record.files)

    def check_tables(self) -> None:
        """Raises WorkspaceError where a table of the block is not as it was written."""
        if changed := self.changed_tables():
            words = "is damaged or was edited: run `aeromatch run`, which makes it again"
            raise WorkspaceError(f"{self.root / changed[0]} {words}")

    def stage_report(self, stage: str, shard: str = "") -> Path:
        return self.reports / (f"{stage}.{shard}.json" if shard else f"{stage}.json")

    def forget(self, stage: str, paths: Iterable[Path] = ()) -> None:
        """Remove what a stage of the whole block has left: first its report, so that where the command is stopped
        nothing vouches for what is then made of something else."""
        for path in (self.stage_report(stage), *paths):
            with translated_os_errors(path):
                path.unlink(missing_ok=True)

    def withdraw(self, stage: str, paths: Sequence[Path]) -> None:
        """As `forget`, of a stage that is not asked for: where it has left none of these files, its report says so and
        stays as it is."""
        if any(path.exists() for path in paths):
            self.forget(stage, paths)

    def create(self) -> None:
        """Make the folder and prove that it can be written; refuse one of another format version, or with links that
        lead out of it."""
        with translated_os_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
        self.check_links()
        self.check_version()
        probe = temporary_name(self.root / "writable")
        with translated_os_errors(self.root):
            probe.touch()
            probe.unlink()
        remove_stale_temporaries(self.root)

    def check_links(self) -> None:
        """Raises WorkspaceError where a link leads out of the folder: what is written through it would land there."""
        root = self.root.resolve()
        for path in _links_below(root):
            if not path.resolve().is_relative_to(root):
                raise WorkspaceError(
                    f"{path} is a link that leads out of the workspace, to {path.resolve()}: remove it; to keep "
                    "results on another disk, place the whole workspace there"
                )

    def check_version(self) -> None:
        """Raises WorkspaceError where another format version wrote this workspace."""
        if not self.block.exists():
            return
        with readable(self.block, ValueError):  # of other versions it may have no checksum
            found = json_object(self.block.read_text(encoding="utf-8")).get("format_version")
        if found != FORMAT_VERSION:
            raise WorkspaceError(
                f"workspace {self.root} has format version {found}, this program writes {FORMAT_VERSION}; "
                "use the version that wrote it, or choose another --workspace"
            )


def _links_below(folder: Path) -> Iterator[Path]:
    """Yield symbolic links at any depth; `Path.walk` and the like ask the disk for each of a hundred thousand files."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                yield Path(entry.path)
            elif entry.is_dir():
                yield from _links_below(Path(entry.path))


def opened_workspace(root: Path, *, tables: bool = True) -> Workspace:
    """One that a command wrote, to look at. tables: whether those of the block are compared with their checksums.

    Raises ConfigError where the folder is none, InputError where it holds no results yet, WorkspaceError where it has
    another format version or a table of the block is not as it was written.
    """
    workspace = Workspace(root)
    if not workspace.images.is_file():
        if not root.exists():
            raise ConfigError(
                f"the workspace {root} does not exist: check its path, and give the folder that an earlier `aeromatch "
                "run --workspace DIR` has filled"
            )
        if workspace.orientation.is_dir():
            state = "holds no results yet (images.csv is missing): its run is estimating the orientation, or was ended"
            raise InputError(f"{root} {state} while it did; `aeromatch run` goes on with it")
        raise ConfigError(
            f"{root} is no workspace of aeromatch (images.csv is missing): give the folder of --workspace"
        )
    workspace.check_version()
    if tables:
        workspace.check_tables()
    return workspace


@contextlib.contextmanager
def locked(workspace: Workspace, command: str, *, shared: bool) -> Iterator[None]:
    """Holds a workspace for one command; shared: shards hold it together. A process that ends, or is killed, lets go.

    Raises WorkspaceError where another command holds it. Where the system or the folder knows no locks (Windows, some
    network file systems), nothing is held.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = workspace.lock
    with translated_os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():  # the lock's words would be written to what it links to
            path.unlink()
        stream = path.open("a+", encoding="utf-8")
    with stream:
        try:
            fcntl.flock(stream, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            holder = stream.read().strip() or "another command"
            raise WorkspaceError(
                f"workspace {workspace.root} is in use by {holder}: wait until it ends, or choose another --workspace"
            ) from None
        except OSError:
            yield
            return
        stream.truncate(0)
        stream.write(f"`aeromatch {command}`, process {os.getpid()} on {socket.gethostname()}\n")
        stream.flush()
        try:
            yield
        finally:
            stream.truncate(0)
