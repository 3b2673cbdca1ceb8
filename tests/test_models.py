"""Which of two mapped first passes is taken, and which parts of models are mapped by themselves."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from aeromatch_cli.errors import InputError
from aeromatch_cli.stages import models
from aeromatch_cli.stages.models import Mapped


class _Model:
    def __init__(self, images: int, contradiction: str) -> None:
        self.rotations = dict.fromkeys(range(images))
        self.figures = SimpleNamespace(contradiction=contradiction)


def mapped(sizes: tuple[int, ...], contradiction: str = "") -> Mapped:
    found: Any = tuple(_Model(size, contradiction) for size in sizes)
    nothing: Any = None
    return Mapped(nothing, nothing, nothing, found)


@pytest.mark.parametrize(("new", "old", "taken"), [
    (mapped((6,)), mapped((3, 3)), True),
    (mapped((6,)), mapped((6,)), False),
    (mapped((5,)), mapped((3, 3)), False),  # an image would be lost
    (mapped((4, 2)), mapped((3, 3)), True),
    (mapped((5,)), mapped((3, 3), "mirrored"), True),  # those lie at wrong places anyway
    (mapped((3,)), mapped(()), True),
    (mapped((6,), "scattered"), mapped((5, 1)), False),
    (mapped((19,), "scattered"), mapped((3, 3)), True),  # three images fit positions by chance
    (mapped((19,), "scattered"), mapped((10, 9)), False),
])  # fmt: skip
def test_the_larger_model_is_taken_where_nothing_is_lost_for_it(new: Mapped, old: Mapped, taken: bool) -> None:
    assert new.beats(old) is taken


def parts_of(
    monkeypatch: pytest.MonkeyPatch, sound: dict[str, str], again: Callable[[set[str]], tuple[SimpleNamespace, ...]]
) -> tuple[list[SimpleNamespace], list[set[str]]]:
    """What `_sound_parts` makes of one model of the images abcdef, and which images were mapped once more.

    sound: name of a model -> its images that explain their matches.
    """
    asked: list[set[str]] = []

    def mapped_again(_context: Any, _first: Any, _mapper: str, image_ids: set[str]) -> tuple[SimpleNamespace, ...]:
        asked.append(set(image_ids))
        return again(image_ids)

    monkeypatch.setattr(models, "_mapped_images", mapped_again)
    monkeypatch.setattr(models, "_sound", lambda _context, _evidence, model: model_of(sound[model.name], model.name))
    monkeypatch.setattr(models, "only", lambda model, image_ids: model)
    nothing: Any = None
    whole: Any = model_of("abcdef", "whole")
    return models._sound_parts(nothing, nothing, nothing, "global", [whole]), asked  # type: ignore[return-value]


def model_of(image_ids: str, name: str) -> SimpleNamespace:
    return SimpleNamespace(rotations=dict.fromkeys(image_ids), name=name)


def test_a_part_of_a_model_is_mapped_by_itself_where_others_were_in_wrong_places(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two triples of images that share one: the mapper puts the second anywhere, and levels both together."""
    sound = {"whole": "abcd", "alone": "abcd"}
    (part,), asked = parts_of(monkeypatch, sound, lambda ids: (model_of("abcd", "alone"),))
    assert (part.name, asked) == ("alone", [set("abcd")])


@pytest.mark.parametrize(
    ("sound", "made", "mapped_again"),
    [
        ({"whole": "abcde"}, None, False),  # nearly all of them
        ({"whole": "abcd", "alone": "abc"}, "abcd", True),  # an image would be lost
        ({"whole": "abcd"}, None, True),  # the mapper stops, or finds nothing
    ],
)
def test_else_the_part_stays_as_it_is(
    monkeypatch: pytest.MonkeyPatch, sound: dict[str, str], made: str | None, mapped_again: bool
) -> None:
    def again(_image_ids: set[str]) -> tuple[SimpleNamespace, ...]:
        if made is None:
            raise InputError("the mapper stopped")
        return (model_of(made, "alone"),)

    (part,), asked = parts_of(monkeypatch, sound, again)
    assert (part.name, bool(asked)) == ("whole", mapped_again)
    assert parts_of(monkeypatch, {"whole": "abcd"}, lambda ids: ())[0][0].name == "whole"
