"""The driver of stages whose items are images or pairs: what is not up to date is made, the rest is counted.

All pairs of one image are a row: one task and one file, in which single pairs are made again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from aeromatch_cli.data import PairGeometry
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.executor import Outcome, guarded
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.stage_report import StageReport

S = TypeVar("S")
V = TypeVar("V")


class ImageTask(Protocol):
    """Asks for what a stage makes of one image, which must carry the fingerprint."""

    @property
    def image_id(self) -> str: ...

    @property
    def fingerprint(self) -> str: ...


class Entry(Protocol):
    """Requires of an entry of a row, which holds one pair, that it states its fingerprint."""

    @property
    def fingerprint(self) -> str: ...


E = TypeVar("E", bound=Entry)


@dataclass(frozen=True, eq=False)
class PairTask:
    """One pair of a row: its geometry, the fingerprint that its result must carry, the fingerprints of both images'
    features, and the seed of what is random."""

    geometry: PairGeometry
    fingerprint: str
    features: tuple[str, str]
    seed: int = 0

    @property
    def image_id1(self) -> str:
        return self.geometry.pair.image_id1


class RowTask(Protocol):
    """Asks for all pairs of one image."""

    @property
    def image_id0(self) -> str: ...

    @property
    def pairs(self) -> tuple[PairTask, ...]: ...


class Known(Protocol):
    """Requires of what is known of a pair on file that it says of what the pair was made."""

    @property
    def fingerprint(self) -> str: ...


I = TypeVar("I", bound=ImageTask)  # noqa: E741
K = TypeVar("K", bound=Known)
T = TypeVar("T", bound=RowTask)


@dataclass(frozen=True)
class RowResult(Generic[K]):
    """What became of a row. done, found: pairs that were made now, and their matches. failures: ("id0 id1", reason).
    known: of all pairs that are on file now, by image_id1."""

    image_id0: str
    done: int
    found: int
    failures: tuple[tuple[str, str], ...]
    known: Mapping[str, K]


@dataclass(frozen=True, eq=False)
class Row(Generic[E]):
    """entries: of all pairs that could be made, in order; made: the new ones among them; failures: (pair, reason)."""

    entries: tuple[E, ...]
    made: tuple[E, ...]
    failures: tuple[tuple[str, str], ...]


def redo(image_id0: str, pairs: Sequence[PairTask], old: Mapping[str, E], make: Callable[[PairTask], E]) -> Row[E]:
    """Keep the entries that carry the wanted fingerprint, make the others; one failing pair does not stop the rest."""
    entries, made, failures = [], [], []
    wanted = {pair.image_id1 for pair in missing(pairs, old)}
    for pair in pairs:
        entry = old.get(pair.image_id1)
        if entry is None or pair.image_id1 in wanted:
            outcome = guarded(make, pair)
            if outcome.value is None:
                failures.append((f"{image_id0} {pair.image_id1}", outcome.error))
                continue
            entry = outcome.value
            made.append(entry)
        entries.append(entry)
    return Row(tuple(entries), tuple(made), tuple(failures))


def missing(pairs: Sequence[PairTask], old: Mapping[str, E]) -> list[PairTask]:
    """Return the pairs without an entry that carries the wanted fingerprint."""
    on_file = {image_id1: entry.fingerprint for image_id1, entry in old.items()}
    return [pair for pair in pairs if on_file.get(pair.image_id1) != pair.fingerprint]


def readable(read: Callable[[Path], dict[str, E]], path: Path, overwrite: bool) -> dict[str, E]:
    """Return the row on file as far as it is wanted and can be read: a broken file is made again."""
    if overwrite:
        return {}
    try:
        return read(path)
    except BrokenFileError:
        return {}


def run_images(
    context: Context,
    report: StageReport,
    work: Callable[[I], V],
    tasks: Sequence[I],
    is_done: Callable[[I], bool],
    *,
    network: bool = False,
) -> list[V]:
    """Make what is not up to date of a stage's images, and count them in the report; return what was made.

    work: makes what belongs to an image. is_done: whether that is on file as the task would make it. network: whether
    the tasks run one.
    """
    todo = [task for task in tasks if context.scope.overwrite or not is_done(task)]
    report.items += len(tasks)
    report.skipped += len(tasks) - len(todo)
    report.fingerprint = fingerprint(report.fingerprint, [task.fingerprint for task in tasks])
    return run_stage(context, report, work, todo, [task.image_id for task in todo], network=network)


def run_rows(
    context: Context,
    report: StageReport,
    work: Callable[[T], RowResult[K]],
    tasks: Sequence[T],
    on_file: Callable[[str], Mapping[str, K]],
    learn: Callable[[str, Mapping[str, K]], None],
    *,
    network: bool = False,
) -> list[RowResult[K]]:
    """Bring the rows of a stage up to date, and count its pairs in the report; return what became of those that were
    not. A row is up to date where it holds exactly the wanted pairs, each of the wanted fingerprint.

    work: makes a row. on_file: gives what is known of a row by its image_id0. learn: is told what it holds now.
    network: whether the tasks run one.
    """
    todo, anew = [], context.scope.overwrite
    for task in tasks:
        known = {image_id1: one.fingerprint for image_id1, one in on_file(task.image_id0).items()}
        wanted = {pair.image_id1: pair.fingerprint for pair in task.pairs}
        report.items += len(wanted)
        report.skipped += 0 if anew else sum(known.get(i) == made_of for i, made_of in wanted.items())
        if anew or known != wanted:
            todo.append(task)
    names, sizes = [task.image_id0 for task in todo], [len(task.pairs) for task in todo]
    results = run_stage(context, report, work, todo, names, sizes, network=network)
    for result in results:
        learn(result.image_id0, result.known)
        report.failures.extend(result.failures)
    context.index.flush()
    report.done = sum(result.done for result in results)
    return results


def run_stage(
    context: Context,
    report: StageReport,
    function: Callable[[S], V],
    tasks: Sequence[S],
    names: Sequence[str],
    sizes: Sequence[int] | None = None,
    *,
    network: bool = False,
) -> list[V]:
    """Run tasks, put failures into the report under their names, return the values of the rest.

    sizes: how many items each task counts while it is shown how far the stage is. network: whether tasks run one.
    """
    label = context.scope.part + report.stage
    outcomes: list[Outcome[V]] = context.executor.run(function, tasks, label, sizes, network=network) if tasks else []
    values = []
    for name, outcome in zip(names, outcomes, strict=True):
        if outcome.value is None:
            report.failures.append((name, outcome.error))
        else:
            values.append(outcome.value)
    report.done += len(values)
    return values
