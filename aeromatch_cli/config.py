"""The YAML tree: schema, presets, files, `--set` overrides, validation with useful messages, and the full dump.

Each strategy class brings its own keys and defaults; this module only says where it sits. A tree is built from the
defaults, a preset or file holding differences, and overrides, in this order; then it is validated once.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from aeromatch_cli.config_faults import accidents, describe, nearest, root_faults
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
    """A bare name stands for the strategy with its defaults."""
    return {"name": value} if isinstance(value, str) else value


def _chain(value: Any) -> Any:
    """`a+b` and a single mapping are chains too; null and `none` are the empty one."""
    if value is None or value == "none":
        return []
    if isinstance(value, str):
        value = [name.strip() for name in value.split("+")]
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
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


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

    @field_validator("crs", "ground", mode="before")
    @classmethod
    def _number_as_text(cls, value: Any) -> Any:
        return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


class RunSettings(_Section):
    """How it is run; nothing here changes a result."""

    executor: Literal["serial", "processes", "dask"] = Field(
        "processes", description="Where tasks run; `dask` needs the extra [cluster]."
    )
    jobs: int = Field(0, ge=0, description="Worker processes; 0 = one per core.")
    keep_images: bool = Field(False, description="`run` keeps enhanced and simulated pictures too.")


class Settings(_Section):
    """The whole tree."""

    workspace: str = Field("aeromatch-work", min_length=1, description="Folder for every result; made if missing.")
    seed: int = Field(0, ge=0, description="Seed of everything random.")
    block: BlockSettings = Field(BlockSettings(), description="What was flown.")
    run: RunSettings = Field(RunSettings(), description="How it is run; nothing here changes a result.")
    pairs: _choice(PAIRINGS) = Field(  # type: ignore[valid-type]
        PAIRINGS["overlap"](), description="Which images are compared."
    )
    enhance: _choice(ENHANCERS) = Field(  # type: ignore[valid-type]
        ENHANCERS["none"](), description="What is done to a picture before anything else."
    )
    simulate: _choice(SIMULATORS) = Field(  # type: ignore[valid-type]
        SIMULATORS["ground"](), description="From where a picture is looked at: virtual views."
    )
    extract: _choice(EXTRACTORS) = Field(  # type: ignore[valid-type]
        EXTRACTORS["sift"](), description="Features of each image, over all its views."
    )
    match: _choice(MATCHERS) = Field(  # type: ignore[valid-type]
        MATCHERS["nearest"](), description="Which features of two images belong together."
    )
    filter: Annotated[tuple[_choice(FILTERS), ...], BeforeValidator(_chain)] = Field(  # type: ignore[valid-type]
        (FILTERS["poselib"](),),
        min_length=1,  # without a filter no pair is ever verified
        description="Which matches are kept: a chain, each sees what those before it left.",
    )
    export: Annotated[tuple[_choice(EXPORTERS), ...], BeforeValidator(_chain)] = Field(  # type: ignore[valid-type]
        (EXPORTERS["colmap"](),), description="For which programs the result is written: a list."
    )

    @field_validator("filter")
    @classmethod
    def _one_that_verifies(cls, value: tuple[Strategy, ...]) -> tuple[Strategy, ...]:
        if not any(one.verifies for one in value):
            names = "+".join(getattr(one, "name", "") for one in value)
            evidence = next(name for name, strategy in FILTERS.items() if strategy.verifies)
            colours = " with extract.colours=true" if any("colour" in one.needs for one in value) else ""
            raise ValueError(f"{names} verifies nothing by itself; use {names}+{evidence}{colours}")
        return value

    @model_validator(mode="after")
    def _descriptors_for_matchers(self) -> Settings:
        made, wanted = self.extract.descriptors, self.match.reads_descriptors
        if not self.match.reads_pixels and (not made or wanted not in ("", made)):
            # What has no descriptors only pixels can compare; what has them need not be measured anew.
            readers = [
                name
                for name, one in MATCHERS.items()
                if one.reads_pixels != bool(made) and one.reads_descriptors in ("", made)
            ]
            makers = [name for name, one in EXTRACTORS.items() if one.descriptors and wanted in ("", one.descriptors)]
            raise ValueError(
                f"match {self.match.name} compares {wanted or 'any'} descriptors, extract {self.extract.name} makes "
                f"{made or 'none'}; use match {' or '.join(readers)}, or extract {' or '.join(makers)}"
            )
        return self

    @model_validator(mode="after")
    def _colours_for_filters(self) -> Settings:
        readers = [getattr(one, "name", "") for one in self.filter if "colour" in one.needs]
        if readers and not self.extract.colours:
            raise ValueError(
                f"filter {'+'.join(readers)} compares colours that are not kept; add --set extract.colours=true"
            )
        return self

    @field_validator("export")
    @classmethod
    def _one_folder_each(cls, value: tuple[Strategy, ...]) -> tuple[Strategy, ...]:
        names = [getattr(exporter, "name", "") for exporter in value]
        if len(set(names)) < len(names):
            raise ValueError(f"each exporter at most once, its folder has its name: {', '.join(names)}")
        return value


FAMILIES: Mapping[str, Mapping[str, type[Strategy]]] = {
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

    overrides: "key.sub=value" texts. block, top: values from the command line; None means not given. Paths in a file
    are relative to that file, all others to the current folder.
    Raises ConfigError naming the key's place and the nearest valid one.
    """
    tree, origin = _read_tree(source)
    for text in overrides:
        _apply_override(tree, text)
    given = {key: value for key, value in top.items() if value is not None}
    block_given = {key: value for key, value in (block or {}).items() if value is not None}
    if block_given:
        given["block"] = block_given
    if overrides and given:
        validate(tree, f"{origin} with --set")  # a mistake is one even where an option hides it
    _merge(tree, _absolute_paths(given, tree, Path.cwd()))
    return validate(tree, f"{origin} with the options given" if overrides or given else origin)


