"""Pairs of a row that put their questions to a network together, where the matcher is faster that way."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from aeromatch_cli.data import Features, Matches
from aeromatch_cli.executor import guarded
from aeromatch_cli.stages.rows import PairTask
from aeromatch_cli.strategies import Asking, Matcher

log = logging.getLogger(__name__)
# Pairs whose features and questions are in memory at once.
_TOGETHER = 32


@dataclass(frozen=True, eq=False)
class _Turn:
    """How far a pair has come. questions: that it waits for the answers of; matches: None until it has ended."""

    steps: Generator[Sequence[Any], Sequence[Any], Matches]
    questions: Sequence[Any]
    matches: Matches | None = None


def asked_together(
    matcher: Matcher, pairs: Sequence[PairTask], sides: Callable[[PairTask], tuple[Features, Features]]
) -> dict[str, Matches]:
    """Matches by image_id1; none where the matcher takes pairs one by one.

    A pair that fails here is left out: matched by itself it fails again, and says why, or gets along with less memory.
    """
    if not (isinstance(matcher, Asking) and matcher.asks_together) or len(pairs) < 2:
        return {}
    found: dict[str, Matches] = {}
    for start in range(0, len(pairs), _TOGETHER):
        found |= _of_some(matcher, pairs[start : start + _TOGETHER], sides)
    return found


def _of_some(
    matcher: Asking, pairs: Sequence[PairTask], sides: Callable[[PairTask], tuple[Features, Features]]
) -> dict[str, Matches]:
    turns = {}
    for pair in pairs:
        begun = guarded(lambda task: _sent(matcher.steps(*sides(task), task.geometry)), pair)
        if begun.value is not None:
            turns[pair.image_id1] = begun.value
    while waiting := {image_id1: turn for image_id1, turn in turns.items() if turn.matches is None}:
        asked = guarded(matcher.answers, [question for turn in waiting.values() for question in turn.questions])
        if asked.value is None:
            log.warning("the network is asked pair by pair: %s", asked.error)
            break
        answers = iter(asked.value)
        for image_id1, turn in waiting.items():
            own = [next(answers) for _ in turn.questions]
            ended = guarded(partial(_sent, turn.steps), own)
            if ended.value is None:
                del turns[image_id1]
            else:
                turns[image_id1] = ended.value
    return {image_id1: turn.matches for image_id1, turn in turns.items() if turn.matches is not None}


def _sent(steps: Generator[Sequence[Any], Sequence[Any], Matches], answers: Sequence[Any] | None = None) -> _Turn:
    """On to the next questions, or to the end."""
    try:
        return _Turn(steps, next(steps) if answers is None else steps.send(answers))
    except StopIteration as end:
        return _Turn(steps, (), end.value)
