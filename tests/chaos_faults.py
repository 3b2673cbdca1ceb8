"""What `chaos` does to runs and workspaces: a kind of fault is a function of a site, and says what the run must do."""

from __future__ import annotations

import contextlib
import ctypes
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dask_cluster import dask_cluster

_SETTINGS = ("--jobs", "2", "--set", "extract.keypoints=200", "--quiet")
# Runs that make files of other kinds: whatever a run may leave is in one of them. The first is the quickest.
RUNS: Mapping[str, Sequence[str]] = {
    "baseline": ("--set", "orient=none"),
    "fusion": ("--keep-images", "--set", "match=nearest", "--set", "export=[colmap, opensfm, geojson, tracks]"),
    "auto": (),
}
# A run takes some seconds: one that takes longer hangs.
_LONGEST_S = 180.0
# Nothing reads the first pass once the orientation stands; the lock is empty.
PASSING = frozenset({".lock", "first_pass"})
# A worker that has imported what it needs; before, Python itself shows a traceback.
_STARTED_BYTES = 600 << 20
# What a run may end with that meets a fault which it may also get over.
_ANY = (0, 1, 2, 3)


@dataclass
class Site:
    """A rendered block and a workspace of it that one of the runs makes.

    seconds: that it takes undisturbed. touched: what a fault has changed.
    """

    block: Path
    work: Path
    preset: str
    seconds: float = 5.0
    touched: str = ""

    def command(self) -> list[str]:
        block = ["--images", self.block / "images", "--poses", self.block / "poses.csv"]
        more = ["--cameras", self.block / "block.json", "--workspace", self.work, *_SETTINGS, *RUNS[self.preset]]
        return [sys.executable, "-m", "aeromatch_cli.cli", "run", self.preset, *map(str, [*block, *more])]

    def start(self, *more: str, **options: object) -> subprocess.Popen[str]:
        return _process([*self.command(), *more], **options)

    def wait(self, rng: random.Random) -> None:
        """Some part of what the run takes."""
        time.sleep(rng.uniform(0.3, self.seconds))


def _process(command: Sequence[str], **options: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        **options,  # type: ignore[call-overload]
    )  # fmt: skip


def ended(process: subprocess.Popen[str], codes: Sequence[int] = (0,)) -> tuple[int, str]:
    """Exit code and stderr. Raises AssertionError where it hangs, shows a traceback or ends with another code."""
    try:
        _, said = process.communicate(timeout=_LONGEST_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise AssertionError(f"hangs for more than {_LONGEST_S:.0f} s") from None
    assert "Traceback" not in said, said[-2000:]
    assert "this is a defect" not in said, said[-2000:]
    assert process.returncode in codes, f"exit code {process.returncode}: {said[-500:]}"
    return process.returncode, said


def _signalled(site: Site, rng: random.Random, number: int, *, whole_group: bool, codes: Sequence[int]) -> None:
    process = site.start()
    site.wait(rng)
    if process.poll() is None:
        (os.killpg if whole_group else os.kill)(process.pid, number)
        ended(process, codes)
    else:
        ended(process)


def _run_killed(site: Site, rng: random.Random) -> None:
    _signalled(site, rng, signal.SIGKILL, whole_group=True, codes=(-9,))


def _run_killed_alone(site: Site, rng: random.Random) -> None:
    _signalled(site, rng, signal.SIGKILL, whole_group=False, codes=(-9,))


def _run_terminated(site: Site, rng: random.Random) -> None:
    # Before Python has set its own handler the signal itself ends the process.
    _signalled(site, rng, signal.SIGTERM, whole_group=False, codes=(130, -15, 0))


def _run_stopped_for_a_while(site: Site, rng: random.Random) -> None:
    process = site.start()
    site.wait(rng)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(1.0)
        os.killpg(process.pid, signal.SIGCONT)
    ended(process)


def _workers(process: subprocess.Popen[str]) -> list[int]:
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        return [int(pid) for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return []


def _worker_killed(site: Site, rng: random.Random) -> None:
    process = site.start()
    site.wait(rng)
    if process.poll() is None and (workers := _workers(process)):
        with contextlib.suppress(ProcessLookupError):
            os.kill(rng.choice(workers), signal.SIGKILL)
    ended(process, (0, 1, 2))


def _of_cluster_killed(site: Site, rng: random.Random, number: int, codes: Sequence[int]) -> None:
    with dask_cluster() as (address, processes):
        process = site.start("--executor", "dask", "--scheduler", address)
        site.wait(rng)
        processes[number].kill()
        code, said = ended(process, codes)
        assert code == 0 or "dask" in said, said


def _scheduler_killed(site: Site, rng: random.Random) -> None:
    _of_cluster_killed(site, rng, 0, (0, 2, 3))


def _dask_worker_killed(site: Site, rng: random.Random) -> None:
    _of_cluster_killed(site, rng, 1, (0,))


def _large_files_refused(site: Site, rng: random.Random) -> None:
    """No file may grow beyond some kilobytes."""
    limit = rng.choice([2_000, 20_000, 60_000])
    process = site.start(
        preexec_fn=lambda: (
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )
    )
    _, said = ended(process, (1, 3))
    assert "error:" in said, said


def _disk_full(site: Site, rng: random.Random) -> None:
    """The workspace lies in a small file system of its own; later its contents go where there is room."""
    small = site.work.with_name("small")
    small.mkdir(parents=True)
    size = rng.choice([8, 100, 300])
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(small)], capture_output=True, check=False
    )
    try:
        if mounted.returncode:  # only root may: the other fault of this kind stands in for it
            _large_files_refused(site, rng)
            return
        place = Site(site.block, small / site.work.name, site.preset)
        _, said = ended(place.start(), (1, 3))
        assert "disk full" in said or "check free space" in said, said
        shutil.copytree(place.work, site.work)
    finally:
        if not mounted.returncode:
            subprocess.run(["umount", "-l", str(small)], check=True)
        shutil.rmtree(small, ignore_errors=True)


