"""What a results table rests on: command, commit, date, machine, versions, and the blocks networks were trained on."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Collection, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from aeromatch_cli.config import FAMILIES, Settings, load, parse_method, preset_names
from aeromatch_cli.config.load import differences_of_preset
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.nets.files import SHIPPED_FOLDER, sha256_of_file
from aeromatch_cli.nets.precision import has_bfloat16
from aeromatch_cli.stages import adjust, consistency, orient
from aeromatch_cli.stages.cascade import strategies_of
from aeromatch_cli.stages.versions import PIPELINE_VERSION
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters.chain import VERSION as CHAIN_VERSION

Version = int | str
Versions = Mapping[str, Version]
# command, commit (null outside a repository), date, machine, trained_on, versions.
Stamp = dict[str, Any]
REPOSITORY = Path(__file__).parent.parent.parent
_ORIENTATION: Versions = {
    "stage.orient": orient.VERSION,
    "stage.adjust": adjust.VERSION,
    "stage.consistency": consistency.VERSION,
}
_DIGITS = 12  # of a SHA-256 that tell weights and presets apart
_SOME = ("sheffield", "caliterra", "brighton")
_MOST = ("sheffield", "caliterra", "seneca", "brighton")
# Real blocks whose pictures a network has seen in training, as its card says (nets/trained/*.md).
TRAINED_ON: Mapping[str, tuple[str, ...]] = {
    "context": (), "detector": _MOST, "geodesc": _MOST, "lightglue": _SOME, "lightglue-learned": _MOST,
    "orientation": _MOST, "shadow": (),
}  # fmt: skip
_FEATURES = {"avx2": "AVX2", "avx512f": "AVX-512", "amx_tile": "AMX"}  # flag of the processor: its name


def make_stamp(command: str, versions: Versions) -> Stamp:
    """Of a table that is made now by `command`."""
    return {
        "command": command,
        "commit": commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "trained_on": trained_on(versions),
        "versions": dict(sorted(versions.items())),
    }


def said(stamp: Stamp) -> str:
    """The line of a page that says what a stamp holds."""
    blocks = ", ".join(stamp["trained_on"])
    trained = f"; networks trained on {blocks}" if blocks else ""
    return f"Commit {stamp['commit'] or 'unknown'}, {stamp['date']}; {stamp['machine']}{trained}."


def commit(checkout: Path = REPOSITORY) -> str | None:
    """The short hash, `+changes` where tracked files outside docs/ differ from it; None outside a repository."""
    found = _git(checkout, "rev-parse", "--short", "HEAD")
    if not found:
        return None
    return f"{found}+changes" if _git(checkout, "status", "--porcelain", "-uno", "--", ".", ":!docs") else found


def _git(checkout: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", *words], cwd=checkout, check=False, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def machine() -> str:
    """What tells processors apart by speed and rounding."""
    import torch

    info = Path("/proc/cpuinfo")
    flags = set(info.read_text(encoding="utf-8", errors="replace").split()) if info.is_file() else set()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parts = [f"{cores} cores", *(name for flag, name in _FEATURES.items() if flag in flags)]
    if "avx512f" in flags and torch.backends.cpu.get_cpu_capability() == "AVX2":
        parts.append("used as AVX2")
    parts.append("bfloat16" if has_bfloat16() else "no bfloat16")
    return ", ".join(parts + ([torch.cuda.get_device_name()] if torch.cuda.is_available() else []))


def trained_on(versions: Iterable[str]) -> list[str]:
    """Real blocks that any of the networks among these keys has seen, in a fixed order."""
    seen = {block for key in versions if key.startswith("weights.") for block in TRAINED_ON[key.partition(".")[2]]}
    return [block for block in _MOST if block in seen]


def of_settings(*every: Settings, families: Collection[str] = tuple(FAMILIES)) -> dict[str, Version]:
    """Versions of the pipeline, of all strategies of these families, of those of a cascade's steps, and of their
    networks."""
    found: dict[str, Version] = {"pipeline": PIPELINE_VERSION} if every else {}
    for settings in every:
        for family in families:
            value = getattr(settings, family)
            found |= of_strategies(family, *(value if isinstance(value, tuple) else (value,)))
        for step in settings.cascade if "cascade" in families else ():
            for family, strategy in strategies_of(step, settings).items():
                found |= of_strategies(family, strategy)
    return found


def of_pipeline() -> dict[str, Version]:
    """Of tables that state seconds and memory of whole runs."""
    return {"pipeline": PIPELINE_VERSION, **_ORIENTATION}


def of_matching(*every: Settings) -> dict[str, Version]:
    """Versions of all that the verified matches of pairs rest on whose poses are given."""
    return of_settings(*every, families=("pairs", "enhance", "simulate", "extract", "match", "filter"))


def of_chain(*methods: str, exported: bool = False) -> dict[str, Version]:
    """Versions of all that `aeromatch run` rests on with presets, PRESET or PRESET[key=value,...]. exported: whether
    the table shows what others make of the export."""
    every = [load(*parse_method(method)) for method in methods]
    presets = of_presets(*(parse_method(method)[0] for method in methods))
    families = [family for family in FAMILIES if exported or family != "export"]
    return presets | of_settings(*every, families=families) | (_ORIENTATION if every else {})


def of_presets(*names: str) -> dict[str, Version]:
    """What presets set that is not the default, as digests."""
    every = {name: json.dumps(differences_of_preset(name)[1], sort_keys=True) for name in names}
    return {f"preset.{name}": hashlib.sha256(text.encode()).hexdigest()[:_DIGITS] for name, text in every.items()}


def of_strategies(family: str, *strategies: Strategy) -> dict[str, Version]:
    """Versions of strategies of one family, of the filters' chain, and of the networks that ship for them."""
    found: dict[str, Version] = {"filter.chain": CHAIN_VERSION} if family == "filter" else {}
    for strategy in strategies:
        found[f"{family}.{getattr(strategy, 'name', '')}"] = strategy.version
        paths = [Path(path) for path in strategy.fingerprint_files()]
        found |= of_networks(*(path.stem for path in paths if path.parent == SHIPPED_FOLDER))
    return found


def of_networks(*names: str) -> dict[str, Version]:
    """Versions of networks that ship."""
    return {f"weights.{name}": sha256_of_file(SHIPPED_FOLDER / f"{name}.safetensors")[:_DIGITS] for name in names}


def present_versions() -> dict[str, Version]:
    """Every version that there is now."""
    tables = [*FAMILIES.items(), *ARMS.items()]
    strategies = {f"{family}.{name}": one.version for family, table in tables for name, one in table.items()}
    networks = of_networks(*(path.stem for path in SHIPPED_FOLDER.glob("*.safetensors")))
    return {
        "pipeline": PIPELINE_VERSION,
        "filter.chain": CHAIN_VERSION,
        **_ORIENTATION,
        **of_presets(*preset_names()),
        **strategies,
        **networks,
    }


def changed(stamp: Stamp, present: Versions) -> Iterator[str]:
    """What a table depends on that is not what it was."""
    yield from (key for key, value in stamp["versions"].items() if present.get(key) != value)
