"""The YAML tree: schema, presets, files, `--set` overrides, validation with useful messages, and the full dump.

Each strategy class brings its own keys and defaults; this module only says where it sits. A tree is built from the
defaults, a preset or file holding differences, and overrides, in this order; then it is validated once.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.enhancers import ENHANCERS
from aeromatch_cli.strategies.exporters import EXPORTERS
from aeromatch_cli.strategies.extractors import EXTRACTORS
from aeromatch_cli.strategies.filters import FILTERS
from aeromatch_cli.strategies.matchers import MATCHERS
from aeromatch_cli.strategies.pairings import PAIRINGS
from aeromatch_cli.strategies.simulators import SIMULATORS

PATH_KEYS = ("images", "poses", "cameras", "ground", "masks")
_WORDS = {"poses": ("exif", "none"), "cameras": ("exif", "folder"), "ground": ("auto",)}


def _named(value: Any) -> Any:
    """A bare name stands for the strategy with its defaults; YAML's null means `none`."""
    if value is None:
        return {"name": "none"}
    return {"name": value} if isinstance(value, str) else value


def _chain(value: Any) -> Any:
    """`a+b` and a single mapping are chains too."""
    if isinstance(value, str):
        value = value.split("+")
    elif isinstance(value, Mapping):
        value = [value]
    return [_named(item) for item in value] if isinstance(value, Sequence) else value


def _choice(table: Mapping[str, type[Strategy]]) -> Any:
    """Type of "one of this family", chosen by `name`."""
    classes = tuple(table.values())
    if len(classes) == 1:
        return Annotated[classes[0], BeforeValidator(_named)]
    return Annotated[Union[classes], Field(discriminator="name"), BeforeValidator(_named)]  # noqa: UP007


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class BlockSettings(_Section):
    """What was flown: images, poses, cameras, ground."""

    images: str = Field("", description="Folder of images, searched recursively.")
    poses: str = Field("exif", description="Pose list (CSV/TXT), `exif` for GPS and XMP angles, or `none`.")
    cameras: str = Field("exif", description="COLMAP cameras.txt, YAML, JSON, `exif` or `folder` (one per folder).")
    crs: str = Field("auto", description="Code of the world frame (EPSG:32633), `local`, or `auto` (UTM zone).")
    ground: str = Field("auto", description="Height in metres, a DEM file, or `auto` (triangulated).")
    masks: str = Field("", description="Folder of masks (a/1.jpg.png masks a/1.jpg; 0 = ignore) or one mask for all.")
    angles: Literal["auto", "gimbal", "nadir"] = Field(
        "auto", description="Zero of yaw/pitch/roll: camera forward (gimbal, DJI) or down (nadir, Parrot)."
    )
    sigma_position_m: float = Field(5.0, gt=0, description="Standard deviation of each coordinate, metres.")
    sigma_angle_deg: float = Field(3.0, gt=0, description="Standard deviation of each angle, degrees.")
    max_size_px: int = Field(0, ge=0, description="Larger images are reduced to this longer side; 0 = never.")


class RunSettings(_Section):
    """How it is run; nothing here changes a result."""

    executor: Literal["serial", "processes", "dask"] = Field(
        "processes", description="Where tasks run; `dask` needs the extra [cluster]."
    )
    jobs: int = Field(0, ge=0, description="Worker processes; 0 = one per core.")
    keep_images: bool = Field(False, description="`run` keeps enhanced and simulated pictures too.")


class Settings(_Section):
    """The whole tree."""

    workspace: str = Field("aeromatch-work", description="Folder for every result; made if missing.")
    seed: int = Field(0, ge=0, description="Seed of everything random.")
    block: BlockSettings = BlockSettings()
    run: RunSettings = RunSettings()
    pairs: _choice(PAIRINGS) = PAIRINGS["overlap"]()  # type: ignore[valid-type]
    enhance: _choice(ENHANCERS) = ENHANCERS["none"]()  # type: ignore[valid-type]
    simulate: _choice(SIMULATORS) = SIMULATORS["ground"]()  # type: ignore[valid-type]
    extract: _choice(EXTRACTORS) = EXTRACTORS["sift"]()  # type: ignore[valid-type]
    match: _choice(MATCHERS) = MATCHERS["nearest"]()  # type: ignore[valid-type]
    filter: Annotated[tuple[_choice(FILTERS), ...], BeforeValidator(_chain)] = (  # type: ignore[valid-type]
        FILTERS["poselib"](),
    )
    export: Annotated[tuple[_choice(EXPORTERS), ...], BeforeValidator(_chain)] = (  # type: ignore[valid-type]
        EXPORTERS["colmap"](),
    )


