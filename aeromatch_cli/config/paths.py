"""Paths in a tree of settings: relative to the file that names them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aeromatch_cli.blocks.ground import looks_like_height
from aeromatch_cli.config.schema import FAMILIES
from aeromatch_cli.strategies import Strategy

PATH_KEYS = ("images", "poses", "cameras", "ground", "masks", "gcp", "gcp_marks")

_WORDS = {"poses": ("exif", "none"), "cameras": ("exif", "folder"), "ground": ("auto",)}


def absolute_paths(differences: Mapping[str, Any], tree: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """`differences` with every path below `folder` unless it is absolute. tree: names the strategies they refer to."""
    result = dict(differences)
    if isinstance(result.get("workspace"), str) and result["workspace"]:
        result["workspace"] = _below(folder, result["workspace"])
    block = result.get("block")
    if isinstance(block, Mapping):
        result["block"] = {key: _absolute_block_path(key, value, folder) for key, value in block.items()}
    for key, table in FAMILIES.items():
        current, value = tree.get(key), result.get(key)
        default = current.get("name") if isinstance(current, Mapping) else None
        if isinstance(value, Mapping):
            result[key] = absolute_strategy_paths(value, table.get(str(value.get("name", default))), folder)
        elif isinstance(value, list):
            result[key] = [
                absolute_strategy_paths(item, table.get(str(item.get("name"))), folder)
                if isinstance(item, Mapping)
                else item
                for item in value
            ]
    return result


def _absolute_block_path(key: Any, value: Any, folder: Path) -> Any:
    """Return a setting of the block with the paths that it holds below a folder; words and numbers stay."""
    if not isinstance(value, str):
        return value
    if key == "exclude":
        return ",".join(_absolute_list(entry, folder) for entry in value.split(","))
    if key not in PATH_KEYS or not value or value in _WORDS.get(key, ()):
        return value
    if key == "images" and "://" in value:
        return value
    if key == "ground" and looks_like_height(value):
        is_file = not value[-1:].isdigit() and Path(_below(folder, value)).exists()
        return _below(folder, value) if is_file else value
    return _below(folder, value)


def _absolute_list(entry: str, folder: Path) -> str:
    """Return an entry of `exclude`: the path of a file of names, else the name or pattern as it is."""
    path = _below(folder, entry.strip())
    return path if Path(path).is_file() else entry


def absolute_strategy_paths(values: Mapping[str, Any], strategy: type[Strategy] | None, folder: Path) -> dict[str, Any]:
    """A field marked `path` holds a path; one marked "path or name" does where it is written as one or exists."""
    result = dict(values)
    for key, field in strategy.model_fields.items() if strategy else ():
        extra, value = field.json_schema_extra, result.get(key)
        kind = extra.get("path") if isinstance(extra, dict) else None
        if not kind or not isinstance(value, str) or not value:
            continue
        if kind is True or os.sep in value or Path(_below(folder, value)).is_file():
            result[key] = _below(folder, value)
    return result


def _below(folder: Path, path: str) -> str:
    return os.path.normpath(folder / os.path.expanduser(path))  # noqa: PTH111 - Path's raises on an unknown user