def validate(tree: Mapping[str, Any], origin: str = "configuration") -> Settings:
    """Settings of a plain tree. Raises ConfigError listing every fault."""
    try:
        settings = Settings.model_validate(tree)
        faults = list(accidents(tree, settings.model_dump(mode="json")))
    except ValidationError as error:
        faults = [describe(fault, Settings, FAMILIES) for fault in root_faults(error.errors())]
    if faults:
        raise ConfigError(f"{origin} is not valid:\n" + "\n".join(f"  {fault}" for fault in faults))
    return settings


def dump(settings: Settings) -> str:
    """The complete tree as YAML, every default present, for the workspace itself.

    Its `workspace` is therefore `.`: the file runs again where it lies, even after the folder was moved.
    """
    tree = settings.model_dump(mode="json") | {"workspace": "."}
    return yaml.safe_dump(tree, sort_keys=False, width=100, allow_unicode=True)


def parse_method(text: str) -> tuple[str, list[str]]:
    """`fusion[enhance=none,match.ratio=0.7]` to ("fusion", ["enhance=none", "match.ratio=0.7"])."""
    match = re.fullmatch(r"([^\[\]]+)(?:\[(.*)\])?", text.strip())
    if not match:
        raise ConfigError(f"{text!r} is not a method; write PRESET or PRESET[key=value,key=value]")
    return match[1], [part for part in (match[2] or "").split(",") if part]


