"""docs/configuration.md, made from the schema.

To bring the page up to date: `python -m aeromatch_cli.config.page > docs/configuration.md`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel

from aeromatch_cli.config.load import differences_of_preset, preset_names
from aeromatch_cli.config.renamed import SETTINGS, STRATEGIES
from aeromatch_cli.config.schema import FAMILIES, Settings
from aeromatch_cli.config.text import first_sentence, scalar
from aeromatch_cli.strategies import Strategy

_HEADING = """\
# Configuration

This page is made from the settings' own descriptions: `python -m aeromatch_cli.config.page > docs/configuration.md`.

A configuration is a preset's name, a YAML file or a workspace, which stands for the settings in it. A file holds only
what differs from a preset: the one that its key `preset` names, `auto` if it names none. What neither sets has the
default below; [configs/default.yaml](../configs/default.yaml) has all of them. Paths in a file are relative to that
file.

    aeromatch run fusion --images IMGS --poses poses.csv --workspace WORK --set extract.keypoints=12000

| on the command line | does |
|---|---|
| `--set extract.keypoints=12000` | changes one setting |
| `--set match=lightglue` | takes another strategy, with its defaults |
| `--set filter=poselib+graph` | takes a chain of strategies |
| `--set filter.poselib.threshold_px=2` | changes a setting of a chain's member |

An unknown key is an error that names its place and the nearest valid key. `aeromatch check PRESET --images IMGS`
tests a configuration without writing anything.
"""


def page() -> str:
    """The whole page as Markdown."""
    lines = [_HEADING, *_contents(), "## Presets", "", *_presets(), *_general()]
    for key, table in FAMILIES.items():
        lines += _family(key, table.values())
    return "\n".join([*lines, *_renamed()]).rstrip() + "\n"


def _contents() -> Iterator[str]:
    sections = ["presets", "general", *_plain_sections(), *FAMILIES, "renamed-settings"]
    links = [f"[{name.replace('-', ' ')}](#{name})" for name in sections]
    yield f"Sections: {', '.join(links)}."
    yield ""


def _presets() -> Iterator[str]:
    for name in preset_names():
        comment, tree = differences_of_preset(name)
        yield f"- `{name}`: {comment}"
        chosen = ", ".join(f"`{text}`" for key, value in tree.items() for text in _written(key, value))
        yield f"  {chosen}." if chosen else "  No differences."
    yield ""


def _written(key: str, value: Any) -> Iterator[str]:
    """The differences of one section as `--set` would write them."""
    if isinstance(value, list):
        yield f"{key}={'+'.join(item['name'] for item in value)}"
        for item in value:
            yield from _written(f"{key}.{item['name']}", {k: v for k, v in item.items() if k != "name"})
    elif isinstance(value, dict):
        if "name" in value:
            yield f"{key}={value['name']}"
        yield from (f"{key}.{name}={scalar(item)}" for name, item in value.items() if name != "name")
    else:
        yield f"{key}={scalar(value)}"


def _general() -> Iterator[str]:
    settings = Settings()
    yield from ("## general", "")
    yield from _table(settings, [key for key, field in Settings.model_fields.items() if _is_plain(field.annotation)])
    for key in _plain_sections():
        section: BaseModel = getattr(settings, key)
        yield from (f"## {key}", "", str(Settings.model_fields[key].description), "")
        yield from _table(section, list(type(section).model_fields))


def _plain_sections() -> list[str]:
    """Groups of settings that no strategy brings."""
    settings = Settings()
    return [key for key, value in settings if key not in FAMILIES and isinstance(value, BaseModel)]


def _is_plain(annotation: Any) -> bool:
    return annotation in (str, int, float, bool)


def _family(key: str, strategies: Iterable[type[Strategy]]) -> Iterator[str]:
    yield from (f"## {key}", "", str(Settings.model_fields[key].description), "")
    default = getattr(Settings(), key)
    used = default if isinstance(default, tuple) else (default,)
    for strategy in strategies:
        made = strategy()
        name = getattr(made, "name", "")
        mark = " (default)" if any(isinstance(one, strategy) for one in used) else ""
        yield from (f"### {key}={name}{mark}", "", first_sentence(strategy), "")
        yield from _table(made, [field for field in strategy.model_fields if field != "name"])


def _table(settings: BaseModel, keys: Iterable[str]) -> Iterator[str]:
    rows = []
    for key in keys:
        field = type(settings).model_fields[key]
        choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
        named = f" One of {', '.join(f'`{choice}`' for choice in choices)}." if choices else ""
        value = getattr(settings, key)
        shown = "" if value == "" else f"`{scalar(value)}`"
        meaning = f"{field.description}{named}".replace("|", "\\|")
        rows.append(f"| `{key}` | {shown} | {meaning} |")
    if rows:
        yield from ("| setting | default | meaning |", "|---|---|---|", *rows, "")


def _renamed() -> Iterator[str]:
    yield from ("## renamed settings", "", "An old name is an error that says the new one.", "")
    yield from ("| before | now |", "|---|---|")
    for section, strategies in SETTINGS.items():
        for strategy, keys in strategies.items():
            where = f" (`{strategy}`)" if strategy else ""
            yield from (f"| `{section}.{old}`{where} | `{section}.{new}` |" for old, new in keys.items())
    for section, names in STRATEGIES.items():
        yield from (f"| `{section}={old}` | `{section}={new}` |" for old, new in names.items())


if __name__ == "__main__":
    sys.stdout.write(page())
