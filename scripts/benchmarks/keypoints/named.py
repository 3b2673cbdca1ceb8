"""What is compared, by name: NAME, LABEL=NAME, or LABEL=NAME:FILE with weights of one's own."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import ConfigError
from benchmarks.peers.base import Options


@dataclass(frozen=True)
class Named:
    """label: in tables and rows. name: of the table it is made from. weights: a file, or None."""

    label: str
    name: str
    weights: Path | None


def named(text: str, known: Mapping[str, Any]) -> list[Named]:
    """The methods between commas. Raises ConfigError on an unknown name and on a label that occurs twice."""
    found: dict[str, Named] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        head, _, weights = part.partition(":")
        label, _, name = head.rpartition("=")
        one = Named(label or name, name, Path(weights) if weights else None)
        if name not in known:
            raise ConfigError(f"{name!r} is none of {', '.join(known)}")
        if one.label in found:
            raise ConfigError(f"{one.label} stands for two methods; give labels: LABEL={name}")
        found[one.label] = one
    return list(found.values())


def without_paths(text: str) -> str:
    """The same names, FILE in the place of weights."""
    return re.sub(r":[^,]+", ":FILE", text)


def make(table: Mapping[str, Callable[..., Any]], method: Named, options: Options) -> Any:
    """What a name stands for, made."""
    if method.weights is None:
        return table[method.name](options)
    if not method.weights.is_file():
        raise ConfigError(f"weights {method.weights} not found")
    return table[method.name](options, weights=method.weights)