def _read_tree(source: str) -> tuple[dict[str, Any], str]:
    """Defaults with the differences of a preset or file merged in, and the source in words."""
    tree: dict[str, Any] = Settings().model_dump(mode="json")
    path = Path(source)
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    if not is_yaml and source in preset_names():
        text, origin, folder = _read_text(_preset_folder() / f"{source}.yaml"), f"preset {source}", None
    elif is_yaml or path.is_file():
        text, origin, folder = _read_text(path), str(path), path.absolute().parent
    else:
        hint = nearest(source, preset_names(), otherwise="")
        raise ConfigError(
            f"{source!r} is neither a YAML file nor a preset; presets are {', '.join(preset_names())}{hint}"
        )
    try:
        differences = yaml.load(text, _UniqueKeyLoader) or {}
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{origin} is not YAML: {error}") from None
    if not isinstance(differences, dict):
        raise ConfigError(f"{origin} must hold keys and values at the top, not a {type(differences).__name__}")
    _merge(tree, _absolute_paths(differences, tree, folder) if folder else differences)
    return tree, origin


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"cannot read configuration {path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"cannot read configuration {path}: {error}; save it as UTF-8") from None


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that is written twice; YAML would silently take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                if key_node.value in seen:
                    raise yaml.MarkedYAMLError(
                        problem=f"the key {key_node.value!r} is written twice", problem_mark=key_node.start_mark
                    )
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def _absolute_paths(differences: Mapping[str, Any], tree: Mapping[str, Any], folder: Path) -> dict[str, Any]:
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
            result[key] = _absolute_strategy_paths(value, table.get(str(value.get("name", default))), folder)
        elif isinstance(value, list):
            result[key] = [
                _absolute_strategy_paths(item, table.get(str(item.get("name"))), folder)
                if isinstance(item, Mapping)
                else item
                for item in value
            ]
    return result


def _absolute_block_path(key: Any, value: Any, folder: Path) -> Any:
    if key not in PATH_KEYS or not isinstance(value, str) or not value or value in _WORDS.get(key, ()):
        return value
    return value if key == "ground" and _is_number(value) else _below(folder, value)


def _absolute_strategy_paths(
    values: Mapping[str, Any], strategy: type[Strategy] | None, folder: Path
) -> dict[str, Any]:
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
            if value is None and "none" in FAMILIES[key]:
                value = "none"
            value = _chain(value) if isinstance(current, list) else _named(value)
        if isinstance(current, dict) and isinstance(value, Mapping):
            if "name" in current and value.get("name", current["name"]) != current["name"]:
                tree[key] = copy.deepcopy(dict(value))
            else:
                _merge(current, value)
        elif key in FAMILIES or not (isinstance(current, dict) and value is None):  # an empty section changes nothing
            tree[key] = copy.deepcopy(value)


def _apply_override(tree: dict[str, Any], text: str) -> None:
    """One `--set`: the text becomes a small tree that is merged like a file's."""
    key, separator, value_text = text.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise ConfigError(f"--set {text!r}: write key.sub=value, for example --set extract.keypoints=8000")
    value = _override_value(parts, value_text)
    if value is None and not value_text.strip():
        raise ConfigError(f"--set {text!r}: the value is missing; write --set {key.strip()}=VALUE")
    if isinstance(tree.get(parts[0]), list) and len(parts) > 1:
        member, table = _member(tree[parts[0]], parts), FAMILIES[parts[0]]
        inner = _nested(parts[2:], value)
        _merge(member, _absolute_strategy_paths(inner, table.get(str(member["name"])), Path.cwd()))
    else:
        _merge(tree, _absolute_paths(_nested(parts, value), tree, Path.cwd()))


def _override_value(parts: Sequence[str], text: str) -> Any:
    """The text as YAML; for a setting that is text, as it stands: a folder may be named 2024-06-31, 007 or no."""
    field: Any = Settings.model_fields.get(parts[0])
    if parts[0] == "block" and len(parts) == 2:
        field = BlockSettings.model_fields.get(parts[1])
    if field is not None and field.annotation is str:
        return text
    try:
        return yaml.load(text, _UniqueKeyLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return text


def _nested(parts: Sequence[str], value: Any) -> dict[str, Any]:
    for part in reversed(parts):
        value = {part: value}
    return dict(value)


def _member(chain: Iterable[Any], parts: Sequence[str]) -> dict[str, Any]:
    """The one member of a chain that `filter.poselib.threshold_px` names."""
    place, name = ".".join(parts), parts[1]
    present = [item for item in chain if isinstance(item, dict)]
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