FAMILIES: dict[str, Mapping[str, type[Strategy]]] = {
    "pairs": PAIRINGS,
    "enhance": ENHANCERS,
    "simulate": SIMULATORS,
    "extract": EXTRACTORS,
    "match": MATCHERS,
    "filter": FILTERS,
    "export": EXPORTERS,
}


def preset_names() -> list[str]:
    """Presets that ship with the package."""
    return sorted(path.stem for path in _preset_folder().glob("*.yaml"))


def _preset_folder() -> Path:
    """Inside the package when installed from a wheel, beside it in a checkout."""
    inside = Path(__file__).parent / "configs"
    return inside if inside.is_dir() else Path(__file__).parent.parent / "configs"


def load(source: str, overrides: Sequence[str] = (), block: Mapping[str, Any] | None = None, **top: Any) -> Settings:
    """Settings of a preset name or YAML file, with `--set` overrides and command-line block options on top.

    overrides: "key.sub=value" texts. block, top: values from the command line; None means not given.
    Raises ConfigError naming the key's place and the nearest valid one.
    """
    tree, origin = _read_tree(source)
    for text in overrides:
        _apply_override(tree, text)
    given = {key: value for key, value in (block or {}).items() if value is not None}
    _merge(tree, {"block": _absolute_paths(given, Path.cwd())} if given else {})
    _merge(tree, {key: value for key, value in top.items() if value is not None})
    return validate(tree, origin)


def validate(tree: Mapping[str, Any], origin: str = "configuration") -> Settings:
    """Settings of a plain tree. Raises ConfigError listing every fault."""
    try:
        return Settings.model_validate(tree)
    except ValidationError as error:
        faults = "\n".join(f"  {_describe(dict(fault))}" for fault in error.errors())
        raise ConfigError(f"{origin} is not valid:\n{faults}") from None


def dump(settings: Settings) -> str:
    """The complete tree as YAML, every default present."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, width=100)


def parse_method(text: str) -> tuple[str, list[str]]:
    """`fusion[enhance=none,match.ratio=0.7]` to ("fusion", ["enhance=none", "match.ratio=0.7"])."""
    match = re.fullmatch(r"([^\[\]]+)(?:\[(.*)\])?", text.strip())
    if not match:
        raise ConfigError(f"{text!r} is not a method; write PRESET or PRESET[key=value,key=value]")
    return match[1], [part for part in (match[2] or "").split(",") if part]


def _read_tree(source: str) -> tuple[dict[str, Any], str]:
    tree: dict[str, Any] = Settings().model_dump(mode="json")
    path = Path(source)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"cannot read configuration {source}: {error}") from None
        origin, folder = str(path), path.resolve().parent
    elif source in preset_names():
        text = (_preset_folder() / f"{source}.yaml").read_text(encoding="utf-8")
        origin, folder = f"preset {source}", Path.cwd()
    else:
        hint = _nearest(source, preset_names())
        raise ConfigError(
            f"{source!r} is neither a YAML file nor a preset; presets are {', '.join(preset_names())}{hint}"
        )
    try:
        differences = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise ConfigError(f"{origin} is not YAML: {error}") from None
    if not isinstance(differences, dict):
        raise ConfigError(f"{origin} must hold keys and values at the top, not a {type(differences).__name__}")
    if isinstance(differences.get("block"), dict):
        differences["block"] = _absolute_paths(differences["block"], folder)
    if isinstance(differences.get("workspace"), str):
        differences["workspace"] = str((folder / differences["workspace"]).absolute())
    _merge(tree, differences)
    return tree, origin


def _absolute_paths(block: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Paths in a file are relative to that file, on the command line to the current folder."""
    result = dict(block)
    for key in PATH_KEYS:
        value = result.get(key)
        if isinstance(value, str) and value and value not in _WORDS.get(key, ()) and not _is_number(value):
            result[key] = os.path.normpath(folder / Path(value).expanduser())
        elif key == "ground" and isinstance(value, int | float) and not isinstance(value, bool):
            result[key] = str(value)
    return result


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _merge(tree: dict[str, Any], differences: Mapping[str, Any]) -> None:
    """Deep merge; a strategy of another name replaces the whole entry, so that no foreign key survives."""
    for key, value in differences.items():
        current = tree.get(key)
        if key in FAMILIES and (isinstance(value, str) or value is None):
            value = _chain(value) if isinstance(current, list) else _named(value)
        if isinstance(current, dict) and isinstance(value, Mapping):
            if "name" in current and value.get("name", current["name"]) != current["name"]:
                tree[key] = dict(value)
            else:
                _merge(current, value)
        else:
            tree[key] = value


