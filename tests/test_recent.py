"""What is kept of costly things: the ones asked for lately."""

from __future__ import annotations

from aeromatch_cli.recent import recent


def test_the_one_not_asked_for_longest_goes() -> None:
    store: dict[str, int] = {}
    made: list[str] = []

    def ask(key: str) -> int:
        def make() -> int:
            made.append(key)
            return len(made) - 1  # 0, too, is a value

        return recent(store, key, make, 2)

    assert [ask(key) for key in "abacab"] == [0, 1, 0, 2, 0, 3]
    assert made == ["a", "b", "c", "b"]
    assert list(store) == ["a", "b"]
