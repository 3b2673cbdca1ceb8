"""Benchmarks that are a list of runs of others.

A run is the text of a command after `scripts/bench`. DATA and WEIGHTS stand for folders that are given, SEED for the
seed, OUT for the folder of results; `--docs` and the table after it are left out where docs/results stay as they are.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import options
from benchmarks.stamps import REPOSITORY


def words(run: str, given: Mapping[str, str], *, docs: bool) -> list[str]:
    """Arguments of `scripts/bench` for one run."""
    text = run if docs else re.sub(r" --docs( bench_\S+)?", "", run)
    return [re.sub(r"^(DATA|WEIGHTS|SEED|OUT)\b", lambda match: given[match[0]], word) for word in shlex.split(text)]


def run_all(name: str, about: str | None, runs: Sequence[str], arguments: Sequence[str]) -> int:
    """Each run in a process of its own, in order, up to one that fails: its exit code."""
    parser = options.make_parser(name, about)
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="folder of real blocks")
    if any("WEIGHTS" in run for run in runs):
        add("--reference-weights", type=Path, required=True, metavar="DIR", help="weights of the peers")
    add("--seed", type=int, default=1, help="another seed gives other blocks, pairs and samples")
    add("--docs", action="store_true", help="write the tables into their pages of docs/results")
    add("--list", action="store_true", help="print the commands instead of running them")
    add("--out", type=Path, required=True, help="folder of results; a killed run goes on where it was")
    args = options.parse(parser, arguments)
    folders = {"DATA": args.data, "OUT": args.out, "WEIGHTS": getattr(args, "reference_weights", args.data)}
    given = {key: str(path.resolve()) for key, path in folders.items()} | {"SEED": str(args.seed)}
    for run in runs:
        asked = words(run, given, docs=args.docs)
        print(shlex.join(["scripts/bench", *asked]), file=sys.stdout if args.list else sys.stderr, flush=True)
        if not args.list:
            done = subprocess.run([sys.executable, "-m", "benchmarks", *asked], cwd=REPOSITORY / "scripts", check=False)
            if done.returncode:
                return done.returncode
    return 0