def _apply_override(tree: dict[str, Any], text: str) -> None:
    key, separator, value_text = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {text!r}: write key.sub=value, for example --set extract.keypoints=8000")
    try:
        value = yaml.safe_load(value_text)
    except yaml.YAMLError:
        value = value_text
    parts = key.strip().split(".")
    if parts[0] == "block" and len(parts) == 2:
        _merge(tree, {"block": _absolute_paths({parts[1]: value}, Path.cwd())})
        return
    node: Any = tree
    for depth, part in enumerate(parts[:-1]):
        node = _child(node, part, ".".join(parts[: depth + 1]))
    if isinstance(node, list):
        raise ConfigError(f"--set {key}: name a setting of the chain's member, for example {key}.KEY=VALUE")
    _merge(node, {parts[-1]: value})


def _child(node: Any, part: str, place: str) -> Any:
    if isinstance(node, list):
        for item in node:
            if isinstance(item, dict) and item.get("name") == part:
                return item
        present = ", ".join(str(item.get("name")) for item in node if isinstance(item, dict))
        raise ConfigError(f"--set {place}: the chain holds {present}; no member is named {part!r}")
    if not isinstance(node, dict) or not isinstance(node.get(part), dict | list):
        known = [k for k, v in node.items() if isinstance(v, dict | list)] if isinstance(node, dict) else []
        raise ConfigError(f"--set {place}: no such section{_nearest(part, known)}")
    return node[part]


def _nearest(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else (f"; valid here: {', '.join(known)}" if known else "")


def _describe(fault: Mapping[str, Any]) -> str:
    """One line for one pydantic fault: place, what is wrong, what would be right."""
    location = tuple(fault["loc"])
    names = [str(part) for part in _visible(location)]
    place = ".".join(names)
    if fault["type"] == "extra_forbidden":
        siblings = _siblings(location[:-1])
        return f"{place}: unknown key{_nearest(names[-1], siblings)}"
    if fault["type"] == "union_tag_invalid":
        family = FAMILIES[str(location[0])]
        name = str(fault["ctx"]["tag"])
        return f"{place}: no strategy is named {name!r}{_nearest(name, list(family))}"
    if fault["type"] == "literal_error" and location[-1] == "name" and location[0] in FAMILIES:
        name = str(fault["input"])
        return f"{place}: no strategy is named {name!r}{_nearest(name, list(FAMILIES[str(location[0])]))}"
    return f"{place}: {fault['msg']} (got {fault['input']!r})"


def _visible(location: tuple[Any, ...]) -> Iterator[Any]:
    """The location without the union tags that pydantic puts in."""
    family = FAMILIES.get(str(location[0])) if location else None
    chained = len(location) > 1 and isinstance(location[1], int)
    for index, part in enumerate(location):
        # In a chain the tag names the member and stays; elsewhere it repeats what the section says.
        is_tag = family is not None and len(family) > 1 and not chained and index == 1 and part in family
        if not is_tag and not isinstance(part, int):
            yield part


def _siblings(location: tuple[Any, ...]) -> list[str]:
    model: Any = Settings
    for part in location:
        if isinstance(part, int):
            continue
        if isinstance(model, type) and issubclass(model, BaseModel) and part in model.model_fields:
            model = model.model_fields[part].annotation
        else:
            family = FAMILIES.get(str(location[0]), {})
            model = family.get(str(part), model)
    candidates = [model, *get_args(model)]
    for candidate in candidates:
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return list(candidate.model_fields)
    return []