def _without_override() -> None:
    """Root heeds permissions like anybody else: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH leave the bounding set."""
    library = ctypes.CDLL(None)
    for capability in (1, 2):
        library.prctl(24, capability, 0, 0, 0)


def _permissions_revoked(site: Site, rng: random.Random) -> None:
    folder = rng.choice([site.work, *sorted(path for path in site.work.iterdir() if path.is_dir())])
    site.touched = folder.relative_to(site.work.parent).as_posix()
    for path in folder.rglob("*.npz"):
        path.unlink()  # so that there is something to write
        break
    mode = rng.choice([0o555, 0o000])
    before = folder.stat().st_mode
    folder.chmod(mode)
    try:
        code, said = ended(site.start(preexec_fn=_without_override), _ANY)
        assert code == 0 or "cannot " in said or "is not readable" in said, said
    finally:
        folder.chmod(before)


def _few_handles(site: Site, rng: random.Random) -> None:
    limit = rng.choice([24, 40])
    ended(site.start(preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))), _ANY)


def _little_memory(site: Site, rng: random.Random) -> None:
    """A worker gets hardly more than it has."""
    process = site.start()
    site.wait(rng)
    if process.poll() is None and (workers := _workers(process)):
        pid = rng.choice(workers)
        with contextlib.suppress(ProcessLookupError, FileNotFoundError):
            held = int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()
            limit = held + (rng.choice([0, 4, 20]) << 20)
            if held > _STARTED_BYTES:
                resource.prlimit(pid, resource.RLIMIT_AS, (limit, limit))
    ended(process, (0, 1, 3))


def _patched(site: Site, text: str) -> subprocess.Popen[str]:
    """A run that executes some Python first, in each of its processes."""
    patch = site.work.with_name("patch")
    patch.mkdir(parents=True, exist_ok=True)
    (patch / "sitecustomize.py").write_text(text)
    return site.start(env={**os.environ, "PYTHONPATH": f"{patch}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"})


_SLOW_RENAMES = """
import pathlib, time
old = pathlib.Path.replace
pathlib.Path.replace = lambda self, to: (time.sleep(0.3), old(self, to))[1]
"""


def _slow_renames(site: Site, rng: random.Random) -> None:
    """As on a folder far away; the run is killed in the middle of one."""
    process = _patched(site, _SLOW_RENAMES)
    time.sleep(rng.uniform(1.0, 3.0 * site.seconds))
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    ended(process, (0, -9))


# Files bear the clock's time when they come to their names, as they would on a machine whose clock is set.
_CLOCK = """
import os, pathlib, time
true, old, set_at, jump = time.time, pathlib.Path.replace, {at}, {jump}
time.time = lambda: true() + (jump if true() > set_at else 0.0)
time.time_ns = lambda: int(time.time() * 1e9)
pathlib.Path.replace = lambda self, to: (os.utime(self, (time.time(), time.time())), old(self, to))[1]
"""


def _clock_jumps(site: Site, rng: random.Random) -> None:
    """Forward or back by a second to a year; half of the runs are killed afterwards, so that another one goes on with
    the true time."""
    jump = rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(0.0, 7.5)
    process = _patched(site, _CLOCK.format(at=time.time() + rng.uniform(0.5, site.seconds), jump=jump))
    if rng.random() < 0.5:
        site.wait(rng)
        os.killpg(process.pid, signal.SIGKILL)
    ended(process, (0, -9))


