"""Settings from a preset or file, `--set` overrides and options; validated once; dumped whole.

A tree is built from the defaults, a preset or file holding differences, and overrides, in this order.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from aeromatch_cli import DEFAULT_PRESET
from aeromatch_cli.config.faults import accidents, describe, nearest, root_faults
from aeromatch_cli.config.merge import apply_override, merge
from aeromatch_cli.config.paths import absolute_paths
from aeromatch_cli.config.reading import UniqueKeyLoader, read_text
from aeromatch_cli.config.schema import FAMILIES, Settings
from aeromatch_cli.errors import ConfigError

# Is read as a preset where it is named, and offered nowhere.
_ALL_SETTINGS = "default"


def preset_names() -> list[str]:
    """Presets that ship with the package, but for the commented list of all settings: that is `baseline`."""
    return sorted(path.stem for path in _preset_folder().glob("*.yaml") if path.stem != _ALL_SETTINGS)


def _is_preset(name: Any) -> bool:
    return name in (*preset_names(), _ALL_SETTINGS)


def differences_of_preset(name: str) -> tuple[str, dict[str, Any]]:
    """What a preset is for, in the comment at its top, and what it sets besides the defaults."""
    text = read_text(_preset_folder() / f"{name}.yaml")
    comment = " ".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    return comment, yaml.safe_load(text) or {}


def _preset_folder() -> Path:
    """Inside the package when installed from a wheel, beside it in a checkout."""
    package = Path(__file__).parent.parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def load(source: str, overrides: Sequence[str] = (), block: Mapping[str, Any] | None = None, **top: Any) -> Settings:
    """Settings of a preset name, a YAML file or a workspace, with `--set` overrides and options on top.

    overrides: "key.sub=value" texts. block, top: values from the command line; None means not given. Paths in a file
    are relative to that file, all others to the current folder.
    Raises ConfigError naming the key's place and the nearest valid one.
    """
    tree, origin = _read_tree(source)
    for text in overrides:
        apply_override(tree, text)
    given = {key: value for key, value in top.items() if value is not None}
    block_given = {key: value for key, value in (block or {}).items() if value is not None}
    if block_given:
        given["block"] = block_given
    if overrides and given:
        validate(tree, f"{origin} and --set")  # a mistake is one even where an option hides it
    merge(tree, absolute_paths(given, tree, Path.cwd()))
    return validate(tree, f"{origin} and the options given" if overrides or given else origin)


def validate(tree: Mapping[str, Any], origin: str = "configuration") -> Settings:
    """Settings of a plain tree. Raises ConfigError listing every fault."""
    try:
        settings = Settings.model_validate(tree)
        faults = list(accidents(tree, settings.model_dump(mode="json")))
    except ValidationError as error:
        faults = [describe(fault, Settings, FAMILIES) for fault in root_faults(error.errors())]
    if faults:
        raise ConfigError(f"wrong settings ({origin}):\n" + "\n".join(f"  {fault}" for fault in faults))
    return settings


def dump(settings: Settings) -> str:
    """The complete tree as YAML, every default present, for the workspace itself.

    Its `workspace` is therefore `.`: the file runs again where it lies, even after the folder was moved.
    """
    return yaml.safe_dump(plain(settings), sort_keys=False, width=100, allow_unicode=True)


def plain(settings: Settings) -> dict[str, Any]:
    """Return the tree that `dump` writes, as reading it gives it back."""
    return settings.model_dump(mode="json") | {"workspace": "."}


def parse_method(text: str) -> tuple[str, list[str]]:
    """`fusion[enhance=none,match.ratio=0.7]` to ("fusion", ["enhance=none", "match.ratio=0.7"])."""
    match = re.fullmatch(r"([^\[\]]+)(?:\[(.*)\])?", text.strip())
    if not match:
        raise ConfigError(f"{text!r} is not a method; write PRESET or PRESET[key=value,key=value]")
    return match[1], [part for part in (match[2] or "").split(",") if part]


def _merge_preset(tree: dict[str, Any], name: Any, origin: str) -> None:
    if not _is_preset(name):
        hint = nearest(str(name), preset_names(), otherwise="")
        raise ConfigError(f"{origin}: preset {name!r} is none of {', '.join(preset_names())}{hint}")
    merge(tree, differences_of_preset(name)[1])


def _read_tree(source: str) -> tuple[dict[str, Any], str]:
    """Defaults with the differences of a preset or file merged in, and the source in words.

    A workspace stands for its config.yaml. A file stands on a preset: the one that its key `preset` names, else the
    default preset.
    """
    tree: dict[str, Any] = Settings().model_dump(mode="json")
    text, origin, folder = _text_of(source)
    differences = _parsed(text, origin)
    if folder is not None:
        _merge_preset(tree, differences.pop("preset", DEFAULT_PRESET), origin)
    merge(tree, absolute_paths(differences, tree, folder) if folder else differences)
    return tree, origin


def _text_of(source: str) -> tuple[str, str, Path | None]:
    """Return the text of a preset, file or workspace, the source in words, and the folder of a file. Raises
    ConfigError."""
    path = Path(source)
    if not _is_preset(source) and (path / "block.json").is_file():
        path /= "config.yaml"  # of a workspace
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    if not is_yaml and _is_preset(source):
        return read_text(_preset_folder() / f"{source}.yaml"), f"preset {source}", None
    if (path / ".lock").is_file():
        raise ConfigError(
            f"{source!r} is a workspace whose run has not got as far as to write its settings: let it end, or run the "
            "same command again"
        )
    if path.is_dir():
        raise ConfigError(f"{source!r} is a folder: give a folder of images with --images, as in: --images {source}")
    if is_yaml or path.is_file():
        return read_text(path), str(path), path.absolute().parent
    hint = nearest(source, preset_names(), otherwise="")
    raise ConfigError(f"{source!r} is neither a YAML file nor a preset; presets are {', '.join(preset_names())}{hint}")


def _parsed(text: str, origin: str) -> dict[str, Any]:
    """Return the settings that a text in YAML holds. Raises ConfigError."""
    try:
        differences = yaml.load(text, UniqueKeyLoader) or {}
    except RecursionError:
        raise ConfigError(f"{origin} is nested too deeply for settings") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{origin} is not YAML: {error}") from None
    except ValueError:
        raise ConfigError(f"{origin} holds a number of too many digits, or a date that no calendar has") from None
    if not isinstance(differences, dict):
        raise ConfigError(f"{origin} must hold keys and values at the top, not a {type(differences).__name__}")
    return differences
