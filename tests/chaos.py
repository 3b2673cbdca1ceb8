"""Faults injected into runs: after each, the command must say what happened with the right exit code, and the next run
must end with the same files as one that nothing disturbed. `scripts/chaos` injects as many as are asked for.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from conftest import contents

from aeromatch_cli.synthetic import render_block

_SETTINGS = ("--jobs", "2", "--set", "extract.keypoints=200", "--set", "orient=none", "--quiet")
_IMAGES, _WIDTH, _HEIGHT = 4, 240, 180
# A run takes some seconds: one that takes longer hangs.
_LONGEST_S = 180.0
# Files that are made anew wherever they come from.
_PASSING = (".lock",)


@dataclass
class Site:
    """A rendered block and a workspace of it."""

    block: Path
    work: Path

    def command(self) -> list[str]:
        block = ["--images", self.block / "images", "--poses", self.block / "poses.csv"]
        more = ["--cameras", self.block / "block.json", "--workspace", self.work, *_SETTINGS]
        return [sys.executable, "-m", "aeromatch_cli.cli", "run", "baseline", *map(str, [*block, *more])]

    def start(self, **options: object) -> subprocess.Popen[str]:
        return subprocess.Popen(
            self.command(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
            **options,  # type: ignore[call-overload]
        )  # fmt: skip

    def run(self) -> tuple[int, str]:
        process = self.start()
        return _ended(process)


def _ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and stderr. Raises AssertionError where it hangs, or shows a traceback."""
    try:
        _, said = process.communicate(timeout=_LONGEST_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise AssertionError(f"hangs for more than {_LONGEST_S:.0f} s") from None
    assert "Traceback" not in said, said[-2000:]
    assert "this is a defect" not in said, said[-2000:]
    return process.returncode, said


def _signalled(site: Site, rng: random.Random, number: int, *, whole_group: bool, codes: Sequence[int]) -> None:
    process = site.start()
    time.sleep(rng.uniform(0.3, 6.0))
    if process.poll() is None:
        (os.killpg if whole_group else os.kill)(process.pid, number)
        code, _ = _ended(process)
        assert code in codes, f"exit code {code}"
    else:
        assert _ended(process)[0] == 0


def _run_killed(site: Site, rng: random.Random) -> None:
    _signalled(site, rng, signal.SIGKILL, whole_group=True, codes=(-9,))


def _run_killed_alone(site: Site, rng: random.Random) -> None:
    _signalled(site, rng, signal.SIGKILL, whole_group=False, codes=(-9,))


def _run_terminated(site: Site, rng: random.Random) -> None:
    # Before Python has set its own handler the signal itself ends the process.
    _signalled(site, rng, signal.SIGTERM, whole_group=False, codes=(130, -15, 0))


def _run_stopped_for_a_while(site: Site, rng: random.Random) -> None:
    process = site.start()
    time.sleep(rng.uniform(0.3, 4.0))
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(1.0)
        os.killpg(process.pid, signal.SIGCONT)
    assert _ended(process)[0] == 0


def _worker_killed(site: Site, rng: random.Random) -> None:
    process = site.start()
    time.sleep(rng.uniform(1.0, 5.0))
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    if process.poll() is None:
        pids = children.read_text().split()
        workers = [pid for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        if workers:
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
    code, said = _ended(process)
    assert code in (0, 1, 2), f"exit code {code}: {said}"


def _disk_full(site: Site, rng: random.Random) -> None:
    """No file may grow beyond some kilobytes."""
    limit = rng.choice([2_000, 20_000, 60_000])
    process = site.start(
        preexec_fn=lambda: (
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )
    )
    code, said = _ended(process)
    assert code in (1, 3), f"exit code {code}: {said}"
    assert "error:" in said, said


def _few_handles(site: Site, rng: random.Random) -> None:
    limit = rng.choice([24, 40])
    process = site.start(preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit)))
    code, said = _ended(process)
    assert code in (0, 1, 2, 3), f"exit code {code}: {said}"


def _files(site: Site) -> list[Path]:
    return sorted(path for path in site.work.rglob("*") if path.is_file() and path.name not in _PASSING)