def _begun(site: Site, rng: random.Random) -> subprocess.Popen[str]:
    """A run that has read the headers of all images, and has come some way since."""
    process = site.start()
    while process.poll() is None and not list(site.work.rglob("features/*.npz")):
        time.sleep(0.05)
    # After a longer wait it has often ended.
    time.sleep(rng.uniform(0.0, 0.2 * site.seconds))
    return process


def _input_gone(site: Site, rng: random.Random) -> None:
    """For a while, once the run knows it: a run that finds fewer images from the start is another one."""
    image = rng.choice(sorted((site.block / "images").iterdir()))
    aside = image.with_name(f".{image.name}.aside")
    process = _begun(site, rng)
    image.rename(aside)
    try:
        ended(process, (0, 1, 3))
    finally:
        aside.rename(image)


def _input_replaced(site: Site, rng: random.Random) -> None:
    """For a while, by another picture, once the run knows it."""
    image, other = rng.sample(sorted((site.block / "images").iterdir()), 2)
    aside = image.with_name(f".{image.name}.aside")
    process = _begun(site, rng)
    still_running = process.poll() is None
    shutil.copy2(image, aside)
    shutil.copy(other, image)
    try:
        ended(process, (0, 1))
        assert still_running, "the run had ended before its input was replaced"
    finally:
        aside.replace(image)


def files(site: Site) -> list[Path]:
    return sorted(path for path in site.work.rglob("*") if path.is_file() and not PASSING & set(path.parts))


def _chosen(site: Site, rng: random.Random) -> Path:
    """A file of any kind: rare kinds as often as those of every image."""
    kinds: dict[str, list[Path]] = {}
    for path in files(site):
        place = path.parent.relative_to(site.work).as_posix()
        kind = path.name if place in (".", "orientation", "reports") else f"{place} {path.suffix}"
        kinds.setdefault(kind, []).append(path)
    path = rng.choice(kinds[rng.choice(sorted(kinds))])
    site.touched = path.relative_to(site.work).as_posix()
    return path


def _byte_flipped(site: Site, rng: random.Random) -> None:
    flip_byte(_chosen(site, rng), rng)


def flip_byte(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    if data:
        data[rng.randrange(len(data))] ^= rng.randrange(1, 256)
        path.write_bytes(bytes(data))


def _file_cut(site: Site, rng: random.Random) -> None:
    path = _chosen(site, rng)
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data) + 1)])


def _file_gone(site: Site, rng: random.Random) -> None:
    _chosen(site, rng).unlink()


def _folder_gone(site: Site, rng: random.Random) -> None:
    folder = rng.choice(sorted(path for path in site.work.rglob("*") if path.is_dir()))
    site.touched = folder.relative_to(site.work).as_posix()
    shutil.rmtree(folder)


def _files_of_the_future(site: Site, rng: random.Random) -> None:
    for path in files(site):
        if rng.random() < 0.3:
            os.utime(path, (time.time() + 1e7, time.time() + 1e7))


def _two_at_once(site: Site, rng: random.Random) -> None:
    first = site.start()
    time.sleep(rng.uniform(0.0, 1.0))
    second = site.start()
    codes = sorted(ended(process, (0, 3))[0] for process in (first, second))
    # The second is refused, or comes when the first has ended.
    assert codes in ([0, 3], [0, 0]), codes


Fault = Callable[[Site, random.Random], None]
OF_RUNS: Mapping[str, Fault] = {
    "run killed with its workers": _run_killed,
    "run killed alone": _run_killed_alone,
    "run terminated": _run_terminated,
    "run stopped for a while": _run_stopped_for_a_while,
    "worker killed": _worker_killed,
    "scheduler killed": _scheduler_killed,
    "dask worker killed": _dask_worker_killed,
    "large files refused": _large_files_refused,
    "disk full": _disk_full,
    "few file handles": _few_handles,
    "little memory": _little_memory,
    "slow renames": _slow_renames,
    "clock jumps": _clock_jumps,
    "input gone": _input_gone,
    "input replaced": _input_replaced,
    "two runs at once": _two_at_once,
}
# These disturb a finished workspace.
OF_FILES: Mapping[str, Fault] = {
    "byte flipped": _byte_flipped,
    "file cut": _file_cut,
    "file gone": _file_gone,
    "folder gone": _folder_gone,
    "files of the future": _files_of_the_future,
    "permissions revoked": _permissions_revoked,
}
