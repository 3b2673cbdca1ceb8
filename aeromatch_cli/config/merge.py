"""Differences merged into a tree of settings: deep, with strategies by name, and `--set` texts."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from aeromatch_cli.config.paths import absolute_paths, absolute_strategy_paths
from aeromatch_cli.config.reading import UniqueKeyLoader
from aeromatch_cli.config.schema import FAMILIES, BlockSettings, Settings, chain, named
from aeromatch_cli.errors import ConfigError


def merge(tree: dict[str, Any], differences: Mapping[str, Any]) -> None:
    """Deep merge; a strategy of another name replaces the whole entry, so that no foreign key survives."""
    for key, value in differences.items():
        current = tree.get(key)
        if key in FAMILIES and (isinstance(value, str) or value is None):
            if value is None and "none" in FAMILIES[key]:
                value = "none"
            value = chain(value) if isinstance(current, list) else named(value)
        if not isinstance(current, dict):
            tree[key] = copy.deepcopy(value)
        elif isinstance(value, Mapping):
            other_strategy = "name" in current and value.get("name", current["name"]) != current["name"]
            if other_strategy:
                tree[key] = copy.deepcopy(dict(value))
            else:
                merge(current, value)
        elif key in FAMILIES or value is not None:  # an empty section changes nothing
            tree[key] = copy.deepcopy(value)


def apply_override(tree: dict[str, Any], text: str) -> None:
    """One `--set`: the text becomes a small tree that is merged like a file's."""
    key, separator, value_text = text.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise ConfigError(f"--set {text!r}: write key.sub=value, for example --set extract.keypoints=12000")
    value = _override_value(parts, value_text)
    if value is None and not value_text.strip():
        raise ConfigError(f"--set {text!r}: the value is missing; write --set {key.strip()}=VALUE")
    if isinstance(tree.get(parts[0]), list) and len(parts) > 1:
        member, table = _member(tree[parts[0]], parts), FAMILIES[parts[0]]
        inner = _nested(parts[2:], value)
        merge(member, absolute_strategy_paths(inner, table.get(str(member["name"])), Path.cwd()))
    else:
        merge(tree, absolute_paths(_nested(parts, value), tree, Path.cwd()))


def _override_value(parts: Sequence[str], text: str) -> Any:
    """The text as YAML; for a setting that is text, as it stands: a folder may be named 2024-06-31, 007 or no."""
    field: Any = Settings.model_fields.get(parts[0])
    if parts[0] == "block" and len(parts) == 2:
        field = BlockSettings.model_fields.get(parts[1])
    if field is not None and field.annotation is str:
        return text
    try:
        return yaml.load(text, UniqueKeyLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return text


def _nested(parts: Sequence[str], value: Any) -> dict[str, Any]:
    for part in reversed(parts):
        value = {part: value}
    return dict(value)


def _member(members: Iterable[Any], parts: Sequence[str]) -> dict[str, Any]:
    """The one member of a chain that `filter.poselib.threshold_px` names."""
    place, name = ".".join(parts), parts[1]
    present = [item for item in members if isinstance(item, dict)]
    names = [str(item.get("name")) for item in present]
    found = [item for item in present if item.get("name") == name]
    if len(found) > 1:
        raise ConfigError(f"--set {place}: the chain holds {name} more than once; give the whole chain in a YAML file")
    if not found and name in FAMILIES[parts[0]]:
        raise ConfigError(
            f"--set {place}: the chain holds {'+'.join(names) or 'nothing'}; first --set {parts[0]}="
            f"{'+'.join([name, *names])}"
        )
    if not found or len(parts) < 3:
        example = f"{parts[0]}.{found[0]['name'] if found else (names or list(FAMILIES[parts[0]]))[0]}"
        raise ConfigError(f"--set {place}: name the chain's member and its setting: {example}.KEY=VALUE")
    return found[0]


def differing(first: Any, second: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Keys, as `extract.keypoints`, under which two trees of settings differ, and either's value; None where it has
    none."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for key in dict.fromkeys([*first, *second]):
            yield from differing(first.get(key), second.get(key), f"{place}.{key}" if place else key)
    elif _names(first) and _names(first) == _names(second):  # steps of a cascade, filters, exporters
        for one, other in zip(first, second, strict=True):
            yield from differing(one, other, f"{place}.{one['name']}")
    elif first != second:
        yield place, first, second


def _names(value: Any) -> list[Any]:
    """Return the names of a list of strategies; nothing of other values."""
    if not isinstance(value, list):
        return []
    names = [one["name"] for one in value if isinstance(one, Mapping) and "name" in one]
    return names if len(names) == len(value) else []
