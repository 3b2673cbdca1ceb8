"""What is wrong with a configuration, in words: the key's place, the fault, and what would be right."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from aeromatch_cli.config.renamed import DROPPED, STRATEGIES, new_key

Families = Mapping[str, Mapping[str, type[BaseModel]]]

_LONGEST_VALUE = 60
_LARGEST_WRITTEN = 1e15
# Of places where a key may belong, so many are named.
_MOST_PLACES = 3
# pydantic's fault types, in the words of someone who writes YAML.
_PHRASES = {
    "model_type": "must hold settings (key: value)",
    "model_attributes_type": "must be a strategy's name, or its settings (key: value)",
    "tuple_type": "must be a list, or names joined by +",
    "too_short": "must name at least one strategy",
    "string_type": "must be text; put it in quotes",
    "string_too_short": "must not be empty",
    "invalid_key": "keys must be text",
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
}


def describe(fault: ErrorDetails, root: type[BaseModel], families: Families) -> str:
    """Return one line for one pydantic fault. root: the whole tree's class; families: section -> its strategies."""
    location = tuple(fault["loc"])
    names = [str(part) for part in _visible(location, families)]
    place = ".".join(names)
    family = families.get(str(location[0]), {}) if location else {}
    kind = fault["type"]
    if kind == "extra_forbidden":
        return f"{place}: {_unknown_key(location, names, root, families)}"
    if kind == "union_tag_invalid":
        return f"{place.removesuffix('.name')}: {_unknown_strategy(str(location[0]), str(fault['ctx']['tag']), family)}"
    if kind == "literal_error" and family and location[-1] == "name":
        return f"{place.removesuffix('.name')}: {_unknown_strategy(str(location[0]), str(fault['input']), family)}"
    if kind == "union_tag_not_found":
        return f"{place}: name the strategy (name: ...), one of {', '.join(family)} (got {_shown(fault['input'])})"
    if fault["input"] is None and family and kind.startswith("model_"):
        return f"{place}: a value is missing; one of {', '.join(family)}"
    if kind == "value_error":
        return f"{place or 'top level'}: {fault['msg'].removeprefix('Value error, ')}"
    phrase = _PHRASES.get(kind) or fault["msg"].replace("Input should", "must")
    hint = _whole_number(fault["input"]) if kind == "int_parsing" else ""
    if kind == "literal_error":
        hint = nearest(str(fault["input"]), re.findall(r"'([^']*)'", fault["ctx"]["expected"]), otherwise="")
    return f"{place or 'top level'}: {phrase} (got {_shown(fault['input'])}){hint}"


def _unknown_key(location: tuple[Any, ...], names: Sequence[str], root: type[BaseModel], families: Families) -> str:
    """Say what to write for a key that is not known. names: of its place, as `--set` would write it."""
    section, key = str(location[0]), names[-1]
    siblings = _siblings(location[:-1], root, families)
    renamed = new_key(section, key, frozenset(siblings))
    if renamed:
        return f"this setting is now named {renamed}; write {'.'.join([*names[:-1], renamed])}"
    if len(names) == 1:
        elsewhere = _places(key, root, families)
        if elsewhere:
            return f"unknown key; did you mean {_either(elsewhere)}?"
    else:
        owners = [name for name, strategy in families.get(section, {}).items() if key in strategy.model_fields]
        if owners:
            return f"unknown key here, it belongs to {' and '.join(owners)}{nearest(key, siblings)}"
    return f"unknown key{nearest(key, siblings)}"


def _unknown_strategy(section: str, name: str, family: Mapping[str, type[BaseModel]]) -> str:
    """Say what to write for the name of a strategy that is not known."""
    renamed = STRATEGIES.get(section, {}).get(name)
    if renamed:
        return f"the strategy {name!r} is now named {renamed!r}"
    if name in DROPPED.get(section, ()):
        return f"there is no strategy {name!r} any more; take {_either(list(family))}"
    return f"no strategy is named {name!r}{nearest(name, list(family))}"


