from __future__ import annotations

import errno
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
import pytest
from make_features import random_features
from pydantic import Field

from aeromatch_cli.config import FAMILIES
from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.errors import BrokenFileError, ConfigError, WorkspaceError
from aeromatch_cli.files import read_json, remove_stale_temporaries, write_atomically, write_json, write_text
from aeromatch_cli.fingerprints import file_digest, fingerprint, image_fingerprint, stable_hash
from aeromatch_cli.formats.features import write_features
from aeromatch_cli.nets import published
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.workspace import FORMAT_VERSION, Workspace


class Recipe(Strategy):
    """A strategy with one setting of each kind."""

    name: Literal["recipe"] = "recipe"
    count: int = 3
    share: float = Field(0.5)
    words: tuple[str, ...] = ("a", "b")
    weights: str = Field("", json_schema_extra={"path": True})

    def fingerprint_files(self) -> tuple[str, ...]:
        return (self.weights,) if self.weights else ()


def files_below(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


# --- atomic writes --------------------------------------------------------------------------------------------------


def test_write_appears_whole(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a" / "b.bin", lambda stream: stream.write(b"12345"))
    assert (tmp_path / "a" / "b.bin").read_bytes() == b"12345"
    assert files_below(tmp_path) == ["a/b.bin"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_writer_that_raises_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "row.npz"
    path.write_bytes(b"old")

    def half(stream: BinaryIO) -> None:
        stream.write(b"new and only ha")
        raise error

    with pytest.raises(error):
        write_atomically(path, half)
    assert path.read_bytes() == b"old"
    assert files_below(tmp_path) == ["row.npz"]


def test_a_killed_writer_leaves_no_half_file(tmp_path: Path) -> None:
    """SIGKILL in the middle of a write: the old file stays, the next run removes the scratch file."""
    path = tmp_path / "row.npz"
    path.write_bytes(b"old")
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom aeromatch_cli.files import write_atomically\n"
        "def slow(stream):\n    stream.write(b'x' * 100_000)\n    stream.flush()\n    print('half', flush=True)\n"
        "    time.sleep(60)\nwrite_atomically(Path(sys.argv[1]), slow)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"half\n"
    remove_stale_temporaries(tmp_path)
    assert len(files_below(tmp_path)) == 2  # its process lives: the scratch file is not touched
    process.send_signal(signal.SIGKILL)
    # It is dead, though nobody has asked for it yet.
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert path.read_bytes() == b"old"
    Workspace(tmp_path).create()
    assert files_below(tmp_path) == ["row.npz"]
    process.wait()
    process.stdout.close()


def test_stale_temporaries_of_other_machines_and_foreign_files_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    monkeypatch.setattr(socket, "gethostname", lambda: "node.one.cluster")
    target = tmp_path / "x.csv"
    names: list[str] = []
    with pytest.raises(RuntimeError):
        write_atomically(target, lambda stream: names.append(Path(stream.name).name) or _raise(RuntimeError))
    ours = names[0].replace(f".{os.getpid()}.", f".{dead.pid}.")
    monkeypatch.setattr(socket, "gethostname", lambda: "node.two.cluster")
    with pytest.raises(RuntimeError):
        write_atomically(target, lambda stream: names.append(Path(stream.name).name) or _raise(RuntimeError))
    theirs = names[1].replace(f".{os.getpid()}.", f".{dead.pid}.")
    monkeypatch.setattr(socket, "gethostname", lambda: "node.one.cluster")
    for name in (ours, theirs, ".notes.tmp", "keep.tmp"):
        (tmp_path / name).write_bytes(b"")
    remove_stale_temporaries(tmp_path)
    assert files_below(tmp_path) == sorted([theirs, ".notes.tmp", "keep.tmp"])


def _raise(error: type[Exception]) -> None:
    raise error


def test_the_longest_name_that_a_disk_takes_for_an_image_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 150 + "-0123456789.mask.png")
    write_atomically(path, lambda stream: stream.write(b"1"))
    assert path.read_bytes() == b"1"


def test_unchanged_text_is_not_written_again(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    write_text(path, "a,é\n")
    os.utime(path, ns=(1, 1))
    write_text(path, "a,é\n")
    assert path.stat().st_mtime_ns == 1
    write_text(path, "b\n")
    assert path.read_text() == "b\n"


# --- a disk that fails ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ENOSPC, "disk full"),
        (errno.EDQUOT, "disk full"),
        (errno.EACCES, "choose another --workspace"),
        (errno.EROFS, "choose another --workspace"),
        (errno.ENOENT, "choose another --workspace"),  # a folder of /proc, say
        (errno.EIO, r"cannot write .* \(Input/output error\); choose another --workspace"),
    ],
)
def test_disk_errors_are_told_in_words(tmp_path: Path, number: int, expected: str) -> None:
    def fail(stream: BinaryIO) -> None:
        raise OSError(number, os.strerror(number))

    with pytest.raises(WorkspaceError, match=expected) as caught:
        write_atomically(tmp_path / "out.bin", fail)
    assert caught.value.exit_code == 3
    assert "out.bin" in str(caught.value)
    assert files_below(tmp_path) == []


def test_a_file_larger_than_the_limit_leaves_nothing(tmp_path: Path) -> None:
    """A real failure in the middle of writing an archive: the size limit of a process (EFBIG)."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(WorkspaceError, match="cannot write"):
            write_atomically(tmp_path / "f.npz", lambda stream: write_features(stream, random_features(2000), "x"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, old)
    assert files_below(tmp_path) == []


def test_a_workspace_below_a_file_or_on_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(WorkspaceError, match="--workspace"):
            Workspace(root).create()
    with pytest.raises(WorkspaceError, match="--workspace"):
        write_text(tmp_path / "file" / "a.csv", "x")


def test_a_read_only_workspace_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    for method in ("touch", "open"):
        monkeypatch.setattr(Path, method, refuse)
    with pytest.raises(WorkspaceError, match="Read-only file system"):
        Workspace(tmp_path).create()


def test_create_leaves_an_empty_folder_and_may_be_repeated(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "a" / "b")
    workspace.create()
    workspace.create()
    assert files_below(tmp_path) == []


@pytest.mark.parametrize("version", [FORMAT_VERSION + 1, 0, "1", None])
def test_another_format_version_is_refused_and_left_alone(tmp_path: Path, version: Any) -> None:
    write_json(tmp_path / "block.json", {"format_version": version})
    with pytest.raises(WorkspaceError, match="format version"):
        Workspace(tmp_path).create()
    assert files_below(tmp_path) == ["block.json"]


@pytest.mark.parametrize("text", ["", "{", "[1]", "\x00\x01", "NaN,"])
def test_broken_json_says_what_to_do(tmp_path: Path, text: str) -> None:
    path = tmp_path / "views.json"
    path.write_text(text)
    with pytest.raises(BrokenFileError, match="delete it to have it made again"):
        read_json(path)
    with pytest.raises(BrokenFileError):
        read_json(tmp_path / "absent.json")


def test_json_round_trip_and_no_nan(tmp_path: Path) -> None:
    value = {"a": [1, 2.5, None], "ü": {"x": 1e-300}}
    write_json(tmp_path / "x.json", value)
    assert read_json(tmp_path / "x.json") == value
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", {"a": float("nan")})


# --- fingerprints ---------------------------------------------------------------------------------------------------


def test_fingerprint_is_the_same_in_another_process() -> None:
    code = (
        "from aeromatch_cli.config import Settings\n"
        "from aeromatch_cli.fingerprints import fingerprint, stable_hash\n"
        "s = Settings()\nprint(fingerprint(s.pairs, s.extract, s.match, s.filter, {'b': 1.5, 'a': None}))\n"
        "print(stable_hash('a/ü'))"
    )
    results = {
        subprocess.run(
            [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONHASHSEED": s},
        ).stdout
        for s in ("1", "2")
    }
    assert len(results) == 1
    assert int(results.pop().split()[1]) == stable_hash("a/ü")


def test_stable_hash_is_pinned() -> None:
    """First eight bytes of SHA-256: shards of different releases must agree."""
    assert stable_hash("") == 0xE3B0C44298FC1C14


@pytest.mark.parametrize(
    "changed", [{"count": 4}, {"share": 0.5000000000000001}, {"words": ("b", "a")}, {"words": ("ab",)}, {"words": ()}]
)
def test_fingerprint_feels_every_field(changed: dict[str, Any]) -> None:
    assert fingerprint(Recipe()) == fingerprint(Recipe())
    assert fingerprint(Recipe(**changed)) != fingerprint(Recipe())


@pytest.mark.parametrize("name", [f"{family}.{name}" for family, table in FAMILIES.items() for name in table])
def test_fingerprint_feels_every_field_of_every_strategy(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "published.pth").write_bytes(b"")
    monkeypatch.setattr(published, "published_path", lambda _: tmp_path / "published.pth")
    family, _, key = name.partition(".")
    default = FAMILIES[family][key]()
    if "weights" in type(default).model_fields:  # a folder of files, or one file; "other" does not exist
        own = tmp_path if family == "extract" else tmp_path / "own.pt"
        (tmp_path / ("geodesc.safetensors" if family == "extract" else "own.pt")).write_bytes(b"")
        default = default.model_copy(update={"weights": str(own)})
    prints = {fingerprint(default)}
    # Where a network runs is no part of the recipe.
    fields = [f for f in type(default).model_fields if f not in ("name", "device")]
    for field in fields:
        value = getattr(default, field)
        other = not value if isinstance(value, bool) else value + 1 if isinstance(value, int | float) else "other"
        changed = default.model_copy(update={field: other})
        try:
            prints.add(fingerprint(changed))
        except ConfigError:  # a file that does not exist cannot be overlooked either
            prints.add(field)
    assert len(prints) == len(fields) + 1


def test_fingerprint_feels_name_and_version_of_the_class() -> None:
    class Newer(Recipe):
        version: ClassVar[int] = 2

    Newer.__name__ = "Recipe"
    assert fingerprint(Newer()) != fingerprint(Recipe())

    class Renamed(Recipe):
        pass

    assert fingerprint(Renamed()) != fingerprint(Recipe())


def test_fingerprint_feels_the_contents_of_weights(tmp_path: Path) -> None:
    weights = tmp_path / "w.pt"
    weights.write_bytes(b"one")
    first = fingerprint(Recipe(weights=str(weights)))
    assert fingerprint(Recipe(weights=str(weights))) == first
    (tmp_path / "moved.pt").write_bytes(b"one")
    assert fingerprint(Recipe(weights=str(tmp_path / "moved.pt"))) == first
    weights.write_bytes(b"two")
    os.utime(weights, ns=(5, 5))
    assert fingerprint(Recipe(weights=str(weights))) != first
    with pytest.raises(ConfigError, match=r"gone\.pt"):
        fingerprint(Recipe(weights=str(tmp_path / "gone.pt")))


def test_file_digest_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"abc")
    assert file_digest(tmp_path / "x") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_fingerprint_of_geometry() -> None:
    camera = Camera("PINHOLE", 10, 20, (1.0, 2.0, 3.0, 4.0))
    pose = Pose(np.zeros(3), np.eye(3), 1.0, 2.0)
    assert fingerprint(camera, pose) == fingerprint(Camera("PINHOLE", 10, 20, (1.0, 2.0, 3.0, 4.0)), pose)
    assert fingerprint(camera) != fingerprint(Camera("PINHOLE", 10, 20, (1.0, 2.0, 3.0, 4.0000000000000009)))
    assert fingerprint(pose) != fingerprint(Pose(np.zeros(3), None, 1.0, 2.0))
    assert fingerprint(1, 2) != fingerprint(12)
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    with pytest.raises(TypeError):
        fingerprint({1, 2})


def _append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"x")


def _touch(path: Path) -> None:
    os.utime(path, ns=(7, 7))


def _flip(place: int) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        status = path.stat()
        data = bytearray(path.read_bytes())
        data[place] ^= 1
        path.write_bytes(data)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    return change


@pytest.mark.parametrize("change", [_append, _touch, _flip(0), _flip(-1), _flip((1 << 20) - 1)])
@pytest.mark.parametrize("size", [(1 << 20) + 10, 3 << 20])
def test_image_fingerprint_notices_a_change(tmp_path: Path, change: Callable[[Path], None], size: int) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(np.random.default_rng(1).bytes(size))
    first = image_fingerprint(path)
    assert image_fingerprint(path) == first
    change(path)
    assert image_fingerprint(path) != first


def test_image_fingerprint_reads_the_ends_only(tmp_path: Path) -> None:
    path = tmp_path / "big.tif"
    with path.open("wb") as stream:
        stream.truncate(4 << 30)  # sparse
    started = time.perf_counter()
    image_fingerprint(path)
    assert time.perf_counter() - started < 0.5
