"""Pairs of one row that run a network together, where the matcher is faster that way."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from aeromatch_cli.data import Features, Matches
from aeromatch_cli.executor import guarded
from aeromatch_cli.stages.driver import PairTask
from aeromatch_cli.strategies import BatchedMatcher, Matcher

log = logging.getLogger(__name__)
# Pairs whose features and network inputs are in memory at once.
_BATCH_PAIRS = 32


@dataclass(frozen=True, eq=False)
class _Running:
    """The state of one pair. inputs: of the network, whose outputs it waits for; matches: None until it has ended."""

    steps: Generator[Sequence[Any], Sequence[Any], Matches]
    inputs: Sequence[Any]
    matches: Matches | None = None


def matched_in_batches(
    matchers: Mapping[str, Matcher],
    pairs: Sequence[PairTask],
    sides: Callable[[PairTask], tuple[Features, Features]],
) -> dict[str, Matches]:
    """Match pairs in batches; return matches by image_id1, none where a matcher takes pairs one by one.

    A pair that fails here is left out: it is matched by itself, and fails again with its reason, or needs less memory.
    """
    found: dict[str, Matches] = {}
    for matcher in dict.fromkeys(matchers.values()):
        own = [pair for pair in pairs if matchers[pair.image_id1] == matcher]
        if not (isinstance(matcher, BatchedMatcher) and matcher.batches_pairs) or len(own) < 2:
            continue
        for start in range(0, len(own), _BATCH_PAIRS):
            found |= _one_batch(matcher, own[start : start + _BATCH_PAIRS], sides)
    return found


def _one_batch(
    matcher: BatchedMatcher, pairs: Sequence[PairTask], sides: Callable[[PairTask], tuple[Features, Features]]
) -> dict[str, Matches]:
    running = {}
    for pair in pairs:
        begun = guarded(lambda task: _resumed(matcher.steps(*sides(task), task.geometry)), pair)
        if begun.value is not None:
            running[pair.image_id1] = begun.value
    while waiting := {image_id1: state for image_id1, state in running.items() if state.matches is None}:
        outcome = guarded(matcher.run_network, [item for state in waiting.values() for item in state.inputs])
        if outcome.value is None:
            log.warning("the network runs pair by pair: %s", outcome.error)
            break
        outputs = iter(outcome.value)
        for image_id1, state in waiting.items():
            own = [next(outputs) for _ in state.inputs]
            ended = guarded(partial(_resumed, state.steps), own)
            if ended.value is None:
                del running[image_id1]
            else:
                running[image_id1] = ended.value
    return {image_id1: state.matches for image_id1, state in running.items() if state.matches is not None}


def _resumed(steps: Generator[Sequence[Any], Sequence[Any], Matches], outputs: Sequence[Any] | None = None) -> _Running:
    """The pair at its next inputs, or at its end."""
    try:
        return _Running(steps, next(steps) if outputs is None else steps.send(outputs))
    except StopIteration as end:
        return _Running(steps, (), end.value)