def _byte_flipped(site: Site, rng: random.Random) -> None:
    if files := _files(site):
        path = rng.choice(files)
        data = bytearray(path.read_bytes())
        if data:
            data[rng.randrange(len(data))] ^= rng.randrange(1, 256)
            path.write_bytes(bytes(data))


def _file_cut(site: Site, rng: random.Random) -> None:
    if files := _files(site):
        path = rng.choice(files)
        data = path.read_bytes()
        path.write_bytes(data[: rng.randrange(len(data) + 1)])


def _file_gone(site: Site, rng: random.Random) -> None:
    if files := _files(site):
        rng.choice(files).unlink()


def _folder_gone(site: Site, rng: random.Random) -> None:
    if folders := sorted(path for path in site.work.rglob("*") if path.is_dir()):
        shutil.rmtree(rng.choice(folders))


def _files_of_the_future(site: Site, rng: random.Random) -> None:
    for path in _files(site):
        if rng.random() < 0.3:
            os.utime(path, (time.time() + 1e7, time.time() + 1e7))


def _two_at_once(site: Site, rng: random.Random) -> None:
    first, second = site.start(), site.start()
    codes = sorted(_ended(process)[0] for process in (first, second))
    # The second is refused, or comes when the first has ended.
    assert codes in ([0, 3], [0, 0]), codes


FAULTS: dict[str, Callable[[Site, random.Random], None]] = {
    "run killed with its workers": _run_killed,
    "run killed alone": _run_killed_alone,
    "run terminated": _run_terminated,
    "run stopped for a while": _run_stopped_for_a_while,
    "worker killed": _worker_killed,
    "disk full": _disk_full,
    "few file handles": _few_handles,
    "byte flipped": _byte_flipped,
    "file cut": _file_cut,
    "file gone": _file_gone,
    "folder gone": _folder_gone,
    "files of the future": _files_of_the_future,
    "two runs at once": _two_at_once,
}
# These need a finished workspace to disturb.
_OF_FILES = ("byte flipped", "file cut", "file gone", "folder gone", "files of the future")


def prepared(folder: Path) -> tuple[Path, dict[str, object]]:
    """A block, and what an undisturbed run makes of it."""
    block = folder / "block"
    render_block(block, "suburb", seed=5, width_px=_WIDTH, height_px=_HEIGHT, images=_IMAGES)
    site = Site(block, folder / "calm")
    code, said = site.run()
    assert code == 0, said
    return block, _compared(site.work)


def _compared(work: Path) -> dict[str, object]:
    return {name: content for name, content in contents(work).items() if Path(name).name not in _PASSING}


def injected(kind: str, seed: int, block: Path, expected: dict[str, object], folder: Path) -> str:
    """One fault; "" where all is as it should be, else what is not."""
    rng = random.Random(seed)
    site = Site(block, folder / "work")
    shutil.rmtree(site.work, ignore_errors=True)
    try:
        if kind in _OF_FILES:
            assert site.run()[0] == 0
        FAULTS[kind](site, rng)
        code, said = site.run()
        assert code == 0, f"the next run ends with {code}: {said[-500:]}"
        found = _compared(site.work)
        different = sorted(n for n in {*found, *expected} if not _same(found.get(n), expected.get(n)))
        assert not different, f"other files than of an undisturbed run: {', '.join(different[:5])}"
    except (AssertionError, zipfile.BadZipFile) as error:
        return str(error)
    return ""


def _same(one: object, other: object) -> bool:
    return bool(np.all(one == other)) if type(one) is type(other) else False


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/chaos", description=__doc__)
    parser.add_argument("--faults", type=int, default=200, help="default 200")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default="", help=f"comma-separated of {', '.join(FAULTS)}; all by default")
    args = parser.parse_args()
    kinds = [kind.strip() for kind in args.kinds.split(",") if kind.strip()] or list(FAULTS)
    count, bad = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        block, expected = prepared(folder)
        for number in range(args.faults):
            kind = kinds[number % len(kinds)]
            what = injected(kind, args.seed * 100_000 + number, block, expected, folder)
            count[kind] += 1
            if what:
                bad[kind] += 1
                print(f"{kind}, number {number}: {what}", file=sys.stderr, flush=True)
    for kind in kinds:
        print(f"{kind}: {count[kind]} injected, {bad[kind]} not withstood")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
