"""Makes the tables of docs/results: runs the standing benchmarks one after the other, each in processes of its own.

All of them take two hours on two idle cores. Every benchmark goes on where it was, as long as the code is the same: OUT
has a folder for each state of aeromatch_cli. A benchmark that fails does not keep the others from being run. With
--docs the tables are written into their pages, and their figures into the README.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import figures, options
from benchmarks.sources import code_digest
from benchmarks.stamps import REPOSITORY


@dataclass(frozen=True)
class Standing:
    """A page of docs/results. minutes: planned, on two idle cores. runs: the text of commands after `scripts/bench`, in
    which DATA, WEIGHTS and OUT stand for folders."""

    page: str
    minutes: int
    runs: tuple[str, ...]


STANDING: Mapping[str, Standing] = {
    "auto": Standing(
        "auto.md",
        45,
        (
            "auto rendered --docs --out OUT/auto",
            "auto strategies --docs --out OUT/auto",
            "auto real --data DATA --docs --out OUT/auto",
        ),
    ),
    "claims": Standing(
        "claims.md",
        20,
        ("claims --seed 1 --data DATA --reference-weights WEIGHTS --docs --out OUT/claims",),
    ),
    "peers": Standing(
        "peers.md",
        15,
        (
            "peers --reference-weights WEIGHTS --docs --out OUT/peers",
            "peers --scenes '' --data DATA --blocks lewis,ochota --reference-weights WEIGHTS --docs bench_peers_real "
            "--out OUT/peers-real",
        ),
    ),
    "calibration": Standing("calibration.md", 10, ("calibration --docs --out OUT/calibration",)),
    "orientation": Standing(
        "orientation.md",
        10,
        (
            "orientation --data DATA --blocks seneca,ochota,lewis --thin 2 --cases reference,noise,nothing,third "
            "--keypoints 3000 --docs --out OUT/orientation",
            "orientation --blocks city:nadir,grass:nadir,hills:nadir,suburb:mixed --rendered 12 --size 800x600 "
            "--cases reference,noise,noisy,unoriented --keypoints 2000 --docs bench_orientation_rendered "
            "--out OUT/orientation",
        ),
    ),
    "growth": Standing("growth.md", 6, ("growth --docs --out OUT/growth",)),
    "speed": Standing("speed.md", 10, ("speed --docs --out OUT/speed",)),
    "robustness": Standing("robustness.md", 4, ("robustness --docs --out OUT/robustness",)),
}


def words(run: str, given: Mapping[str, str], *, docs: bool, quick: bool = False) -> list[str]:
    """Arguments of `scripts/bench` for one run; without weights their option is left out."""
    text = run if docs else re.sub(r" --docs( bench_\S+)?", "", run)
    text = text if "WEIGHTS" in given else re.sub(r" --reference-weights WEIGHTS", "", text)
    found = [re.sub(r"^(DATA|WEIGHTS|OUT)\b", lambda match: given[match[0]], word) for word in shlex.split(text)]
    return [*found, *(["--quick"] if quick else [])]


def main(arguments: Sequence[str]) -> int:
    parser = options.make_parser("results", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of real blocks")
    add("--reference-weights", type=Path, metavar="DIR", help="weights of the peers that are networks; else without")
    add("--only", type=options.names, default=",".join(STANDING), help="comma-separated")
    add("--docs", action="store_true", help="write the tables into docs/results and their figures into the README")
    add("--list", action="store_true", help="print the commands and their planned minutes instead of running them")
    add("--quick", action="store_true", help="all of them small: figures without worth, in minutes")
    add("--out", type=Path, required=True, help="folder of results; a killed run goes on where it was")
    args = options.parse(parser, arguments)
    if unknown := sorted(set(args.only) - set(STANDING)):
        parser.error(f"--only: {', '.join(unknown)} are none of {', '.join(STANDING)}")
    given = {"DATA": str(args.data.resolve()), "OUT": str(args.out.resolve() / code_digest("")[:8])}
    if args.reference_weights:
        given["WEIGHTS"] = str(args.reference_weights.resolve())
    failed = []
    for name in args.only:
        standing, started = STANDING[name], time.monotonic()
        print(f"# {name}: about {standing.minutes} minutes", flush=True)
        for run in standing.runs:
            asked = words(run, given, docs=args.docs, quick=args.quick)
            print(shlex.join(["scripts/bench", *asked]), flush=True)
            if not args.list and _run(asked):
                failed.append(shlex.join(["scripts/bench", *asked]))
        if not args.list:
            print(f"# {name}: {(time.monotonic() - started) / 60.0:.1f} minutes", flush=True)
    if args.docs and not args.list:
        figures.write_readme()
    for command in failed:
        print(f"failed: {command}", file=sys.stderr)
    return 1 if failed else 0


def _run(asked: Sequence[str]) -> int:
    command = [sys.executable, "-m", "benchmarks", *asked]
    return subprocess.run(command, cwd=REPOSITORY / "scripts", stdout=subprocess.DEVNULL, check=False).returncode
