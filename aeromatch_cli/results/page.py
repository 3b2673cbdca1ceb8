"""The part of docs/workspace.md that describes the results of stages, made from their types."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator
from typing import Any, get_args, get_origin, get_type_hints

from pydantic import BaseModel

from aeromatch_cli.results.stages import StageResult

_WIDTH = 118


def text(kinds: Iterable[type[StageResult]]) -> str:
    """Markdown: the result of every stage, then the types that these are made of."""
    lines, inner = [], dict[str, type]()
    for kind in kinds:
        lines += [f"### Result of {kind.stage}", "", *_described(kind, inner), ""]
    described = set[str]()
    while left := [name for name in inner if name not in described]:
        described.add(left[0])
        lines += [f"#### {left[0]}", "", *_described(inner[left[0]], inner), ""]
    return "\n".join(lines).rstrip() + "\n"


def _described(kind: type, inner: dict[str, type]) -> Iterator[str]:
    """The docstring and the fields of a type; types of its fields that are described elsewhere are added to `inner`."""
    yield from textwrap.wrap(" ".join((kind.__doc__ or "").split()), _WIDTH)
    yield ""
    if not issubclass(kind, BaseModel):
        yield from ("In JSON it is a list of:", "")
    for name, annotation, words in _fields(kind):
        inner.update({one.__name__: one for one in _records(annotation)})
        shown = f"- `{name}` ({_words(annotation)})" + (f": {words}" if words else "")
        yield from textwrap.wrap(shown, _WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def _fields(kind: type) -> Iterator[tuple[str, Any, str]]:
    if issubclass(kind, BaseModel):
        for name, field in kind.model_fields.items():
            yield name, field.annotation, field.description or ""
    else:  # a NamedTuple is a list in JSON
        for name, annotation in get_type_hints(kind).items():
            yield name, annotation, ""


def _records(annotation: Any) -> Iterator[type]:
    """Types of a field that have fields themselves."""
    if isinstance(annotation, type) and (issubclass(annotation, BaseModel) or hasattr(annotation, "_fields")):
        yield annotation
    for inner in get_args(annotation):
        yield from _records(inner)


def _plural(words: str) -> str:
    return f"{words}s" if words in ("integer", "number", "string") else words


def _words(annotation: Any) -> str:
    """A type as readers of JSON know it."""
    inner, origin = get_args(annotation), get_origin(annotation)
    if origin is dict:
        return f"object: name -> {_words(inner[1])}"
    if origin is list:
        return f"list of {_plural(_words(inner[0]))}"
    if origin is tuple:
        return f"list of {len(inner)} {_plural(_words(inner[0]))}"
    if inner and all(isinstance(one, str) for one in inner):  # Literal
        return " or ".join(f'"{one}"' for one in inner)
    if inner:
        return " or ".join(_words(one) for one in inner)
    names = {int: "integer", float: "number", str: "string", bool: "true or false", type(None): "null"}
    if annotation in names:
        return names[annotation]
    return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
