"""Which of two workspaces of the same images is better, and by what."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

# Differences that are not chance, as a share of the larger value.
_ERROR_SHARE, _MATCHES_SHARE = 0.1, 0.05


@dataclass(frozen=True)
class Standing:
    """What speaks for one side; None where it is not known.

    verdict: as `aeromatch run` says it. oriented: images of those in both. check_m: error at check points, root mean
    square of their distances, and checks: which these are. empty: ninths of images without a point though other images
    show them. matches: verified ones of pairs of images in both.
    """

    verdict: str | None
    oriented: int | None
    check_m: float | None
    checks: frozenset[str]
    empty: int | None
    matches: int


@dataclass(frozen=True)
class Criterion:
    """what: its name; first, second: the values as they are shown; better: "first", "second" or "neither"."""

    what: str
    first: str
    second: str
    better: str


def criteria(one: Standing, two: Standing) -> list[Criterion]:
    """All that can be compared, the gravest first."""
    return list(_criteria(one, two))


def verdict_lines(found: Sequence[Criterion]) -> list[str]:
    """Which side is better by the gravest criterion in which they differ, and what else differs."""
    apart = [one for one in found if one.better != "neither"]
    if not apart:
        return [f"better      neither: they differ in nothing that counts ({', '.join(one.what for one in found)})"]
    winner = apart[0].better
    lines = [f"better      the {winner}: {_words(apart[0])}"]
    for words, same in (("and", True), ("but", False)):
        rest = [one for one in apart[1:] if (one.better == winner) == same]
        lines += [f"            {words} the {one.better} in: {_words(one)}" for one in rest]
    return lines


def as_facts(found: Sequence[Criterion]) -> dict[str, Any]:
    """JSON-ready."""
    apart = [one.better for one in found if one.better != "neither"]
    return {"better": apart[0] if apart else "neither", "criteria": [asdict(one) for one in found]}


def _words(one: Criterion) -> str:
    return f"{one.what}, {one.first} in the first and {one.second} in the second"


def _criteria(one: Standing, two: Standing) -> Iterator[Criterion]:
    if one.verdict is not None and two.verdict is not None:
        order = ("bad", "doubtful", "good")
        yield _larger("result", (order.index(one.verdict), order.index(two.verdict)), (one.verdict, two.verdict))
    if one.oriented is not None and two.oriented is not None:
        yield _larger("images oriented", (one.oriented, two.oriented))
    if one.check_m is not None and two.check_m is not None and one.checks == two.checks:
        shown = f"{one.check_m:.3f} m", f"{two.check_m:.3f} m"
        yield _larger("error at check points", (-one.check_m, -two.check_m), shown, _ERROR_SHARE)
    if one.empty is not None and two.empty is not None:
        shown = str(one.empty), str(two.empty)
        yield _larger("parts of images without points", (-one.empty, -two.empty), shown, _ERROR_SHARE)
    yield _larger("verified matches", (one.matches, two.matches), None, _MATCHES_SHARE)


def _larger(
    what: str, values: tuple[float, float], shown: tuple[str, str] | None = None, share: float = 0.0
) -> Criterion:
    """share: of the larger magnitude, by which values may differ without being better."""
    first, second = values
    even = abs(first - second) <= share * max(abs(first), abs(second))
    words = shown or (f"{first:,}", f"{second:,}")
    return Criterion(what, *words, "neither" if even else "first" if first > second else "second")