def root_faults(faults: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Without those that only follow from another: pydantic calls a chain too short when a member is invalid."""
    places = [tuple(fault["loc"]) for fault in faults]
    return [
        fault
        for fault, place in zip(faults, places, strict=True)
        if fault["type"] != "too_short" or not any(other[:-1][: len(place)] == place for other in places)
    ]


def accidents(given: Any, validated: Any, place: str = "") -> Iterator[str]:
    """Find faults that the types let through: YAML reads a bare `yes` as true, and true would pass as the number 1."""
    if isinstance(given, Mapping) and isinstance(validated, Mapping):
        for key in validated:
            if key in given:
                yield from accidents(given[key], validated[key], f"{place}.{key}" if place else str(key))
    elif isinstance(given, list) and isinstance(validated, list):
        for one, other in zip(given, validated, strict=True):
            place_of_one = f"{place}.{other['name']}" if isinstance(other, Mapping) else place
            yield from accidents(one, other, place_of_one)
    elif isinstance(given, bool) and not isinstance(validated, bool):
        yield f"{place}: must be a number (got {given!r})"
    elif isinstance(given, str) and "\0" in given:
        yield f"{place}: must not hold a null character (got {_shown(given)})"


def nearest(word: str, known: Sequence[str], *, otherwise: str | None = None) -> str:
    """`; did you mean 'x'?`, or the list of valid words (or `otherwise`) where none is close."""
    # Of few short words any is like any: `gpu` is no `cpu`.
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5 if len(known) > 3 else 0.7)
    if close:
        return f"; did you mean {close[0]!r}?"
    if otherwise is not None:
        return otherwise
    return f"; valid here: {', '.join(known)}" if known else ""


def _places(key: str, root: type[BaseModel], families: Families) -> list[str]:
    """Where settings of this name stand: sections first, then the default strategies', then those of others."""
    defaults = root()
    found: dict[str, int] = {}
    for section in root.model_fields:
        value = getattr(defaults, section)
        if section not in families:
            if isinstance(value, BaseModel) and key in type(value).model_fields:
                found[f"{section}.{key}"] = 0
            continue
        chained = isinstance(value, tuple)
        chosen = {type(one) for one in (value if chained else (value,))}
        for name, strategy in families[section].items():
            if key in strategy.model_fields:
                place = f"{section}.{name}.{key}" if chained else f"{section}.{key}"
                found[place] = min(found.get(place, 2), 1 if strategy in chosen else 2)
    return [place for place, _ in sorted(found.items(), key=lambda item: item[1])][:_MOST_PLACES]


def _either(words: Sequence[str]) -> str:
    quoted = [repr(word) for word in words]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} or {quoted[-1]}"


def _whole_number(value: Any) -> str:
    """`; write 1000` for 1e3, which YAML reads as text."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return ""
    return f"; write {number:.0f}" if number.is_integer() and abs(number) < _LARGEST_WRITTEN else ""


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 4] + " ..."


def _visible(location: tuple[Any, ...], families: Families) -> Iterator[Any]:
    """The location as `--set` would write it: without chain positions and the union tags that pydantic puts in."""
    family = families.get(str(location[0])) if location else None
    if family is None or len(location) < 2:
        yield from (part for part in location if not isinstance(part, int))
        return
    section, second, *others = location
    yield section
    if isinstance(second, int):
        # A chain's member is told by its name, which pydantic leaves out where the family has only one.
        if len(family) == 1 and others:
            yield next(iter(family))
    elif len(family) == 1 or second not in family:
        yield second
    yield from (part for part in others if not isinstance(part, int))


def _siblings(location: tuple[Any, ...], root: type[BaseModel], families: Families) -> list[str]:
    """The keys that are valid at a place."""
    family = families.get(str(location[0])) if location else None
    if family is not None:
        named = [family[part] for part in location[1:] if part in family]
        # pydantic leaves out the name where the family has only one.
        strategy = named[0] if named else next(iter(family.values()))
        return list(strategy.model_fields)
    model: Any = root
    for part in location:
        model = model.model_fields[part].annotation
    return list(model.model_fields)
