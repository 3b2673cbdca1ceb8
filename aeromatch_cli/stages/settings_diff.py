"""This module says what other settings than those of the last run mean for a workspace, before its results are
replaced."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.config import Settings, differing, load, plain
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import listed


def changed_words(config: Path, settings: Settings) -> str:
    """Return the settings that differ from those in `config`, the workspace's own, and from where on results that
    depend on them are made again; "" where there are none, or no sound file."""
    try:
        before = plain(load(str(config)))
    except ConfigError:
        return ""
    changed = [
        (key, old, new)
        for key, new, old in differing(plain(settings), before)
        if graph.first_reader(key) and _resolved(old) != _resolved(new)
    ]
    if not changed:
        return ""
    named = listed(f"{key} {said_value(old)} -> {said_value(new)}" for key, old, new in changed)
    first = min((graph.first_reader(key) for key, *_ in changed), key=graph.ORDER.index)
    return f"{named}: what depends on it is made again, from {first} on"


def _resolved(value: Any) -> Any:
    """Return a value that is the same for one file or folder, however its path is written."""
    return str(Path(value).resolve()) if isinstance(value, str) and "/" in value and Path(value).exists() else value


def said_value(value: Any) -> str:
    """Write a value as the command line does; steps and filters by their names."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return (
            "+".join(str(item.get("name", item)) if isinstance(item, Mapping) else str(item) for item in value)
            or "none"
        )
    return str(value).lower() if isinstance(value, bool) else str(value)
