"""Results of stages of which a test states only what it is about."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel

T = TypeVar("T", bound=BaseModel)
NOTHING: dict[Any, Any] = {int: 0, float: 0.0, str: "", bool: False}


def filled(kind: type[T], values: Mapping[str, Any] | None = None, /, **more: Any) -> T:
    """A record with these values, and with zeros, empty texts and empty lists for what it needs besides."""
    given = {**(values or {}), **more}
    made = {}
    for name, field in kind.model_fields.items():
        if name in given:
            made[name] = _filled(field.annotation, given.pop(name))
        elif field.is_required():
            made[name] = _nothing(field.annotation)
    assert not given, f"{kind.__name__} has no {', '.join(given)}"
    return kind(**made)


def _filled(annotation: Any, value: Any) -> Any:
    """Records inside a value, filled as well."""
    inner = get_args(annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel) and isinstance(value, Mapping):
        return filled(annotation, value)
    if get_origin(annotation) is list:
        return [_filled(inner[0], one) for one in value]
    if get_origin(annotation) is dict:
        return {key: _filled(inner[1], one) for key, one in value.items()}
    for one in inner:
        if isinstance(one, type) and issubclass(one, BaseModel) and isinstance(value, Mapping):
            return filled(one, value)
    return value


def _nothing(annotation: Any) -> Any:
    inner, origin = get_args(annotation), get_origin(annotation)
    if origin in (list, dict):
        return origin()
    if origin is tuple:
        return tuple(_nothing(one) for one in inner)
    if annotation in NOTHING:
        return NOTHING[annotation]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return filled(annotation)
    if inner and all(isinstance(one, str) for one in inner):  # Literal
        return inner[0]
    if type(None) in inner:
        return None
    raise TypeError(f"no value for {annotation}")
