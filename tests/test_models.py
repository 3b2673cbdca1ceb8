"""Which of two mapped first passes is taken."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from aeromatch_cli.stages.models import Mapped


class _Model:
    def __init__(self, images: int, contradiction: str) -> None:
        self.rotations = dict.fromkeys(range(images))
        self.figures = SimpleNamespace(contradiction=contradiction)


def mapped(sizes: tuple[int, ...], contradiction: str = "") -> Mapped:
    models: Any = tuple(_Model(size, contradiction) for size in sizes)
    nothing: Any = None
    return Mapped(nothing, nothing, nothing, models)


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
