"""Makes the tables of docs/results: runs the standing benchmarks one after the other, each in processes of its own.

They are planned for two hours on two idle cores that multiply bfloat16; others take up to twice as long. Every
benchmark goes on where it was, as long as the code is the same: OUT has a folder for each state of aeromatch_cli. A
benchmark that fails does not keep the others from being run. With --docs the tables are written into their pages, and
their figures into the README.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import figures, options
from benchmarks.processes import children_seconds
from benchmarks.sources import code_digest
from benchmarks.stamps import REPOSITORY


@dataclass(frozen=True)
class Standing:
    """A page of docs/results. minutes: planned, on two idle cores. runs: the text of commands after `scripts/bench`, in
    which DATA, ANCHORS and WEIGHTS stand for folders."""

    page: str
    minutes: int
    runs: tuple[str, ...]


STANDING: Mapping[str, Standing] = {
    "auto": Standing(
        "auto.md", 52, ("auto rendered", "auto strategies", "auto real --data DATA --reference-weights WEIGHTS")
    ),
    "claims": Standing("claims.md", 12, ("claims --seed 1 --data DATA --reference-weights WEIGHTS",)),
    "peers": Standing(
        "peers.md",
        21,
        (
            "peers rendered --reference-weights WEIGHTS",
            "peers real --data DATA --reference-weights WEIGHTS",
            "anchors --data ANCHORS --reference-weights WEIGHTS",
        ),
    ),
    "calibration": Standing("calibration.md", 7, ("calibration",)),
    "orientation": Standing("orientation.md", 12, ("orientation real --data DATA", "orientation rendered")),
    "growth": Standing("growth.md", 5, ("growth",)),
    "speed": Standing("speed.md", 8, ("speed --repeats 1",)),
    "robustness": Standing("robustness.md", 3, ("robustness",)),
}


def words(run: str, given: Mapping[str, str], *, docs: bool = False, quick: bool = False) -> list[str]:
    """Arguments of `scripts/bench` for one run. Without weights their option is left out; every benchmark has a folder
    of its name in OUT."""
    text = run if "WEIGHTS" in given else run.removesuffix(" --reference-weights WEIGHTS")
    found = [given.get(word, word) for word in shlex.split(text)]
    found += ["--out", str(Path(given["OUT"]) / found[0])]
    return [*found, *(["--docs"] if docs else []), *(["--quick"] if quick else [])]


def main(arguments: Sequence[str]) -> int:
    parser = options.make_parser("results", __doc__)
    add = parser.add_argument
    add("--data", type=Path, metavar="DIR", help="folder of real blocks, BLOCK/images and BLOCK/reference")
    add("--anchors", type=Path, metavar="DIR", help="homography pairs of danini/magsac: some minutes more")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of the peers that are networks; else without")
    add("--only", type=options.names, default=",".join(STANDING), help="comma-separated")
    add("--docs", action="store_true", help="write the tables into docs/results and their figures into the README")
    add("--list", action="store_true", help="print the commands and their planned minutes instead of running them")
    add("--quick", action="store_true", help="all of them small: figures without worth, in minutes")
    add("--out", type=Path, metavar="DIR", help="folder of results; a killed run goes on where it was")
    args = options.parse(parser, arguments)
    if unknown := sorted(set(args.only) - set(STANDING)):
        parser.error(f"--only: {', '.join(unknown)} are none of {', '.join(STANDING)}")
    if args.docs and args.quick:
        parser.error("--docs and --quick: small runs make figures without worth, which do not belong into docs/results")
    if not args.list:
        _check_folders(parser, args)
    for folder in (args.data, args.anchors, args.reference_weights):
        if folder is not None and not folder.is_dir():
            parser.error(f"{folder} is no folder")
    state = code_digest("")[:8] + ("-quick" if args.quick else "")
    given = {"DATA": _text(args.data), "OUT": _text(args.out and args.out / state)}
    for word, folder in (("WEIGHTS", args.reference_weights), ("ANCHORS", args.anchors)):
        if folder or args.list:
            given[word] = _text(folder)
    failed = []
    for name in args.only:
        standing, started, used_s = STANDING[name], time.monotonic(), children_seconds()
        print(f"# {name}" + ("" if args.quick else f": about {standing.minutes} minutes"), flush=True)
        for run in standing.runs:
            if "ANCHORS" in shlex.split(run) and "ANCHORS" not in given:
                print(f"left out: {run} (--anchors DIR)", flush=True)
                continue
            asked = words(run, given, docs=args.docs, quick=args.quick)
            print(shlex.join(["scripts/bench", *asked]), flush=True)
            if not args.list and _run(asked):
                failed.append(shlex.join(["scripts/bench", *asked]))
        if not args.list:
            wall, processor = (time.monotonic() - started) / 60.0, (children_seconds() - used_s) / 60.0
            print(f"# {name}: {wall:.1f} minutes, {processor:.1f} of the processor", flush=True)
    if args.docs and not args.list:
        figures.write_readme()
    for command in failed:
        print(f"failed: {command}", file=sys.stderr)
    return 1 if failed else 0


def _check_folders(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Real blocks are asked for by those pages alone whose commands hold DATA."""
    if args.out is None:
        parser.error("give a folder for results with --out")
    reading = [name for name in args.only if any("DATA" in shlex.split(run) for run in STANDING[name].runs)]
    if reading and args.data is None:
        parser.error(f"give the folder of real blocks with --data, for {', '.join(reading)}")


def _text(folder: Path | None) -> str:
    return "DIR" if folder is None else str(folder.resolve())


def _run(asked: Sequence[str]) -> int:
    command = [sys.executable, "-m", "benchmarks", *asked]
    return subprocess.run(command, cwd=REPOSITORY / "scripts", stdout=subprocess.DEVNULL, check=False).returncode
