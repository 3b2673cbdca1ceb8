"""The commented default configuration, made from the schema.

To bring the file up to date: `python -m aeromatch_cli.config.text > configs/default.yaml`.
"""

from __future__ import annotations

import inspect
import sys
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel

from aeromatch_cli.config import FAMILIES, Settings
from aeromatch_cli.strategies import Strategy

_WIDTH = 100
_HEADING = """\
Every setting with its default and meaning. A configuration of your own needs only what differs from
a preset, named by its key `preset` (auto if it names none; `preset: baseline` is what stands here).
Paths are relative to the file that they stand in. On the command line
`--set extract.keypoints=12000` changes one setting, `--set match=NAME` takes another strategy, and
`--set filter.poselib.threshold_px=2` reaches into a chain; a chain is also written NAME+NAME.
Strategies that are not the default follow their section as comments.
Made by `python -m aeromatch_cli.config.text`; edit the descriptions in the code, not this file."""


def default_yaml() -> str:
    """The tree of defaults as YAML; every key in order, its description above it, other strategies as comments."""
    settings = Settings()
    lines = [f"# {line}" for line in _HEADING.splitlines()] + [""]
    for key, field in Settings.model_fields.items():
        value = getattr(settings, key)
        lines += _comment(field.description)
        if key in FAMILIES:
            lines += [*_family(key, FAMILIES[key], value), ""]
        elif isinstance(value, BaseModel):
            lines += [f"{key}:", *_indented(_settings_lines(value)), ""]
        else:
            lines += [f"{key}: {scalar(value)}", ""]
    return "\n".join(lines[:-1]) + "\n"


def _family(key: str, table: Mapping[str, type[Strategy]], value: Any) -> Iterator[str]:
    """A section that chooses among strategies: the default, then the others as comments."""
    chained = isinstance(value, tuple)
    used = value if chained else (value,)
    yield from _comment(f"Names: {', '.join(table)}")
    yield f"{key}:" if used else f"{key}: []"
    for strategy in used:
        yield from _indented(_strategy_lines(strategy, chained=chained))
    for strategy_class in table.values():
        if not any(isinstance(strategy, strategy_class) for strategy in used):
            other = [f"{key}:", *_indented(_strategy_lines(strategy_class(), chained=chained))]
            yield from ("#" if not line else f"# {line}" for line in ["", *other])


def _strategy_lines(strategy: Strategy, *, chained: bool) -> list[str]:
    """What the strategy is, in its docstring's first sentence, and its settings; in a chain as a list item."""
    lines = list(_settings_lines(strategy))
    if chained:
        lines = [f"- {lines[0]}", *_indented(lines[1:])]
    return [*_comment(first_sentence(type(strategy))), *lines]


def _settings_lines(settings: BaseModel) -> Iterator[str]:
    fields = type(settings).model_fields
    for key, field in sorted(fields.items(), key=lambda item: item[0] != "name"):  # stable: the rest keeps its order
        yield from _comment(field.description)
        if get_origin(field.annotation) is Literal and key != "name":
            yield from _comment(f"One of: {', '.join(map(str, get_args(field.annotation)))}")
        yield f"{key}: {scalar(getattr(settings, key))}"


def first_sentence(strategy: type[Strategy]) -> str:
    """What a strategy is, in the first sentence of its docstring."""
    words = " ".join((inspect.getdoc(strategy) or "").split())
    return words.split(". ")[0].rstrip(".") + "."


def _comment(text: str | None) -> list[str]:
    """Comment lines; none without text."""
    return [f"# {line}" for line in textwrap.wrap(" ".join(text.split()), _WIDTH)] if text else []


def _indented(lines: Any) -> list[str]:
    return [f"  {line}" for line in lines]


def scalar(value: Any) -> str:
    """A setting's value as YAML on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    return (
        yaml.safe_dump(plain, default_flow_style=True, allow_unicode=True, width=10_000).removesuffix("...\n").strip()
    )


if __name__ == "__main__":
    sys.stdout.write(default_yaml())
